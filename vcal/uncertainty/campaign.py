"""Virtual calibration by Monte Carlo: machines are drawn, measured, identified and evaluated.

This propagates distributions *through a simulated measurement and its evaluation*, draw by draw,
rather than through a measurement function of input estimates as in JCGM 101. The spread of
(identified - true) over the draws is the uncertainty of the procedure before any measurement. It
equals the posterior uncertainty of one measurement only for a linear model with a prior that is the
population of machines.
"""

import hashlib
import uuid
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..identification.batch import identify_alone, identify_damped, identify_one, prepare_batch
from ..instruments.base import Instrument
from ..labelled import labelling
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..model.forward import Model, Shapes
from ..model.simulate import draw, prepare
from ..numerics.arrays import Array
from ..numerics.compiled import jit_outermost
from ..numerics.processes import cores
from .cluster import InCluster
from .ensemble import Ensemble
from .intervals import Kind
from .outputs import Field, Output
from .programs import Programs
from .quantities import Measure, Pair, ParameterErrors, Quantity, State, scalars
from .streaming import KEEP, MOST, Progress, stream

_STEPS = "identification: exact gradients"
_RETRIED = "identification: retried"
_BLOCK = 1000
_SHOWN = 8
"""Most quantities that a campaign lists as text."""
_PART = 125
"""Draws that one thread of a CPU computes per call."""
TOGETHER = 25
"""Draws that a CPU computes together, so that their working set stays in its cache."""


