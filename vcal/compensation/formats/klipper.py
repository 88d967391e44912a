"""Klipper: skew correction of X, Y and Z (``[skew_correction]``).

The firmware moves to

    x' = x - y a_xy - z (a_xz - a_xy a_yz),    y' = y - z a_yz,    z' = z

with the factors of a stored profile. They are the tangents of the angles by which the axes are out
of square: the mean slope over the working volume of the correction of one axis of a plane by the
position of the other, both ways together, since a rotation of the workpiece takes the rest.

Klipper has no table of positions and no backlash. grbl has neither; forks with backlash differ in
the numbers of their settings, so that no format is offered for them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from pydantic import Field as Key

from ..base import FORMATS, Covariates, Format, Options, Tables, at_inside
from ..fields import spaced
from ..headers import conditions_in_words, header
from ..lines import lines_of
from ..machine import IdentifiedMachine
from ..refusals import AXES, refuse_axes, refuse_travel

_NODES, _DIGITS = 11, 9


class KlipperOptions(Options):
    """Options of the skew correction."""

    profile: str = Key(
        default="vcal", pattern=r"^[A-Za-z0-9_-]+$", description="name of the stored profile"
    )


@dataclass(frozen=True)
class KlipperTables(Tables):
    """The factors as they stand in the file."""

    machine: IdentifiedMachine
    options: KlipperOptions
    at: Mapping[str, float]
    xy: float
    xz: float
    yz: float

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        del directions, covariates
        x, y, z = (self.machine.axes.index(axis) for axis in AXES)
        found = np.zeros_like(position)
        rest = self.xz - self.xy * self.yz
        found[:, x] = -self.xy * position[:, y] - rest * position[:, z]
        found[:, y] = -self.yz * position[:, z]
        return found

    @cached_property
    def files(self) -> Mapping[str, str]:
        about = [*header(self.machine, Klipper), *conditions_in_words(self.machine, None, self.at)]
        name = self.options.profile
        lines = [
            *(f"# {line}" for line in about),
            "# Add these lines to printer.cfg, and run in the start G-code after homing:",
            f"# SKEW_PROFILE LOAD={name}",
            "[skew_correction]",
            "",
            f"[skew_correction {name}]",
            *(f"{key}_skew: {getattr(self, key):.{_DIGITS}f}" for key in ("xy", "xz", "yz")),
        ]
        return {"skew.cfg": "\n".join(lines) + "\n"}


@FORMATS.register
class Klipper(Format[KlipperOptions]):
    """Skew correction of Klipper."""

    name = "klipper"
    summary = "Klipper: skew correction (squareness of X, Y and Z)"
    source = (
        "Klipper documentation, https://www.klipper3d.org/Skew_Correction.html, and the transform "
        "in klippy/extras/skew_correction.py of https://github.com/Klipper3d/klipper"
    )
    sign = "subtracted from the command: x - y xy_skew, y - z yz_skew"
    units = "radians (tangents of angles)"
    resolution = "1e-9"
    limits = "linear axes X, Y, Z, all three; three factors: no tables, no backlash"
    options = KlipperOptions

    def refuse(self, machine: IdentifiedMachine, options: KlipperOptions) -> str | None:
        unfit = refuse_axes(machine) or refuse_travel(machine)
        if unfit is None and len(machine.axes) != len(AXES):
            unfit = (
                f"found the axes {', '.join(machine.axes)}, expected all of X, Y and Z; choose "
                "another format"
            )
        return unfit

    def reason(self, machine: IdentifiedMachine, part: str) -> str:
        del machine, part
        return "three constant factors of squareness, zero at the zero of the axes"

    def tables(self, machine: IdentifiedMachine, options: KlipperOptions) -> KlipperTables:
        at = at_inside(machine, options)
        travels = dict(zip(machine.axes, machine.volume, strict=True))
        nodes = {axis: spaced(low, high, _NODES) for axis, (low, high) in travels.items()}
        slopes = {
            (line.corrected, line.by): np.polyfit(line.nodes, (line.up + line.down) / 2.0, 1)[0]
            for line in lines_of(machine, nodes, at)
        }
        xy, xz, yz = (-(slopes[a, b] + slopes[b, a]) for a, b in ("XY", "XZ", "YZ"))
        rounded = (round(float(v), _DIGITS) for v in (xy, xz + xy * yz, yz))
        return KlipperTables(machine, options, at, *rounded)
