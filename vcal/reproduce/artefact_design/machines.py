"""Machines drawn, measured with an artefact and identified, with exact kinematics."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...design import ArrayPoses, displacements
from ...instruments.ball_array import ArtefactPoses
from ...instruments.ball_shape import BallShape
from ...machine.plan import Plan
from ...model.forward import Model
from ...numerics.arrays import Array
from ...uncertainty import Campaign, Measure, Output, Quantity, monte_carlo
from ...uncertainty.mismatch import fitted_places
from ...uncertainty.quantities import Pair, State
from .expected import Task, precision_of, touched
from .setting import Known, grid_points

_MICRO = 1e-6
_LOOSEST_M = 1e-3
WHEN = ("before", "after")
POINTS = 100
"""Points of the grid at which single errors are kept, for their distribution."""


class GridErrors(eqx.Module, Quantity):
    """Root mean square of the volumetric error on the grid, before and after compensation, um,
    aligned and raw: sqrt(d' G d) with d the amplitudes of the error, true less found; and the
    aligned error at some points of the grid.
    """

    points: Plan

    def measure(self, pair: Pair) -> Measure:
        moved, known = displacements(pair.truth, self.points), fitted_places(pair)
        n = self.points.rows
        flat = moved.raw.reshape(3 * n, -1)
        raw = flat.T @ flat / n
        picked = np.random.default_rng(0).choice(n, min(POINTS, n), replace=False)
        return _GridErrors(
            (raw - moved.seen.T @ moved.seen / n, raw),
            moved.aligned[picked],
            moved.places,
            known[moved.places],
        )


class _GridErrors(Measure):
    gram: tuple[np.ndarray, ...]
    at_points: np.ndarray
    true: np.ndarray
    """Places of the amplitudes that move the tool."""
    found: np.ndarray
    """The same in what is fitted; -1 where it is not."""

    @property
    def outputs(self):
        labels = tuple(f"{kind} {when} [um]" for when in WHEN for kind in ("aligned", "raw"))
        points = tuple(f"point {i} {when} [um]" for when in WHEN for i in range(POINTS))
        return (
            Output("grid error", (len(labels),), labels),
            Output("point error", (len(points),), points),
        )

    def __call__(self, state: State) -> dict[str, Array]:
        true = state.true[self.true]
        # The last place, which -1 reads, is that of what is not fitted.
        found = jnp.append(state.found, 0.0)[self.found]
        both = (true, true - found)
        values = [jnp.sqrt(jnp.maximum(d @ (g @ d), 0.0)) for d in both for g in self.gram]
        lengths = [jnp.linalg.norm(self.at_points @ d, axis=-1) for d in both]
        return {
            "grid error": jnp.stack(values) / _MICRO,
            "point error": jnp.concatenate(lengths) / _MICRO,
        }


@dataclass(frozen=True)
class Machines:
    """Many machines calibrated with one design."""

    campaign: Campaign

    def errors(self, when: str = "after", kind: str = "aligned") -> Float[np.ndarray, " n"]:
        """Error of every machine, um."""
        ensemble = self.campaign.ensemble
        return ensemble.values[:, ensemble.index(f"{kind} {when} [um]")]

    def at_points(self, when: str = "after") -> Float[np.ndarray, "n p"]:
        """Error of every machine at some points of the grid, um, aligned."""
        ensemble = self.campaign.ensemble
        start = ensemble.index(f"point 0 {when} [um]")
        return ensemble.values[:, start : start + POINTS]

    def rms(self, when: str = "after", kind: str = "aligned") -> float:
        """Root mean square over the machines, um."""
        return float(np.sqrt((self.errors(when, kind) ** 2).mean()))


def calibrate(task: Task, poses: ArrayPoses, known: Known, **campaign: Any) -> Machines:
    """Draw machines, touch all balls, identify machine, poses and artefact together; `campaign` are
    the draws, seed, progress and programs of `monte_carlo`.
    """
    model, plan = measured_by(task, poses, known)
    return calibrate_as(model, model, plan, grid_points(task.model.chain), **campaign)


def calibrate_as(truth: Model, fit: Model, plan: Plan, points: Plan, **campaign: Any) -> Machines:
    """Draw machines from `truth`, identify `fit`, judge over `points`; `campaign` as above."""
    return Machines(monte_carlo(truth, fit, plan, quantities=[GridErrors(points)], **campaign))


def measured_by(task: Task, poses: ArrayPoses, known: Known) -> tuple[Model, Plan]:
    """The machine with an artefact in its poses, and the touches.

    Raises `ValueError` for poses with tools of their own, which the chain cannot change.
    """
    if poses.tool is not None:
        raise ValueError("poses: found tools of their own, expected the tool of the chain")
    chain = task.model.chain
    m, n = poses.rotation.shape[0], poses.balls.shape[0]
    balls = np.asarray(poses.balls)
    numbers = np.arange(m)
    instrument = touched(balls, np.asarray(poses.rotation), np.asarray(poses.origin))
    position = np.asarray(poses.position(chain)).reshape(-1, 3)
    order = ["XYZ".index(axis) for axis in chain.axes]
    groups = {"pose": np.repeat(numbers, n), "ball": np.tile(np.arange(n), m)}
    plan = Plan(chain.axes, position[:, order], {}, groups)
    own = tuple(int(i) for i in numbers)
    K = np.asarray(precision_of(known, poses.balls))
    shape = BallShape.of(balls, K, _LOOSEST_M, own if known == "P" else ())
    return Model(chain, instrument, (*task.model.effects, ArtefactPoses(poses=own), shape)), plan
