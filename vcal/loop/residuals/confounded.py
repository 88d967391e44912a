"""Confounded covariates, whose influences cannot be separated with these data."""

from collections.abc import Iterable, Mapping

import numpy as np

from ...instruments.conditions import file_column
from ...machine.plan import Plan
from ...words import plural
from ..screening.candidates import Untestable

_TOGETHER = 0.95
"""Least correlation of covariates that count as confounded."""
_CLOSELY = 0.9
"""The same for a plan before it is measured, while it can still be changed."""
_SEQUENCE = ("order", "pose", "run")
"""Groups whose number increases with time."""


def confounded(plan: Plan, names: Iterable[str]) -> list[str]:
    """Sentences on the covariates that are confounded with any of `names`: time, temperatures,
    sequence.
    """
    conditions = {
        name: np.asarray(x, float)
        for name, x in plan.covariates.items()
        if name == "t" or name.startswith("T_")
    }
    conditions |= {
        name: np.asarray(plan.groups[name], float)
        for name in ("run", "pose")
        if name in plan.groups
    }
    conditions = _varied(conditions)
    found, reported = [], set()
    for name in names:
        if name not in conditions or name in reported:
            continue
        linked = _linked(name, conditions, _TOGETHER)
        reported |= {name, *linked}
        if linked:
            columns = [file_column(n, plan.axes)[0] for n in (name, *linked)]
            found.append(
                f"the columns {', '.join(columns[:-1])} and {columns[-1]} are correlated "
                f"({min(linked.values()):.2f} or more): a dependence on one of them cannot be "
                "distinguished from one on the others; vary them independently"
            )
    return found


def confounding(plan: Plan, names: Iterable[str]) -> list[str]:
    """Sentences on which of these covariates follow a position or another covariate in a plan, for
    use before anything is measured.
    """
    names = list(names)
    positions = {axis: np.asarray(plan.x(axis), float) for axis in plan.axes}
    known = _varied(positions | {n: np.asarray(plan.covariates[n], float) for n in names})
    found, reported = [], set()
    for name in names:
        if name not in known or name in reported:
            continue
        linked = _linked(name, known, _CLOSELY)
        reported |= {name, *linked} - positions.keys()
        if linked:
            column = file_column(name, plan.axes)[0]
            each = [f"{file_column(n, plan.axes)[0]} ({r:.2f})" for n, r in linked.items()]
            random = linked.keys() & positions.keys()
            do = "measure in random order" if random else "vary them independently"
            found.append(
                f"{column} is correlated with {', '.join(each)}: a dependence on one cannot be "
                f"distinguished from one on the {plural(len(each), 'other')}; {do}"
            )
    return found


def _varied(known: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {n: x for n, x in known.items() if np.isfinite(x).all() and np.ptp(x) > 0.0}


def _linked(name: str, known: Mapping[str, np.ndarray], least: float) -> dict[str, float]:
    """Other covariates whose correlation with one is at least `least`, with its magnitude."""
    linked = {
        other: abs(float(np.corrcoef(known[name], x)[0, 1]))
        for other, x in known.items()
        if other != name
    }
    return {other: r for other, r in linked.items() if r >= least}


def unrecorded_time(plan: Plan, name: str, untestable: Iterable[Untestable]) -> list[str]:
    """A sentence where the residual depends on the sequence and the time was not recorded: it may
    depend on time.
    """
    wanting = {u.effect for u in untestable if [missing for missing, _ in u.missing] == ["t"]}
    if name not in _SEQUENCE or not wanting:
        return []
    column, time = (file_column(n, plan.axes)[0] for n in (name, "t"))
    return [
        f"what depends on {column} may depend on time, which was not recorded: "
        f"{', '.join(sorted(wanting))} could not be tested; record the time of every reading "
        f"(column {time})"
    ]
