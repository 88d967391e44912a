"""Tests as the publication makes them: a machine is drawn, measured and identified, many times.

Every test gives these errors per point: *initial* (true less nominal tool point), *residual* (what
the tracker measured less what the identified model predicts, which is what can be seen in a
workshop), *left* (true less predicted tool point, which only a simulation can know) and *aligned*
(the same after the best rigid alignment of all points).
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from ...identification.batch import Batch, identify_one
from ...machine.chain import Chain
from ...machine.plan import Plan
from ...model.forward import tool_columns
from ...model.port_map import PortMap
from ...model.simulate import Simulator, draw
from ...numerics.arrays import Array
from ...numerics.compiled import jit_outermost
from ...numerics.processes import cores
from ...numerics.spatial import rigid_basis
from ...uncertainty.campaign import virtual_pair
from ...uncertainty.ensemble import Ensemble
from ...uncertainty.linear import Linearised, linearised
from ...uncertainty.outputs import Field, Output
from ...uncertainty.quantities import ErrorMotionErrors, Measure, Pair, State
from ...uncertainty.streaming import stream
from .setting import Family, Setting, truth_and_fit

_MICRO = 1e-6
LEFT = "error left [um]"


class PointErrors(Measure):
    """Error that is left at every point, d = true less predicted tool point, in um.

    Scalars: components and length of d at some of the points. Field: components of d at all.
    They are not aligned, since the tracker's position counts as known.
    """

    true: PortMap
    found: PortMap
    nominal: Float[np.ndarray, "n 3"]
    position: Float[np.ndarray, "n 3"]
    chain: Chain
    rigid: Float[np.ndarray, "n3 6"]
    """Orthonormal columns of the rigid motions of all points."""
    named: tuple[int, ...] = eqx.field(static=True)
    places: tuple[str, ...] = eqx.field(static=True)

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        components = tuple(f"d{c} at {place} mm [um]" for place in self.places for c in "XYZ")
        lengths = tuple(f"|d| at {place} mm [um]" for place in self.places)
        return (
            Output("component", (len(components),), components),
            Output("length", (len(lengths),), lengths),
            Field(LEFT, self.nominal.shape),
        )

    def errors(self, state: State) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """True less nominal tool points, and true less predicted ones, m."""
        true = self.true(state.true, state.true_shapes)
        found = self.found(state.found, state.found_shapes)
        real = jnp.stack(tool_columns(self.chain, self.position, true), -1)
        predicted = jnp.stack(tool_columns(self.chain, self.position, found), -1)
        return real - self.nominal, real - predicted

    def aligned(self, d: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Errors less the rigid motion that fits them best."""
        flat = d.reshape(-1)
        return (flat - self.rigid @ (self.rigid.T @ flat)).reshape(d.shape)

    def __call__(self, state: State) -> dict[str, Array]:
        _, left = self.errors(state)
        left = left / _MICRO
        some = left[jnp.asarray(self.named)]
        return {
            "component": some.reshape(-1),
            "length": jnp.sqrt((some * some).sum(-1)),
            LEFT: left,
        }


def point_errors(pair: Pair, points: Plan, every: int = 2) -> PointErrors:
    """The quantity at these points, a square grid of which `every` other row and column is named.

    Raises `ValueError` where the points are no square grid.
    """
    position = np.asarray(points.position)
    side = int(round(len(position) ** 0.5))
    if side * side != len(position):
        raise ValueError(f"found {len(position)} points, expected a square grid")
    named = [i * side + j for i in range(0, side, every) for j in range(0, side, every)]
    chain = pair.truth.chain
    still = [0.0] * len(pair.truth.layout)
    nominal = np.column_stack(tool_columns(chain, position, still))
    return PointErrors(
        *pair.maps(points),
        nominal=nominal,
        position=position,
        chain=chain,
        rigid=rigid_basis(nominal),
        named=tuple(named),
        places=tuple("({:g}, {:g})".format(*(1e3 * position[i, :2])) for i in named),
    )


def length_labels(measure: PointErrors) -> tuple[str, ...]:
    """Names of the lengths |d|."""
    return measure.outputs[1].labels  # type: ignore[union-attr]


def component_labels(measure: PointErrors) -> tuple[str, ...]:
    """Names of the components of d, three per point."""
    return measure.outputs[0].labels  # type: ignore[union-attr]


KINDS = ("initial", "residual", "left", "aligned")
PARTS = ("X", "Y", "Z", "distance")
NODES = 3
_BINS = 60
_MARGIN = 1.1
_BLOCK = 1000
_PART = 125
"""Tests that a processor computes together: what they need stays in its cache."""
_OF_SIMULATOR = ("scatter", "sigma")
_OF_BATCH = ("nominal", "whitener", "root_precision", "curvature", "inverse", "gain")
"""What differs from setting to setting."""
_SIZES = "sizes"
_ERRORS = "errors"


