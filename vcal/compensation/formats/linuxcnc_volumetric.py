"""LinuxCNC: volumetric compensation of X, Y and Z by external offsets.

A component of user space (Python, standard library and ``hal``) reads the commanded positions of
the axes and the pins of the conditions, interpolates a table that vcal has written, and sets the
external offsets of the axes. The external offset is added to the command.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pydantic import Field as Key

from ..base import FORMATS, Covariates, Format, Options, Tables, at_inside
from ..fields import Field, conditions_of, field_of
from ..headers import conditions_in_words, header, outside
from ..machine import IdentifiedMachine
from ..refusals import refuse_axes

_COMPONENT = Path(__file__).with_name("linuxcnc_component.py.txt")
_NAME = "vcal-comp"
_MOST = 50_000
_STEP_M, _SLOPE_STEP = 1e-9, 1e-10
_MARGIN_K = 10.0
"""How far beyond the measured temperatures the correction follows a sensor."""


class VolumetricOptions(Options):
    """Options of the volumetric compensation."""

    points: int = Key(default=11, ge=2, description="nodes per axis")
    scale_mm: float = Key(
        default=1e-4, gt=0.0, le=1e-2, description="offset per count, mm: the resolution"
    )
    ratio: float = Key(
        default=0.1,
        gt=0.0,
        le=0.9,
        description="share of speed and acceleration for the offsets (OFFSET_AV_RATIO)",
    )


@dataclass(frozen=True)
class VolumetricTables(Tables):
    """The table of the component, and the counts that it sets."""

    machine: IdentifiedMachine
    options: VolumetricOptions
    at: Mapping[str, float]
    field: Field

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        given = conditions_of(self.field, self.machine, directions, covariates)
        for name in given:
            if not name.startswith("dir_"):
                given[name] = np.clip(given[name], *self._bounds(name))
        scale = 1e-3 * self.options.scale_mm
        return np.round(self.field.at(position, given) / scale) * scale

    def _bounds(self, name: str) -> tuple[float, float]:
        measured = self.machine.ranges[name]
        margin = _MARGIN_K if name.startswith("T_") else 0.0
        return measured.low - margin, measured.high + margin

    @cached_property
    def files(self) -> Mapping[str, str]:
        about = [
            *header(self.machine, LinuxcncVolumetric),
            *conditions_in_words(self.machine, self.field, self.at),
        ]
        table = json.dumps(self._table(about), allow_nan=False) + "\n"
        comments = "".join(f"# {line}\n" for line in about)
        return {
            "vcal_comp.py": _COMPONENT.read_text(encoding="utf-8"),
            "vcal_comp.json": table,
            "vcal_comp.hal": comments + self._hal(),
            "vcal_comp.ini": comments + self._ini(),
        }

    def _table(self, about: list[str]) -> dict:
        """What the component reads: mm, mm per unit of a condition, degC as on the sensor."""
        field, machine = self.field, self.machine
        conditions = []
        for name, slope in field.slopes.items():
            one: dict = {"name": name, "slope": _listed(1e3 * slope, 7)}
            if name.startswith("dir_"):
                one["axis"] = name.removeprefix("dir_")
            else:
                low, high = self._bounds(name)
                one |= {
                    "pin": pin_of(name),
                    "zero": outside(machine, name, field.zeros[name]),
                    "low": outside(machine, name, low),
                    "high": outside(machine, name, high),
                }
            conditions.append(one)
        return {
            "schema": "vcal-linuxcnc/1",
            "about": about,
            "axes": list(field.axes),
            "lines_mm": [_listed(1e3 * line, 6) for line in field.lines],
            "corrections_mm": _listed(1e3 * field.base, 6),
            "conditions": conditions,
            "scale_mm": self.options.scale_mm,
        }

    def _hal(self) -> str:
        pins = [pin_of(n) for n in self.field.slopes if not n.startswith("dir_")]
        lines = [f"loadusr -Wn {_NAME} /usr/bin/python3 vcal_comp.py vcal_comp.json"]
        for axis in (axis.lower() for axis in self.field.axes):
            lines += [
                f"setp axis.{axis}.eoffset-enable 1",
                f"setp axis.{axis}.eoffset-scale {self.options.scale_mm:.9g}",
                f"net vcal-{axis}-command axis.{axis}.pos-cmd => {_NAME}.{axis}",
                f"net vcal-{axis}-counts {_NAME}.d{axis} => axis.{axis}.eoffset-counts",
                f"net vcal-{axis}-request axis.{axis}.eoffset-request => {_NAME}.r{axis}",
            ]
        lines += [
            f"net vcal-enabled motion.motion-enabled => {_NAME}.enabled",
            f"net vcal-homed motion.is-all-homed => {_NAME}.homed",
        ]
        lines += [
            f"# net vcal-{pin} SENSOR => {_NAME}.{pin}  # connect the sensor: its value, in degC"
            if pin.startswith("T-")
            else f"# net vcal-{pin} SOURCE => {_NAME}.{pin}  # connect its value, in SI units"
            for pin in pins
        ]
        return "\n".join(lines) + "\n"

    def _ini(self) -> str:
        lines = ["[HAL]", "HALFILE = vcal_comp.hal", "# after the HALFILE that loads motmod"]
        for axis in self.field.axes:
            lines += ["", f"[AXIS_{axis}]", f"OFFSET_AV_RATIO = {self.options.ratio:.6g}"]
        return "\n".join(lines) + "\n"


@FORMATS.register
class LinuxcncVolumetric(Format[VolumetricOptions]):
    """Volumetric compensation of LinuxCNC by external offsets."""

    name = "linuxcnc"
    summary = "LinuxCNC: volumetric compensation by external offsets, with a HAL component"
    source = (
        "LinuxCNC 2.9, External axis offsets, "
        "https://linuxcnc.org/docs/2.9/html/motion/external-offsets.html, and the Python interface "
        "of HAL, https://linuxcnc.org/docs/2.9/html/hal/halmodule.html"
    )
    sign = "add to the command: motor = command + offset"
    units = "mm ([TRAJ]LINEAR_UNITS = mm), temperatures in degC as read on the sensor"
    resolution = "one count (option scale_mm, 1e-4 mm), linear between the nodes"
    limits = f"linear axes X, Y, Z; at most {_MOST} nodes; no other use of external offsets"
    options = VolumetricOptions

    def refuse(self, machine: IdentifiedMachine, options: VolumetricOptions) -> str | None:
        nodes = options.points ** len(machine.axes)
        if nodes > _MOST:
            return (
                f"option points: found {options.points}, which makes {nodes} nodes, expected at "
                f"most {_MOST}; choose fewer points"
            )
        return refuse_axes(machine)

    def reason(self, machine: IdentifiedMachine, part: str) -> str:
        needs = next((p.needs for p in machine.parts if p.name == part), ())
        unknown = [n for n in needs if n not in machine.axes and n not in machine.varying]
        if unknown:
            return f"depends on {', '.join(unknown)}, which the control does not know"
        return "varies faster than the grid; choose more points"

    def tables(self, machine: IdentifiedMachine, options: VolumetricOptions) -> VolumetricTables:
        at = at_inside(machine, options)
        lines = [
            np.round(np.linspace(low, high, options.points) / _STEP_M) * _STEP_M
            for low, high in machine.volume
        ]
        field = field_of(machine, lines, machine.varying, at)
        slopes = {n: np.round(v / _SLOPE_STEP) * _SLOPE_STEP for n, v in field.slopes.items()}
        base = np.round(field.base / _STEP_M) * _STEP_M
        rounded = Field(field.axes, field.lines, base, field.corrected, slopes, field.zeros)
        return VolumetricTables(machine, options, at, rounded)


def pin_of(name: str) -> str:
    """The pin of a condition: ``T-Z`` of ``T_Z``."""
    return name.replace("_", "-")


def _listed(values: np.ndarray, digits: int) -> list:
    return (np.round(values, digits) + 0.0).tolist()
