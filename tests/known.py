"""Small studies of the oracle, told to vcal without rounding, with the truth in vcal's terms."""

import dataclasses
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from oracle import make_case, write_study
from vcal import CATALOGUE, Effect, Measurement, Model, load_study, predict
from vcal.effects import Setup
from vcal.study.simulated import parse_with

PLANS = {
    "laser_tracker": {"shape": (4, 4, 3)},
    "ball_array": {"repeats": 1},
    "reflectors": {"n": 60},
}
KINDS = tuple(PLANS)
LATERAL = (0.03, -0.02, -0.15)
"""A tool for which every rotation has a lever, m."""


class Known:
    """A small study without noise, and the oracle's case behind it."""

    def __init__(self, kind: str, folder: Path, seed: int = 3, **options: Any):
        defaults: dict[str, Any] = {"plan": PLANS[kind], "noise_factor": 0.0}
        if kind != "reflectors":
            defaults["tool_offset"] = LATERAL
        self.case = case = make_case(kind, seed=seed, **defaults | options)
        study = load_study(write_study(folder / f"{kind}_{seed}", case))
        chain, instrument = study.chain, study.instrument
        plan = study.plan.with_position(case.arm_run.q if case.arm_run else case.run.q)
        readings = study.measurement.readings
        if case.balls is not None:
            instrument = dataclasses.replace(instrument, centres=case.balls.balls)
            instrument = instrument.start(chain, plan, readings)
        if case.tracker is not None:
            readings = case.readings
        self.study, self.chain, self.plan, self.instrument = study, chain, plan, instrument
        self.model = Model(chain, instrument, (*study.model.effects, *study.model.random))
        self.measurement = Measurement(plan, readings)
        self.room = len(self.model.entries) + 16
        """Slots as the loop asks for them, so that all tests share its compiled solver."""
        layout, artefact = self.model.layout, instrument.artefact
        self.setup = Setup(chain, layout, plan, self.model.effects, artefact)
        true = self._true_values()
        self.theta = np.array(
            [true[e.key, e.parameter.name] / e.parameter.step for e in self.model.entries]
        )
        """The truth, in solver units."""

    def _true_values(self) -> dict[tuple[str, str], float]:
        """The parameters that are not zero, by effect and name, SI."""
        case, start = self.case, self.instrument
        found: dict[tuple[str, str], float] = defaultdict(float)

        def put(effect: str, values: dict[str, float]) -> None:
            found.update({(effect, name): value for name, value in values.items()})

        if case.machine is not None:
            labels = ["a0", "a1", "n1", "b1", "c1", "n2", "b2", "c2"]
            for motion, row in case.machine.coefficients().items():
                names = [motion] if "0" in motion else [f"{motion}.{label}" for label in labels]
                put("geometric", dict(zip(names, 1e-6 * np.array(row), strict=False)))
        if case.tracker is not None:
            turned = Rotation.from_euler("XYZ", case.tracker.euler).as_matrix()
            pose = start.orientation, start.station, turned, case.tracker.station
            put("station", _pose("", *pose))
        if case.balls is not None:
            for k, place in enumerate(zip(case.balls.rotation, case.balls.origin, strict=True)):
                pose = start.pose_rotation[k], start.pose_origin[k], *place
                put("artefact_pose", _pose(f"{k}.", *pose))
        if case.arm_run is not None:
            for j, errors in enumerate(np.hstack([case.arm.translation, case.arm.rotation])):
                names = [f"E{c}J{j + 1}.0" for c in "XYZABC"]
                put("geometric", dict(zip(names, errors, strict=True)))
            turned = case.arm_run.rotation.T
            station = -turned @ case.arm_run.origin
            put("station", _pose("", start.orientation, start.station, turned, station))
            for k, off in enumerate(case.arm_run.tool - start.points, start=1):
                put("tool_points", {f"{k}.{c}": v for c, v in zip("XYZ", off, strict=True)})
        return found

    def readings(self, *effects: Effect, theta: np.ndarray | None = None) -> np.ndarray:
        """Readings of the true machine with further effects, at their declared values."""
        model = self.model.with_effects(*effects)
        shapes = {
            len(self.model.effects) + i: {p.name: p.mean * p.si for p in effect.shapes}
            for i, effect in enumerate(effects)
        }
        theta = self.theta if theta is None else theta
        more = len(model.entries) - len(theta)
        return np.asarray(predict(model, self.plan, np.pad(theta, (0, more)), shapes))

    def effect(self, text: str) -> Effect:
        """An effect as `vcal simulate --with` takes it."""
        return parse_with(text, CATALOGUE, self.setup)


def _pose(prefix: str, r0: np.ndarray, t0: np.ndarray, r: np.ndarray, t: np.ndarray) -> dict:
    """From a start to the true pose: t = t0 + (X, Y, Z), R = R0 exp(A, B, C)."""
    twist = [*(t - t0), *Rotation.from_matrix(r0.T @ r).as_rotvec()]
    return {f"{prefix}{c}": v for c, v in zip("XYZABC", twist, strict=True)}


def know_all(folder: Path) -> dict[str, Known]:
    """One of every instrument."""
    return {kind: Known(kind, folder) for kind in KINDS}
