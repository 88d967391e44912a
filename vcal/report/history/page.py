"""The page of a history: what has changed, and every series."""

import math
from collections.abc import Sequence

from ...history import History, Outcome
from ...words import counted
from ..html import text
from ..html.picture import Picture, Shown, by_section
from ..html.provenance import EXPANDED, NAMES, versions
from ..html.sheet import Badge, Section, Table, Tile, sheet
from .sentences import appearance, sentence, sizes

FILES = {"history.json": "all results, for programs"}
_POOR = 0.01
"""p-value of the scatter that changes leave, below which a note says so."""


def page(
    history: History, drawn: Sequence[Picture], *, command: str = "", seconds: float = math.nan
) -> str:
    """The page as one self-contained HTML text, pictures included."""
    shown = by_section(drawn)
    sections = [
        _changes(history),
        _since(history),
        *_groups(history, shown),
        _reports(history),
        _method(history),
        _provenance(command, seconds),
    ]
    number = history.serial_number
    facts = [
        ("Machine", f"{history.machine}{f', serial number {number}' if number else ''}"),
        ("Reports", f"{len(history.reports)}"),
        ("Measured", f"{history.reports[0].date} to {history.reports[-1].date}"),
    ]
    name = str(history.reports[-1].content["name"])
    return sheet(
        name,
        sentence(history),
        sections,
        kicker="vcal – history of a machine",
        badge=_badge(history),
        facts=facts,
        warnings=[*history.notes, *_scattered(history)],
        tiles=_tiles(history),
    )


def _badge(history: History) -> Badge:
    if history.changed or history.appeared:
        return Badge("Changed", "caution")
    return Badge("No change found", "good") if history.tested else Badge("Nothing to compare")


def _tiles(history: History) -> list[Tile]:
    if not history.tested:
        return []
    share = text.percent(history.alpha)
    return [
        Tile(
            "Series with a change",
            f"{len(history.changed)} of {len(history.tested)}",
            f"probability of any where nothing has changed: {share}",
        ),
        Tile(
            "Changed since the last report",
            f"{len(history.recent)}",
            f"{history.reports[-2].date} to {history.reports[-1].date}",
        ),
        Tile(
            "Effective number of tests",
            text.number(history.effective),
            f"of {counted(history.tests, 'test')}: places of a step, and drifts",
        ),
    ]


def _scattered(history: History) -> list[str]:
    """Series that scatter by more than their uncertainties, whatever has changed."""
    limit = _POOR / max(len(history.tested), 1)
    found = [one.series.name for one in history.tested if one.remaining_p_value < limit]
    if not found:
        return []
    return [
        f"{', '.join(found)}: what the changes found leave scatters by more than the stated "
        "uncertainties. Either the machine changes in another way than by steps or one drift, or "
        "the uncertainties of the reports do not cover the reproducibility of the measurement."
    ]


def _changes(history: History) -> Section:
    rows = [
        (
            one.series.name,
            change.kind,
            "; ".join(sizes(one.series, change.size)),
            f"{change.first} to {change.last}",
            text.probability(change.p_value),
        )
        for one in history.outcomes
        for change in one.changes
    ]
    appeared = [
        appearance(one.series, found) for one in history.appeared for found in one.appearances
    ]
    words = () if rows or appeared else ("None is significant.",)
    header = ("series", "kind", "size ± U (k = 2)", "dates", "p, corrected")
    note = (
        "A step lies between the two dates. Where neighbouring places describe it as well (within "
        "3.84 of the largest chi-square), the dates enclose all of them. The size of a drift is "
        "the change from the first to the last date."
    )
    return Section(
        "What has changed", words, tuple(appeared), (Table(header, rows, "llllr"),),
        note=note if rows else "",
    )  # fmt: skip


def _since(history: History) -> Section:
    found = [one for one in history.outcomes if one.since is not None]
    found.sort(key=lambda one: one.since.p_value if one.since else 1.0)
    rows = [
        (
            one.series.name,
            "; ".join(sizes(one.series, one.since.size)),
            f"{one.since.first}",
            text.probability(one.since.p_value),
            text.probability(one.since.corrected),
        )
        for one in found
        if one.since is not None
    ]
    strong = frozenset(k for k, one in enumerate(found) if one in history.recent)
    header = ("series", "difference ± U (k = 2)", "since", "p", "p, corrected")
    words = (
        "Last result minus the one before. In bold: significant after correction for all of them.",
    )
    table = Table(header, rows, "lllrr", strong=strong)
    return Section("Since the last report", words if rows else (), tables=(table,))


def _groups(history: History, shown: Shown) -> list[Section]:
    found = []
    for group in dict.fromkeys(one.series.group for one in history.outcomes):
        mine = [one for one in history.outcomes if one.series.group == group]
        rows = [row for one in mine for row in _rows(history, one)]
        header = ("series", "date", "value ± U (k = 2)", "p of a constant, corrected")
        fold = f"{counted(len(mine), 'series', 'series')} in numbers"
        table = Table(header, rows, "lllr", fold=fold)
        title = f"{group[0].upper()}{group[1:]}"
        found.append(Section(title, tables=(table,), pictures=shown.get(group, ())))
    return found


def _rows(history: History, one: Outcome) -> list[tuple[str, ...]]:
    chance = text.DASH if one.tested is None else text.probability(one.p_value)
    return [
        (one.series.name, f"{report.date}", _cell(one, i), chance)
        for i, report in enumerate(history.reports)
    ]


def _cell(one: Outcome, i: int) -> str:
    """What a report says: values, or the reason why there are none."""
    entry, parts = one.series.entries[i], one.series.parts
    if entry.size is not None and entry.state != "not stated":
        said = "; ".join(sizes(one.series, entry.size))
        return said if entry.state in ("measured", "named") else f"{said} ({entry.state})"
    limits = [
        f"{part.name} {text.number(size)} {text.unit(part.unit)}".strip()
        for part, size in zip(parts, entry.smallest, strict=False)
        if size is not None
    ]
    return f"{entry.state}; would have been from {', '.join(limits)} on" if limits else entry.state


def _reports(history: History) -> Section:
    rows = [
        (f"{one.date}", one.folder, one.content["name"], one.content["sentence"])
        for one in history.reports
    ]
    return Section("Reports", tables=(Table(("date", "folder", "study", "result"), rows, "lcll"),))


def _method(history: History) -> Section:
    return Section(
        "Method",
        points=(
            NAMES,
            EXPANDED,
            "Each series is tested for a constant against a step at every place between two dates, "
            "and against a drift linear in the date, by weighted least squares with the covariance "
            "of every report. Reports count as independent. The largest chi-square has a p-value "
            "for the effective number of these tests, which share their data; over the series, "
            "p-values are corrected by Holm. The results before and after a significant step are "
            "tested again for further steps.",
            f"The probability that any change is found where nothing has changed is at most "
            f"{text.percent(history.alpha)}. It is lower where results depend on declared priors, "
            "or on errors that all measurements share, such as those of one instrument.",
            "Errors that depend on direction or temperature are in the series of their effects. An "
            "effect that is in the model of one report only may change the others: the geometry "
            "takes up a part of what is not named.",
        ),
    )


def _provenance(command: str, seconds: float) -> Section:
    rows = [
        *([("command", command)] if command else []),
        ("versions", ", ".join(f"{k} {v}" for k, v in versions().items())),
        *([("time", f"{text.number(seconds)} s")] if math.isfinite(seconds) else []),
    ]
    links = {name: name for name in FILES}
    beside = Table(("file beside this page", "content"), [*FILES.items()], links=links)
    return Section("Provenance", tables=(Table(("", ""), rows), beside))
