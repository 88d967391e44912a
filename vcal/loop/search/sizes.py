"""Declared sizes that do not fit: a wrong declaration, or an effect that is missing."""

import math

import numpy as np

from ...effects.geometric import GeometricErrors
from ...identification.declared_sizes import DeclaredSizes, declared_sizes
from ...identification.family_sizes import (
    declared_kind,
    learned_sizes,
    log_prior_of_factors,
    with_sizes,
)
from ...identification.fit import Fit
from ...identification.identify import identify
from ...model.forward import Model
from ..outcome.misdeclared import Misdeclared
from .state import State

LIKELIER = math.log(20.0)
"""Gain in log evidence from which other sizes are clearly more probable than the declared ones."""


def tested_sizes(fit: Fit, declared: Model) -> DeclaredSizes:
    """The test of the declared sizes for the systematic effects of the declared model."""
    places = [i for i, effect in enumerate(declared.effects) if effect.kind == "systematic"]
    return declared_sizes(fit, places, math.sqrt(max(1.0, fit.chi2 / fit.dof)))


def sizes_that_fit(
    state: State, declared: Model, test: DeclaredSizes, room: int
) -> tuple[Model, dict[str, float], float] | None:
    """The model with the sizes that the readings show, their factors by kind, and its gain in log
    evidence, with the prior of the factors; None without a declared family, or where the estimate
    fails.

    All errors of one declared size share a factor, so that an effect which is missing from one axis
    does not pass for a wrong declaration.
    """
    fit = state.scored
    if not any(isinstance(effect, GeometricErrors) for effect in declared.effects):
        return None
    try:
        by_name = learned_sizes(fit, declared_kind)
        model = with_sizes(state.model, by_name)
        wide = identify(
            model,
            fit.measurement,
            shapes=fit.shapes,
            whitener=fit.whitener,
            keep=state.keep,
            room=room,
        )
        if not (wide.converged and wide.determined):
            return None
        noise = math.sqrt(max(1.0, wide.chi2 / wide.dof))
        factors = {declared_kind(name): factor for name, factor in by_name.items()}
        # A declaration that is wrong by a factor of thirty is less likely than one by three.
        gain = wide.log_evidence(noise) - fit.log_evidence(noise)
        gain += log_prior_of_factors(factors.values())
    except (RuntimeError, np.linalg.LinAlgError):
        return None
    return model, factors, gain


def misdeclared(state: State, declared: Model, room: int) -> Misdeclared | None:
    """The declared sizes that do not fit beside the effects of a state; None where they fit."""
    test = tested_sizes(state.scored, declared)
    if not test.misfit:
        return None
    found = sizes_that_fit(state, declared, test, room)
    factors = found[1] if found is not None and found[2] > LIKELIER else {}
    return Misdeclared(test, factors, False) if factors or test.gross else None
