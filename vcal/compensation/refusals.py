"""Which machines formats do not take, with the reason in a sentence."""

from .machine import IdentifiedMachine

AXES = ("X", "Y", "Z")
"""The linear axes that formats of machine tools take."""


def refuse_axes(machine: IdentifiedMachine) -> str | None:
    """Why a machine is not taken: it has other than the linear axes X, Y and Z."""
    others = [axis for axis in machine.axes if axis not in AXES]
    if not others:
        return None
    what = "the joints of an arm" if machine.chain.arm else "the axes"
    return (
        f"found {what} {', '.join(others)}, expected the linear axes X, Y and Z only: rotary and "
        "secondary axes need kinematics that this format does not write; leave them out of the "
        "machine, or choose another format"
    )


def refuse_travel(machine: IdentifiedMachine) -> str | None:
    """Why a machine has no tables: an axis without a travel."""
    short = [a for a, (low, high) in zip(machine.axes, machine.volume, strict=True) if low >= high]
    if not short:
        return None
    return (
        f"found no travel of {', '.join(short)}, expected two different ends: a table has a "
        "distance between its points; declare [machine] travel"
    )