@dataclass(frozen=True)
class Campaign:
    """Results of a virtual calibration."""

    ensemble: Ensemble
    """All quantities, and statistics of the identification."""
    pair: Pair
    quantities: tuple[str, ...]
    """Names of the scalar outputs that are quantities."""
    seed: int

    def __repr__(self) -> str:
        rows = [
            f"  {name} = {self.ensemble.mean[i]:.4g} ± {self.ensemble.u[i]:.2g}"
            for name in self.quantities[:_SHOWN]
            for i in [self.ensemble.index(name)]
        ]
        more = len(self.quantities) - _SHOWN
        rows += [f"  and {more} more"] if more > 0 else []
        head = f"Campaign of {self.ensemble.draws} draws, seed {self.seed}, SI units"
        return "\n".join([head, *rows])

    def to_pandas(self) -> Any:
        """Mean, standard uncertainty and extremes of every scalar output as a `pandas.DataFrame`,
        in SI units.

        Raises `ImportError` where pandas is not installed.
        """
        one = self.ensemble
        values = {
            "mean": one.mean, "standard_uncertainty": one.u, "minimum": one.minimum,
            "maximum": one.maximum,
        }  # fmt: skip
        return labelling("pandas").DataFrame(values, index=list(one.labels))

    def to_xarray(self) -> Any:
        """The values of all draws that are kept as an `xarray.Dataset` in SI units: one variable
        per scalar output, over the dimensions ``chain`` (a single one) and ``draw``, as ArviZ
        expects of draws.

        Raises `ImportError` where xarray is not installed.
        """
        xarray = labelling("xarray")
        values = self.ensemble.values
        return xarray.Dataset(
            {
                name: (("chain", "draw"), values[None, :, i])
                for i, name in enumerate(self.ensemble.labels)
            },
            coords={"chain": [0], "draw": range(len(values))},
            attrs={"seed": self.seed, "draws": self.ensemble.draws},
        )

    @property
    def retried(self) -> float:
        """Share of the draws that the shared curvature did not solve.

        These are solved with their own curvature or by damped least squares. The share is one where
        `pair.batch.shared` excludes the shared curvature.
        """
        return float(self.ensemble.mean[self.ensemble.index(_RETRIED)])

    @property
    def gradients(self) -> float:
        """Average number of exact gradients per draw in the identification."""
        return float(self.ensemble.mean[self.ensemble.index(_STEPS)])

    @property
    def failed(self) -> int:
        """Number of draws without an identification or with a quantity that is not finite.

        They are left out of every statistic.
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
    """Both models on a plan, prepared for many draws.

    `shapes` are the nominal shape parameters (SI) of the fitted model; those of the truth are
    drawn, unless declared. Raises as `vcal.model.simulate.prepare` and
    `vcal.identification.batch.prepare_batch` do, and `ValueError` where the two models differ in
    more than their effects.
    """
    apart = [
        *_apart("machine", truth.chain, fit.chain),
        *_apart("instrument", truth.instrument, fit.instrument),
    ]
    if apart:
        raise ValueError(
            f"truth and fit: found differences in {', '.join(apart)}, expected the same machine "
            "and instrument; let them differ in their effects only"
        )
    declared = {
        i: {p.name: p.mean * p.si for p in effect.shapes}
        for i, effect in enumerate(truth.effects)
        if effect.shapes
    }
    simulator = prepare(truth, plan, declared, noise_factor=noise_factor, draw_shapes=True)
    return Pair(truth, fit, simulator, prepare_batch(fit, plan, shapes=shapes))


def _apart(what: str, one: Chain | Instrument, other: Chain | Instrument) -> list[str]:
    """Names of the fields in which two objects differ."""
    if type(one) is not type(other):
        return [f"{what} ({type(one).__name__} and {type(other).__name__})"]
    names = [f.name for f in fields(one)]
    pairs = [(name, getattr(one, name), getattr(other, name)) for name in names]
    return [f"{what}.{name}" for name, a, b in pairs if a is not b and not eqx.tree_equal(a, b)]


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
    keep: int = KEEP,
    progress: Progress = lambda done, total: None,
    programs: Programs | None = None,
    client: Any = None,
) -> Campaign:
    """Draw machines and instruments from `truth`, measure them on `plan`, and identify `fit`.

    `truth` is the simulated reality and `fit` the fitted model: an effect present only in the first
    model adds uncertainty that is never corrected. Every draw has its own key, from `seed` and its
    index, so that results depend on the seed alone, not on `chunk`, the number of devices or a
    restart from `folder`.

    Every identification converges to `tolerance` posterior standard deviations. A draw that does
    not converge with the shared curvature is identified with its own curvature, and then by damped
    least squares; machines that are too different to share a curvature all use their own. A draw
    without a solution counts as failed. The readings of an implicit instrument are residuals at the
    planned positions.

    With `programs`, campaigns whose models differ in numbers only are compiled once. Without it,
    everything that is equal in all draws is a constant to the compiler, and long campaigns run a
    little faster.

    With a `distributed.Client` as `client`, the workers of its Dask cluster compute and summarise
    the blocks, with the same result; `programs` is then not used. Summaries travel, and the values
    of scalar outputs as long as they are kept: exact quantiles need all of them. `keep` is the
    largest number of kept values; with zero, quantiles come from counts in fine bins.

    The other arguments are those of `vcal.uncertainty.streaming`. Raises as `virtual_pair` and
    `stream` do, and `TypeError` for a quantity that is no `Quantity`.
    """
    for quantity in quantities:
        if not isinstance(quantity, Quantity):
            raise TypeError(
                f"quantities: found {quantity!r}, expected instances of quantities, such as "
                "ParameterErrors()"
            )
    pair = virtual_pair(truth, fit, plan, shapes=shapes, noise_factor=noise_factor)
    measures = tuple(q.measure(pair) for q in quantities)
    given = [o for m in measures for o in m.outputs]
    outputs = [o for o in given if isinstance(o, Output)]
    here = _Evaluate(pair, measures, seed, tolerance, programs)
    local = jax.local_devices()
    evaluate, devices = here, local if len(local) > 1 else ()
    if client is not None:
        given_to_all = (truth, fit, plan, tuple(quantities), seed, tolerance, shapes, noise_factor)
        evaluate = InCluster(client, _evaluate_in_worker, given_to_all, uuid.uuid4().hex)
        devices = evaluate.slots
    result = stream(
        evaluate,
        draws,
        [*outputs, Output(_STEPS), Output(_RETRIED)],
        fields=[o for o in given if isinstance(o, Field)],
        block=_BLOCK,
        chunk=chunk,
        folder=folder,
        fingerprint=None if folder is None else here.identity(),
        keep=keep,
        progress=progress,
        devices=devices,
        coverage=coverage,
        kind=kind,
        digits=digits,
        most=most,
    )
    names = tuple(label for o in outputs for label in o.labels)
    return Campaign(result, pair, names, seed)


def _evaluate_in_worker(
    truth: Model,
    fit: Model,
    plan: Plan,
    quantities: Sequence[Quantity],
    seed: int,
    tolerance: float,
    shapes: Shapes | None,
    noise_factor: float,
) -> "_Evaluate":
    """The outputs of draws, on a worker of a cluster that has one core for each of its threads."""
    pair = virtual_pair(truth, fit, plan, shapes=shapes, noise_factor=noise_factor)
    measures = tuple(q.measure(pair) for q in quantities)
    found = _Evaluate(pair, measures, seed, tolerance)
    found.workers = 1
    return found


def side_by_side(function: Any, together: int) -> Any:
    """Map a function of one draw over many draws, `together` at a time; all at once for zero."""
    if not together:
        return jax.vmap(function)
    return lambda index: jax.lax.map(function, index, batch_size=together)


def in_parts(
    pool: ThreadPoolExecutor, function: Any, index: np.ndarray, size: int, device: Any
) -> dict[str, np.ndarray]:
    """A compiled function of draws, applied to `size` of them at a time."""
    # The last part is padded to the same size, so that it needs no compilation.
    full = np.concatenate([index, np.repeat(index[-1:], -len(index) % size)])

    def run(part: np.ndarray) -> dict[str, Array]:
        return jax.block_until_ready(function(jax.device_put(part, device)))

    found = list(pool.map(run, full.reshape(-1, size)))
    return {
        name: np.concatenate([np.asarray(f[name]) for f in found])[: len(index)]
        for name in found[0]
    }


class _Evaluate:
    """The outputs of a range of draws."""

    def __init__(
        self,
        pair: Pair,
        measures: Sequence[Measure],
        seed: int,
        tolerance: float,
        programs: Programs | None = None,
    ):
        self.pair, self.measures = pair, tuple(measures)
        self.seed, self.tolerance = seed, tolerance
        self.key = jax.random.key(seed)
        processor = jax.default_backend() == "cpu"
        self.workers = cores() if processor else 1
        self.size = _PART if processor else _BLOCK
        # Methods of identification in order, each applied to the draws that are left, with the
        # number of draws computed together. On a CPU, none waits for the slowest of its part.
        few = 1 if processor else _PART
        ways = [(identify_alone, few), (identify_damped, few)]
        if pair.batch.shared:
            ways.insert(0, (identify_one, self.size))
        self.content = self._content()
        together = TOGETHER if processor else 0
        self.ways = [
            (self._compiled(way, min(together, size), programs), size) for way, size in ways
        ]

    def _content(self) -> tuple[Any, ...]:
        """What all draws share, as an argument of `one`."""
        return self.pair.simulator, self.pair.batch, self.measures

    @staticmethod
    def one(way: Any, tolerance: float, content: Any, key: Array, index: Array) -> dict[str, Array]:
        """One draw, identified by one method."""
        return _one(way, tolerance, content, key, index)[0]

    def __call__(self, first: int, count: int, device: Any = None) -> dict[str, np.ndarray]:
        left = np.arange(first, first + count, dtype=np.uint32)
        values: dict[str, np.ndarray] = {}
        with ThreadPoolExecutor(self.workers) as pool:
            for function, size in self.ways:
                found = in_parts(pool, function, left, size, device)
                lost = found.pop("converged") == 0.0
                for name, value in found.items():
                    whole = values.setdefault(name, np.empty((count, *value.shape[1:])))
                    whole[left - first] = value
                left = left[lost]
                if not len(left):
                    break
        for value in values.values():
            value[left - first] = np.nan
        return values

    def _compiled(self, way: Any, together: int, programs: Programs | None) -> Any:
        """One method of identification for many draws at once, as a function of their indices."""
        function = partial(self.one, way, self.tolerance)
        if programs is None:
            # Closed over, so that everything equal in all draws is a constant to the compiler.
            fixed = partial(function, self.content, self.key)
            return jit_outermost(side_by_side(fixed, together))
        name = type(self).__name__, way.__name__, self.tolerance, together
        shared = programs.of(function, self.content, name, partial(side_by_side, together=together))
        return partial(shared, self.key)

    def identity(self) -> dict[str, Any]:
        """Everything on which the draws depend, for the fingerprint of a checkpoint."""
        content = self.pair, self.measures
        numbers = hashlib.sha256(str(jax.tree.structure(content)).encode())
        for leaf in jax.tree.leaves(content):
            numbers.update(np.asarray(leaf).tobytes())
        function, size = self.ways[0]
        index = np.zeros(size, np.uint32)
        if hasattr(function, "trace"):
            program = function.trace(index).jaxpr  # the first block needs it too, and finds it
        else:
            program = jax.make_jaxpr(function)(index)
        return {
            "seed": self.seed,
            "tolerance": self.tolerance,
            "models and plan": numbers.hexdigest(),
            "program": hashlib.sha256(str(program).encode()).hexdigest(),
            "draws computed together": self.size,
        }


def _one(
    way: Any, tolerance: float, content: Any, key: Array, index: Array
) -> tuple[dict[str, Array], State]:
    """The outputs of one draw, identified by one method, and what they were computed from."""
    simulator, batch, measures = content
    made = draw(simulator, jax.random.fold_in(key, index))
    found = way(batch, made.readings, tolerance=tolerance)
    shapes = batch.shape_values(found.theta)
    state = State(made.theta, made.shapes, found.theta, shapes, made.readings)
    outputs = {
        **{name: v for m in measures for name, v in m(state).items()},
        _STEPS: found.steps.astype(float),
        _RETRIED: jnp.asarray(0.0 if way is identify_one else 1.0),
        "converged": found.converged.astype(float),
    }
    return outputs, state


class PairEvaluate(_Evaluate):
    """The scalar outputs of a range of draws, exact and by a linear identification of the same
    machine and noise (`levels.LinearDraws`).
    """

    def __init__(
        self,
        pair: Pair,
        measures: Sequence[Measure],
        seed: int,
        tolerance: float,
        linear: Any,
        programs: Programs | None = None,
    ):
        self.linear = linear
        super().__init__(pair, measures, seed, tolerance, programs)

    @staticmethod
    def linear_name(name: str) -> str:
        """Name of the linear result beside an output."""
        return f"linear: {name}"

    def _content(self) -> tuple[Any, ...]:
        return (*super()._content(), self.linear)

    @staticmethod
    def one(way: Any, tolerance: float, content: Any, key: Array, index: Array) -> dict[str, Array]:
        """One draw, identified by one method and by the linear one."""
        simulator, batch, measures, linear = content
        exact, state = _one(way, tolerance, content[:3], key, index)
        found = linear.beside(simulator, state.true, jax.random.fold_in(key, index))
        beside = State(state.true, state.true_shapes, found, batch.shape_values(found))
        of_both = {"converged": exact["converged"]}
        for name, value in scalars(measures, beside).items():
            of_both |= {name: exact[name], PairEvaluate.linear_name(name): value}
        return of_both
