"""The same 51 points, better placed: beam path, shares of the beams and places on them.

The largest expanded uncertainty of the thirteen errors is minimised, each in um as the publication
gives it, with least squares as the identification; that of the tool in the volume is given as well.
The search gets one freedom after the other, so that the gain of each is visible.

Paths are runs of edges of the work space that turn at every corner, as pentaprisms make them. For
each the convex problem of how often to measure where gives a bound and the shares of the beams; the
best is then refined by gradient, with places that keep a distance from each other.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...design import (
    apportion,
    covariance,
    expanded,
    information,
    inverse,
    jacobian,
    minimax,
    precision,
    weigh,
)
from ...instruments.laser_frame import Segment
from ...machine.plan import Plan
from ...model.forward import Model
from ...numerics.arrays import Array
from ...numerics.compiled import jit_outermost
from .defined import Asked
from .recipe import Lever
from .setting import (
    LEVER_M,
    THIRTEEN,
    TRAVEL,
    WIDE_M,
    Layout,
    ReadingNoise,
    errors,
    frame_setup,
    range_of,
    reading_u,
)

GAP_M = 5e-3
"""Least distance between points: closer ones share what the budget takes for independent."""
_GRID = 21
"""Candidate places on an edge."""
_COMMON = {"X": (2, 4), "Y": (1, 3), "Z": (5, 5)}
"""Segments of the publication whose ranges of the diode the first and the second beam along an axis
get.
"""
_LEAST = 3
_ACCURACY = 1e-5
_COVERAGE = 2.0

Goal = Literal["errors", "tool"]


@dataclass(frozen=True)
class Step:
    """The best that a freedom allows."""

    freedom: str
    layout: Layout
    U: dict[str, float]
    """Largest expanded uncertainty of every error along its axis, um."""
    tool: float
    """Largest expanded uncertainty of a component of the tool's displacement, um."""

    @property
    def largest(self) -> float:
        """Of the thirteen."""
        return max(self.U.values())


@dataclass(frozen=True)
class PathBound:
    """One beam path, measured at its best places without regard to their distance."""

    corners: tuple[tuple[int, ...], ...]
    """Corners of the work space in the order of the beam, 0 and 1 for the ends of X, Y, Z."""
    evenly: float
    """Largest U of the thirteen with evenly spaced points, um; infinite where it does not see
    them.
    """
    bound: float
    """The least that any places and shares on these edges can reach, um."""
    weights: Float[np.ndarray, "beams grid"]
    """How often to measure at evenly spaced candidates of every beam."""

    @property
    def shares(self) -> tuple[float, ...]:
        """Points per beam."""
        return tuple(self.weights.sum(1).tolist())


@dataclass(frozen=True)
class Better:
    """What the search found."""

    steps: tuple[Step, ...]
    """The publication's way first, then with one freedom after the other."""
    for_tool: Step
    """The best for the tool in the volume, on the path of the last step."""
    five: tuple[PathBound, ...]
    """Paths of five beams that see all thirteen, best first."""
    six: tuple[PathBound, ...]
    """The best paths of six beams."""
    tried: tuple[int, int]
    """How many paths of five and six beams there are."""


def better(progress: Callable[[str], None] = lambda what: None) -> Better:
    """Search for better layouts of the publication's points."""
    start = Layout.named("3d")
    total = start.points
    progress("beam paths")
    edges = _Edges()
    five, tried5 = edges.paths(5, total)
    six, tried6 = edges.paths(6, total)
    own = edges.bound(_corners(start.segments), total)
    progress("places of the points")
    shared = _with_counts(start, apportion(np.asarray(own.shares), total, _LEAST).tolist())
    paths = [_measured(one[0], total) for one in (five, six)]
    steps = (
        judge("as published, on the path “3d”", start),
        refine("places on the beams", start),
        refine("and points per beam", shared),
        refine("and lever of the diode", shared, lever=True),
        refine("and beam path", paths[0], lever=True),
        refine("and a sixth beam", paths[1], lever=True),
    )
    progress("places for the tool")
    for_tool = refine("for the tool in the volume", paths[0], goal="tool")
    return Better(steps, for_tool, tuple(five), tuple(six), (tried5, tried6))


