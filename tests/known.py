"""Small studies of the oracle, told to vcal without rounding, with the truth in vcal's terms."""

import dataclasses
from pathlib import Path

import numpy as np

from oracle import make_case, write_study
from vcal import CATALOGUE, Effect, Model, load_study, predict
from vcal.effects import Setup
from vcal.io.simulated import parse_with

PLANS = {
    "laser_tracker": {"shape": (4, 4, 3)},
    "ball_array": {"repeats": 1},
    "reflectors": {"n": 60},
}
KINDS = tuple(PLANS)
LATERAL = {"tool_offset": (0.03, -0.02, -0.15)}  # so that every rotation has a lever


class Known:
    """A small study and the oracle's case behind it, told to vcal without rounding."""

    def __init__(self, kind: str, folder: Path):
        more = {} if kind == "reflectors" else LATERAL
        self.case = case = make_case(kind, seed=3, plan=PLANS[kind], noise_factor=0.0, **more)
        study = load_study(write_study(folder / kind, case))
        self.chain, self.model, self.measurement = study.chain, study.model, study.measurement
        self.plan = study.plan.with_position(case.arm_run.q if kind == "reflectors" else case.run.q)
        if kind == "ball_array":
            exact = dataclasses.replace(study.instrument, centres=case.balls.balls)
            exact = exact.start(self.chain, self.plan, np.zeros((self.plan.rows, 3)))
            self.model = Model(self.chain, exact, self.model.effects)
        self.instrument = self.model.instrument
        self.setup = Setup(
            self.chain,
            self.model.layout,
            self.plan,
            self.model.effects,
            self.instrument.artefact,
        )
        self.theta = np.array([self._true(entry) for entry in self.model.entries])

    def _true(self, entry) -> float:
        """Value of a parameter of the true machine, in solver units; poses at their start."""
        p, case = entry.parameter, self.case
        if entry.key != "geometric":
            return 0.0
        motion, _, label = p.name.partition(".")
        if case.machine is not None:
            row = case.machine.coefficients()[motion]
            labels = ["a0", "a1", "n1", "b1", "c1", "n2", "b2", "c2"]
            return row[labels.index(label or "a0")] * 1e-6 / p.step
        component, joint = "XYZABC".index(motion[1]), int(motion[3:]) - 1
        return np.hstack([case.arm.translation, case.arm.rotation])[joint, component] / p.step

    def readings(self, *effects, theta=None) -> np.ndarray:
        """Readings of the true machine with further effects, at their declared values."""
        model = self.model.with_effects(*effects)
        first = len(self.model.effects)
        shapes = {
            first + i: {p.name: p.mean * p.si for p in effect.shapes}
            for i, effect in enumerate(effects)
        }
        theta = self.theta if theta is None else theta
        more = len(model.entries) - len(theta)
        return np.asarray(predict(model, self.plan, np.pad(theta, (0, more)), shapes))

    def effect(self, text: str) -> Effect:
        """An effect as `vcal simulate --with` takes it."""
        return parse_with(text, CATALOGUE, self.setup)


def know_all(folder: Path) -> dict[str, Known]:
    """One of every instrument."""
    return {kind: Known(kind, folder) for kind in KINDS}
