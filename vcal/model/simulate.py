"""Simulation: the readings of an instrument on a machine drawn from the priors of a model.

    theta ~ prior -> ports -> readings -> readings + noise

`prepare` computes once what does not depend on the draw. `draw` is then a pure function of this and
of a key, which may be compiled and mapped over keys. `simulate` makes one complete measurement,
with the positions that an implicit instrument would find.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from ..distributions import Univariate
from ..effects.base import Effect
from ..instruments.base import Instrument
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..numerics.compiled import filter_jit_outermost
from ..numerics.normal_draws import standard_normal
from ..numerics.spatial import require_float64
from .forward import (
    Model,
    Shapes,
    Terms,
    concatenate,
    effect_terms,
    observe_all,
    observe_columns,
    port_values,
    tool_points,
)
from .measurement import Measurement
from .port_map import PortColumn, PortMap, columns_of, port_map
from .prior import Amplitudes, DrawnShape, drawn_shapes


class Truth(NamedTuple):
    """The true machine and instrument: a value for every parameter of a model."""

    theta: np.ndarray
    """Amplitudes (k,) in solver units (`Model.entries`)."""
    shapes: Shapes
    """Shape parameters in SI, by position of the effect in the model."""


class Draw(NamedTuple):
    """One virtual measurement with the true parameters behind it."""

    theta: Float[Array, " k"]
    """True amplitudes in solver units."""
    readings: Float[Array, "n m"]
    """Reduced readings with noise, SI."""
    shapes: dict[int, dict[str, Float[Array, ""]]]
    """True values (SI) of the shape parameters that were drawn, by position of the effect."""


class Simulator(eqx.Module):
    """A model on a plan, prepared for draws: arrays that do not depend on the draw."""

    chain: Chain
    instrument: Instrument
    plan: Plan
    rows: Any
    ports: PortMap
    scatter: tuple[PortColumn, ...]
    """Random effects, per standard deviation."""
    fresh: Amplitudes
    """Prior of the amplitudes of the random effects, which are drawn independently for every row.
    """
    shapes: tuple[DrawnShape, ...]
    """Shape parameters that are drawn; none, unless `prepare` had `draw_shapes`."""
    fixed: dict[int, dict[str, float]]
    """Values (SI) of the shape parameters that are not drawn."""
    sigma: Float[Array, "n m"]
    """Noise of the readings at the nominal machine, one standard deviation, SI."""
    amplitudes: Amplitudes
    """Prior of the amplitudes."""


@dataclass(frozen=True)
class Simulated:
    """A simulated measurement with the true parameters behind it."""

    model: Model
    """The true model: the one it was drawn from, with the added effects."""
    measurement: Measurement
    truth: Truth
    ideal: np.ndarray = field(repr=False)
    """Readings (n, m) without the noise of the instrument, SI; for an implicit instrument, at the
    recorded positions.
    """
    noise: np.ndarray = field(repr=False)
    """The drawn noise (n, m), SI, of the readings or of the recorded positions."""

    @property
    def theta(self) -> np.ndarray:
        """Amplitudes (k,) in solver units."""
        return self.truth.theta

    @property
    def shapes(self) -> Shapes:
        """Shape parameters in SI, by position of the effect."""
        return self.truth.shapes

    def values(self, effect: Effect) -> list[tuple[Parameter, float]]:
        """Parameters of an effect of the model with their true values, in the units of the
        parameters; for a random effect, with their standard deviations.

        Raises `ValueError` if the effect is not in the model.
        """
        if any(effect is other for other in self.model.random):
            return [(p, _deviation(p)) for p in effect.amplitudes]
        places = [i for i, other in enumerate(self.model.effects) if other is effect]
        if not places:
            keys = ", ".join(e.key for e in (*self.model.effects, *self.model.random))
            raise ValueError(f"effect {effect.key!r} is not in the model, which has {keys}")
        own = self.theta[self.model.places[places[0]]]
        values = [
            (p, float(p.mean + value * p.step / p.si))
            for p, value in zip(effect.amplitudes, own, strict=True)
        ]
        return values + [(p, self.shapes[places[0]][p.name] / p.si) for p in effect.shapes]

    def tool_points(self, plan: Plan) -> Float[np.ndarray, "n 3"]:
        """True tool points (n, 3) in the workpiece frame, m: with all effects of the machine and
        none of the instrument.
        """
        return true_tool_points(self.model, plan, self.truth)


_sample = filter_jit_outermost(Amplitudes.sample)


def draw_truth(model: Model, plan: Plan, key: PRNGKeyArray) -> Truth:
    """A machine and an instrument drawn from the priors of a model.

    Amplitudes, including uncertain calibrated positions, are drawn from their priors; those with a
    flat prior are zero, that is nominal. Shape parameters that are not declared have their own
    distribution, or are uniform over the scan of the loop on `plan`, in the coordinate of the scan.
    Every effect has its own key: an additional effect does not change the draws of the others.
    """
    theta = np.asarray(_sample(Amplitudes.of(model.effects), key))
    shapes = {
        i: {p.name: p.mean * p.si for p in effect.shapes}
        for i, effect in enumerate(model.effects)
        if effect.shapes
    }
    for item in drawn_shapes(model, plan):
        shapes[item.effect][item.name] = float(item.sample(key))
    return Truth(theta, shapes)


def prepare(
    model: Model,
    plan: Plan,
    shapes: Shapes | None = None,
    *,
    noise_factor: float = 1.0,
    draw_shapes: bool = False,
) -> Simulator:
    """The part of a simulation that is the same for every draw.

    `shapes` are the values of shape parameters (SI); with `draw_shapes`, those that are not
    declared are drawn with the amplitudes instead. `noise_factor` multiplies the declared noise of
    the instrument.

    Raises `RuntimeError` where JAX runs in float32, `ValueError` for a negative factor, and
    `KeyError` where an effect needs a covariate that the plan does not have.
    """
    require_float64()
    if not 0.0 <= noise_factor < np.inf:
        raise ValueError(f"noise_factor: found {noise_factor}, expected a number of at least 0")
    model.check_plan(plan)
    drawn = drawn_shapes(model, plan) if draw_shapes else ()
    shapes = shapes if draw_shapes else model.shapes_at(plan, shapes)
    moving = sorted({item.effect for item in drawn})
    rows = model.instrument.rows(plan)
    nominal = jnp.zeros((plan.rows, len(model.layout)))
    readings = observe_all(model.chain, model.instrument, plan.position, rows, nominal)
    reduced = np.asarray(model.instrument.reduce(readings, plan))
    return Simulator(
        chain=model.chain,
        instrument=model.instrument,
        plan=plan,
        rows=rows,
        ports=port_map(model, plan, shapes, moving),
        scatter=columns_of(_scatter(model, plan)),
        fresh=_fresh(model),
        shapes=drawn,
        fixed={i: dict(v) for i, v in (shapes or {}).items()},
        sigma=jnp.asarray(noise_factor * model.instrument.noise(plan, reduced)),
        amplitudes=Amplitudes.of(model.effects),
    )


def _scatter(model: Model, plan: Plan) -> Terms:
    """Terms of the random effects, with their standard deviation as unit."""
    blocks, count = [], 0
    for effect in model.random:
        blocks.append(effect_terms(scattering(effect), model.layout, plan, {}, count))
        count += len(effect.amplitudes)
    return concatenate(blocks, plan.rows, len(model.layout))


def scattering(effect: Effect) -> Effect:
    """A random effect with its standard deviation as unit of its amplitudes."""
    given = tuple((p.name, 0.0, _deviation(p)) for p in effect.amplitudes)
    return replace(effect, given=given, priors=())


def _fresh(model: Model) -> Amplitudes:
    """Priors of the random effects. Raises `ValueError` for a prior with a mean other than zero."""
    for effect in model.random:
        for prior in effect.priors:
            if any(prior.mean) or not isinstance(prior.distribution, Univariate):
                raise ValueError(
                    f"effect {effect.key!r}: found a {prior.distribution.name} distribution with "
                    f"the mean {', '.join(f'{v:g}' for v in prior.mean)}, expected a univariate "
                    "one with the mean zero; declare the systematic part of a random effect as an "
                    "effect of its own"
                )
    return Amplitudes.of(model.random)


def _deviation(parameter: Parameter) -> float:
    """Standard deviation of a random effect, in its unit: the declared or the prior's value."""
    return parameter.mean or parameter.sigma