def segments_along(corners: Sequence[Sequence[int]], counts: Sequence[int]) -> tuple[Segment, ...]:
    """Beams from corner to corner of the work space."""
    found, seen = [], dict.fromkeys("XYZ", 0)
    for number, (a, b, n) in enumerate(zip(corners, corners[1:], counts, strict=False), start=1):
        axis = next(c for i, c in enumerate("XYZ") if a[i] != b[i])
        ends = [tuple(TRAVEL[c][int(v)] for c, v in zip("XYZ", end, strict=True)) for end in (a, b)]
        reach = range_of(_COMMON[axis][min(seen[axis], 1)])
        seen[axis] += 1
        psd = "horizontal" if axis == "Z" else "vertical"
        found.append(Segment(number, *ends, int(n), psd, reach))  # type: ignore[arg-type]
    return tuple(found)


def _corners(segments: Sequence[Segment]) -> tuple[tuple[int, ...], ...]:
    ends = [segments[0].start, *(one.end for one in segments)]
    return tuple(
        tuple(int(v == TRAVEL[c][1]) for c, v in zip("XYZ", end, strict=True)) for end in ends
    )


def _measured(path: PathBound, total: int) -> Layout:
    """Evenly, with the points per beam that the weights give."""
    shares = apportion(np.asarray(path.shares), total, _LEAST)
    return Layout.even(segments_along(path.corners, shares.tolist()))


def _with_counts(layout: Layout, counts: Sequence[int]) -> Layout:
    pairs = zip(layout.segments, counts, strict=True)
    return Layout.even([one._replace(points=int(n)) for one, n in pairs])


def _fitted(layout: Layout) -> tuple[Model, Plan, Asked, np.ndarray, np.ndarray]:
    """Least squares on a layout; what is asked in um per amplitude: errors, and the tool."""
    chain, instrument, plan = frame_setup(layout, sigma_m=0.0)
    own = errors(chain, THIRTEEN, dict.fromkeys(THIRTEEN, WIDE_M))
    model = Model(chain, instrument, (own, *instrument.effects(plan)))
    asked, lever = Asked.usual(), Lever.seen()
    outputs = asked.of(model)
    levers = np.array([lever.of(name) for name in asked.names])
    return model, plan, asked, outputs * levers[:, None] / 1e-6, asked.tool(chain, outputs) / 1e-6


def _U(layout: Layout) -> tuple[dict[str, float], float]:
    model, plan, asked, on_errors, on_tool = _fitted(layout)
    C = covariance(model.with_effects(ReadingNoise(layout.u())), plan)
    each = np.asarray(expanded(on_errors, C))
    own = np.asarray(asked.names)
    return (
        {name: float(each[own == name].max()) for name in THIRTEEN},
        float(expanded(on_tool, C).max()),
    )


def judge(freedom: str, layout: Layout) -> Step:
    """What a layout gives."""
    return Step(freedom, layout, *_U(layout))


def refine(freedom: str, start: Layout, *, goal: Goal = "errors", lever: bool = False) -> Step:
    """The places, and the lever where asked, that make the largest U smallest, from a start."""
    model, plan, _, on_errors, on_tool = _fitted(start)
    functionals = on_errors if goal == "errors" else on_tool
    counts = [len(s) for s in start.shares]
    cuts = np.cumsum(counts)[:-1]
    ends = [(np.asarray(one.start), one.length * one.direction) for one in start.segments]

    def informed(z: Float[Array, " n"], lever: Float[Array, ""]) -> Float[Array, "n k k"]:
        shares = jnp.split(z, cuts)
        position = jnp.concatenate(
            [a + s[:, None] * step for (a, step), s in zip(ends, shares, strict=True)]
        )
        instrument = replace(model.instrument, lever=lever)
        noise = ReadingNoise(reading_u(start.segments, shares))
        there = Model(model.chain, instrument, (*model.effects, noise))
        return information(there, plan.with_position(position))

    # A point's information depends on its own place: one direction has the derivatives of all.
    @jit_outermost
    def with_slopes(z: Float[Array, " n"], lever: Float[Array, ""]):
        ones, none = jnp.ones_like(z), jnp.zeros_like(z)
        value, by_place = jax.jvp(informed, (z, lever), (ones, 0.0))
        _, by_lever = jax.jvp(informed, (z, lever), (none, 1.0))
        return value, by_place, by_lever.sum(0)

    prior = precision(model)

    # Asked for the criteria and then for their slopes at the same place.
    @lru_cache(maxsize=1)
    def value_and_slopes(place: bytes) -> tuple[np.ndarray, np.ndarray]:
        z = np.frombuffer(place)
        reached = z[-1] if lever else start.lever
        F, by_place, by_lever = map(np.asarray, with_slopes(z[: start.points], np.asarray(reached)))
        H = prior + F.sum(0)
        R = functionals @ np.asarray(inverse(H))
        U = _COVERAGE * np.sqrt((R * functionals).sum(1))
        dF = np.concatenate([by_place, by_lever[None]]) if lever else by_place
        # U^2 = k^2 d' C d, and dC = - C dF C.
        half = np.einsum("qk,nkl->qnl", R, dF, optimize=True)
        return U, -0.5 * _COVERAGE**2 * np.einsum("qnl,ql->qn", half, R) / U[:, None]

    z = np.concatenate(start.shares)
    high = np.ones(len(z))
    if lever:
        # Zero is a stationary point wherever the sign of the lever does not matter.
        z, high = np.append(z, 0.5 * LEVER_M), np.append(high, LEVER_M)
    found = minimax(
        lambda z: value_and_slopes(z.tobytes())[0],
        z,
        np.zeros(len(z)),
        high,
        slopes=lambda z: value_and_slopes(z.tobytes())[1],
        at_least=_distances(start, len(z)),
        tolerance=_ACCURACY,
    )
    shares = tuple(np.split(found.z[: start.points], cuts))
    reached = float(found.z[-1]) if lever else start.lever
    return judge(freedom, Layout(start.segments, shares, reached))


