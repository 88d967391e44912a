"""Beckhoff TF5280 and ISG-CNC: volumetric compensation from tables in ISG CSV format.

The control takes error motions with the names of ISO 230-1 as functions of any axis positions. It
subtracts the error of the tool point that follows from them by its model of the machine. Written
are the translational errors EXX, EYY and EZZ as functions of X, Y and Z: the whole error of the
tool point in the directions of the axes. They need no lever, and so hold whatever the model of the
control takes as the reference of the rotations.

Not found in the public pages: where the reference points of the rotations lie in its two models
(``alternative_model``), so that rotational error motions are not written; the sign of an error,
which is taken as that of ISO 230-1 (actual - nominal), with ``negate`` to change it; and what holds
beyond a table, for which the value at its edge is taken.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from pydantic import Field as Key

from ..base import FORMATS, Covariates, Format, Options, Tables, at_inside
from ..fields import Field, field_of, spaced
from ..headers import conditions_in_words, header
from ..machine import IdentifiedMachine
from ..refusals import AXES, refuse_axes, refuse_travel

_STEP_M, _DIGITS = 1e-9, 6


class Tf5280Options(Options):
    """Options of the volumetric compensation."""

    points: int = Key(default=11, ge=2, description="nodes per axis")
    records: int = Key(
        default=2000,
        ge=1,
        description="vol_comp[0].max_records of the control; more nodes are refused",
    )
    numbers: str = Key(
        default="1,2,3",
        pattern=r"^\d+,\d+,\d+$",
        description="logical axis numbers of X, Y and Z",
    )


@dataclass(frozen=True)
class Tf5280Tables(Tables):
    """The errors as they stand in the file."""

    machine: IdentifiedMachine
    options: Tf5280Options
    at: Mapping[str, float]
    field: Field
    """Corrections: minus the errors."""

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        del directions, covariates
        found = np.zeros_like(position)
        found[:, self.machine.linear] = self.field.at(position, {})
        return found

    @cached_property
    def files(self) -> Mapping[str, str]:
        about = [
            *header(self.machine, BeckhoffTf5280),
            *conditions_in_words(self.machine, None, self.at),
        ]
        return {
            "volcomp.csv": "".join(f"{line}\n" for line in self._rows(about)),
            "volcomp.lis": "".join(f"{line}\n" for line in self._list(about)),
        }

    def _rows(self, about: list[str]) -> Iterator[str]:
        yield from (f"// {line}" for line in about)
        axes = self.field.axes
        yield " ".join([*axes, *(f"E{axis}{axis}" for axis in self.field.corrected)])
        nodes = np.stack([v.ravel() for v in np.meshgrid(*self.field.lines, indexing="ij")], 1)
        errors = -self.field.base.reshape(len(nodes), -1)
        for row in 1e3 * np.hstack([nodes, errors]):
            yield " ".join(f"{value + 0.0:.{_DIGITS}f}" for value in row)

    def _list(self, about: list[str]) -> Iterator[str]:
        yield from (f"# {line}" for line in about)
        yield "# in hochlauf.lis: vol_comp[0].file_name with the path of this file, and"
        yield f"# vol_comp[0].max_records of at least {self.field.base[..., 0].size}"
        yield "# In an NC program: #VOLCOMP ON [ID0]. If the error doubles: negate XYZ here."
        for axis, number in zip(AXES, self.options.numbers.split(","), strict=True):
            if axis in self.machine.axes:
                yield f"{axis} {number}"
        yield f"chain {''.join(self.machine.axes)}"
        yield "workpiece_axes 0"
        yield "interpolation GRID"
        yield "alternative_model 0"
        yield "file[0] volcomp.csv"
        yield "file_format[0] ISG_CSV"


@FORMATS.register
class BeckhoffTf5280(Format[Tf5280Options]):
    """Volumetric compensation of TwinCAT CNC and ISG-CNC."""

    name = "beckhoff-tf5280"
    summary = "Beckhoff TF5280 TwinCAT CNC, ISG-CNC: volumetric compensation (ISG CSV)"
    source = (
        "Beckhoff, TF5280 TwinCAT 3 CNC Volumetric Compensation, ISG CSV format, units of measure, "
        "configuration, https://infosys.beckhoff.com/content/1033/tf5280_volumetric_comp/; ISG, "
        "FCT-C26, https://www.isg-stuttgart.de/fileadmin/kernel/kernel-html/en-GB/296429067.html"
    )
    sign = "errors EXX, EYY, EZZ (actual - nominal), which the control subtracts from the setpoint"
    units = "mm"
    resolution = "1e-6 mm, linear between the nodes (interpolation GRID), constant beyond them"
    limits = (
        "linear axes X, Y, Z, all three; vol_comp[0].max_records nodes (option records); no tables "
        "for directions or temperatures"
    )
    options = Tf5280Options

    def refuse(self, machine: IdentifiedMachine, options: Tf5280Options) -> str | None:
        unfit = refuse_axes(machine) or refuse_travel(machine)
        if unfit is not None:
            return unfit
        if len(machine.axes) != len(AXES):
            return (
                f"found the axes {', '.join(machine.axes)}, expected all of X, Y and Z, which the "
                "control requires; choose another format"
            )
        if len({*options.numbers.split(",")}) < len(AXES):
            return (
                f"option numbers: found {options.numbers!r}, expected three different logical axis "
                "numbers; correct it"
            )
        nodes = options.points ** len(AXES)
        if nodes > options.records:
            return (
                f"option points: found {options.points}, which makes {nodes} nodes, expected at "
                f"most {options.records} (option records); choose fewer points, or raise "
                "vol_comp[0].max_records and the option"
            )
        return None

    def reason(self, machine: IdentifiedMachine, part: str) -> str:
        needs = next((p.needs for p in machine.parts if p.name == part), ())
        others = [n for n in needs if n not in machine.axes]
        if others:
            return f"depends on {', '.join(others)}, for which the table has one value"
        return "varies between the nodes; choose more points"

    def tables(self, machine: IdentifiedMachine, options: Tf5280Options) -> Tf5280Tables:
        at = at_inside(machine, options)
        lines = [
            np.round(spaced(low, high, options.points) / _STEP_M) * _STEP_M
            for low, high in machine.volume
        ]
        field = field_of(machine, lines, (), at).rounded(_STEP_M)
        return Tf5280Tables(machine, options, at, field)
