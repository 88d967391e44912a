"""Notes for the reader where numbers mislead."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .ensemble import Ensemble
from .taylor import Taylor

_DEPARTS = 0.5
"""Departure of the function from the series, in u of the output, from which a note reports it."""
_DOMINANT, _FEW = 0.05, 20.0
"""A single draw with more than this share of the variance, plus _FEW over the number of draws,
rules the result: of a normal output, the largest has about 25/M of a million draws."""


def departure_notes(
    labels: Sequence[str],
    value: Float[np.ndarray, " m"],
    u: Float[np.ndarray, " m"],
    taylor: Taylor,
    moved: Float[np.ndarray, "2 r m"],
) -> tuple[str, ...]:
    """Notes on outputs that the series does not describe over the uncertainties of the inputs.

    `moved` are the outputs at the estimates plus and minus one standard uncertainty, in every
    direction of the series: f +/- a_i + H_ii / 2 by the series.
    """
    bend = np.diagonal(taylor.H, axis1=1, axis2=2).T if taylor.H.size else 0.0
    series = value + np.stack([taylor.a.T, -taylor.a.T]) + 0.5 * bend
    with np.errstate(invalid="ignore"):
        apart = np.sqrt((0.5 * (moved - series) ** 2).sum((0, 1)))
    notes = []
    broken = [label for label, d in zip(labels, apart, strict=True) if not np.isfinite(d)]
    if broken:
        notes.append(
            f"{_listed(broken)} is not finite at the estimates plus or minus one standard "
            "uncertainty, so that these numbers do not hold over it; use Monte Carlo, which "
            "states the share of draws without a result"
        )
    order = "second" if taylor.H.size else "first"
    for label, d, own in zip(labels, apart, u, strict=True):
        if own > 0.0 and np.isfinite(d) and d > _DEPARTS * own:
            notes.append(
                f"{label} departs by {d:.2g} from its series of {order} order at the estimates "
                f"plus or minus one standard uncertainty, which is much against u = {own:.2g}: the "
                "series does not hold over these uncertainties; use Monte Carlo"
            )
    return tuple(notes)


def failed_notes(ensemble: Ensemble) -> tuple[str, ...]:
    """Notes on draws without a finite result."""
    return tuple(
        f"{name}: {count} of {ensemble.draws} draws ({100.0 * count / ensemble.draws:.2g} %) are "
        "not finite; y, u and the interval are those of the other draws, and of the quantity only "
        "where these draws are impossible"
        for name, count in ensemble.failed.items()
    )


def single_draw_notes(ensemble: Ensemble) -> tuple[str, ...]:
    """Notes on outputs whose variance is that of single draws."""
    notes = []
    for i, label in enumerate(ensemble.labels):
        count = ensemble.draws - ensemble.failed.get(label, 0)
        total = float(ensemble.covariance[i, i]) * (count - 1)
        ends = np.array([ensemble.minimum[i], ensemble.maximum[i]]) - ensemble.mean[i]
        if not total > 0.0:
            continue
        share = float((ends**2).max()) / total
        if share > _DOMINANT + _FEW / count:
            notes.append(
                f"{label}: a single draw has {100.0 * share:.0f} % of the variance of all {count}, "
                "as of a quantity without a standard deviation: y and u do not settle; take the "
                "coverage interval and the median"
            )
    return tuple(notes)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
