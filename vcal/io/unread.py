"""Columns of a table without readings that were meant to be readings: it would pass for a plan."""

import os
import re
from collections.abc import Collection, Sequence

from .messages import listed, refusal

_UNITS = frozenset(
    "nm um mm cm m km in inch inches mil rad mrad urad deg degree degrees grad gon arcmin arcsec "
    "arcs micron microns".split()
)
_LONG = 5
"""Letters that a name has at least where one of them may be wrong."""


def check_unread(
    name: str,
    kind: str,
    further: Sequence[str],
    readings: Collection[str],
    otherwise: Collection[str],
) -> None:
    """Raises `StudyError` where one of the `further` columns of a table that has none of the
    `readings` is named like one, or is one of those that the instrument reads `otherwise`, with
    other settings.
    """
    names = listed(sorted(readings))
    if others := [column for column in further if column in otherwise]:
        raise refusal(
            name,
            f"header, column{'s' * (len(others) > 1)} {listed(others)}",
            f"what a {kind} reads with other settings than those of its [instrument]",
            f"{names}; or no readings, in a plan",
            "correct the settings or the columns, or remove them from a plan",
        )
    for column in further:
        if meant := _like(column, readings):
            raise refusal(
                name,
                f"header, column {column}",
                f"no column of readings, but one that is named like {meant}",
                f"{names}, in these units; or no column like them, in a plan",
                "correct its name and unit, or give it another name where it is another quantity",
            )


def _like(column: str, readings: Collection[str]) -> str | None:
    """The reading that a column may be in another unit or spelling."""
    stems = {_stem(reading): reading for reading in sorted(readings)}
    own = _stem(column)
    if own in stems or len(own.replace("_", "")) < _LONG:
        return stems.get(own)
    return next((reading for stem, reading in stems.items() if _slip(own, stem)), None)


def _slip(one: str, other: str) -> bool:
    """Whether a letter too many, too few or another, or two exchanged, make one of the other."""
    start = len(os.path.commonprefix([one, other]))
    one, other = one[start:], other[start:]
    end = len(os.path.commonprefix([one[::-1], other[::-1]]))
    one, other = one[: len(one) - end], other[: len(other) - end]
    return max(len(one), len(other)) == 1 or (len(one) == 2 and one == other[::-1])


def _stem(column: str) -> str:
    """A name without its unit, in small letters: ``range`` of ``Range [mm]``."""
    parts = re.findall(r"[^\W_]+", column.casefold().replace("μ", "u"))  # also of the micro sign
    while len(parts) > 1 and parts[-1] in _UNITS:
        parts.pop()
    return "_".join(parts)