@dataclass(frozen=True)
class Pooled:
    """Distribution of one error over all points and tests, um."""

    mean: float
    sd: float
    u_mean: float
    """Standard deviation of the mean itself: tests are independent, points of a test are not."""
    edges: Float[np.ndarray, " b"]
    share: Float[np.ndarray, " b-1"]
    """Share of the points and tests in every bin."""

    def quantile(self, p: float) -> float:
        """Value that a share p does not exceed: linear within a bin."""
        return float(np.interp(p, np.concatenate([[0.0], np.cumsum(self.share)]), self.edges))


@dataclass(frozen=True)
class Trials:
    """The tests of one setting."""

    setting: Setting
    pair: Pair
    ensemble: Ensemble
    pooled: dict[tuple[str, str], Pooled]
    """By kind of error and part of it."""
    measures: tuple[Measure, ...]
    points: PointErrors

    @property
    def failed(self) -> int:
        """Tests whose identification did not converge: counted, and left out of everything."""
        return max(self.ensemble.failed.values(), default=0)

    def gum(self, coverage: float = 0.95) -> Linearised:
        """The same uncertainties by the GUM, through the identification."""
        return linearised(self.pair, self.measures, coverage)


class Runner:
    """Runs campaigns whose models have the same structure with one compiled program."""

    def __init__(self, family: Family, seed: int):
        self.family, self.seed = family, seed
        self.programs: dict[Any, Callable[..., dict[str, Array]]] = {}

    def __call__(self, setting: Setting, tests: int) -> Trials:
        """Tests number 0 ... tests - 1 of a setting; the same random numbers in every setting.

        Raises `ValueError` for fewer than two tests.
        """
        pair = virtual_pair(*truth_and_fit(setting, self.family), setting.plan)
        points = point_errors(pair, setting.points)
        measures = (ErrorMotionErrors(nodes=NODES).measure(pair), points)
        numbers = _numbers(pair, measures)
        program = self._program(pair, measures, numbers)
        pilot = program(np.arange(_size(), dtype=np.uint32), self._key, numbers)
        counts = _Counts(_edges(np.asarray(pilot[_ERRORS])))
        given = [o for m in measures for o in m.outputs]
        sizes = [f"{kind} {part} {power}" for kind in KINDS for part in PARTS for power in "12"]
        ensemble = stream(
            _Evaluate(program, self._key, numbers, counts, tests),
            tests,
            [
                *(o for o in given if isinstance(o, Output)),
                Output(_SIZES, (len(sizes),), (*sizes,)),
            ],
            fields=[o for o in given if isinstance(o, Field)],
            block=max(min(_BLOCK, tests), 1),
        )
        return Trials(setting, pair, ensemble, _pooled(ensemble, counts), measures, points)

    @property
    def _key(self) -> PRNGKeyArray:
        return jax.random.key(self.seed)

    def _program(
        self, pair: Pair, measures: tuple[Measure, ...], numbers: Any
    ) -> Callable[..., dict[str, Array]]:
        """The compiled program for models of this structure."""
        structure = jax.tree.structure(numbers), tuple(a.shape for a in jax.tree.leaves(numbers))
        if structure not in self.programs:

            def one(index: Array, key: PRNGKeyArray, numbers: Any) -> dict[str, Array]:
                return _test(jax.random.fold_in(key, index), *_filled(pair, measures, numbers))

            self.programs[structure] = jit_outermost(jax.vmap(one, in_axes=(0, None, None)))
        return self.programs[structure]


def _numbers(pair: Pair, measures: tuple[Measure, ...]) -> Any:
    """All of a campaign that differs from setting to setting: arrays only."""
    both = [
        (one.ports.columns, {name: getattr(one, name) for name in names})
        for one, names in ((pair.simulator, _OF_SIMULATOR), (pair.batch, _OF_BATCH))
    ]
    columns = [(m.true.columns, m.found.columns) for m in measures]  # type: ignore[attr-defined]
    return jax.tree.map(jnp.asarray, (both, columns))


def _filled(
    pair: Pair, measures: tuple[Measure, ...], numbers: Any
) -> tuple[Simulator, Batch, list[Measure]]:
    """The prepared models with the numbers of one setting in them.

    Chain, station and positions stay constants to the compiler.
    """
    both, columns = numbers
    simulator, batch = (
        replace(one, ports=replace(one.ports, columns=own), **values)
        for one, (own, values) in zip((pair.simulator, pair.batch), both, strict=True)
    )
    filled = [
        replace(m, true=replace(m.true, columns=true), found=replace(m.found, columns=found))  # type: ignore[attr-defined, call-arg]
        for m, (true, found) in zip(measures, columns, strict=True)
    ]
    return simulator, batch, filled  # type: ignore[return-value]


