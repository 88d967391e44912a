"""The declared covariance of the readings: their noise, and the contribution of random effects."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..machine.plan import Plan
from ..numerics.identity_cache import IdentityCache
from .forward import Model, compared_with_jacobian, effect_terms
from .measurement import Measurement

_RANDOM: IdentityCache[list[tuple[str, np.ndarray]]] = IdentityCache(4)
"""Covariances of the random effects of the last few models."""


def declared_whitener(model: Model, measurement: Measurement) -> np.ndarray:
    """W of every row (n, m, m), from the declared noise of the instrument and the random effects.

    W'W is the inverse of the covariance of the readings of the row (`declared_covariances`). A
    random effect with the response c through the nominal machine (per unit of its parameter, SI)
    adds sigma^2 c c' to it.
    """
    covariance = np.sum([part for _, part in declared_covariances(model, measurement)], axis=0)
    return whitener_of(covariance + absent(model, measurement.plan))


def whitener_of(covariance: Float[np.ndarray, "n m m"]) -> Float[np.ndarray, "n m m"]:
    """W of every row (n, m, m), with W'W the inverse of its covariance."""
    return np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)


def absent(model: Model, plan: Plan) -> Float[np.ndarray, "n m m"]:
    """Ones on the diagonal (n, m, m) for readings that a row does not have, which keep its
    covariance invertible.
    """
    missing = ~model.instrument.present(plan)
    return np.einsum("ni,ij->nij", missing.astype(float), np.eye(missing.shape[1]))


def declared_covariances(model: Model, measurement: Measurement) -> list[tuple[str, np.ndarray]]:
    """Contributions to the covariance of every row, each with its name and (n, m, m), SI.

    These are the noise of every component of a reading, for every data set, and the random effects.
    """
    plan, instrument = measurement.plan, model.instrument
    sigma = instrument.noise(plan, measurement.readings) * instrument.present(plan)
    m = sigma.shape[1]
    found = []
    for one, inside in plan.parts.items():
        for k, name in enumerate(instrument.members.get(one, instrument).readings[:m]):
            part = np.zeros((len(sigma), m, m))
            part[inside, k, k] = sigma[inside, k] ** 2
            found.append((f"{one} {name}".strip(), part))
    if model.random:
        made_of = model.chain, instrument, plan, *model.random
        found += _RANDOM.of(made_of, lambda: _random_covariances(model, measurement))
    return found


def _random_covariances(
    model: Model, measurement: Measurement
) -> list[tuple[str, Float[np.ndarray, "n m m"]]]:
    """Contributions of the random effects to the covariance of every row, through the nominal
    machine.
    """
    plan, instrument, found = measurement.plan, model.instrument, []
    still = np.zeros((plan.rows, len(model.layout)))
    rows, measured = instrument.rows(plan), measurement.readings
    _, by_port = compared_with_jacobian(model.chain, instrument, plan, rows, measured, still)
    by_port = np.asarray(by_port)
    for effect in model.random:
        for p in effect.amplitudes:
            # A declared value is the standard deviation itself, known.
            given = ((p.name, 0.0, p.mean or p.sigma),)
            own = dataclasses.replace(effect, given=given, priors=())
            terms = effect_terms(own, model.layout, plan, {})
            mine = terms.parameter == [q.name for q in effect.amplitudes].index(p.name)
            c = (by_port[:, :, terms.port] * terms.values[:, None, :])[:, :, mine].sum(2)
            found.append((f"{effect.key} {p.name}", np.einsum("ni,nj->nij", c, c)))
    return found
