"""Tool points of the identified machine, with their derivatives by the parameters."""

import numpy as np

from ..identification.fit import Fit
from ..identification.linearised import shape_terms
from ..machine.plan import Plan
from ..model.forward import Terms, concatenate, effect_terms, tool_points_with_jacobian

_BLOCK, _BLOCKS = 8, 25


def machine_terms(fit: Fit, plan: Plan) -> tuple[Terms, Terms]:
    """Terms on another plan of the effects that move the tool point, and the derivatives of their
    ports by the fitted shape parameters.

    Effects that need a covariate which the plan does not have are left out.
    """
    model, theta = fit.model, fit.theta
    blocks: list[Terms] = []
    slopes: list[Terms] = []
    shape_start = len(model.entries)
    for i, (effect, own) in enumerate(zip(model.effects, model.places, strict=True)):
        shape = fit.shapes.get(i, {})
        if effect.where == "machine" and plan.has(*effect.needs_at(shape)):
            blocks.append(effect_terms(effect, model.layout, plan, shape, own.start))
            measured = fit.measurement.plan
            slopes += shape_terms(model, i, plan, shape, theta[own], measured, shape_start)
        shape_start += sum(p.moves for p in effect.shapes)
    ports = len(model.layout)
    return concatenate(blocks, plan.rows, ports), concatenate(slopes, plan.rows, ports)


def compensated_points(fit: Fit, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Tool points of the identified machine in the workpiece frame (n, 3), m, and their derivative
    (n, 3, k) by the parameters in solver units.
    """
    terms, slopes = machine_terms(fit, plan)
    size = len(fit.model.layout)
    ports = terms.offset + (terms.values * fit.theta[terms.parameter]) @ np.eye(size)[terms.port]
    points, by_port = (
        np.asarray(v)
        for v in tool_points_with_jacobian(fit.model.chain, np.asarray(plan.position), ports)
    )
    derivative = np.zeros((*points.shape, len(fit.theta)))
    for part in (terms, slopes):
        gather = np.zeros((len(part.parameter), len(fit.theta)))
        gather[np.arange(len(part.parameter)), part.parameter] = 1.0
        derivative += (by_port[:, :, part.port] * part.values[:, None, :]) @ gather
    return points, derivative


def compensated_in_blocks(
    fit: Fit, position: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """`compensated_points` at axis positions (n, axes), m or rad, in blocks of `size` rows.

    With the number of rows of a plan that is compiled already, nothing has to be compiled. Effects
    that depend on more than the positions are not included.
    """
    blocks = -(-len(position) // size)
    padded = np.concatenate([position, np.repeat(position[:1], blocks * size - len(position), 0)])
    found = [
        compensated_points(fit, Plan(fit.model.chain.axes, block))
        for block in np.split(padded, blocks)
    ]
    points, jacobian = (
        np.concatenate(parts)[: len(position)] for parts in zip(*found, strict=True)
    )
    return points, jacobian