def _test(
    key: PRNGKeyArray, simulator: Simulator, batch: Batch, measures: list[Measure]
) -> dict[str, Array]:
    """One test: outputs in um and urad, and all errors (kinds, parts, points)."""
    made = draw(simulator, key)
    found = identify_one(batch, made.readings)
    state = State(made.theta, made.shapes, found.theta, {})
    points = measures[-1]
    assert isinstance(points, PointErrors)
    initial, left = points.errors(state)
    seen = measured_points(batch.instrument, made.readings)
    residual = seen - measured_points(batch.instrument, batch.predict(found.theta))
    errors = jnp.stack([initial, residual, left, points.aligned(left)]) / _MICRO
    parts = jnp.concatenate([errors, jnp.linalg.norm(errors, axis=-1, keepdims=True)], -1)
    parts = parts.swapaxes(1, 2)
    values = {name: v for m in measures for name, v in m(state).items()}
    values[_SIZES] = jnp.stack([parts.mean(-1), (parts**2).mean(-1)], -1).reshape(-1)
    values[_ERRORS] = parts
    lost = jnp.where(found.converged, 0.0, jnp.nan)
    return {name: v + lost for name, v in values.items()}


def measured_points(tracker: Any, readings: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Points in the machine's frame from range, azimuth and elevation: station + R v, m."""
    r, azimuth, elevation = readings[:, 0], readings[:, 1], readings[:, 2]
    level = r * jnp.cos(elevation)
    v = [level * jnp.cos(azimuth), level * jnp.sin(azimuth), r * jnp.sin(elevation)]
    return jnp.asarray(tracker.station) + jnp.stack(v, -1) @ jnp.asarray(tracker.orientation).T


def _edges(errors: Float[np.ndarray, "tests kinds parts n"]) -> np.ndarray:
    """Bins (kinds, parts, b) that hold what a pilot run gave, and a little more."""
    largest = _MARGIN * np.nanmax(np.abs(errors), axis=(0, 3))
    # The three components share their bins, so that their histograms can be compared.
    largest[:, :3] = largest[:, :3].max(1, keepdims=True)
    low = np.where(np.arange(len(PARTS)) < 3, -largest, 0.0)
    share = np.linspace(0.0, 1.0, _BINS + 1)
    return low[..., None] + (largest - low)[..., None] * share


class _Counts:
    """Histograms of the errors of all points and tests, added to as the tests come."""

    def __init__(self, edges: Float[np.ndarray, "kinds parts b"]):
        self.edges = edges
        self.counts = np.zeros(edges.shape[:2] + (_BINS,), np.int64)
        self.total = 0

    def add(self, errors: Float[np.ndarray, "tests kinds parts n"]) -> None:
        """Count those of some tests; what lies outside of all bins counts in `total` only."""
        good = errors[np.isfinite(errors).all((1, 2, 3))]
        self.total += good.shape[0] * good.shape[3]
        low, width = self.edges[..., 0], self.edges[..., 1] - self.edges[..., 0]
        place = np.floor((good - low[..., None]) / width[..., None])
        for i, j in np.ndindex(self.counts.shape[:2]):
            inside = place[:, i, j][(place[:, i, j] >= 0) & (place[:, i, j] < _BINS)]
            self.counts[i, j] += np.bincount(inside.astype(np.int64), minlength=_BINS)


class _Evaluate:
    """The outputs of a range of tests, in parts that several processors share."""

    def __init__(
        self,
        program: Callable[..., dict[str, Array]],
        key: PRNGKeyArray,
        numbers: Any,
        counts: _Counts,
        tests: int,
    ):
        self.program, self.key, self.numbers = program, key, numbers
        self.counts, self.tests = counts, tests
        self.workers = cores() if _on_processor() else 1
        self.size = _size()

    def __call__(self, first: int, count: int) -> dict[str, np.ndarray]:
        # The last part is computed whole and cut, so that one program serves them all.
        starts = range(first, first + count, self.size)

        def run(start: int) -> dict[str, Array]:
            index = np.arange(start, start + self.size, dtype=np.uint32)
            return jax.block_until_ready(self.program(index, self.key, self.numbers))

        with ThreadPoolExecutor(min(self.workers, len(starts))) as pool:
            found = list(pool.map(run, starts))
        values = {k: np.concatenate([np.asarray(f[k]) for f in found])[:count] for k in found[0]}
        # The last block of a campaign is asked for whole as well.
        self.counts.add(values.pop(_ERRORS)[: self.tests - first])
        return values


def _on_processor() -> bool:
    return jax.default_backend() == "cpu"


def _size() -> int:
    """Tests that are computed in one piece."""
    return _PART if _on_processor() else _BLOCK


def _pooled(ensemble: Ensemble, counts: _Counts) -> dict[tuple[str, str], Pooled]:
    good = ensemble.draws - max(ensemble.failed.values(), default=0)
    found = {}
    for i, kind in enumerate(KINDS):
        for j, part in enumerate(PARTS):
            one, two = (ensemble.index(f"{kind} {part} {power}") for power in "12")
            mean, square = float(ensemble.mean[one]), float(ensemble.mean[two])
            found[kind, part] = Pooled(
                mean=mean,
                sd=max(square - mean**2, 0.0) ** 0.5,
                u_mean=float(ensemble.u[one]) / max(good, 1) ** 0.5,
                edges=counts.edges[i, j],
                share=counts.counts[i, j] / max(counts.total, 1),
            )
    return found
