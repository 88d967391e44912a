"""Quantities of a virtual calibration: functions of the true and of the identified parameters."""

import abc
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..geometry.straight_lines import StraightLines
from ..identification.batch import Batch
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS
from ..model.forward import Model, tool_columns
from ..model.port_map import PortMap, port_map
from ..model.simulate import Simulator, conditions_at, travels
from ..numerics.arrays import Array
from ..numerics.rigid import Scalar
from ..numerics.spatial import after_small_alignment
from .outputs import Field, Output

_MICRO = 1e-6


class Pair(NamedTuple):
    """A truth and the model fitted to its measurements, both prepared for many draws."""

    truth: Model
    fit: Model
    simulator: Simulator
    batch: Batch

    def maps(self, plan: Plan) -> tuple[PortMap, PortMap]:
        """Port maps of the true and the fitted machine on another plan, without the instrument."""
        true = sorted({item.effect for item in self.simulator.shapes})
        found = sorted({*self.batch.fixed, *(i for i, *_ in self.batch.shapes)})
        return (
            port_map(self.truth, plan, self.simulator.fixed, true, machine_only=True),
            port_map(self.fit, plan, self.batch.nominal_shapes, found, machine_only=True),
        )


class State(NamedTuple):
    """One draw, as the argument of a quantity."""

    true: Float[Array, " k"]
    """True amplitudes in solver units."""
    true_shapes: Mapping[int, Mapping[str, Any]]
    found: Float[Array, " l"]
    """Identified parameters in solver units."""
    found_shapes: Mapping[int, Mapping[str, Any]]
    readings: Float[Array, "n m"] | None = None
    """Readings, SI, for an evaluation in addition to the identification; None in a linearised
    campaign, which has derivatives by the parameters only.
    """


class Measure(eqx.Module):
    """A quantity of a given pair of models: a pure function of one draw."""

    @property
    @abc.abstractmethod
    def outputs(self) -> tuple[Output | Field, ...]:
        """Declarations of its outputs."""

    @abc.abstractmethod
    def __call__(self, state: State) -> dict[str, Array]:
        """Values by name, in um, urad or the units of the parameters."""


def scalars(measures: Sequence[Measure], state: State) -> dict[str, Array]:
    """The scalar outputs of one draw, by name."""
    wanted = {o.name for m in measures for o in m.outputs if isinstance(o, Output)}
    return {name: v for m in measures for name, v in m(state).items() if name in wanted}


class Quantity(abc.ABC):
    """Base class of all quantities; subclasses are final, frozen settings."""

    @abc.abstractmethod
    def measure(self, pair: Pair) -> Measure:
        """The quantity for this pair of models."""


# --- parameters ---


class ParameterErrors(eqx.Module, Quantity):
    """Identified minus true value of every fitted amplitude; a missing true one counts as zero."""

    name: str = eqx.field(static=True, default="parameter")

    def measure(self, pair: Pair) -> Measure:
        true = {
            (e.key, e.parameter.name): (i, e.parameter) for i, e in enumerate(pair.truth.entries)
        }
        fitted = pair.fit.entries
        places, labels, scales, offsets, steps = [], [], [], [], []
        for entry in fitted:
            p = entry.parameter
            i, other = true.get((entry.key, p.name), (-1, None))
            places.append(i)
            labels.append(f"{entry.key}: {p.name} [{p.unit}]")
            scales.append(p.step / p.si)
            steps.append(0.0 if other is None else other.step / p.si)
            offsets.append(p.mean - (0.0 if other is None else other.mean))
        return _ParameterErrors(
            self.name, tuple(labels), *(np.asarray(v) for v in (places, scales, steps, offsets))
        )


class _ParameterErrors(Measure):
    name: str = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    places: np.ndarray
    scales: np.ndarray
    steps: np.ndarray
    offsets: np.ndarray

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        return (Output(self.name, (len(self.labels),), self.labels),)

    def __call__(self, state: State) -> dict[str, Array]:
        found = state.found[: len(self.labels)]
        # An index of -1 reads an arbitrary parameter, which a scale of zero then removes.
        true = jnp.append(state.true, 0.0)[self.places] * self.steps
        return {self.name: self.offsets + self.scales * found - true}