def draw(simulator: Simulator, key: PRNGKeyArray) -> Draw:
    """One virtual measurement: a pure function of the key.

    The amplitudes are those of `draw_truth` for the first of the three keys into which `key` is
    split. The readings of an implicit instrument are its residuals at the planned positions.
    """
    machine, noise, fresh = jax.random.split(key, 3)
    theta = simulator.amplitudes.sample(machine)
    shapes: dict[int, dict[str, Any]] = {}
    for item in simulator.shapes:
        shapes.setdefault(item.effect, {})[item.name] = item.sample(machine)
    ideal = ideal_readings(simulator, theta, draw_scatter(simulator, fresh), shapes)
    return Draw(theta, ideal + simulator.sigma * standard_normal(noise, ideal.shape), shapes)


def draw_scatter(simulator: Simulator, key: PRNGKeyArray) -> Float[Array, "n r"]:
    """Amplitudes (n, r) of the random effects for every row, in standard deviations."""
    own = simulator.fresh
    return own.shaped(standard_normal(key, (simulator.plan.rows, sum(own.counts))))


def ideal_readings(
    simulator: Simulator,
    theta: Float[Array, " k"],
    scatter: Float[Array, "n r"],
    shapes: Mapping[int, Mapping[str, Any]] | None = None,
) -> Float[Array, "n m"]:
    """Reduced readings (n, m) without the noise of the instrument, SI: a pure function.

    `theta` are the amplitudes in solver units, `scatter` those of the random effects in standard
    deviations, `shapes` the values (SI) of the drawn shape parameters by position of the effect.
    """
    s = simulator
    ports = s.ports(theta, shapes)
    for column in s.scatter:
        fresh = (column.values * scatter[:, column.parameter].T).sum(0)
        ports[column.port] = ports[column.port] + fresh
    readings = observe_columns(s.chain, s.instrument, s.plan.position, s.rows, ports)
    return s.instrument.reduce(jnp.stack(readings, -1), s.plan)


