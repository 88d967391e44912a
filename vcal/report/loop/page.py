"""The page of a report: everything it says, put in order for the template beside this file."""

import datetime
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...effects.base import Effect
from ...effects.data_set import OfDataSet
from ...effects.registry import CATALOGUE
from ...effects.thermal import REFERENCE_DEGC
from ...geometry.acceptance import GeometricTest
from ...geometry.error_motions import ErrorMotionTable
from ...identification.fit import HARDLY_TOLD, Learnt
from ...loop.empirical import EMPIRICAL
from ...loop.outcome.closure import Closure, FoundEffect
from ...plots import column_of, minus_log10_p
from ...study.study import Study, looked_for
from ..html import text
from ..html.picture import Picture
from ..html.template import render
from .derived import (
    FEW,
    declared,
    in_short,
    intervals_in_file,
    missing_columns,
    parameters,
    shares_by_column,
    untested_beside,
    untested_in_words,
)
from .own_effect import own_effect
from .record import plain, versions

_TITLES = {
    "nothing_missing": "Nothing is missing",
    "named": "Named",
    "ambiguous": "Ambiguous",
    "unexplained": "Unexplained",
}
_WORTH_NAMING = 0.0005
"""Probability of a rival from which it is on the page, where it would else be 0.0 %."""

_APART = 3.0
"""Standard uncertainties from which the scatter of a kind of reading is not as declared."""


def page(
    closure: Closure,
    study: Study,
    tables: Sequence[ErrorMotionTable],
    drawn: Sequence[Picture],
    tests: Sequence[GeometricTest] = (),
    *,
    command: str = "",
    seconds: float = math.nan,
) -> str:
    """The page as one self-contained HTML text, pictures included."""
    shown: dict[str, list[Picture]] = {}
    for picture in drawn:
        shown.setdefault(picture.section, []).append(picture)
    after, summaries = closure.after, _summaries(closure, study)
    return render(
        "page.html.j2",
        name=study.name,
        title=_title(closure),
        verdict="louder" if closure.louder else closure.verdict or "interrupted",
        sentence=closure.sentence,
        interrupted=closure.interrupted,
        notes=closure.notes,
        facts=_facts(closure, study),
        tiles=_tiles(closure),
        errors=_errors(closure),
        data_sets=_data_sets(closure, study),
        has_check=closure.check is not None,
        effects=[_effect(closure, found) for found in closure.effects],
        declared=_declared(closure),
        unexplained=_unexplained(closure),
        own_effect=own_effect(closure) is not None,
        pictures=shown,
        alpha=f"{100 * closure.settings['alpha']:g} %",
        restricted=_restricted(closure),
        full=closure.full,
        alternatives=any(one.others for one in closure.alternatives),
        tried=_tried(closure, summaries),
        rounds=len(closure.screenings),
        rejected=_rejected(closure, summaries),
        untestable=_untestable(closure, summaries),
        unseen=_unseen(closure, summaries),
        suspected=_suspected(closure),
        locations=[_location(t) for t in tables if not len(t.position)],
        motions=[_motion(t) for t in tables if len(t.position)],
        tests=[_test(t) for t in tests],
        information=Learnt.of(after.entries, np.sqrt(after.precision), after.planned_covariance),
        arm=study.chain.arm,
        rotary=not study.chain.arm and not study.chain.linear,
        counts_from=_counts_from(study),
        **_noise(closure),
        clustered=bool((after.clusters >= 0).any()),
        files=sorted(study.hashes.items()),
        settings={k: v for k, v in plain(closure.settings).items() if k != "effects"},
        searched=", ".join(closure.searched) or "none",
        study_settings=json.dumps(plain(study.as_dict), indent=1, ensure_ascii=False),
        versions=versions(),
        command=command,
        seconds=text.number(seconds) if math.isfinite(seconds) else "",
        written=datetime.datetime.now().strftime("%Y-%m-%d %H:%M"),
    )


def _title(closure: Closure) -> str:
    if closure.louder:
        return "Noise larger than declared"
    return _TITLES[closure.verdict] if closure.verdict else "Interrupted"


@dataclass(frozen=True)
class _Metric:
    name: str
    unit: str
    attribute: str


_METRICS = (
    _Metric("Check points, rms after rigid alignment", "µm", "check"),
    _Metric("Check points, rms without alignment", "µm", "check_raw"),
    _Metric("Held-out readings, rms per point", "µm", "heldout"),
    _Metric("Fitted readings, rms per point", "µm", "fit"),
    _Metric("χ² per degree of freedom, declared noise", "", "chi2_per_dof"),
)


