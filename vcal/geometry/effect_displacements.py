"""How far one effect of the identified machine moves the tool point."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..identification.fit import Fit
from ..model.forward import tool_points
from .compensated import machine_terms


class Reach(NamedTuple):
    """Displacement of the tool point by one effect over the rows of a measurement, m."""

    largest: float
    rms: float


def effect_displacements(fit: Fit, place: int) -> Float[np.ndarray, "n 3"]:
    """Displacement of the tool point in every row of the measurement by the effect at that place of
    the model, m: the tool point of the identified machine minus that without the effect.

    It is zero for an effect of the instrument.
    """
    model, plan = fit.model, fit.measurement.plan
    terms, _ = machine_terms(fit, plan)
    without = fit.theta.copy()
    without[model.places[place]] = 0.0
    port = np.eye(len(model.layout))[terms.port]
    position = jnp.asarray(plan.position)
    there, back = (
        np.asarray(
            tool_points(
                model.chain,
                position,
                jnp.asarray(terms.offset + (terms.values * theta[terms.parameter]) @ port),
            )
        )
        for theta in (fit.theta, without)
    )
    return there - back


def reach(fit: Fit, place: int) -> Reach:
    """The largest and the rms distance of `effect_displacements` from their mean, which is no
    different from a constant offset.
    """
    moved = effect_displacements(fit, place)
    distance = np.linalg.norm(moved - moved.mean(0), axis=1)
    return Reach(float(distance.max(initial=0.0)), float(np.sqrt(np.mean(distance**2))))
