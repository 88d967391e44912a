"""GUM uncertainty of an identification, by the implicit function theorem.

At the minimum theta of f(theta, y), the gradient stays zero when the readings change, so that

    d theta = H^-1 J' W' W dy,      dy = J_true d theta_true + noise

with H = J'J + L exact at the nominal machine, where the residuals vanish. A quantity q(theta_true,
theta) then has the first-order uncertainty of JCGM 100, with every parameter of the truth and every
reading as an input. A fitted parameter contributes with its posterior uncertainty. A parameter that
is not fitted (a wrong expansion coefficient, a wrong artefact length) contributes through the
identified parameters that it biases.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..effects.base import Effect
from ..model.forward import effect_terms, observe_with_jacobian, port_values
from ..model.simulate import ideal_readings
from ..numerics.arrays import Array
from ..numerics.compiled import jit_outermost
from .budget import Budget, Source
from .outputs import Output
from .quantities import Measure, Pair, State
from .taylor import first_order

_SCATTER = "scatter "
_ROUNDING = 1e-6
"""Difference of readings, in standard deviations, below which it is rounding."""


@dataclass(frozen=True)
class Linearised:
    """First-order uncertainty of the quantities of a virtual calibration."""

    budget: Budget
    """Budget of the scalar outputs. Inputs are effects and reading components, each with all its
    elements. The sensitivity of an input is the root sum of squares over them, for one standard
    deviation each.
    """
    fields: dict[str, tuple[np.ndarray, np.ndarray]]
    """Value and standard uncertainty of every field, element by element."""
    undefined: tuple[str, ...]
    """Outputs without a derivative at the nominal machine, such as the length of an error with zero
    expectation. They have no first-order uncertainty.
    """


def linearised(pair: Pair, measures: Sequence[Measure], coverage: float = 0.95) -> Linearised:
    """First-order uncertainty of quantities, through the identification (JCGM 100, 5.1).

    Distributions are treated as normal. Shape parameters of the truth are set to their nominal
    values, as they have no sensitivity at amplitudes of zero. `coverage` is the coverage
    probability of the budget.
    """
    (found,) = linearised_groups(pair, [measures], coverage)
    return found


def linearised_groups(
    pair: Pair, groups: Sequence[Sequence[Measure]], coverage: float = 0.95
) -> list[Linearised]:
    """`linearised` for several groups of quantities, with one program for their derivatives."""
    value, by_true, by_found = _derivatives(pair, [m for group in groups for m in group])
    given = sources(pair)
    gain = np.asarray(pair.batch.gain)
    # Every column: one standard deviation of one element of a source.
    parts = {
        name: _times(by_true, source.parameters) + by_found @ source.through(gain)
        for name, source in given.items()
    }
    found, start = [], 0
    for group in groups:
        size = sum(math.prod(o.shape) for m in group for o in m.outputs)
        own = slice(start, start + size)
        of_group = {name: part[own] for name, part in parts.items()}
        found.append(_linearised(pair, group, value[own], of_group, coverage))
        start += size
    return found


def _linearised(
    pair: Pair,
    measures: Sequence[Measure],
    value: np.ndarray,
    parts: Mapping[str, np.ndarray],
    coverage: float,
) -> Linearised:
    """From the values of all outputs and their columns by source."""
    declared = [o for m in measures for o in m.outputs]
    columns = np.concatenate(list(parts.values()), 1)
    defined = np.isfinite(value) & np.isfinite(columns).all(1)
    scalars, labels, fields, start = [], [], {}, 0
    undefined: list[str] = []
    for output in declared:
        size = math.prod(output.shape)
        place = slice(start, start + size)
        start += size
        if isinstance(output, Output):
            for row, label in zip(range(place.start, place.stop), output.labels, strict=True):
                if defined[row]:
                    scalars.append(row)
                    labels.append(label)
                else:
                    undefined.append(label)
        elif defined[place].all():
            u = np.sqrt((columns[place] ** 2).sum(1))
            fields[output.name] = (value[place].reshape(output.shape), u.reshape(output.shape))
        else:
            undefined.append(output.name)
    taylor = first_order(columns[scalars])
    count = len(parts)
    sizes = np.stack([np.sqrt((p[scalars] ** 2).sum(1)) for p in parts.values()], 1)
    budget = Budget(
        labels=tuple(labels),
        value=value[scalars],
        u=np.sqrt(taylor.variance),
        nu_eff=np.full(len(scalars), np.inf),
        coverage=coverage,
        order=1,
        source=Source(
            labels=tuple(parts),
            distributions=tuple(_kinds(pair, name) for name in parts),
            value=np.zeros(count),
            covariance=np.eye(count),
            dof=np.full(count, np.inf),
            groups=(),
        ),
        sensitivity=sizes,
        taylor=taylor,
        notes=("inputs are groups of elements, in units of their standard deviations",),
    )
    return Linearised(budget, fields, tuple(undefined))


def _kinds(pair: Pair, source: str) -> str:
    """Names of the distributions of the elements of a source."""
    drawn = [(e, p) for e in pair.truth.effects if e.key == source for p in e.amplitudes]
    if source.startswith(_SCATTER):
        every = [(e, p) for e in pair.truth.random for p in e.amplitudes]
        drawn = [every[int(source.removeprefix(_SCATTER)) - 1]]
    names = []
    for effect, p in drawn:
        declared = [prior.distribution.name for prior in effect.priors if p.name in prior.names]
        names += declared or ([p.law.name] if p.law is not None else ["normal"])
    return ", ".join(dict.fromkeys(names)) or "normal"


def _times(by_true: np.ndarray, parameters: np.ndarray | None) -> np.ndarray | float:
    return 0.0 if parameters is None else by_true @ parameters


def _derivatives(
    pair: Pair, measures: Sequence[Measure]
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "q k"], Float[np.ndarray, "q l"]]:
    """All quantities at the nominal machine, with derivatives by true and identified parameters."""
    drawn = _middle_shapes(pair)
    true = jnp.zeros(len(pair.truth.entries))
    # The fit of the nominal truth, which known effects that are not fitted displace.
    batch, off = pair.batch, _nominal_residual(pair)
    found = batch.gain @ off.reshape(-1)

    def judged(both: Array) -> Array:
        a, b = both[: len(true)], both[len(true) :]
        state = State(a, drawn, b, pair.batch.shape_values(b))
        values = [(m, m(state)) for m in measures]
        return jnp.concatenate([jnp.ravel(v[o.name]) for m, v in values for o in m.outputs])

    at = jnp.concatenate([true, found])
    push = jit_outermost(lambda unit: jax.jvp(judged, (at,), (unit,)))
    value, _ = push(np.zeros(len(at)))
    slopes = np.stack([np.asarray(push(unit)[1]) for unit in np.eye(len(at))], 1)
    return np.asarray(value), slopes[:, : len(true)], slopes[:, len(true) :]


def _middle_shapes(pair: Pair) -> dict[int, dict[str, Any]]:
    """The middle of the drawn shape parameters of the truth (SI), by position of the effect."""
    drawn: dict[int, dict[str, Any]] = {}
    for item in pair.simulator.shapes:
        drawn.setdefault(item.effect, {})[item.name] = item.middle
    return drawn


def _nominal_residual(pair: Pair) -> np.ndarray:
    """Readings (n, m) of the nominal truth less those of the nominal fitted model."""
    s, batch = pair.simulator, pair.batch
    true = jnp.zeros(len(pair.truth.entries))
    none = jnp.zeros((s.plan.rows, sum(s.fresh.counts)))
    still = ideal_readings(s, true, none, _middle_shapes(pair))
    off = np.asarray(batch.instrument.difference(still, batch.nominal))
    # Rounding must not count as an expectation: the length of an error has no derivative at zero.
    return np.where(np.abs(off) > _ROUNDING * np.asarray(s.sigma), off, 0.0)


def _by_port(pair: Pair) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
    """Derivatives of the reduced readings by the ports (n, m, p) at the nominal truth, and the
    values of all its shape parameters.
    """
    model, simulator = pair.truth, pair.simulator
    shapes: dict[int, dict[str, Any]] = {i: dict(v) for i, v in simulator.fixed.items()}
    for i, values in _middle_shapes(pair).items():
        middle = {name: float(value) for name, value in values.items()}
        shapes[i] = {**shapes.get(i, {}), **middle}
    terms = model.terms(simulator.plan, shapes)
    nominal = port_values(terms, np.zeros(len(model.entries)), len(model.layout))
    _, slopes = observe_with_jacobian(
        model.chain, model.instrument, simulator.plan.position, simulator.rows, nominal
    )
    return np.asarray(model.instrument.reduce(slopes, simulator.plan)), shapes


def _columns(pair: Pair, effect: Effect, by_port: np.ndarray, shape: dict[str, Any]) -> np.ndarray:
    """Derivatives of all readings (nm, a) by the amplitudes of an effect of the truth, in solver
    units.
    """
    n, m, _ = by_port.shape
    own = effect_terms(effect, pair.truth.layout, pair.simulator.plan, shape)
    columns = np.zeros((n * m, len(effect.amplitudes)))
    moved = by_port[:, :, own.port] * np.asarray(own.values)[:, None, :]
    np.add.at(columns.T, np.asarray(own.parameter), moved.reshape(n * m, -1).T)
    return columns


class LinearParts(NamedTuple):
    """The identified parameters as a linear function, in solver units."""

    at_nominal: Float[np.ndarray, " k"]
    """Those of the nominal truth without noise."""
    by_true: Float[np.ndarray, "k l"]
    """Derivatives by the true amplitudes."""
    by_noise: Float[np.ndarray, "k nm"]
    """Derivatives by the noise of every reading, per standard deviation."""
    by_scatter: Float[np.ndarray, "k ns"]
    """The same by the random effects of every row, by row and then by effect."""


def linear_parts(pair: Pair) -> LinearParts:
    """The derivatives d found = H^-1 J' W' W dy of an identification at the nominal machine."""
    batch, simulator = pair.batch, pair.simulator
    gain = np.asarray(batch.gain)
    by_port, shapes = _by_port(pair)
    n, m, _ = by_port.shape
    by_true = np.zeros((n * m, len(pair.truth.entries)))
    for i, (effect, here) in enumerate(zip(pair.truth.effects, pair.truth.places, strict=True)):
        by_true[:, here] = _columns(pair, effect, by_port, shapes.get(i, {}))
    by_row = gain.reshape(len(gain), n, m)
    scatter = np.zeros((len(gain), n, sum(simulator.fresh.counts)))
    for column in simulator.scatter:
        moved = np.einsum("knm,nm->kn", by_row, by_port[:, :, column.port])
        for values, k in zip(column.values, column.parameter, strict=True):
            scatter[:, :, int(k)] += moved * np.asarray(values)
    return LinearParts(
        gain @ _nominal_residual(pair).reshape(-1),
        gain @ by_true,
        gain * np.asarray(simulator.sigma).reshape(-1),
        scatter.reshape(len(gain), -1),
    )


class Elements(NamedTuple):
    """The effect of one standard deviation of each independent element of a source."""

    parameters: Float[np.ndarray, "k e"] | None
    """Change of the true parameters; None for a source of noise."""
    readings: Float[np.ndarray, "nm e"] | Float[np.ndarray, "e m"]
    """Change of all readings; with `rows`, of the readings of one row each."""
    rows: Int[np.ndarray, " e"] | None = None
    """Row of each element, for noise, which has an element per reading."""

    def through(self, gain: Float[np.ndarray, "a nm"]) -> Float[np.ndarray, "a e"]:
        """Change of a linear function of the readings, such as the identified parameters."""
        if self.rows is None:
            return gain @ self.readings
        by_row = gain.reshape(len(gain), -1, self.readings.shape[1])
        return np.einsum("aem,em->ae", by_row[:, self.rows], self.readings, optimize=True)


def sources(pair: Pair) -> dict[str, Elements]:
    """The independent elements of every source, by its name.

    For parameters with a joint distribution, they are the columns of a root A of their correlation
    matrix, R = A A'.
    """
    model, simulator = pair.truth, pair.simulator
    plan = simulator.plan
    by_port, shapes = _by_port(pair)
    n, m, _ = by_port.shape
    found: dict[str, Elements] = {}
    informed = np.asarray(simulator.amplitudes.informed)
    root = simulator.amplitudes.root
    for i, (effect, here) in enumerate(zip(model.effects, model.places, strict=True)):
        columns = _columns(pair, effect, by_port, shapes.get(i, {}))
        parameters = root[:, here][:, informed[here] > 0.0]
        if parameters.shape[1]:
            found[effect.key] = Elements(parameters, columns @ parameters[here])
    sigma = np.asarray(simulator.sigma)
    for part, inside in plan.parts.items():
        rows = np.flatnonzero(inside)
        own = model.instrument.members.get(part, model.instrument)
        for j, name in enumerate(own.readings):
            of_one = np.where(np.arange(m) == j, sigma[rows], 0.0)
            found[f"noise: {f'{part} {name}'.strip()}"] = Elements(None, of_one, rows)
    for column in simulator.scatter:
        slope = by_port[:, :, column.port]
        for values, k in zip(column.values, column.parameter, strict=True):
            name = f"{_SCATTER}{int(k) + 1}"
            before = found[name].readings if name in found else 0.0
            moved = before + slope * np.asarray(values)[:, None]
            found[name] = Elements(None, moved, np.arange(n))
    return found
