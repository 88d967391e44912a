"""What a history says in words."""

from collections.abc import Iterable

from ...history import Appearance, Change, History, Series, Size
from ...words import counted, plural
from ..html import text


def sentence(history: History) -> str:
    """The answer in one sentence."""
    span = counted(len(history.reports), "report")
    first, last = history.reports[0].date, history.reports[-1].date
    if len(history.reports) == 1:
        return f"There is one report, of {first}: nothing to compare it with."
    if not history.tested and not history.appeared:
        return f"No result of the {span} from {first} to {last} occurs on two dates."
    count = len(history.changed)
    series = f"{len(history.tested)} series of {span} from {first} to {last}"
    names = [f"{one.series.name} {one.appearances[0].what}" for one in history.appeared]
    effects = f" {'; '.join(names)}." if names else ""
    if not count:
        return f"No significant change was found in {series}.{effects}"
    some = f"{count} of {series} {plural(count, 'has', 'have')} changed significantly"
    return f"{some}: {', '.join(one.series.name for one in history.changed)}.{effects}"


def lines(history: History) -> list[str]:
    """Every change, and every effect that appears, in one line."""
    found = []
    for one in history.outcomes:
        found += [said(one.series, change) for change in one.changes]
        found += [appearance(one.series, change) for change in one.appearances]
    return found


def said(series: Series, change: Change) -> str:
    """A change in words: ``EC(0X)Y: step of 12.1 +- 2.0 urad between ...``."""
    size = ", ".join(sizes(series, change.size))
    chance = f"p = {text.probability(change.p_value)}"
    if change.kind == "drift":
        return f"{series.name}: drift by {size} from {change.first} to {change.last}, {chance}"
    return f"{series.name}: step of {size} between {change.first} and {change.last}, {chance}"


def sizes(series: Series, size: Size) -> Iterable[str]:
    """Every part with its expanded uncertainty U (k = 2)."""
    for part, value, u in zip(series.parts, size.value, size.u, strict=True):
        shown = " ± ".join(text.rounded(float(value), text.COVERAGE * float(u)))
        yield f"{part.name} {shown} {text.unit(part.unit)}".strip()


def appearance(series: Series, found: Appearance) -> str:
    """An effect that has appeared or disappeared, in words."""
    unit = text.unit(found.unit)
    shown = " ± ".join(text.rounded(found.value, text.COVERAGE * found.u))
    return (
        f"{series.name}: {found.what} between {found.first} and {found.last}; {found.part} "
        f"{shown} {unit}, while the other report would have named it from "
        f"{text.number(found.smallest)} {unit} on"
    )