def _errors(closure: Closure) -> list[dict[str, Any]]:
    rows = []
    for metric in _METRICS:
        cells = []
        for column in ("uncompensated", "before", "after"):
            found = getattr(closure.errors[column], metric.attribute)
            if found is None:
                cells.append(text.DASH)
            elif isinstance(found, float):
                cells.append(text.number(found))
            else:
                cells.append(text.with_uncertainty(found.value, found.u))
        if any(cell != text.DASH for cell in cells):
            rows.append({"name": metric.name, "unit": metric.unit, "cells": cells})
    return rows


def _data_sets(closure: Closure, study: Study) -> list[dict[str, Any]]:
    """One line per data set, where there are several: what it holds, and its errors."""
    before, after = (closure.errors[name].sets for name in ("before", "after"))
    return [
        {
            "name": one.name,
            "instrument": one.settings.kind.replace("_", " "),
            "file": one.file,
            "readings": int(
                closure.after.counted[closure.after.measurement.plan.in_set(one.name)].sum()
            ),
            "fit": [text.number(errors[one.name].fit.value) for errors in (before, after)],
            "heldout": [
                text.with_uncertainty(errors[one.name].heldout.value, errors[one.name].heldout.u)
                for errors in (before, after)
            ],
            "chi2": [text.number(errors[one.name].chi2_per_dof) for errors in (before, after)],
        }
        for one in study.sets
        if one.name
    ]


def _noise(closure: Closure) -> dict[str, Any]:
    return {
        "noise_scale": text.number(closure.noise_scale, 3),
        "noise_uneven": closure.noise_uneven,
        "noise_components": [
            {"name": part.name, "factor": text.number(part.factor), "u": text.number(part.u, 2)}
            for part in closure.noise_components
            if not math.isnan(part.u)
        ],
        "noise_as_declared": closure.noise_scale == 1.0,
        "noise_apart": _noise_apart(closure),
        "noise_larger": closure.noise_scale > 1.0,
        "noise_by_set": [
            f"{name} {text.number(scale, 3)}"
            for name, scale in closure.noise_scales.items()
            if name
        ],
    }


def _noise_apart(closure: Closure) -> list[str]:
    """Kinds of reading that scatter differently from what is declared where, all taken together,
    nothing does.
    """
    found = []
    for part in closure.noise_components:
        whole = closure.noise_scales.get(part.name.partition(" ")[0], closure.noise_scale)
        if whole == 1.0 and abs(part.factor - 1.0) > _APART * part.u:
            found.append(f"{part.name} {text.number(part.factor)} ± {text.number(part.u, 2)}")
    return found


def _tiles(closure: Closure) -> list[dict[str, str]]:
    """The two or three figures that a reader looks for first."""
    tiles = []
    for attribute, name in (("check", "Error at check points"), ("heldout", "Held-out error")):
        values = [
            getattr(closure.errors[c], attribute) for c in ("uncompensated", "before", "after")
        ]
        if any(v is None or not math.isfinite(v.value) for v in values):
            continue
        tiles.append(
            {
                "name": name,
                "value": text.with_uncertainty(values[2].value, values[2].u) + " µm",
                "note": f"declared model {text.number(values[1].value)} µm, "
                f"uncompensated {text.number(values[0].value)} µm",
            }
        )
    before, after = closure.errors["before"], closure.errors["after"]
    tiles.append(
        {
            "name": "χ² per degree of freedom",
            "value": text.number(after.chi2_per_dof),
            "note": f"declared model {text.number(before.chi2_per_dof)}; 1 is the declared noise",
        }
    )
    return tiles


def _facts(closure: Closure, study: Study) -> list[tuple[str, str]]:
    after = closure.after
    plan = after.measurement.plan
    used = int(after.used.sum())
    held = f", {plan.rows - used} of them held out or left out" if used < plan.rows else ""
    check = len(closure.check.tool_point) if closure.check is not None else 0
    return [
        ("Machine", study.chain.text),
        study.observers,
        ("Measurement", study.observations + held),
        ("Check points", str(check) if check else "none"),
        ("Parameters", f"{len(closure.before.theta)} declared, {len(after.theta)} in the end"),
    ]


