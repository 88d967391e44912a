"""`vcal compensate --nc`: the corrected positions of an NC program."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import StudyError
from .session import say

if TYPE_CHECKING:
    from ..compensation import IdentifiedMachine
    from ..compensation.nc import NcOptions


def corrected_program(
    machine: "IdentifiedMachine",
    program: Path,
    out: Path,
    options: "NcOptions",
    at: dict[str, float],
) -> None:
    """Write the corrected program, and print its report."""
    from ..compensation.nc import correct_file
    from ..compensation.nc_displacement import nc_displacement

    if out.is_dir():
        raise StudyError(
            f"{out}: found a folder, expected a file for the corrected program; give its name"
        )
    displacement = nc_displacement(machine, at)
    travel = dict(zip(machine.axes, (1e3 * machine.volume).tolist(), strict=True))
    options = replace(options, travels_mm=[travel[axis] for axis in "XYZ"])
    report = correct_file(program, out, displacement, options)
    say(report.text())
    say(f"Wrote {out}.")


def nc_options(
    tolerance: float | None, offsets: Sequence[str], codes: Sequence[str]
) -> "NcOptions":
    """Options from the command line: ``G54=150,80,-300`` for a work offset in mm. Raises
    `StudyError` for texts of another form and for values out of range.
    """
    from ..compensation.nc import NcOptions

    given: dict[str, tuple[float, ...]] = {}
    for text in offsets:
        name, _, values = text.partition("=")
        try:
            given[name.strip()] = tuple(float(value) for value in values.split(","))
        except ValueError as error:
            raise StudyError(
                f"--work-offset: found {text!r}, expected NAME=X,Y,Z in mm, such as "
                "G54=150,80,-300; correct it"
            ) from error
    um = NcOptions.tolerance_um if tolerance is None else tolerance
    return NcOptions(tolerance_um=um, work_offsets_mm=given, ignored_codes=tuple(codes))