_ideal_readings = filter_jit_outermost(ideal_readings)
"""One program that is kept from run to run, instead of one for every operation."""


def simulate(
    model: Model,
    plan: Plan,
    key: PRNGKeyArray,
    *,
    truth: Truth | None = None,
    effects: Sequence[Effect] = (),
    noise_factor: float = 1.0,
    name: str = "",
) -> Simulated:
    """One measurement of a plan on a machine drawn from the priors of `model`.

    `effects` are present in the true machine in addition to those of the model. `truth` (of the
    model with these effects) replaces the draw. `noise_factor` multiplies the declared noise of the
    instrument (0: no noise). `name` becomes that of the measurement. For the same arguments, the
    result is the same.

    Raises `RuntimeError` where JAX runs in float32, `ValueError` for a negative factor or a truth
    that does not fit the model, and `StudyError` where the positions of an implicit instrument are
    not found.
    """
    require_float64()
    model = model.with_effects(*effects)
    machine, noise, fresh = jax.random.split(key, 3)
    truth = draw_truth(model, plan, machine) if truth is None else truth
    if np.shape(truth.theta) != (len(model.entries),):
        raise ValueError(
            f"truth: found theta of shape {np.shape(truth.theta)}, expected "
            f"({len(model.entries)},), one value per amplitude of the model with its effects"
        )
    simulator = prepare(model, plan, truth.shapes, noise_factor=noise_factor)
    drawn = simulator.sigma * standard_normal(noise, simulator.sigma.shape)
    scatter = draw_scatter(simulator, fresh)

    def ideal(at: Plan) -> np.ndarray:
        # The terms of the effects depend on the positions of the axes.
        here = simulator if at is plan else prepare(model, at, truth.shapes)
        return np.asarray(_ideal_readings(here, jnp.asarray(truth.theta), scatter))

    recorded, readings = model.instrument.record(plan, ideal, np.asarray(drawn))
    return Simulated(
        model=model,
        measurement=Measurement(recorded, np.asarray(readings), name),
        truth=Truth(np.asarray(truth.theta), truth.shapes),
        ideal=ideal(recorded),
        noise=np.asarray(drawn),
    )


