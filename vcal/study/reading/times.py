"""Times in a table: ISO 8601, days of a spreadsheet, and patterns, as seconds on one clock."""

import datetime
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

ISO, EXCEL = "iso8601", "excel"
_EPOCH = datetime.datetime(1970, 1, 1)
_EXCEL_DAYS = 25569
"""Days from 1899-12-30, from which spreadsheets count, to 1970-01-01."""
_EARLIEST, _LATEST = 10_000.0, 80_000.0
"""Days of 1927 and of 2119: other numbers are no dates of measurements."""
_DATE = re.compile(r"\s*\d{4}-?\d\d-?\d\d([T\s]+\d\d:?\d\d.*)?\s*")
_TIME = re.compile(r"\s*\d{1,2}:\d\d(:\d\d([.,]\d+)?)?\s*")
_LOCAL = re.compile(r"\s*\d{1,4}[./-]\d{1,2}[./-]\d{1,4}([,T\s]+\d{1,2}:\d\d.*)?\s*")
_FRACTION = re.compile(r"([.,]\d{6})\d+")


@dataclass
class Clock:
    """The instant that counts as zero in all tables of a study: its first time with a date."""

    zero_ns: int | None = None
    """Nanoseconds since 1970."""
    text: str = ""
    """The same as ISO 8601."""

    def seconds(self, instants_ns: np.ndarray) -> np.ndarray:
        """Instants, ns since 1970, as seconds from zero; the first one read sets the clock."""
        if self.zero_ns is None:
            self.zero_ns = int(instants_ns[0])
            micro = datetime.timedelta(microseconds=self.zero_ns // 1000)
            self.text = (_EPOCH + micro).isoformat()
        return (instants_ns - self.zero_ns) / 1e9


def looks_like_times(cells: Sequence[str], most: int = 50) -> str:
    """``"iso8601"`` for cells with dates and times of ISO 8601, ``"clock"`` for times of day,
    ``"local"`` for dates whose order of day and month cannot be known; empty for others.
    """
    some = [cell for cell in cells[:most] if cell.strip()]
    for name, pattern in ((ISO, _DATE), ("clock", _TIME), ("local", _LOCAL)):
        # Eight digits without a dash may be a number.
        if some and all(pattern.fullmatch(c) and not c.strip().isdigit() for c in some):
            return name
    return ""


def iso_ns(text: str) -> int | None:
    """Nanoseconds since 1970 of a text in ISO 8601, in UTC where it has an offset; a time of day
    alone counts from midnight. None for anything else.
    """
    text = text.strip()
    try:
        if _TIME.fullmatch(text):
            hours, minutes, *seconds = text.replace(",", ".").split(":")
            whole, _, part = (seconds[0] if seconds else "0").partition(".")
            if int(hours) > 24 or int(minutes) > 59 or int(whole) > 60:
                return None
            nano = int(part.ljust(9, "0")[:9]) if part else 0
            return (int(hours) * 3600 + int(minutes) * 60 + int(whole)) * 10**9 + nano
        nano = 0
        if match := re.search(r"[.,](\d{7,9})\d*", text):
            nano = int(match[1].ljust(9, "0")[6:])
            text = _FRACTION.sub(r"\1", text)
        when = datetime.datetime.fromisoformat(
            re.sub(r"\s+", "T", text.replace(" Z", "Z"), count=1)
        )
    except ValueError:
        return None
    return _ns(when) + nano


def pattern_ns(text: str, pattern: str) -> int | None:
    """The same for a text that follows a pattern of `datetime.strptime`."""
    try:
        return _ns(datetime.datetime.strptime(" ".join(text.split()), " ".join(pattern.split())))
    except ValueError:
        return None


def excel_ns(days: float) -> int | None:
    """The same for days since 1899-12-30, to the microsecond; None for a day that is not of this
    century or the last.
    """
    if not _EARLIEST <= days <= _LATEST:
        return None
    return round((days - _EXCEL_DAYS) * 86400e6) * 1000


def has_offset(text: str) -> bool:
    """Whether an instant says its offset from UTC."""
    return bool(re.search(r"(Z|[+-]\d\d:?\d\d)\s*$", text.strip()[10:], re.IGNORECASE))


def _ns(when: datetime.datetime) -> int:
    if when.tzinfo is not None:
        when = when.astimezone(datetime.UTC).replace(tzinfo=None)
    passed = when - _EPOCH
    return (passed.days * 86400 + passed.seconds) * 10**9 + passed.microseconds * 1000
