"""Which machines the formats of LinuxCNC take."""

from ..machine import IdentifiedMachine

AXES = ("X", "Y", "Z")


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
