"""LinuxCNC: screw compensation per joint, ``COMP_FILE`` of type 1.

A row is ``nominal forward_trim reverse_trim``; the motor is commanded to the command plus the trim,
linear between the rows and constant beyond them, by the direction in which the joint moves. Both
directions are written, so that backlash is carried; no ``BACKLASH`` may be set beside it.

Where an axis turns round, the trim jumps by s. LinuxCNC drives the jump by a ramp of its own, of
half the acceleration A of the joint. From rest, the first step of that ramp in a servo period T is
A T^2 / 4, and as much is needed to stop. A jump of A T^2 / 4 < s <= A T^2 / 2 is too long for one
step and too short for the ramp: the joint stands, and keeps the trim of the other direction.
Measured with LinuxCNC 2.9.0: at A = 20 m/s^2 it follows 4 um, and neither 6 um nor 8 um; at
5 m/s^2 it follows 1 um and 8 um, and not 2 um.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field as Key

from ..base import FORMATS, Covariates, Format, Options, Tables, at_inside
from ..headers import conditions_in_words, header
from ..machine import IdentifiedMachine
from ..refusals import refuse_axes

_ROWS = 256
_STEP_M = 1e-9
_DIGITS = 6
_PERIOD_S = 1e-3
"""Usual servo period of LinuxCNC."""
_LEAST_JUMP_UM = 0.01


class ScrewOptions(Options):
    """Options of the screw tables."""

    points: int = Key(default=101, ge=2, le=_ROWS, description="rows per axis")
    line: Literal["volume", "own"] = Key(
        default="volume",
        description="volume: the mean of the correction over the other axes, for the least rms "
        "error in the working volume; own: the positioning error of the axis alone",
    )


@dataclass(frozen=True)
class ScrewTables(Tables):
    """The trims of every joint, as they stand in the files."""

    machine: IdentifiedMachine
    at: Mapping[str, float]
    nominal: tuple[Float[np.ndarray, " rows"], ...]
    """Per axis, m."""
    forward: tuple[Float[np.ndarray, " rows"], ...]
    reverse: tuple[Float[np.ndarray, " rows"], ...]

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        del covariates
        found = np.zeros_like(position)
        tables = zip(self.nominal, self.forward, self.reverse, strict=True)
        for i, (nominal, forward, reverse) in enumerate(tables):
            up = np.interp(position[:, i], nominal, forward)
            down = np.interp(position[:, i], nominal, reverse)
            found[:, i] = np.where(directions[:, i] < 0.0, down, up)
        return found

    @cached_property
    def files(self) -> Mapping[str, str]:
        files, ini = {}, _comments(self.machine, self.at)
        tables = zip(self.machine.axes, self.nominal, self.forward, self.reverse, strict=True)
        for joint, (axis, *columns) in enumerate(tables):
            name = f"{axis.lower()}.comp"
            rows = zip(*(1e3 * column for column in columns), strict=True)
            files[name] = "".join(
                " ".join(f"{v + 0.0:.{_DIGITS}f}" for v in row) + "\n" for row in rows
            )
            ini += [
                "",
                f"[JOINT_{joint}]",
                f"# axis {axis}; without BACKLASH, which these trims contain",
                *_acceleration(columns[1], columns[2]),
                f"COMP_FILE = {name}",
                "COMP_FILE_TYPE = 1",
            ]
        return {**files, "screw.ini": "\n".join(ini) + "\n"}


@FORMATS.register
class LinuxcncScrew(Format[ScrewOptions]):
    """Screw compensation of LinuxCNC."""

    name = "linuxcnc-screw"
    summary = "LinuxCNC: screw compensation per joint in both directions (COMP_FILE, type 1)"
    source = (
        "LinuxCNC 2.9, Integrator's manual, INI configuration, [JOINT_<num>] section, "
        "https://linuxcnc.org/docs/2.9/html/config/ini-config.html"
    )
    sign = "add to the command: motor = command + trim, trim = -(positioning error)"
    units = "mm ([TRAJ]LINEAR_UNITS = mm)"
    resolution = "1e-6 mm, linear between the rows, constant beyond them"
    limits = (
        f"linear axes X, Y, Z as joints 0, 1, 2; at most {_ROWS} rows, ascending; LinuxCNC follows "
        "no jump of the trim between A T^2 / 4 and A T^2 / 2, with the MAX_ACCELERATION A and the "
        "servo period T; screw.ini states the range to avoid"
    )
    options = ScrewOptions

    def refuse(self, machine: IdentifiedMachine, options: ScrewOptions) -> str | None:
        return refuse_axes(machine)

    def reason(self, machine: IdentifiedMachine, part: str) -> str:
        needs = next((p.needs for p in machine.parts if p.name == part), ())
        others = [n for n in needs if n not in machine.axes and not n.startswith("dir_")]
        if others:
            return f"depends on {', '.join(others)}, for which the table has one value"
        return "a screw table moves one axis by its own position only"

    def tables(self, machine: IdentifiedMachine, options: ScrewOptions) -> ScrewTables:
        at = at_inside(machine, options)
        nominal, trims = [], ([], [])
        for axis, (low, high) in zip(machine.axes, machine.volume, strict=True):
            q = _rounded(np.linspace(low, high, options.points))
            nominal.append(q)
            for direction, found in zip((1.0, -1.0), trims, strict=True):
                if options.line == "own":
                    trim = -machine.positioning(axis, q, direction, at)
                else:
                    trim = machine.line_correction(axis, q, direction, at)
                found.append(_rounded(trim))
        return ScrewTables(machine, at, tuple(nominal), *(tuple(found) for found in trims))


def _rounded(values_m: np.ndarray) -> np.ndarray:
    """Values as they are read from the file."""
    return np.round(values_m / _STEP_M) * _STEP_M


def _acceleration(forward: np.ndarray, reverse: np.ndarray) -> list[str]:
    """Which accelerations of a joint LinuxCNC does not follow the trims with, as comments."""
    jump = 1e3 * np.abs(forward - reverse)
    low, high = float(jump.min()), float(jump.max())
    if 1e3 * high < _LEAST_JUMP_UM:
        return []
    return [
        f"# between the directions the trims differ by {1e3 * low:.2f} to {1e3 * high:.2f} um",
        f"# avoid MAX_ACCELERATION from {2.0 * low / _PERIOD_S**2:.0f} to "
        f"{4.0 * high / _PERIOD_S**2:.0f} mm/s^2 (SERVO_PERIOD 1 ms):",
        "# with it LinuxCNC keeps the trim of the other direction",
    ]


def _comments(machine: IdentifiedMachine, at: Mapping[str, float]) -> list[str]:
    about = [*header(machine, LinuxcncScrew), *conditions_in_words(machine, None, at)]
    return [
        *(f"# {line}" for line in about),
        "# Copy the .comp files beside the INI file, and these lines into the sections named here.",
    ]
