"""Time stamps of exports as seconds since the first one."""

from collections.abc import Sequence
from datetime import datetime

import numpy as np

from ..study.messages import listed, refusal

_FORMATS = (
    "%Y-%m-%d %H:%M:%S",
    "%Y/%m/%d %H:%M:%S",
    "%d.%m.%Y %H:%M:%S",
    "%d/%m/%Y %H:%M:%S",
    "%m/%d/%Y %H:%M:%S",
    "%d/%m/%Y %I:%M:%S %p",
    "%m/%d/%Y %I:%M:%S %p",
    "%H:%M:%S",
)
"""Formats of time stamps, each with or without a fraction of a second."""


def seconds(
    cells: Sequence[str], file: str, lines: Sequence[int], given: str | None
) -> np.ndarray | None:
    """Seconds since the first time stamp; None where the format of the cells is none of those
    known here.

    ISO 8601 and the formats of `strptime` above are tried. A date such as 03/04/2024 may have the
    day or the month in front. Where that changes an interval, `StudyError` asks for the format.
    `given` is that format; with it, a cell of another form raises `StudyError`.
    """
    texts = [cell.strip() for cell in cells]
    if given is not None:
        try:
            return _since([datetime.strptime(text, given) for text in texts])
        except ValueError as error:
            bad = next(i for i, text in enumerate(texts) if not _fits(text, given))
            raise refusal(
                file,
                f"line {lines[bad]}",
                f"the time {texts[bad]!r}",
                f"--time-format {given!r}",
                "correct the format or the line",
            ) from error
    try:
        return _since([datetime.fromisoformat(text) for text in texts])
    except (ValueError, TypeError):
        pass
    found: dict[str, np.ndarray] = {}
    for form in (f for base in _FORMATS for f in (base, base.replace("%S", "%S.%f"))):
        try:
            found[form] = _since([datetime.strptime(text, form) for text in texts])
        except ValueError:
            continue
    if not found:
        return None
    first = next(iter(found.values()))
    if any(not np.array_equal(first, other) for other in found.values()):
        raise refusal(
            file,
            f"line {lines[0]}",
            f"the time {texts[0]!r}, which fits {listed(found)}",
            "times that fit one format",
            "give --time-format with the right one",
        )
    return first


def _fits(text: str, form: str) -> bool:
    try:
        datetime.strptime(text, form)
    except ValueError:
        return False
    return True


def _since(times: Sequence[datetime]) -> np.ndarray:
    return np.array([(time - times[0]).total_seconds() for time in times])
