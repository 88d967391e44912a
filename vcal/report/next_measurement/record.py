"""The record of a next measurement for programs: the content of ``result.json``."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...design.next_measurement import Candidate, NextMeasurement
from ...design.optimiser import valuation
from ...design.separation import ALPHA, Lambda
from ...instruments.conditions import file_name
from ...study.design.written_plan import plan_table
from ...study.study import Study
from ...words import counted, plural
from ..design.pictures import in_space
from ..design.record import DESIGN_SCHEMA
from ..html import text
from ..html.provenance import plain, provenance_record


def sentence(done: NextMeasurement) -> str:
    """The answer in one sentence."""
    count = len(done.task.space.groups)
    what = counted(count, f"further {done.task.space.group}")
    if done.separation is not None and done.separated is not None:
        first, second = (r.effect.key for r in done.separation.rivals)
        before, after = (lambda_text(x.smaller) for x in (done.separated, lambdas(done.best)))
        powers = [min(done.separation.powers(x)) for x in (done.separated, lambdas(done.best))]
        verb = plural(count, "raises", "raise")
        return (
            f"{what} {verb} the expected lack of fit between {first} and {second} from {before} to "
            f"{after}; detection power at {100 * ALPHA:g} %: {text.percent(powers[0])} before, "
            f"{text.percent(powers[1])} after."
        )
    criterion = done.task.criterion
    words = f"{criterion.words} from {text.number(done.before.criterion)} to "
    after = f"{text.number(done.best.value.criterion)} {text.unit(criterion.unit)}"
    return f"{what} {plural(count, 'brings', 'bring')} the {words}{after}."


def record(
    done: NextMeasurement,
    study: Study,
    *,
    seed: int,
    why: str,
    command: str = "",
    seconds: float = math.nan,
) -> dict[str, Any]:
    """All results as plain values; see `DESIGN_SCHEMA`."""
    task, best = done.task, done.best
    found: dict[str, Any] = {
        "schema": DESIGN_SCHEMA,
        "name": study.name,
        "next": True,
        "sentence": sentence(done),
        "why": why,
        "goal": task.criterion.name,
        "criterion": {"words": task.criterion.words, "unit": task.criterion.unit},
        "before": {"criterion": done.before.criterion, "rms_um": done.before.aligned_um},
        "after": {"criterion": best.value.criterion, "rms_um": best.value.aligned_um},
        "valuation": {
            "before": valuation(done.before, done.prior),
            "after": valuation(best.value, done.prior),
        },
        "measuring_seconds": task.space.seconds(best.placed),
        "group": task.space.group,
        "groups": task.space.groups,
        "separation": _separation(done),
        "candidates": [
            {
                "criterion": c.value.criterion,
                "lowers_by": decrease(done, c),
                "lambda": None if c.lambdas is None else c.lambdas.smaller,
                "at_mm": centre(done, c),
            }
            for c in done.candidates
        ],
        "drawn": done.drawn,
        "searched_by_gradient": done.differentiable,
        **provenance_record(study, {"seed": seed}, command, seconds),
    }
    return plain(found)


def carried_over(done: NextMeasurement, study: Study) -> str:
    """Sentence on the columns of plan.csv that repeat the last row of the data."""
    axes, space = study.chain.axes, done.task.space
    instrument = space.instrument(done.best.placed)
    own = instrument.columns(study.one.settings, axes, readings=False)
    chosen = {file_name(axis, axes) for axis in axes} | {column.name for column in own}
    chosen |= study.plan.groups.keys() | conditions_of(done, study) | {*space.planned}
    names = [n for n in plan_table(study, space, done.best.placed) if n not in chosen]
    if not names:
        return ""
    return (
        f"In plan.csv {', '.join(names)} repeat the last row of the data. Replace them by the "
        "values at the time of the measurement, because effects are identified from them."
    )


def conditions_of(done: NextMeasurement, study: Study) -> set[str]:
    """Columns, other than positions, on which the effects to be distinguished depend."""
    if done.separation is None:
        return set()
    axes = study.chain.axes
    needs = {n for r in done.separation.rivals for n in r.effect.needs if n not in axes}
    return {file_name(n, axes) for n in needs}


def _separation(done: NextMeasurement) -> Mapping[str, Any] | None:
    if done.separation is None or done.separated is None:
        return None
    found = {}
    for word, value in (("before", done.separated), ("after", lambdas(done.best))):
        found[f"lambda_{word}"] = list(value)
        found[f"power_{word}"] = list(done.separation.powers(value))
    rivals = [r.effect.key for r in done.separation.rivals]
    sizes = [np.sqrt(np.diagonal(r.moment)) for r in done.separation.rivals]
    return {"effects": rivals, "sizes_in_prior_units": sizes, "alpha": ALPHA, **found}


def lambdas(candidate: Candidate) -> Lambda:
    """Non-centralities of a candidate of a task that has a separation."""
    assert candidate.lambdas is not None
    return candidate.lambdas


def lambda_text(value: float) -> str:
    """A non-centrality as text; rounding errors are 0."""
    return text.number(value if value > 1e-6 else 0.0)


def decrease(done: NextMeasurement, candidate: Candidate) -> float:
    """Share by which a candidate decreases the criterion."""
    return 1.0 - candidate.value.criterion / done.before.criterion


def centre(done: NextMeasurement, candidate: Candidate) -> list[float] | None:
    """Mean of X, Y and Z over the rows of a candidate, mm; None on a machine without these axes."""
    plan = done.task.space.plan(candidate.placed)
    if not in_space(done.task):
        return None
    return [1e3 * float(np.asarray(plan.x(axis)).mean()) for axis in "XYZ"]
