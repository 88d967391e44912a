"""HEIDENHAIN: nonlinear axis error compensation with ``.COM`` and ``.CMA`` tables.

A ``.COM`` table belongs to one axis. Its rows are positions of this axis (``AXISPOS``, from the
machine datum); a column per axis holds the error of that axis there, and ``BACKLASH`` the value of
the axis itself in the negative direction of traverse. The ``.CMA`` table names the ``.COM`` table
of every axis; its row with ``*`` is active. The control subtracts the errors, linear between the
points: Z = F(Y) is the column Z of the table of Y.

Not found in the public pages: the text form of the two tables, for which that of other tables of
the controls is taken (BEGIN, column names, numbered rows, [END]); what holds beyond a table, for
which the value at its edge is taken; the resolution, for which that of the machine parameters of
the same chapter is taken (0.0001 mm); and the sign of a nonlinear error, for which that of the
linear one is taken (MP720: positive where the travel is too long). The limits are those of the TNC
407: 256 points per table, and a difference of neighbours of at most their distance / 64.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from pydantic import Field as Key

from ..base import FORMATS, Covariates, Format, Options, Tables, at_inside
from ..fields import spaced
from ..headers import conditions_in_words, header
from ..lines import Line, lines_of
from ..machine import IdentifiedMachine
from ..refusals import refuse_axes, refuse_travel

_MOST, _SLOPE = 256, 64.0
_STEP_M, _DIGITS = 1e-7, 4


class HeidenhainOptions(Options):
    """Options of the compensation-value tables."""

    points: int = Key(default=101, ge=2, le=_MOST, description="compensation points per axis")


@dataclass(frozen=True)
class HeidenhainTables(Tables):
    """The values as they stand in the tables."""

    machine: IdentifiedMachine
    at: Mapping[str, float]
    lines: tuple[Line, ...]
    """Corrections: minus the errors."""

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        del covariates
        column = {axis: i for i, axis in enumerate(self.machine.axes)}
        found = np.zeros_like(position)
        for line in self.lines:
            by = column[line.by]
            found[:, column[line.corrected]] += line.at(position[:, by], directions[:, by])
        return found

    @cached_property
    def files(self) -> Mapping[str, str]:
        axes = self.machine.axes
        found = {f"{axis.lower()}.com": list(self._com(axis)) for axis in axes}
        names = " ".join(f"{axis.lower()}.com" for axis in axes)
        found["config.cma"] = [
            "BEGIN config.cma",
            f"NR ACTIVE {' '.join(axes)}",
            f"0 * {names}",
            "[END]",
        ]
        about = [
            *header(self.machine, Heidenhain),
            *conditions_in_words(self.machine, None, self.at),
        ]
        found["readme.txt"] = [*about, "", *self._readme()]
        return {name: "\n".join(lines) + "\n" for name, lines in found.items()}

    def _com(self, by: str) -> Iterator[str]:
        lines = {line.corrected: line for line in self.lines if line.by == by}
        yield f"BEGIN {by.lower()}.com MM"
        yield f"NR AXISPOS BACKLASH {' '.join(lines)}"
        columns = [lines[by].nodes, -lines[by].down, *(-line.up for line in lines.values())]
        for n, row in enumerate(1e3 * np.stack(columns, 1)):
            yield " ".join([str(n), *(f"{v + 0.0:+.{_DIGITS}f}" for v in row)])
        yield "[END]"

    @staticmethod
    def _readme() -> Iterator[str]:
        yield "1. The text form of .COM and .CMA tables is not in the public pages: create tables"
        yield "   with these columns on the control, compare, and import or enter the rows."
        yield "2. Select nonlinear compensation for every axis (MP730, or its successor)."
        yield "3. Remove the backlash compensation (MP710 = 0): BACKLASH contains it."
        yield "4. Check the sign with an indicator on one axis: a positive error is a travel that"
        yield "   is too long, and the control shortens it."


@FORMATS.register
class Heidenhain(Format[HeidenhainOptions]):
    """Nonlinear axis error compensation of a TNC."""

    name = "heidenhain"
    summary = "HEIDENHAIN TNC, MANUALplus: nonlinear axis error compensation (.COM, .CMA)"
    source = (
        "HEIDENHAIN, Technical Manual MANUALplus 620, pages 716 to 718 (columns); Technical Manual "
        "TNC 407/415/425, pages 4-26 to 4-31, and module 9095 (limits, sign); Technical Manual TNC "
        "306/406, page 4-21 (interpolation, largest difference)"
    )
    sign = "the error, subtracted from the position; positive where the travel is too long"
    units = "mm"
    resolution = "0.0001 mm, linear between the points, constant beyond them"
    limits = (
        f"linear axes X, Y, Z; at most {_MOST} points per table; neighbours differ by at most "
        f"their distance / {_SLOPE:.0f}; the direction matters for the axis itself only"
    )
    options = HeidenhainOptions

    def refuse(self, machine: IdentifiedMachine, options: HeidenhainOptions) -> str | None:
        unfit = refuse_axes(machine) or refuse_travel(machine)
        if unfit is not None:
            return unfit
        for line in self.tables(machine, options).lines:
            change = max(np.abs(np.diff(v)).max() for v in (line.up, line.down))
            allowed = float(np.diff(line.nodes).min()) / _SLOPE
            if change > allowed:
                where = f"{line.corrected} = F({line.by})"
                return (
                    f"found a change of {1e3 * change:.4f} mm between neighbours in {where}, "
                    f"expected at most {1e3 * allowed:.4f} mm (distance / "
                    f"{_SLOPE:.0f}); choose fewer points, or correct the machine"
                )
        return None

    def reason(self, machine: IdentifiedMachine, part: str) -> str:
        needs = next((p.needs for p in machine.parts if p.name == part), ())
        others = [n for n in needs if n not in machine.axes and not n.startswith("dir_")]
        if others:
            return f"depends on {', '.join(others)}, for which the table has one value"
        return "a table depends on the position of one axis, with the direction for itself only"

    def tables(self, machine: IdentifiedMachine, options: HeidenhainOptions) -> HeidenhainTables:
        at = at_inside(machine, options)
        nodes = {
            axis: np.round(spaced(low, high, options.points) / _STEP_M) * _STEP_M
            for axis, (low, high) in zip(machine.axes, machine.volume, strict=True)
        }
        lines = []
        for line in lines_of(machine, nodes, at):
            if line.corrected != line.by:
                middle = (line.up + line.down) / 2.0
                line = Line(line.corrected, line.by, line.nodes, middle, middle)
            lines.append(line.rounded(_STEP_M))
        return HeidenhainTables(machine, at, tuple(lines))