def _distances(layout: Layout, size: int) -> tuple[np.ndarray, np.ndarray]:
    """A and b of ``A z >= b``: neighbours on a beam keep their distance."""
    rows, least, start = [], [], 0
    for one, s in layout.beams:
        for i in range(start, start + len(s) - 1):
            row = np.zeros(size)
            row[i], row[i + 1] = -1.0, 1.0
            rows.append(row)
            least.append(GAP_M / one.length)
        start += len(s)
    return np.array(rows), np.array(least)


class _Edges:
    """The twelve edges of the work space, with what candidate places on them show."""

    def __init__(self):
        corners = list(itertools.product((0, 1), repeat=3))
        self.ends = [
            (a, b)
            for a, b in itertools.combinations(corners, 2)
            if np.abs(np.subtract(a, b)).sum() == 1
        ]
        candidates = [
            segments_along(ends, (_GRID,))[0]._replace(number=k) for k, ends in enumerate(self.ends)
        ]
        layout = Layout.even(candidates)
        model, plan, _, self.functionals, _ = _fitted(layout)
        # The data alone must see everything.
        self.precision = 0.0 * precision(model)
        found = np.asarray(jacobian(model, plan))
        self.jacobian = found.reshape(len(self.ends), _GRID, *found.shape[1:])

    def information(self, corners: Sequence[Sequence[int]]) -> Float[np.ndarray, "n k k"]:
        """Of every candidate along a path, with the noise it has there."""
        segments = segments_along(corners, [_GRID] * (len(corners) - 1))
        u = Layout.even(segments).u().reshape(len(segments), _GRID, 2)
        parts = []
        for k, (a, b) in enumerate(zip(corners, corners[1:], strict=False)):
            ends = tuple(sorted((tuple(a), tuple(b))))
            J = self.jacobian[self.ends.index(ends)]  # type: ignore[arg-type]
            J = J if ends[0] == tuple(a) else J[::-1]
            whitened = J / u[k][:, :, None]
            parts.append(np.einsum("nmk,nml->nkl", whitened, whitened))
        return np.concatenate(parts)

    def bound(self, corners: Sequence[Sequence[int]], total: int) -> PathBound:
        """The best weights along a path; raises `ValueError` where it does not see everything."""
        information = self.information(corners)
        best = weigh(information, self.precision, 2.0 * self.functionals, total)
        evenly = weigh(information, self.precision, 2.0 * self.functionals, total, steps=1)
        weights = best.weights.reshape(-1, _GRID)
        return PathBound(tuple(map(tuple, corners)), evenly.largest, best.largest, weights)

    def paths(self, beams: int, total: int) -> tuple[list[PathBound], int]:
        """Those that see everything, best first, and how many there are at all.

        A path and its mirror image in X are worth the same: only one of them counts.
        """
        found, count = [], 0
        for start in [(0, *rest) for rest in itertools.product((0, 1), repeat=2)]:
            for turns in itertools.product(range(3), repeat=beams):
                if any(a == b for a, b in itertools.pairwise(turns)):
                    continue
                corners: list[tuple[int, ...]] = [start]
                for axis in turns:
                    corners.append(tuple(v ^ (i == axis) for i, v in enumerate(corners[-1])))
                count += 1
                try:
                    found.append(self.bound(corners, total))
                except ValueError:
                    continue
        return sorted(found, key=lambda one: one.bound), count