def _parameter(name: str, value: float, unit: str, u: float) -> dict[str, str]:
    shown, shown_u = text.rounded(value, u)
    expanded = text.rounded(value, text.COVERAGE * u)[1]
    return {"name": name, "value": shown, "u": shown_u, "U": expanded, "unit": text.unit(unit)}


def _effect(closure: Closure, found: FoundEffect) -> dict[str, Any]:
    parts = closure.after.measurement.plan.parts
    rows = np.asarray(found.effect.rows(closure.after.measurement.plan))
    own = [name for name, inside in parts.items() if (inside & rows).any()]
    of = " (in the data set where it fell most)" if own[1:] else f" (in the data set {own[0]})"
    return {
        "title": f"{found.effect.name} {found.placement}".strip(),
        "summary": found.effect.summary,
        "if": found.effect.key if found.joint else "",
        "status": found.status,
        "p": text.probability(found.p_value),
        "log_evidence": text.number(found.log_evidence),
        "delta_bic": text.number(found.delta_bic),
        "gain": ("fell by " if found.heldout_gain >= 0.0 else "rose by ")
        + text.percent(abs(found.heldout_gain))
        + " when it was added"
        + (of if parts.keys() - {""} and len(parts) > 1 else ""),
        "parameters": [_parameter(*row) for row in parameters(closure, found)],
        "equivalent": found.equivalent,
        "alternatives": [
            {"key": f"{name} {placement}".strip(), "probability": text.percent(p)}
            for name, placement, p in found.alternatives
            if p >= _WORTH_NAMING
        ],
        "separation": found.separation,
        "untested": untested_in_words(untested_beside(closure, found)),
    }


def _declared(closure: Closure) -> list[dict[str, Any]]:
    return [
        {
            "key": effect.key,
            "parameters": [_parameter(*row) for row in listed],
            "in_short": in_short(effect, listed) if len(listed) > FEW else "",
        }
        for effect, listed in declared(closure)
    ]


def _unexplained(closure: Closure) -> dict[str, Any] | None:
    what = closure.unexplained
    if what is None:
        return None
    plan = closure.after.measurement.plan
    return {
        "reason": what.reason,
        "described": what.empirical is not None,
        "depends_on": [
            (column, text.percent(share)) for column, share in shares_by_column(what, plan).items()
        ],
        "where": [
            f"{column} from {text.number(low, 4)} to {text.number(high, 4)}"
            for column, low, high in intervals_in_file(what, closure.after)
        ],
        "products": [
            f"{column_of(a, plan)[0]} × {column_of(b, plan)[0]} {text.percent(share)}"
            for a, b, share in what.products
        ],
        "direction": what.direction,
        "size": text.number(what.size_um),
        "size_is": f" ({what.size_is})" if what.size_is else "",
        "share": text.percent(what.share_of_variance),
        "share_is": f" ({what.share_is})" if what.share_is else "",
        "p": text.probability(what.p_value),
        "variance": ", ".join(
            f"{name} {text.percent(share)}" for name, share in closure.variance.items()
        ),
    }


def _restricted(closure: Closure) -> str:
    """How many kinds of effects were asked for, where that is not all of the catalogue."""
    asked = closure.settings.get("effects", ())
    kinds = [name for name, kind in CATALOGUE.items() if looked_for(kind)]
    told = [name for name in kinds if name in asked]
    own = len(set(asked) - CATALOGUE.keys())
    beside = f" and {own} of your own" if own else ""
    return (
        f"{len(told)} of the {len(kinds)} kinds in the catalogue{beside}" if told != kinds else ""
    )


def _summaries(closure: Closure, study: Study) -> dict[str, str]:
    """What every kind of effect is, those of the user's own among them."""
    known = {name: kind.summary for name, kind in study.catalogue.items()}
    for screening in closure.screenings:
        tested = (kind.peaks[0].effect for kind in screening.kinds if kind.peaks)
        for effect in (*tested, *screening.unseen):
            inner: Effect = effect.effect if isinstance(effect, OfDataSet) else effect
            known[inner.name] = inner.summary
    described = {
        cls.name: f"{cls.summary} (for comparison: no physical effect)" for cls in EMPIRICAL
    }
    return known | described


