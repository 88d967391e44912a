"""From parameters to ports, one array per port: `vcal.model.Terms` in a layout for many draws.

A campaign evaluates the same model on the same plan for many draws. Only the ports on which an
effect acts are computed, each as one small product of its own responses with its own parameters.
The others are the constant zero; what depends only on them is never compiled.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..effects.base import Effect
from ..machine.plan import Plan
from ..machine.ports import PortLayout
from ..numerics.arrays import Array
from ..numerics.record import Record
from ..numerics.rigid import Scalar
from .forward import Model, Shapes, Terms, concatenate, effect_terms


class PortColumn(Record):
    """One port: offset + theta[parameter] @ values."""

    port: int = eqx.field(static=True)
    values: Float[Array, "t n"]
    parameter: Int[Array, " t"]
    offset: Float[Array, " n"] | None
    uniform: bool = eqx.field(static=True, default=False)
    """Whether the port is equal in all rows. Everything that only depends on such ports, such as
    the pose of an instrument, is then computed once and not row by row.
    """

    def __call__(self, theta: Float[Array, " k"]) -> Float[Array, " n"] | Float[Array, ""]:
        """Value of the port in every row (n,), or one value () for all rows, SI."""
        values = self.values[:, 0] if self.uniform else self.values
        value = jnp.asarray(theta)[self.parameter] @ values
        if self.offset is None:
            return value
        return value + (self.offset[0] if self.uniform else self.offset)


class _Moving(Record):
    """An effect whose shape parameters differ from draw to draw."""

    effect: Effect
    place: int = eqx.field(static=True)
    """Position of the effect in the model."""
    start: int = eqx.field(static=True)
    """Position of its first amplitude in the parameter vector."""


class PortMap(Record):
    """The ports of every row as a function of the amplitudes, and of shapes that are not fixed."""

    columns: tuple[PortColumn, ...]
    moving: tuple[_Moving, ...]
    plan: Plan
    layout: PortLayout = eqx.field(static=True)

    def __call__(
        self, theta: Float[Array, " k"], shapes: Mapping[int, Mapping[str, Any]] | None = None
    ) -> list[Scalar]:
        """Values of all ports, SI: an array (n,) where an effect acts on a port, one number ()
        where it is equal in all rows, else 0.0.

        `theta` are amplitudes in solver units. `shapes` are the values (SI) of the shape parameters
        that are not fixed, by position of the effect in the model.
        """
        ports: list[Scalar] = [0.0] * len(self.layout)
        for column in self.columns:
            ports[column.port] = column(theta)
        for item in self.moving:
            self._add(ports, item, theta, (shapes or {})[item.place])
        return ports

    def _add(
        self, ports: list[Scalar], item: _Moving, theta: Array, shape: Mapping[str, Any]
    ) -> None:
        amplitudes = {p.name: (k, p) for k, p in enumerate(item.effect.amplitudes)}
        for (port, name), response in item.effect.response(self.plan, shape).items():
            k, p = amplitudes[name]
            size = p.mean * p.si + theta[item.start + k] * p.step
            place = self.layout.index(port)
            ports[place] = ports[place] + response * size


def port_map(
    model: Model,
    plan: Plan,
    shapes: Shapes | None = None,
    moving: Sequence[int] = (),
    *,
    machine_only: bool = False,
) -> PortMap:
    """The ports of a model on a plan as a function of its parameters.

    `shapes` are the values of the shape parameters (SI) of all effects except those at the
    positions `moving`, whose shapes are arguments of the result. `machine_only` leaves out the
    effects of the instrument.
    """
    blocks, items = [], []
    for i, (effect, place) in enumerate(zip(model.effects, model.places, strict=True)):
        if machine_only and effect.where != "machine":
            continue
        if i in moving:
            items.append(_Moving(effect, i, place.start))
        else:
            shape = (shapes or {}).get(i, {})
            blocks.append(effect_terms(effect, model.layout, plan, shape, place.start))
    terms = concatenate(blocks, plan.rows, len(model.layout))
    return PortMap(columns_of(terms), tuple(items), plan, model.layout)


def columns_of(terms: Terms) -> tuple[PortColumn, ...]:
    """Terms sorted by port."""
    found = []
    offset, values = np.asarray(terms.offset), np.asarray(terms.values)
    port, parameter = np.asarray(terms.port), np.asarray(terms.parameter)
    for place in range(offset.shape[1]):
        own = np.flatnonzero(port == place)
        fixed = offset[:, place] if offset[:, place].any() else None
        if len(own) or fixed is not None:
            rows = np.concatenate([values[:, own], offset[:, place, None]], 1)
            found.append(
                PortColumn(
                    place,
                    jnp.asarray(values[:, own].T),
                    jnp.asarray(parameter[own]),
                    None if fixed is None else jnp.asarray(fixed),
                    uniform=bool((rows == rows[:1]).all()),
                )
            )
    return tuple(found)
