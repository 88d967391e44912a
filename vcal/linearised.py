"""A model that is linear about some parameters: shape parameters beside the amplitudes."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .fit import shape_step
from .model import Model, Shapes, Terms, concatenate
from .plan import Plan


def linearised_terms(model: Model, plan: Plan, shapes: Shapes, theta: np.ndarray) -> Terms:
    """Terms of all amplitudes, and of the smooth shape parameters at the given amplitudes."""
    blocks = [model.terms(plan, shapes), *slopes(model, plan, shapes, theta)]
    return concatenate(blocks, plan.rows, len(model.layout))


def slopes(model: Model, plan: Plan, shapes: Shapes, theta: np.ndarray) -> list[Terms]:
    """`shape_terms` of all effects."""
    found = []
    for i, own in enumerate(model.places):
        first = len(model.entries) + len(found)
        found += shape_terms(model, i, plan, shapes.get(i, {}), theta[own], plan, first)
    return found


def shape_terms(
    model: Model,
    effect: int,
    plan: Plan,
    shape: Mapping[str, Any],
    theta: np.ndarray,
    scanned: Plan,
    first: int,
) -> list[Terms]:
    """How the ports change with every smooth shape parameter of the effect at that place of the
    model, per solver unit: its step on the plan that is `scanned`, which is the one identified on.

    `theta` are the effect's own amplitudes; `first` is the place of its first shape
    parameter in the parameter vector.
    """
    one, found = model.effects[effect], []
    moving = [p for p in one.shapes if p.moves]
    grids = one.scan(scanned) if moving else {}
    sizes = {
        a.name: a.mean * a.si + value * a.step
        for a, value in zip(one.amplitudes, theta, strict=False)
    }
    at = {name: jnp.asarray(value, float) for name, value in shape.items()}
    for p in moving:
        along = {name: jnp.asarray(float(name == p.name)) for name in at}
        _, slopes = jax.jvp(lambda s: dict(one.response(plan, s)), (at,), (along,))
        step = shape_step(p, float(shape[p.name]), grids)
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