# --- error motions ---


class ErrorMotionErrors(eqx.Module, Quantity):
    """Remaining error motions after compensation: true minus identified, per position.

    Positions are `nodes` points over the travel of each axis, with the other axes in the middle of
    their travel. Values are in um and urad, with names as in ISO 230-1 (``"EXY at 0.25 m"``).
    """

    nodes: int = eqx.field(static=True, default=5)

    def measure(self, pair: Pair) -> Measure:
        chain, plan = pair.truth.chain, pair.simulator.plan
        travel = travels(chain, plan)
        middle = travel.mean(1)
        positions = np.tile(middle, (len(travel), self.nodes, 1))
        labels = []
        for a, axis in enumerate(chain.axes):
            positions[a, :, a] = np.linspace(travel[a, 0], travel[a, 1], self.nodes)
            for x in positions[a, :, a]:
                place = f"{np.rad2deg(x):.4g} deg" if chain.joints[a].turns else f"{x:.4g} m"
                units = ["um" if c in "XYZ" else "urad" for c in COMPONENTS]
                named = zip(COMPONENTS, units, strict=True)
                labels += [f"E{c}{axis} at {place} [{unit}]" for c, unit in named]
        where = conditions_at(plan, positions.reshape(-1, len(travel)))
        return _ErrorMotionErrors(*pair.maps(where), self.nodes, tuple(labels))


