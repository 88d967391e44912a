"""Sections of the page: effects that were tested, rejected or not testable, and outliers."""

import math
from collections.abc import Mapping

from ...effects.base import Effect
from ...effects.data_set import OfDataSet
from ...effects.registry import CATALOGUE
from ...loop.detectable import Detectable
from ...loop.empirical import EMPIRICAL
from ...loop.outcome.closure import Closure
from ...plots import minus_log10_p
from ...study.study import Study, looked_for
from ..html import text
from ..html.picture import Shown
from ..html.sheet import Section, Table
from .derived import missing_columns


def restricted(closure: Closure) -> str:
    """How many kinds of effects were asked for; empty where all of the catalogue were."""
    asked = closure.settings.get("effects", ())
    kinds = [name for name, kind in CATALOGUE.items() if looked_for(kind)]
    wanted = [name for name in kinds if name in asked]
    own = len(set(asked) - CATALOGUE.keys())
    if wanted == kinds:
        return ""
    beside = f" and {own} of your own" if own else ""
    return f"{len(wanted)} of the {len(kinds)} kinds in the catalogue{beside}"


def tested(closure: Closure, study: Study, shown: Shown) -> list[Section]:
    """Significance of every kind of effect in every round, and the reasons of rejections."""
    summaries, asked = _summaries(closure, study), restricted(closure)
    rows = [
        (f"{one.effect} {one.placement}".strip(), summaries.get(one.effect, ""),
         text.probability(one.p_value), one.reason)
        for one in (*closure.rejected, *closure.passed_over)
    ]  # fmt: skip
    header = ("effect", "description", "p", "reason of the rejection")
    none = "None besides those that were added." if closure.effects else "None."
    every = (
        f"The search was restricted to {asked}. Each of them" if asked else "Every kind of effect"
    )
    return [
        Section(
            "Effects tested",
            (
                f"{every} was tested at every placement for which the data have the necessary "
                "columns. p-values are corrected for the whole search, first within a kind, then "
                f"over the kinds; the limit is {100 * closure.settings['alpha']:g} % for the "
                "search as a whole.",
            ),
            tables=(_by_round(closure, summaries),),
            pictures=shown.get("tried", ()),
        ),
        Section(
            "Significant, but rejected",
            () if rows else (none,),
            tables=(Table(header, rows, "llrl"),),
            minor=True,
        ),
    ]


def _by_round(closure: Closure, summaries: Mapping[str, str]) -> Table:
    """One row per kind of effect: its best placement, and its p-value in every round."""
    screenings = closure.screenings
    limit = -math.log10(closure.settings["alpha"])
    lines: dict[str, list[str]] = {}
    orders: dict[str, float] = {}
    hits = set()
    for i, screening in enumerate(screenings):
        for kind in screening.kinds:
            best = kind.peaks[0].effect.placement if kind.peaks else ""
            start = [kind.kind, summaries.get(kind.kind, ""), str(kind.instances), best]
            line = lines.setdefault(kind.kind, start + [text.DASH] * len(screenings))
            orders.setdefault(kind.kind, -minus_log10_p(screening, kind))
            p_value = screening.corrected(kind)
            if minus_log10_p(screening, kind) >= limit:
                # The p-value of an added effect is that at its fitted shape, as elsewhere.
                p_value = screening.refined_p.get(kind.kind, p_value)
                hits.add((kind.kind, 4 + i))
            line[4 + i] = text.probability(p_value)
    names = sorted(lines, key=lambda name: orders[name])
    added = {found.effect.name for found in closure.effects}
    rounds = [f"p, round {i + 1}" for i in range(len(screenings))]
    return Table(
        ("effect", "description", "placements", "best", *rounds),
        [lines[name] for name in names],
        "llrl" + "r" * len(rounds),
        fold="Every kind of effect, with its best placement and its p-value in each round",
        strong=frozenset(i for i, name in enumerate(names) if name in added),
        marked=frozenset((names.index(name), column) for name, column in hits),
    )


def not_tested(closure: Closure, study: Study, seen: Detectable | None) -> list[Section]:
    """Effects without the columns that they need, pitches and effects that the model spans, and
    outliers. What could have been `seen` lists effects that the model spans in a section of its
    own.
    """
    summaries, asked = _summaries(closure, study), restricted(closure)
    missing = [(k, summaries.get(k, ""), *cells) for k, *cells in _untestable(closure)]
    listed = () if seen is None else {one.effect.key for one in seen.spanned}
    unseen = [key for key in closure.unseen if key not in listed]
    spanned = [(k, summaries.get(k, ""), at) for k, at in _grouped(unseen).items()]
    header = ("effect", "description", "placements")
    lacking = Table(
        (*header, "missing columns"),
        missing,
        "lllc",
        caption="These effects need columns that the data do not have:",
    )
    unobservable = Table(
        header,
        spanned,
        caption="The declared model spans these effects on this plan, in some or all components. "
        "They are not observable beside it and do not impair the identified values:",
    )
    paragraph = "The search had not begun."
    if closure.screenings:
        requested = f"that was requested ({asked}) and " if asked else ""
        paragraph = (
            f"The data have the necessary columns for every effect {requested}that can occur on "
            "this machine."
        )
    tables = (lacking, unobservable)
    section = Section("Effects not tested", () if missing else (paragraph,), tables=tables)
    return [section, _outliers(closure)]


def _outliers(closure: Closure) -> Section:
    plan = closure.after.measurement.plan
    rows = [
        (plan.row_name(one.row), text.number(one.distance), text.probability(one.p_value))
        for one in closure.suspected
    ]
    table = Table(
        ("data row", "distance, robust standard deviations", "p"),
        rows,
        "rrr",
        caption="Excluded from the fits, because they deviate strongly from all other readings:",
        note="Data rows are counted from 1 below the header of the table.",
    )
    return Section("Outliers", () if rows else ("None.",), tables=(table,), minor=True)


def _summaries(closure: Closure, study: Study) -> dict[str, str]:
    """Description of every kind of effect, including those of the user."""
    known = {name: kind.summary for name, kind in study.catalogue.items()}
    for screening in closure.screenings:
        peaks = (kind.peaks[0].effect for kind in screening.kinds if kind.peaks)
        for effect in (*peaks, *screening.unseen):
            inner: Effect = effect.effect if isinstance(effect, OfDataSet) else effect
            known[inner.name] = inner.summary
    described = {
        cls.name: f"{cls.summary} (for comparison: no physical effect)" for cls in EMPIRICAL
    }
    return known | described


def _untestable(closure: Closure) -> list[tuple[str, str, str]]:
    """Every effect that could not be tested, with its placements and the missing columns."""
    plan = closure.after.measurement.plan
    places = _grouped([f"{item.effect} {item.placement}" for item in closure.untestable])
    reasons: dict[str, list[str]] = {}
    for item in closure.untestable:
        missing = missing_columns(item, plan)
        reasons.setdefault(item.effect, []).extend(missing or [item.reason])
    return [(name, at, ", ".join(dict.fromkeys(reasons[name]))) for name, at in places.items()]


def _grouped(keys: list[str]) -> dict[str, str]:
    """Placements of every effect, joined; a dash for an effect without any."""
    places: dict[str, list[str]] = {}
    for key in dict.fromkeys(keys):
        name, _, place = key.partition(" ")
        places.setdefault(name, []).append(place)
    return {name: ", ".join(p for p in found if p) or text.DASH for name, found in places.items()}
