"""Virtual calibration: a machine is drawn, measured, identified and judged, many times over.

This propagates distributions *through a simulated measurement and its evaluation*, draw by draw,
rather than through a measurement function of input estimates as in JCGM 101. The spread of
(identified - true) over the draws is the uncertainty that the procedure will have, before anything
was measured; it becomes the posterior uncertainty of one measurement only where the model is linear
and the prior is the population of machines.
"""

import hashlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..arrays import Array
from ..batch import identify_one, prepare_batch
from ..least_squares import least_squares
from ..model import Model, Shapes
from ..plan import Plan
from ..simulate import draw, prepare
from .ensemble import Ensemble
from .intervals import Kind
from .outputs import Field, Output
from .quantities import Measure, Pair, ParameterErrors, Quantity, State
from .stream import MOST, Progress, stream

_STEPS = "identification: exact gradients"
_RETRIED = "identification: retried"
_BLOCK = 1000
_PART = 125
"""Draws that are computed together on a processor: what they need stays in its cache."""


@dataclass(frozen=True)
class Campaign:
    """Results of a virtual calibration."""

    ensemble: Ensemble
    """Every quantity, and how the identification went."""
    pair: Pair
    quantities: tuple[str, ...]
    """Names of the scalar outputs that are quantities."""
    seed: int

    @property
    def retried(self) -> float:
        """Share of the draws that the shared curvature did not solve, so that damped least
        squares had to.
        """
        return float(self.ensemble.mean[self.ensemble.index(_RETRIED)])

    @property
    def gradients(self) -> float:
        """Exact gradients per draw that the identification needed on average."""
        return float(self.ensemble.mean[self.ensemble.index(_STEPS)])

    @property
    def failed(self) -> int:
        """Draws that could not be identified, or gave a quantity that is not finite: counted, and
        left out of every statistic.
        """
        return max(self.ensemble.failed.values(), default=0)


def virtual_pair(
    truth: Model,
    fit: Model,
    plan: Plan,
    *,
    shapes: Shapes | None = None,
    noise_factor: float = 1.0,
) -> Pair:
    """Both models on a plan, ready for many draws.

    `shapes` are the nominal shape parameters (SI) of the fitted model; those of the truth are
    drawn, unless declared. Raises as `vcal.simulate.prepare` and `vcal.batch.prepare_batch` do,
    and `ValueError` where the two models differ in more than their effects.
    """
    if truth.chain.text != fit.chain.text or truth.layout != fit.layout:
        raise ValueError(
            f"truth and fit: found the chains {truth.chain.text!r} and {fit.chain.text!r} with "
            f"{len(truth.layout)} and {len(fit.layout)} ports, expected the same machine and "
            "instrument; let them differ in their effects"
        )
    declared = {
        i: {p.name: p.mean * p.si for p in effect.shapes}
        for i, effect in enumerate(truth.effects)
        if effect.shapes
    }
    simulator = prepare(truth, plan, declared, noise_factor=noise_factor, draw_shapes=True)
    return Pair(truth, fit, simulator, prepare_batch(fit, plan, shapes=shapes))


def monte_carlo(
    truth: Model,
    fit: Model,
    plan: Plan,
    *,
    draws: int | Literal["adaptive"] = 10_000,
    seed: int = 0,
    quantities: Sequence[Quantity] = (ParameterErrors(),),
    shapes: Shapes | None = None,
    noise_factor: float = 1.0,
    tolerance: float = 1e-3,
    coverage: float = 0.95,
    kind: Kind = "symmetric",
    digits: Literal[1, 2] = 2,
    most: int = MOST,
    chunk: int | None = None,
    folder: Path | str | None = None,
    progress: Progress = lambda done, total: None,
) -> Campaign:
    """Draw a machine and an instrument from `truth`, measure `plan`, identify `fit`; many times.

    `truth` is what reality is and `fit` what is fitted: what only the truth has is an uncertainty
    that was not identified. Every draw has its own key, from `seed` and its index, so that results
    depend on the seed alone, not on `chunk`, the number of devices or a restart from `folder`.
    Every identification converges to `tolerance` posterior standard deviations; a draw for which
    the shared curvature does not is solved by damped least squares, and one that even that does
    not solve is counted as failed. The readings of an implicit instrument are taken as residuals
    at the planned positions.

    The other arguments are those of `vcal.uncertainty.stream`. Raises as `virtual_pair` and
    `stream` do.
    """
    pair = virtual_pair(truth, fit, plan, shapes=shapes, noise_factor=noise_factor)
    measures = tuple(q.measure(pair) for q in quantities)
    given = [o for m in measures for o in m.outputs]
    outputs = [o for o in given if isinstance(o, Output)]
    evaluate = _Evaluate(pair, measures, seed, tolerance)
    local = jax.local_devices()
    result = stream(
        evaluate,
        draws,
        [*outputs, Output(_STEPS), Output(_RETRIED)],
        fields=[o for o in given if isinstance(o, Field)],
        block=_BLOCK,
        chunk=chunk,
        folder=folder,
        fingerprint=None if folder is None else evaluate.identity(),
        progress=progress,
        devices=local if len(local) > 1 else (),
        coverage=coverage,
        kind=kind,
        digits=digits,
        most=most,
    )
    names = tuple(label for o in outputs for label in o.labels)
    return Campaign(result, pair, names, seed)


