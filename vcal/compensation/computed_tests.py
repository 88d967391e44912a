"""Standard tests computed from an identified machine: ISO 230-1, ISO 230-2 and ISO 230-6.

Nothing is measured here: the identified errors are evaluated at the positions that a test would
visit, with their uncertainty from the posterior. The deviation along a line from the nominal point
p(q_0) to p(q_1), at targets q_i approached in the positive (+) or negative (-) direction, is

    x_i(+-) = (p(q_i + E(q_i, +-)) - p(q_i)) . e,    e = (p(q_1) - p(q_0)) / |p(q_1) - p(q_0)|

and E, M, B follow from it as in `vcal.geometry.positioning`. They are linear in the deviations at
the positions that determine them, so that u^2 = w' J C J' w, with the between-model variance of
rival models added.

- Axes (ISO 230-2:2014): one linear axis moves, the others stand in the middle of their travel.
- Body diagonals (ISO 230-6:2002): X, Y and Z move together between opposite corners of the working
  volume; E_d and B_d are the largest E and B of the four.
- Face diagonals (ISO 230-6:2002): two of them move, the third stands in the middle.

Rotary axes stand at zero. Conditions have their mean in the measurement. A and R contain the
repeatability, and are stated for axes where a `repeatability` is declared.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..geometry.acceptance import GeometricTest, tests_of
from ..geometry.error_motions import NODES, Spread
from ..geometry.positioning import QUANTITIES, systematic
from ..geometry.straight_lines import StraightLines
from ..machine.plan import Plan
from .machine import IdentifiedMachine

Kind = Literal["axis", "body diagonal", "face diagonal"]
TARGETS = 21
"""Targets of every line."""
_UM = 1e6
_DIR = "dir_"


@dataclass(frozen=True)
class Quantity:
    """A quantity of a computed test, um."""

    value: float
    u: float
    """Standard uncertainty."""
    information: float
    """Share of information from the data: 1 - variance after / variance before the measurement."""


@dataclass(frozen=True)
class LineTest:
    """A computed test along one line."""

    kind: Kind
    name: str
    """The axis, ``"X"``, or the axes with their signs, ``"-X+Y+Z"``."""
    target: Float[np.ndarray, " m"]
    """Distances from the start of the line, m; of an axis its positions."""
    up: Float[np.ndarray, " m"]
    """Deviations, approached in the positive direction, um."""
    down: Float[np.ndarray, " m"] | None
    """The same for the negative direction; None where the identified machine has no hysteresis on
    this line."""
    quantities: Mapping[str, Quantity]
    """Those of `QUANTITIES` that can be stated: without a hysteresis, E alone (and A, R)."""

    @property
    def standard(self) -> str:
        """The standard whose test is computed."""
        return "ISO 230-2:2014" if self.kind == "axis" else "ISO 230-6:2002"

    @property
    def length(self) -> float:
        """Length of the line, m."""
        return float(abs(self.target[-1] - self.target[0]))


@dataclass(frozen=True)
class _Line:
    kind: Kind
    name: str
    signs: Mapping[str, int]
    position: np.ndarray
    """Positions of all axes (m, axes)."""


def line_tests(machine: IdentifiedMachine, targets: int = TARGETS) -> list[LineTest]:
    """The tests of ISO 230-2 and ISO 230-6 on `targets` positions per line; empty for an arm."""
    lines = _lines(machine, targets)
    if not lines:
        return []
    ways = [_travelled(machine, lines, way) for way in (1, -1)]
    return [
        _test(machine, line, slice(k * targets, (k + 1) * targets), ways)
        for k, line in enumerate(lines)
    ]


@dataclass(frozen=True)
class _Travelled:
    """All lines, travelled in one direction."""

    points: np.ndarray
    """Tool points (n, 3), m."""
    slopes: np.ndarray
    """Their derivative (n, 3, k)."""
    changes: Sequence[Sequence[np.ndarray]]
    """Changes of the tool points (n, 3) by the other models of every rival."""
    scatter: np.ndarray
    """Standard deviation of the tool points (n, 3) at an approach, m."""


def _travelled(machine: IdentifiedMachine, lines: Sequence[_Line], way: int) -> _Travelled:
    whole = machine.whole
    directions = np.concatenate([_directions(machine, line, way) for line in lines])
    plan = whole.plan(np.concatenate([line.position for line in lines]), directions)
    changes = [[change for _, change in rival.changes(plan)] for rival in machine.rivals]
    return _Travelled(*whole.derivative(plan), changes, whole.scatter(plan))


def _test(
    machine: IdentifiedMachine, line: _Line, rows: slice, ways: Sequence[_Travelled]
) -> LineTest:
    nominal = machine.nominal(line.position)
    along = nominal[-1] - nominal[0]
    along = along / np.linalg.norm(along)
    ways = ways if _reverses(machine, line) else ways[:1]
    x = [(one.points[rows] - nominal) @ along for one in ways]
    slopes = np.concatenate([np.einsum("nik,i->nk", one.slopes[rows], along) for one in ways])
    changes = [
        [np.concatenate([one.changes[r][j][rows] @ along for one in ways]) for j in range(count)]
        for r, count in enumerate(len(rival.others) for rival in machine.rivals)
    ]
    up, down = x[0], x[1] if len(x) == 2 else None
    weights = _named(systematic(up, down), down is not None)
    if any(effect.placement == line.name for effect in machine.random):
        s = np.sqrt(ways[0].scatter[rows] ** 2 @ along**2)
        weights |= _with_scatter(up, down, s)
    quantities = {
        name: _quantity(machine, *weights[name], np.concatenate(x), slopes, changes)
        for name in QUANTITIES
        if name in weights
    }
    target = (
        line.position[:, machine.axes.index(line.name)]
        if line.kind == "axis"
        else np.linalg.norm(nominal - nominal[0], axis=1)
    )
    reached = None if down is None else _UM * down
    return LineTest(line.kind, line.name, target, _UM * up, reached, quantities)


def largest_of(tests: Sequence[LineTest], kind: Kind, name: str) -> tuple[str, Quantity] | None:
    """The largest value of a quantity over the lines of one kind, with the name of its line: E_d
    and B_d of ISO 230-6 for body diagonals. None where no line has it.
    """
    those = [(t.name, t.quantities[name]) for t in tests if t.kind == kind and name in t.quantities]
    return max(those, key=lambda one: one[1].value) if those else None


def _lines(machine: IdentifiedMachine, targets: int) -> list[_Line]:
    chain = machine.chain
    low, high = machine.volume.T
    linear = [
        axis
        for axis, a, b in zip(machine.axes, low, high, strict=True)
        if not chain.arm and axis in ("X", "Y", "Z") and b > a
    ]
    straight = StraightLines.of(chain, machine.volume, targets) if linear else None
    if straight is None:
        return []
    paths = straight.position.reshape(len(straight.axes), targets, -1)
    found = [
        _Line("axis", axis, {axis: 1}, paths[straight.axes.index(axis)]) for axis in sorted(linear)
    ]
    rest = found[0].position.copy()  # everything stands, but for the axis that is set here
    for axis in linear:
        i = machine.axes.index(axis)
        rest[:, i] = 0.5 * (low[i] + high[i])
    groups: list[tuple[Kind, tuple[str, ...]]] = [
        ("face diagonal", pair) for pair in itertools.combinations(sorted(linear), 2)
    ]
    if len(linear) == 3:
        groups.insert(0, ("body diagonal", ("X", "Y", "Z")))
    for kind, axes in groups:
        for signs in itertools.product((1, -1), repeat=len(axes) - 1):
            way = dict(zip(axes, (*signs, 1), strict=True))
            position = rest.copy()
            for axis, sign in way.items():
                i = machine.axes.index(axis)
                position[:, i] = np.linspace(low[i], high[i], targets)[::sign]
            name = "".join(f"{'+' if sign > 0 else '-'}{axis}" for axis, sign in way.items())
            found.append(_Line(kind, name, way, position))
    return found


def _directions(machine: IdentifiedMachine, line: _Line, way: int) -> np.ndarray:
    found = np.zeros_like(line.position)
    for axis, sign in line.signs.items():
        found[:, machine.axes.index(axis)] = way * sign
    return found


def _reverses(machine: IdentifiedMachine, line: _Line) -> bool:
    """Whether the identified errors depend on the direction of an axis that moves."""
    named = {f"{_DIR}{axis}" for axis in line.signs}
    return any(named & {*part.needs} for part in machine.parts if part.identified)


_Weighted = dict[str, tuple[np.ndarray, float]]
"""Weights of the deviations in a quantity, and what is added to it, m."""


def _named(weights: Mapping[str, np.ndarray], both: bool) -> _Weighted:
    """Without a hysteresis, E of one direction is that of both."""
    return {(name if both else "E"): (w, 0.0) for name, w in weights.items()}


def _with_scatter(up: np.ndarray, down: np.ndarray | None, s: np.ndarray) -> _Weighted:
    """A and R, with the standard deviation s (m,) of an approach in either direction."""
    other = up if down is None else down
    both, wide = np.concatenate([up, other]), 2.0 * np.concatenate([s, s])
    high, low = int((both + wide).argmax()), int((both - wide).argmin())
    repeated = 4.0 * s + np.abs(up - other)  # R_i of ISO 230-2 for equal s
    m, at = len(up), int(repeated.argmax())
    accuracy, spread = np.zeros(2 * m), np.zeros(2 * m)
    accuracy[high] += 1.0
    accuracy[low] -= 1.0
    sign = math.copysign(1.0, up[at] - other[at])
    spread[at], spread[m + at] = sign, -sign
    if down is None:  # both directions are one
        accuracy, spread = accuracy[:m] + accuracy[m:], spread[:m] + spread[m:]
    return {"A": (accuracy, float(wide[high] + wide[low])), "R": (spread, float(4.0 * s[at]))}


def _quantity(
    machine: IdentifiedMachine,
    weights: np.ndarray,
    added: float,
    deviation: np.ndarray,
    slopes: np.ndarray,
    changes: Sequence[Sequence[np.ndarray]],
) -> Quantity:
    block = (weights @ slopes)[None]
    variance = float((block @ machine.covariance @ block.T)[0, 0])
    for rival, by_model in zip(machine.rivals, changes, strict=True):
        chances = [p for p, _ in rival.others]
        moved = [float(weights @ change) for change in by_model]
        variance += sum(p * change**2 for p, change in zip(chances, moved, strict=True))
        if rival.averaged:
            variance -= sum(p * change for p, change in zip(chances, moved, strict=True)) ** 2
    return Quantity(
        _UM * (float(weights @ deviation) + added),
        _UM * math.sqrt(max(variance, 0.0)),
        float(machine.information(block)[0]),
    )


def geometric_tests_of(machine: IdentifiedMachine) -> list[GeometricTest]:
    """The deviations of ISO 230-1 as a report states them (`geometric_tests`), from the identified
    machine alone; empty for an arm.
    """
    chain = machine.chain
    if chain.arm:
        return []
    lines = StraightLines.of(chain, machine.volume, NODES)
    nodes = machine.lines(NODES)
    bare = replace(machine.whole, rivals=())
    motions = {name: len(mean) for name, (_, mean) in bare.error_functions(nodes).items()}

    def sampled(one: IdentifiedMachine) -> tuple[np.ndarray, np.ndarray]:
        points, jacobian = one.derivative(Plan(one.axes, lines.position))
        values = [(points - lines.nominal.reshape(-1, 3)).ravel()]
        rows = [jacobian.reshape(-1, jacobian.shape[2])]
        functions = one.error_functions(nodes)
        for name, count in motions.items():
            none = (np.zeros((count, len(one.theta))), np.zeros(count))
            block, mean = functions.get(name, none)
            values.append(mean + block @ one.theta)
            rows.append(block)
        return np.concatenate(values), np.concatenate(rows)

    def average(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved, variance = np.zeros(len(weights)), np.zeros(len(weights))
        for rival in machine.rivals:
            named = weights @ sampled(rival.found.whole)[0]
            changes = [(p, weights @ sampled(other.whole)[0] - named) for p, other in rival.others]
            variance = variance + sum(p * change**2 for p, change in changes)
            if rival.averaged:
                mean = sum(p * change for p, change in changes)
                moved = moved + mean
                variance = np.maximum(variance - np.square(mean), 0.0)
        return moved, variance

    prior = np.where(np.isfinite(machine.prior), machine.prior, 0.0)
    spread = Spread(machine.covariance, machine.planned, prior)
    return tests_of(lines, chain, motions, *sampled(bare), spread, average)
