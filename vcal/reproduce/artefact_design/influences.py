"""What the publication leaves for later: heat, bending and sag, and what each of them costs.

The axes warm up while the artefact is measured, the ram bends under its load, the artefact grows
and sags with its inclination. All of it is in the truth; it is either ignored by the
identification or identified with it. The machine is judged as it is at 20 degC, with the ram's load
on it: what is warm during the measurement only is an error of the measurement.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...design import ArrayPoses, gram_for, volumetric_gram
from ...effects.artefact import ArtefactBending, ArtefactExpansion
from ...effects.base import Effect
from ...effects.structure import PayloadSag
from ...effects.thermal import ScaleGrowth, ThermalTilt
from ...instruments.ball_array import BallArray
from ...machine.plan import Plan
from ...model.forward import Model
from ...uncertainty.mismatch import Left, expected_error
from .expected import SUPPORTS, Task
from .machines import Machines, calibrate_as, measured_by
from .setting import TRAVEL, Known, grid_points

POSE_S, BALL_S = 300.0, 20.0
WARM_K, TAU_H = 2.0, 1.0
"""The axes end this much above 20 degC, with this time constant."""
AIR_K = 1.0
LOAD_KG = 50.0
_H = 3600.0

SIZES: Mapping[str, tuple[str, float]] = {
    "scales grow": ("residual expansion of the three scales, um/(m K)", 2.0),
    "column bends": ("tilt of X about Y with its temperature, urad/K", 3.0),
    "ram sags": ("deflection of the ram along Y at full overhang, um/kg", 0.2),
    "artefact expands": ("residual expansion of the artefact, um/(m K)", 1.0),
    "artefact bends": ("sag of the artefact where it lies level, um", 3.0),
}
"""Assumed standard deviations by name of the influence."""


@dataclass(frozen=True)
class Cost:
    """Expected rms on the grid, aligned, um."""

    ignored: float
    """With the influence in the truth alone."""
    identified: float
    """With its amplitudes identified too."""
    size: float
    """Share of the influence itself in the machine's error; zero where it is present only while the
    artefact is measured.
    """


def effects(name: str) -> tuple[Effect, ...]:
    """The effects behind an influence."""
    _, size = SIZES[name]
    low, high = TRAVEL["Y"]
    kinds: dict[str, tuple[Effect, ...]] = {
        "scales grow": tuple(ScaleGrowth(port=f"E{c}{c}", placement=c) for c in "XYZ"),
        "column bends": (ThermalTilt(port="EBX", placement="X"),),
        "ram sags": (PayloadSag(low=low, high=high, placement="Y"),),
        "artefact expands": (ArtefactExpansion(),),
        "artefact bends": (ArtefactBending(supports=SUPPORTS, beam=(1.0, 0.0, 0.0)),),
    }
    return tuple(
        replace(e, given=tuple((p.name, 0.0, size) for p in e.amplitudes)) for e in kinds[name]
    )


def under_conditions(plan: Plan, instrument: BallArray, balls: int) -> Plan:
    """A plan with time, temperatures, load and what follows from the artefact's poses."""
    row = np.arange(plan.rows)
    t = POSE_S * (row // balls + 1) + BALL_S * (row + 1)
    warm = 1.0 - np.exp(-t / (TAU_H * _H))
    covariates = {"t": t, "payload_kg": np.full(plan.rows, LOAD_KG)}
    covariates |= {f"T_{axis}": 20.0 + WARM_K * warm for axis in plan.axes}
    covariates["T_air"] = 20.0 + AIR_K * np.sin(2.0 * np.pi * t / (4.0 * _H))
    return instrument.with_geometry(replace(plan, covariates=covariates))


def judged_at(task: Task) -> Plan:
    """The grid under the conditions in which the machine is judged."""
    points = grid_points(task.model.chain)
    at = np.full(points.rows, 20.0)
    covariates = {f"T_{c}": at for c in points.axes} | {"T_air": at}
    covariates["payload_kg"] = np.full(points.rows, LOAD_KG)
    return replace(points, covariates=covariates)


def models(
    task: Task, poses: ArrayPoses, known: Known, names: tuple[str, ...], identified: bool
) -> tuple[Model, Model, Plan]:
    """Truth, what is fitted, and the plan under its conditions."""
    model, plan = measured_by(task, poses, known)
    assert isinstance(model.instrument, BallArray)
    plan = under_conditions(plan, model.instrument, poses.balls.shape[0])
    truth = model.with_effects(*(e for name in names for e in effects(name)))
    return truth, truth if identified else model, plan


def costs(task: Task, poses: ArrayPoses, known: Known) -> dict[str, Cost]:
    """Cost of every influence alone, of none and of all of them."""
    extra = [e for name in SIZES for e in effects(name) if e.where == "machine"]
    whole = task.model.with_effects(*extra)
    gram = volumetric_gram(whole, judged_at(task))
    size = np.diag(gram.aligned)

    def left(names: tuple[str, ...], identified: bool) -> Left:
        truth, fit, plan = models(task, poses, known, names, identified)
        return expected_error(truth, fit, plan, gram_for(truth, gram, whole))

    found = {}
    cases = {"none": (), **{name: (name,) for name in SIZES}, "all": tuple(SIZES)}
    for name, names in cases.items():
        ignored, identified = left(names, False), left(names, True)
        keys = {e.key for n in names for e in effects(n)}
        own = sum(v for e, v in zip(whole.entries, size, strict=True) if e.key in keys)
        found[name] = Cost(1e6 * ignored.rms[0], 1e6 * identified.rms[0], 1e6 * float(own) ** 0.5)
    return found


def exact(
    task: Task, poses: ArrayPoses, known: Known, *, identified: bool, draws: int, seed: int
) -> Machines:
    """Machines with all influences, measured and identified with exact kinematics."""
    given = models(task, poses, known, tuple(SIZES), identified)
    return calibrate_as(*given, judged_at(task), draws=draws, seed=seed)