def _tried(closure: Closure, summaries: Mapping[str, str]) -> list[dict[str, Any]]:
    """One line per kind of effect: its best place and its significance in every round."""
    lines: dict[str, dict[str, Any]] = {}
    added = [found.effect.name for found in closure.effects]
    limit = -math.log10(closure.settings["alpha"])
    for i, screening in enumerate(closure.screenings):
        for kind in screening.kinds:
            line = lines.setdefault(
                kind.kind,
                {
                    "kind": kind.kind,
                    "summary": summaries.get(kind.kind, ""),
                    "places": kind.instances,
                    "best": kind.peaks[0].effect.placement if kind.peaks else "",
                    "p": [text.DASH] * len(closure.screenings),
                    "significant": [False] * len(closure.screenings),
                    "added": kind.kind in added,
                    "order": -minus_log10_p(screening, kind),
                },
            )
            significant = minus_log10_p(screening, kind) >= limit
            p_value = screening.corrected(kind)
            # Of what was added it is that of its own shape, which is told elsewhere too.
            p_value = screening.refined_p.get(kind.kind, p_value) if significant else p_value
            line["p"][i] = text.probability(p_value)
            line["significant"][i] = significant
    return sorted(lines.values(), key=lambda line: line["order"])


def _rejected(closure: Closure, summaries: Mapping[str, str]) -> list[dict[str, str]]:
    return [
        {
            "key": f"{tried.effect} {tried.placement}".strip(),
            "summary": summaries.get(tried.effect, ""),
            "p": text.probability(tried.p_value),
            "reason": tried.reason,
        }
        for tried in (*closure.rejected, *closure.passed_over)
    ]


def _suspected(closure: Closure) -> list[dict[str, str]]:
    """Readings that may be wrong."""
    return [
        {
            "row": closure.after.measurement.plan.row_name(stray.row),
            "distance": text.number(stray.distance),
            "p": text.probability(stray.p_value),
        }
        for stray in closure.suspected
    ]


def _counts_from(study: Study) -> str:
    """From where temperatures count, by data set where that differs."""
    zeros = {
        one.name: f"{REFERENCE_DEGC + one.instrument.temperature_offset_K:g} °C"
        for one in study.sets
    }
    if len({*zeros.values()}) == 1:
        return next(iter(zeros.values()))
    return ", ".join(f"{zero} in {name}" for name, zero in zeros.items())


def _untestable(closure: Closure, summaries: Mapping[str, str]) -> list[dict[str, str]]:
    """One line per effect: its places, and the columns that they would need."""
    plan = closure.after.measurement.plan
    places: dict[str, list[str]] = {}
    reasons: dict[str, list[str]] = {}
    for item in closure.untestable:
        places.setdefault(item.effect, []).append(item.placement)
        missing = missing_columns(item, plan)
        reasons.setdefault(item.effect, []).extend(missing or [item.reason])
    return [
        {
            "effect": effect,
            "summary": summaries.get(effect, ""),
            "places": ", ".join(dict.fromkeys(p for p in found if p)),
            "missing": ", ".join(dict.fromkeys(reasons[effect])),
        }
        for effect, found in places.items()
    ]


def _unseen(closure: Closure, summaries: Mapping[str, str]) -> list[dict[str, str]]:
    """One line per effect that the declared model spans, its places joined."""
    places: dict[str, list[str]] = {}
    for key in dict.fromkeys(closure.unseen):
        name, _, place = key.partition(" ")
        places.setdefault(name, []).append(place)
    return [
        {
            "effect": name,
            "summary": summaries.get(name, ""),
            "places": ", ".join(p for p in found if p),
        }
        for name, found in places.items()
    ]


def _location(table: ErrorMotionTable) -> dict[str, str]:
    row = _parameter(table.name, float(table.value[0]), table.unit, float(table.u[0]))
    return row | {"axis": table.axis, "information": text.percent(float(table.information[0]))}


def _test(test: GeometricTest) -> dict[str, str]:
    row = _parameter(test.name, test.value, test.unit, test.u)
    if test.information < HARDLY_TOLD:
        row["value"] = text.DASH  # the best estimate of what was not seen is its prior's, nothing
    return row | {"what": test.what, "information": text.percent(test.information)}


def _motion(table: ErrorMotionTable) -> dict[str, str]:
    """An error motion in one line: its range, its largest uncertainty, what the data told."""
    largest = float(table.u.max())
    return {
        "name": table.name,
        "axis": table.axis,
        "unit": text.unit(table.unit),
        "low": text.rounded(float(table.value.min()), largest)[0],
        "high": text.rounded(float(table.value.max()), largest)[0],
        "U": text.rounded(0.0, text.COVERAGE * largest)[1],
        "information": text.percent(float(table.information.mean())),
    }