class _ErrorMotionErrors(Measure):
    true: PortMap
    found: PortMap
    nodes: int = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        return (Output("error motion", (len(self.labels),), self.labels),)

    def __call__(self, state: State) -> dict[str, Array]:
        true = self.true(state.true, state.true_shapes)
        found = self.found(state.found, state.found_shapes)
        left = []
        for first in range(0, len(self.labels) // len(COMPONENTS), self.nodes):
            rows = slice(first, first + self.nodes)
            a = first // self.nodes * len(COMPONENTS)
            ports = range(a, a + len(COMPONENTS))
            left.append(
                jnp.stack(
                    [self._along(true[p], rows) - self._along(found[p], rows) for p in ports], -1
                )
            )
        return {"error motion": jnp.concatenate(left).reshape(-1) / _MICRO}

    def _along(self, port: Scalar, rows: slice) -> Array:
        """A port at the nodes of one axis (nodes,)."""
        values = jnp.asarray(port)
        return jnp.broadcast_to(values[rows] if values.ndim else values, (self.nodes,))


# --- straight motions of the tool point ---


class LineErrors(eqx.Module, Quantity):
    """Remaining squareness errors and slopes of positioning errors after compensation: true minus
    identified, urad and um/m.

    They are those of the least-squares lines through the paths of the tool point over the travel,
    with the other axes in the middle of theirs (`StraightLines`): ``"EC(0X)Y [urad]"``,
    ``"EXX slope [um/m]"``. Unlike parameters, they depend neither on the frame nor on the
    distribution of slopes among parameters.
    """

    nodes: int = eqx.field(static=True, default=9)

    def measure(self, pair: Pair) -> Measure:
        chain, plan = pair.truth.chain, pair.simulator.plan
        lines = StraightLines.of(chain, travels(chain, plan), self.nodes)
        asked = [(f"{name} [urad]", weights) for name, *_, weights in lines.squareness]
        for axis, along in lines.along.items():
            scale = lines.on(axis, lines.slope(axis), along)
            asked.append((f"E{axis}{axis} slope [um/m]", scale))
        weights = np.array([weights.ravel() for _, weights in asked]).reshape(len(asked), -1)
        maps = pair.maps(conditions_at(plan, lines.position))
        return _LineErrors(chain, *maps, tuple(label for label, _ in asked), weights)


class _LineErrors(Measure):
    chain: Chain
    true: PortMap
    found: PortMap
    labels: tuple[str, ...] = eqx.field(static=True)
    weights: np.ndarray
    """(outputs, 3 n)."""

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        return (Output("straight lines", (len(self.labels),), self.labels),)

    def __call__(self, state: State) -> dict[str, Array]:
        position = self.true.plan.position
        real = tool_columns(self.chain, position, self.true(state.true, state.true_shapes))
        predicted = tool_columns(self.chain, position, self.found(state.found, state.found_shapes))
        left = jnp.stack(real, -1) - jnp.stack(predicted, -1)
        return {"straight lines": self.weights @ left.reshape(-1) / _MICRO}


# --- volumetric errors ---


class VolumetricErrors(eqx.Module, Quantity):
    """Volumetric error at check points before and after compensation, um.

    d is the true tool point minus that of the fitted model (before: minus the nominal one). With
    `align`, the best-fit rigid motion of all points is removed, as a measurement with an unknown
    station or artefact pose contains no information about it. Scalar outputs are mean, root mean
    square and largest |d| of a draw, before and after. Fields are the components of d after
    compensation and |d| before and after, per point. `points` is a plan with the covariates that
    the effects need.
    """

    points: Plan
    align: bool = eqx.field(static=True, default=True)
    quantiles: tuple[float, ...] = eqx.field(static=True, default=(0.025, 0.5, 0.975))

    def measure(self, pair: Pair) -> Measure:
        chain = pair.truth.chain
        true, found = pair.maps(self.points)
        still: list[Any] = [0.0] * len(pair.truth.layout)
        nominal = np.column_stack(tool_columns(chain, np.asarray(self.points.position), still))
        return _VolumetricErrors(chain, true, found, nominal, self.align, self.quantiles)


SCALARS = ("mean", "rms", "largest")


class _VolumetricErrors(Measure):
    chain: Chain
    true: PortMap
    found: PortMap
    nominal: np.ndarray
    align: bool = eqx.field(static=True)
    """Whether the best rigid motion of all points is removed."""
    quantiles: tuple[float, ...] = eqx.field(static=True)

    @property
    def outputs(self) -> tuple[Output | Field, ...]:
        n, q = len(self.nominal), self.quantiles
        labels = tuple(f"{s} volumetric error {w} [um]" for w in _WHEN for s in SCALARS)
        return (
            Output("volumetric error", (len(labels),), labels),
            Field("volumetric error before [um]", (n,), q),
            Field("volumetric error after [um]", (n,), q),
            Field("error components after [um]", (n, 3), q),
        )

    def __call__(self, state: State) -> dict[str, Array]:
        position = self.true.plan.position
        true = self.true(state.true, state.true_shapes)
        found = self.found(state.found, state.found_shapes)
        real = jnp.stack(tool_columns(self.chain, position, true), -1)
        predicted = jnp.stack(tool_columns(self.chain, position, found), -1)
        before, after = self._errors(jnp.stack([jnp.asarray(self.nominal), predicted]), real)
        size_before, size_after = _length(before), _length(after)
        scalars = [f(size) for size in (size_before, size_after) for f in (jnp.mean, _rms, jnp.max)]
        return {
            "volumetric error": jnp.stack(scalars) / _MICRO,
            "volumetric error before [um]": size_before / _MICRO,
            "volumetric error after [um]": size_after / _MICRO,
            "error components after [um]": after / _MICRO,
        }

    def _errors(self, found: Float[Array, "2 n 3"], real: Float[Array, "n 3"]) -> Array:
        if not self.align:
            return real - found
        return jax.vmap(after_small_alignment, (0, None))(found, real)


_WHEN = ("before", "after")


def _length(d: Float[Array, "n 3"]) -> Float[Array, " n"]:
    return jnp.sqrt((d * d).sum(-1))


def _rms(size: Float[Array, " n"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.mean(size * size))


# --- plans ---
