"""A model linearised about some parameters: terms of the amplitudes and of the shape parameters."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..effects.base import Effect, Response
from ..machine.plan import Plan
from ..model.forward import Model, Shapes, Terms, concatenate
from .fit import shape_step

_SHORT = 1e-4
"""Share of a step of the scan over which a response is practically linear."""


def linearised_terms(model: Model, plan: Plan, shapes: Shapes, theta: np.ndarray) -> Terms:
    """Terms of all amplitudes, and of the shape parameters that move at the amplitudes `theta`
    (solver units) and `shapes` (SI).
    """
    blocks = [model.terms(plan, shapes), *slopes(model, plan, shapes, theta)]
    return concatenate(blocks, plan.rows, len(model.layout))


def slopes(
    model: Model, plan: Plan, shapes: Shapes, theta: np.ndarray, nearly: bool = False
) -> list[Terms]:
    """`shape_terms` of all effects; with `nearly`, to eight digits in a tenth of the time."""
    found, amplitudes = [], len(model.entries)
    for i, own in enumerate(model.places):
        first = amplitudes + len(found)
        found += shape_terms(model, i, plan, shapes.get(i, {}), theta[own], plan, first, nearly)
    return found


def shape_terms(
    model: Model,
    effect: int,
    plan: Plan,
    shape: Mapping[str, Any],
    theta: np.ndarray,
    scanned: Plan,
    first: int,
    nearly: bool = False,
) -> list[Terms]:
    """Derivatives of the ports by every shape parameter that moves, of the effect at the position
    `effect` of the model, per solver unit.

    The solver unit is the step of the scan on the plan `scanned`, the plan of the identification.
    `shape` are the shape parameters (SI), `theta` the amplitudes of the effect (solver units), and
    `first` the position of its first shape parameter in the parameter vector. `nearly` takes
    central differences: automatic differentiation outside a compiled function takes a millisecond.
    """
    one, found = model.effects[effect], []
    moving = [p for p in one.shapes if p.moves]
    if not moving:
        return []
    grids = one.scan(scanned)
    sizes = {
        a.name: a.mean * a.si + value * a.step
        for a, value in zip(one.amplitudes, theta, strict=False)
    }
    for p in moving:
        step = shape_step(p, float(shape[p.name]), grids)
        slopes = (
            _differences(one, plan, shape, p.name, _SHORT * step)
            if nearly
            else _derivatives(one, plan, shape, p.name)
        )
        columns: dict[int, np.ndarray] = {}
        for (port, name), slope in slopes.items():
            place = model.layout.index(port)
            slope = np.broadcast_to(np.asarray(slope), (plan.rows,))
            columns[place] = columns.get(place, 0.0) + slope * sizes[name] * step
        found.append(
            Terms(
                np.zeros((plan.rows, len(model.layout))),
                np.stack(list(columns.values()), 1),
                np.asarray(list(columns)),
                np.full(len(columns), first + len(found)),
            )  # type: ignore[arg-type]
        )
    return found


def _derivatives(effect: Effect, plan: Plan, shape: Mapping[str, Any], name: str) -> Response:
    """Derivative of the response by one shape parameter (SI)."""
    at = {key: jnp.asarray(value, float) for key, value in shape.items()}
    along = {key: jnp.asarray(float(key == name)) for key in at}
    return jax.jvp(lambda s: dict(effect.response(plan, s)), (at,), (along,))[1]


def _differences(
    effect: Effect, plan: Plan, shape: Mapping[str, Any], name: str, short: float
) -> Response:
    """The derivative by a central difference over `short` (SI) to both sides."""
    above, below = (
        effect.response(plan, {**shape, name: shape[name] + change}) for change in (short, -short)
    )
    return {key: (above[key] - below[key]) / (2.0 * short) for key in above}
