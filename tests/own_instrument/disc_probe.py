"""A user's own instrument: a probe on the edge of a circular master (ISO 230-4).

A disc of calibrated radius stands on the table, and a probe in the spindle reads the distance from
its edge while two axes travel a circle about it. A study names it by

    [instrument]
    kind = "disc_probe"
    kind_file = "disc_probe.py"

Everything it builds on comes from `vcal` and `vcal.instruments`; vcal/instruments/base.py documents
each method.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vcal
from vcal.errors import RowError
from vcal.instruments import (
    Column,
    InstrumentSettings,
    TableInstrument,
    Vector,
    group,
    linear_plan,
    linear_plan_table,
)


class DiscSettings(InstrumentSettings):
    """Keys of `[instrument]` beside kind and kind_file."""

    radius_mm: float = Field(gt=0, le=5000)
    """Calibrated radius of the disc, at which the probe reads zero."""
    radius_u_um: float = Field(gt=0, le=1000)
    """Its standard uncertainty."""
    sigma_um: float = Field(gt=0, le=1000)
    """Noise of one reading."""
    range_mm: float = Field(default=1.0, gt=0)
    """Readings beyond this are refused, and circles of another radius."""


class DiscCentre(vcal.Effect):
    """Place of the disc on the table in every run, in its plane: flat parameters.

    Across that plane it changes no reading to first order, and is left as it was commanded.
    """

    name = "disc_centre"
    summary = "place of the disc on the table in each run"
    kind = "nuisance"
    where = "instrument"
    seen: tuple[tuple[int, str], ...] = eqx.field(static=True)
    """Run and coordinate of every parameter."""

    @property
    def parameters(self):
        return tuple(vcal.Parameter(f"{run}.{c}", "um", scale=100.0) for run, c in self.seen)

    @property
    def needs(self):
        return ("run",)

    def response(self, plan, shape):
        run = np.asarray(plan.groups["run"])
        return {(f"centre.{c}", f"{k}.{c}"): np.where(run == k, 1.0, 0.0) for k, c in self.seen}


class DiscRadius(vcal.Effect):
    """Error of the calibrated radius, the same in all runs: a larger disc reads less."""

    name = "disc_radius"
    summary = "error of the calibrated radius of the disc"
    where = "instrument"
    u_um: float

    @property
    def parameters(self):
        return (vcal.Parameter("error", "um", sigma=self.u_um),)

    def response(self, plan, shape):
        return {("read.radius", "error"): -np.ones(plan.rows)}


class DiscProbe(TableInstrument):
    """Reading |p - c| - R: tool point p, centre of the disc c, calibrated radius R."""

    kind = "disc_probe"
    dimension = 1  # one reading is all that is known of a point
    Settings = DiscSettings

    radius: float
    radius_u_um: float
    sigma: float
    runs: tuple[int, ...] = eqx.field(static=True)
    centres: np.ndarray
    """As commanded, in the order of `runs` (runs, 3), m."""

    @property
    def ports(self):
        return group("centre", ("X", "Y", "Z")) + group("read", ("radius",))

    @property
    def readings(self):
        return ("radius",)

    @classmethod
    def columns(cls, settings, axes, readings):
        # x_mm, y_mm, z_mm, and conditions such as dir_x, are the machine's: they are read anyway.
        plain = [Column(name="run", low=0, integer=True)]
        limit = 1e3 * settings.range_mm
        return plain + [Column(name="deviation_um", low=-limit, high=limit)] * readings

    @classmethod
    def build(cls, settings, chain, table, load):
        run, radius = np.asarray(table["run"], int), settings.radius_mm * 1e-3
        points = np.column_stack([table[f"{c}_mm"] for c in "xyz"]) * 1e-3 + chain.tool_offset
        runs, centres = tuple(int(k) for k in np.unique(run)), []
        for k in runs:
            mine = np.flatnonzero(run == k)
            centres.append(_centre(np.asarray(points[mine])))
            off = np.linalg.norm(points[mine] - centres[-1], axis=1) - radius
            if (worst := np.abs(off).max()) > settings.range_mm * 1e-3:
                raise RowError(
                    int(mine[np.argmax(np.abs(off))]),
                    "columns x_mm, y_mm, z_mm",
                    f"a position {worst * 1e3:.4g} mm beside the circle of run {k}",
                    f"a circle with the radius of {settings.radius_mm:g} mm (instrument.radius_mm)",
                    "correct the positions, the run or the radius",
                )
        return cls(
            radius=radius,
            radius_u_um=settings.radius_u_um,
            sigma=settings.sigma_um * 1e-6,
            runs=runs,
            centres=np.array(centres),
        )

    def plan(self, chain, table):
        return linear_plan(chain, table, readings=("deviation_um",))

    def measured(self, table):
        return np.asarray(table["deviation_um"], float)[:, None] * 1e-6

    def to_table(self, plan, readings):
        return {**linear_plan_table(plan), "deviation_um": readings[:, 0] * 1e6}

    def rows(self, plan):
        # Where the disc stands in the run of every row.
        return self.centres[np.searchsorted(self.runs, np.asarray(plan.groups["run"]))]

    def observe(self, row, rotation, tool, ports):
        arm = tool - Vector.of(row) - Vector.of(ports["centre"])
        return [jnp.sqrt(arm.dot(arm)) - self.radius + ports["read"][0]]

    def noise(self, plan, readings):
        return np.full((plan.rows, 1), self.sigma)

    def lengths(self, plan, readings):
        return np.ones((plan.rows, 1))

    def effects(self, plan):
        run, seen = np.asarray(plan.groups["run"]), []
        for k in self.runs:
            for c in "XYZ":
                if np.ptp(np.asarray(plan.x(c))[run == k]) > 1e-3 * self.radius:
                    seen.append((k, c))
        return (DiscCentre(seen=tuple(seen)), DiscRadius(u_um=self.radius_u_um))

    def folds(self, plan):
        # A fifth of every circle: what is left of it tells where its centre is.
        run, fold = np.asarray(plan.groups["run"]), np.zeros(plan.rows, int)
        for k in self.runs:
            mine = np.flatnonzero(run == k)
            fold[mine] = np.arange(len(mine)) * 5 // len(mine)
        return fold, False


def _centre(points):
    """Centre of the circle, or of an arc, through points (n, 3), in the plane that they span."""
    middle = points.mean(0)
    arm = points - middle
    matrix = np.column_stack([2.0 * arm, np.ones(len(arm))])
    return middle + np.linalg.lstsq(matrix, (arm**2).sum(1), rcond=1e-9)[0][:3]
