"""The pictures of a history with their captions."""

from collections.abc import Iterator

from ...history import History
from ...plots.histories import histories
from ..html.picture import Picture

_CAPTION = (
    "Values with U (k = 2) over the date of the measurement. Dotted: the weighted mean where no "
    "change is significant. Orange lines: means before and after a step, or the drift; a band "
    "covers the dates between which the step lies. {}"
)
_EFFECTS = (
    "Open triangles: the effect was not named, and would have been from this size on. Grey: in the "
    "model with a name that is ambiguous, and not tested."
)


def pictures(history: History) -> Iterator[Picture]:
    """One picture for every group of series."""
    dates = [one.date for one in history.reports]
    for group in dict.fromkeys(one.series.group for one in history.outcomes):
        mine = [one for one in history.outcomes if one.series.group == group]
        caption = _CAPTION.format(_EFFECTS if group.endswith("effects") else "").strip()
        name = f"history_{group.replace(' ', '_')}"
        yield Picture.of(name, group, caption, histories(mine, dates))