def true_tool_points(model: Model, plan: Plan, truth: Truth) -> Float[np.ndarray, "n 3"]:
    """Tool points (n, 3) of the true machine in the workpiece frame, m.

    Only effects of the machine count: effects of the instrument do not move the tool. An effect of
    a condition that the plan does not have, such as a direction that an instrument derives from the
    order of its own rows, is not included.
    """
    require_float64()
    model.check_plan(plan)
    blocks = [
        effect_terms(effect, model.layout, plan, truth.shapes.get(i, {}), place.start)
        for i, (effect, place) in enumerate(zip(model.effects, model.places, strict=True))
        if effect.where == "machine" and plan.has(*effect.needs_at(truth.shapes.get(i, {})))
    ]
    terms = concatenate(blocks, plan.rows, len(model.layout))
    ports = port_values(terms, np.asarray(truth.theta), len(model.layout))
    return np.asarray(tool_points(model.chain, jnp.asarray(plan.position), ports))


def travels(chain: Chain, plan: Plan) -> Float[np.ndarray, "axes 2"]:
    """Travel of every axis (m or rad), or the range of the plan where no travel is declared."""
    own = np.asarray(plan.position)
    ends = np.column_stack([own.min(0), own.max(0)])
    return np.where(np.isfinite(chain.travel), chain.travel, ends)


def scattered(chain: Chain, plan: Plan, key: PRNGKeyArray, rows: int) -> Plan:
    """Plan of an independent check: `rows` random positions over the travel, random directions.

    Where a travel is not bounded, positions are within the range of `plan`. All other covariates
    are those of a row of `plan` chosen at random, so that they are consistent (`Plan.elsewhere`).
    """
    picked, share, signs = map(np.asarray, _at_random(key, plan.rows, (rows, len(plan.axes))))
    low, high = travels(chain, plan).T
    position = low + (high - low) * share
    found = plan.elsewhere(position, picked)
    directions = {f"dir_{axis}": signs[:, i] for i, axis in enumerate(plan.axes)}
    directions = {name: values for name, values in directions.items() if name in found.covariates}
    return Plan(plan.axes, position, {**found.covariates, **directions})


@partial(jax.jit, static_argnums=(1, 2))
def _at_random(
    key: PRNGKeyArray, choices: int, shape: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """A choice per row, and a share of the travel and a sign per element of `shape`."""
    at, where, direction = jax.random.split(key, 3)
    picked = jax.random.choice(where, choices, shape[:1])
    share = jax.random.uniform(at, shape)
    return picked, share, jax.random.rademacher(direction, shape, float)


def conditions_at(plan: Plan, position: Float[np.ndarray, "n axes"]) -> Plan:
    """Other positions (m or rad) under the conditions of the middle row of a plan
    (`Plan.elsewhere`).
    """
    return plan.elsewhere(position, np.full(len(position), plan.rows // 2))