class _Evaluate:
    """The outputs of a range of draws."""

    def __init__(self, pair: Pair, measures: Sequence[Measure], seed: int, tolerance: float):
        self.pair, self.measures = pair, tuple(measures)
        self.seed, self.tolerance = seed, tolerance
        self.key = jax.random.key(seed)
        # Closed over, so that what is the same in all draws is a constant to the compiler.
        self.part = jax.jit(jax.vmap(self._one))
        self.again = jax.jit(self._damped)
        processor = jax.default_backend() == "cpu"
        self.workers = (os.cpu_count() or 1) if processor else 1
        self.size = _PART if processor else _BLOCK

    def __call__(self, first: int, count: int, device: Any = None) -> dict[str, np.ndarray]:
        index = np.arange(first, first + count, dtype=np.uint32)
        parts = [index[i : i + self.size] for i in range(0, count, self.size)]

        def run(part: np.ndarray) -> dict[str, Array]:
            return jax.block_until_ready(self.part(jax.device_put(part, device)))

        with ThreadPoolExecutor(min(self.workers, len(parts))) as pool:
            found = list(pool.map(run, parts))
        values = {k: np.concatenate([np.asarray(f[k]) for f in found]) for k in found[0]}
        for row in np.flatnonzero(values.pop("converged") == 0.0):
            for name, value in self.again(index[row]).items():
                values[name][row] = value
        return values

    def _one(self, index: Array) -> dict[str, Array]:
        made = draw(self.pair.simulator, jax.random.fold_in(self.key, index))
        found = identify_one(self.pair.batch, made.readings, tolerance=self.tolerance)
        return {
            **self._judged(made, found.theta),
            _STEPS: found.steps.astype(float),
            _RETRIED: 0.0 * found.steps,
            "converged": found.converged.astype(float),
        }

    def _damped(self, index: Array) -> dict[str, Array]:
        """The same draw, identified from the linear solution by damped least squares."""
        batch = self.pair.batch
        made = draw(self.pair.simulator, jax.random.fold_in(self.key, index))
        start, _ = batch.linear(made.readings)
        start = jnp.where(jnp.isfinite(start), start, 0.0)
        # The residuals are whitened: their standard deviation is known to be one.
        found = least_squares(
            batch.residual, start, made.readings, tolerance=self.tolerance, noise=1.0
        )
        lost = jnp.where(found.converged, 0.0, jnp.nan)
        values = jax.tree.map(lambda v: v + lost, self._judged(made, found.value))
        return {**values, _STEPS: found.steps.astype(float), _RETRIED: jnp.asarray(1.0)}

    def _judged(self, made, theta: Float[Array, " k"]) -> dict[str, Array]:
        shapes = self.pair.batch.shape_values(theta)
        state = State(made.theta, made.shapes, theta, shapes)
        return {name: v for m in self.measures for name, v in m(state).items()}

    def identity(self) -> dict[str, Any]:
        """What the draws depend on."""
        content = self.pair, self.measures
        numbers = hashlib.sha256(str(jax.tree.structure(content)).encode())
        for leaf in jax.tree.leaves(content):
            numbers.update(np.asarray(leaf).tobytes())
        program = jax.make_jaxpr(self._one)(np.uint32(0))
        return {
            "seed": self.seed,
            "tolerance": self.tolerance,
            "models and plan": numbers.hexdigest(),
            "program": hashlib.sha256(str(program).encode()).hexdigest(),
            "draws computed together": self.size,
        }
