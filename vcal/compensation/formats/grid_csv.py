"""A plain table: corrections of the commands on a grid of positions, for any control.

Every line is a node of the grid: its position, the corrections there, and by how much they change
with the direction of approach and with the conditions. The header states everything that is needed
to use it.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field as Key

from ..base import FORMATS, Covariates, Format, Options, Tables, at_inside
from ..fields import Field, conditions_of, field_of, spaced
from ..headers import conditions_in_words, header
from ..machine import IdentifiedMachine

_MOST = 200_000
_STEP_M = 1e-8


class CsvOptions(Options):
    """Options of the table."""

    points: int = Key(default=11, ge=2, description="nodes per axis")
    sign: Literal["add", "subtract"] = Key(
        default="add",
        description="add: corrections, to be added to the command; subtract: errors, to be "
        "subtracted from it",
    )


@dataclass(frozen=True)
class CsvTables(Tables):
    """The corrections as they stand in the table."""

    machine: IdentifiedMachine
    options: CsvOptions
    at: Mapping[str, float]
    field: Field

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        found = np.zeros_like(position)
        given = conditions_of(self.field, self.machine, directions, covariates)
        found[:, self.machine.linear] = self.field.at(position, given)
        return found

    @cached_property
    def files(self) -> Mapping[str, str]:
        return {"corrections.csv": self._text()}

    def _text(self) -> str:
        add = self.options.sign == "add"
        factor, what = (1e6, "correction") if add else (-1e6, "error")
        rule = "add to the command" if add else "subtract from the command"
        field = self.field
        about = header(self.machine, GridCsv, sign=f"{rule}: {what} columns")
        about += conditions_in_words(self.machine, field, self.at)
        columns = [f"{axis}_mm" for axis in field.axes]
        blocks = [field.base, *field.slopes.values()]
        columns += [f"{what}_{axis}_um" for axis in field.corrected]
        for name in field.slopes:
            per = f"per_{name}" + ("_K" if name.startswith("T_") else "")
            columns += [f"{what}_{axis}_um_{per}" for axis in field.corrected]
        nodes = np.stack([v.ravel() for v in np.meshgrid(*field.lines, indexing="ij")], 1)
        values = np.concatenate([b.reshape(len(nodes), -1) for b in blocks], 1) * factor
        text = io.StringIO()
        text.writelines(f"# {line}\n" for line in about)
        table = csv.writer(text, lineterminator="\n")
        table.writerow(columns)
        for node, row in zip(nodes, values, strict=True):
            table.writerow([f"{1e3 * x:.6g}" for x in node] + [f"{v + 0.0:.2f}" for v in row])
        return text.getvalue()


@FORMATS.register
class GridCsv(Format[CsvOptions]):
    """Corrections on a grid as CSV."""

    name = "csv"
    summary = "corrections of the commands on a grid, for any control or post-processor"
    source = "a plain table; its header states sign, units, tool and conditions"
    sign = "add to the command (option sign=subtract: subtract from the command)"
    units = "positions in mm, corrections in um, temperatures in degC"
    resolution = "0.01 um, linear between the nodes, constant beyond the grid"
    limits = f"linear axes X, Y, Z; at most {_MOST} nodes"
    options = CsvOptions

    def refuse(self, machine: IdentifiedMachine, options: CsvOptions) -> str | None:
        turning = [j.name for j in machine.chain.joints if j.turns]
        if turning or machine.chain.arm:
            return (
                f"found the rotary axes or joints {', '.join(turning)}, expected linear axes only: "
                "a grid over all axes would not hold an orientation; choose another format"
            )
        nodes = options.points ** len(machine.axes)
        if nodes > _MOST:
            return (
                f"option points: found {options.points}, which makes {nodes} nodes, expected at "
                f"most {_MOST}; choose fewer points"
            )
        return None

    def tables(self, machine: IdentifiedMachine, options: CsvOptions) -> CsvTables:
        lines = [spaced(low, high, options.points) for low, high in machine.volume]
        at = at_inside(machine, options)
        field = field_of(machine, lines, machine.varying, at)
        return CsvTables(machine, options, at, _rounded(field))


def _rounded(field: Field) -> Field:
    """The field with the digits that the table has."""
    slopes = {n: np.round(v / _STEP_M) * _STEP_M for n, v in field.slopes.items()}
    lines = tuple(np.array([float(f"{1e3 * x:.6g}") * 1e-3 for x in line]) for line in field.lines)
    base = np.round(field.base / _STEP_M) * _STEP_M
    return Field(field.axes, lines, base, field.corrected, slopes, field.zeros)
