"""Whether several data sets can be of one machine: each fitted alone, against all together."""

import numpy as np
from scipy.special import fdtrc

from ..declared_noise import declared_whitener
from ..fit import Fit
from ..identify import identify
from ..model import Model
from .state import chi2_per_dof

_FACTOR = 2.0
"""Of chi2 per degree of freedom together over that of every data set alone, from which they are
taken to contradict each other: what is missing from all of them shows in each."""
_CHANCE = 1e-3
"""Probability by chance below which what is added by fitting them together counts."""


def contradiction(before: Fit, after: Fit, room: int) -> str:
    """That the data sets do not fit one machine, in words; empty where they do, or there is one.

    The readings that the declared model leaves by every data set `alone`, against what it leaves
    together, also with what was found: (dX / dn) / (X / n) is F with dn and n degrees of freedom
    where one machine has made all of them.
    """
    parts = before.measurement.plan.parts
    if len(parts) < 2:
        return ""
    each = {name: alone(before, rows, room) for name, rows in parts.items()}
    if any(fit.dof <= 1.0 for fit in each.values()):
        return ""
    own = {name: chi2_per_dof(fit) for name, fit in each.items()}
    # What was found may be just what makes one machine of them, or what pulls them further apart.
    together, fit = min(((chi2_per_dof(f), f) for f in (before, after)), key=lambda pair: pair[0])
    n = sum(one.dof for one in each.values())
    squares = sum(own[name] * one.dof for name, one in each.items())
    dn, dx = fit.dof - n, together * fit.dof - squares
    if together < _FACTOR * max(own.values()) or dn <= 0.0:
        return ""
    if fdtrc(dn, n, (dx / dn) / (squares / n)) > _CHANCE:
        return ""
    said = " and ".join(f"{name} {value:.3g}" for name, value in own.items())
    return (
        f"the data sets do not fit one machine: chi² per degree of freedom is {together:.3g} where "
        f"they are fitted together, but {said} where each is fitted alone with the declared model; "
        "check that they are of one machine with the same tool, units and mounting, or study them "
        "alone"
    )


def alone(fit: Fit, rows: np.ndarray, room: int) -> Fit:
    """The model of a fit, identified from one data set: without what acts in others only."""
    model, plan = fit.model, fit.measurement.plan
    places = [i for i, e in enumerate(model.effects) if (np.asarray(e.rows(plan)) & rows).any()]
    mine = tuple(model.effects[i] for i in places)
    return identify(
        Model(model.chain, model.instrument, (*mine, *model.random)),
        fit.measurement,
        shapes={k: fit.shapes[i] for k, i in enumerate(places) if i in fit.shapes},
        whitener=declared_whitener(model, fit.measurement),
        keep=fit.used & rows,
        room=room,
    )
