"""What has changed in a series: steps and drifts, the time since the last report, and effects that
appear.
"""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float

from .change_points import Sample, Size, Tested, against_constant, remaining
from .series import Series

_COVERAGE = 2.0
"""k of the expanded uncertainty."""


@dataclass(frozen=True)
class Change:
    """A significant change of a series."""

    kind: Literal["step", "drift"]
    size: Size
    """Change of every part: over a step, or of a drift from the first to the last date."""
    first: datetime.date
    last: datetime.date
    """The step lies between these dates; the drift was seen between them."""
    p_value: float
    """Corrected for all series and places."""


@dataclass(frozen=True)
class Since:
    """The difference between the last result and the one before."""

    first: datetime.date
    last: datetime.date
    size: Size
    p_value: float
    """Of this series alone."""
    corrected: float
    """Corrected for all series that have such a difference."""


@dataclass(frozen=True)
class Appearance:
    """An effect that is named in one report and was not in the report before that searched for it,
    though its size would have been named; or the reverse.
    """

    what: Literal["appeared", "disappeared"]
    part: str
    unit: str
    value: float
    u: float
    """Of the report that names it."""
    smallest: float
    """Smallest size that the other report would have named with a probability of 95 %."""
    first: datetime.date
    last: datetime.date


@dataclass(frozen=True)
class Segment:
    """Consecutive reports over which a series is constant, or drifts: its fitted values."""

    first: int
    last: int
    """Numbers of the reports, from 0."""
    start: Float[np.ndarray, " d"]
    end: Float[np.ndarray, " d"]


@dataclass(frozen=True)
class Outcome:
    """All that was tested in one series."""

    series: Series
    tested: Tested | None
    """None where no two dates can be compared."""
    p_value: float
    """Of a constant, corrected for all series and places; 1 where it was not tested."""
    changes: tuple[Change, ...]
    segments: tuple[Segment, ...]
    """What is fitted with these changes."""
    remaining_p_value: float
    """Of the scatter that the changes leave: small where the reports scatter by more than their
    uncertainties."""
    since: Since | None
    appearances: tuple[Appearance, ...]


def outcomes(
    series: Sequence[Series], dates: Sequence[datetime.date], alpha: float, seed: int = 0
) -> list[Outcome]:
    """Test every series for changes, with a probability of at most `alpha` that any change is found
    in any series where nothing has changed.

    Each series has one p-value, which is corrected for its places (`against_constant`); over the
    series they are corrected by Holm. After a step, the results before and after it are tested in
    the same way for further steps, corrected for the number of series (binary segmentation).
    """
    days = np.array([(date - dates[0]).days for date in dates], float)
    samples = [one.sample(days) for one in series]
    tests = [against_constant(sample, seed) for sample in samples]
    corrected = _holm({i: t.p_value for i, t in enumerate(tests) if t is not None})
    since = [_since(one, sample, dates) for one, sample in zip(series, samples, strict=True)]
    recent = _holm({i: size.p_value for i, (size, *_) in enumerate(since) if size is not None})
    found = []
    for i, (one, sample, test) in enumerate(zip(series, samples, tests, strict=True)):
        p = corrected.get(i, 1.0)
        when = [dates[k] for k in one.tested]
        drift, places = None, {}
        if test is not None and p <= alpha and test.best.kind == "drift":
            drift = _drift(sample, test, when, p)
        elif test is not None and p <= alpha:
            places = _places(sample, test, p, len(corrected), alpha, seed)
        changes = _steps(sample, places, when) if drift is None else [drift]
        size, first, last = since[i]
        found.append(
            Outcome(
                series=one,
                tested=test,
                p_value=p,
                changes=tuple(changes),
                segments=_segments(one, sample, list(places), drift),
                remaining_p_value=remaining(sample, list(places), drift is not None),
                since=None if size is None else Since(first, last, size, size.p_value, recent[i]),
                appearances=tuple(_appear(one, dates)),
            )
        )
    return found


def _holm(p_values: Mapping[int, float]) -> dict[int, float]:
    """Adjusted p-values (S. Holm 1979, Scand. J. Stat. 6, 65-70)."""
    adjusted, largest = {}, 0.0
    for rank, key in enumerate(sorted(p_values, key=lambda key: p_values[key])):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[key]))
        adjusted[key] = largest
    return adjusted


def _places(
    sample: Sample, test: Tested, p: float, series: int, alpha: float, seed: int, offset: int = 0
) -> dict[int, tuple[list[int], float]]:
    """All steps by the number of results before each: places that are as good, and its p-value."""
    k = test.best.after
    found = {offset + k: ([offset + one for one in test.alike], p)}
    for first, last in ((0, k), (k, sample.size)):
        inner = sample.part(first, last)
        again = against_constant(inner, seed)
        if again is None or again.best.kind == "drift":
            continue
        adjusted = min(1.0, series * again.p_value)
        if adjusted <= alpha:
            found |= _places(inner, again, adjusted, series, alpha, seed, offset + first)
    return dict(sorted(found.items()))


def _steps(
    sample: Sample, places: Mapping[int, tuple[list[int], float]], dates: Sequence[datetime.date]
) -> list[Change]:
    """The differences between the means of neighbouring segments."""
    ends = [0, *places, sample.size]
    means = [sample.part(a, b).mean for a, b in pairwise(ends)]
    return [
        Change("step", after.minus(before), dates[min(alike) - 1], dates[max(alike)], p)
        for before, after, (alike, p) in zip(means, means[1:], places.values(), strict=False)
    ]


def _drift(sample: Sample, test: Tested, dates: Sequence[datetime.date], p: float) -> Change:
    span = sample.times[-1] - sample.times[0]
    per_day = test.best.size
    size = Size(per_day.value * span, per_day.covariance * span**2)
    return Change("drift", size, dates[0], dates[-1], p)


def _segments(
    series: Series, sample: Sample, places: Sequence[int], drift: Change | None
) -> tuple[Segment, ...]:
    mine = series.tested
    if drift is not None:
        span = sample.times[-1] - sample.times[0]
        slope = drift.size.value / span
        start = sample.less(slope).mean.value
        return (Segment(mine[0], mine[-1], start, start + slope * span),)
    ends = [0, *places, sample.size]
    means = [sample.part(a, b).mean.value for a, b in pairwise(ends)]
    return tuple(
        Segment(mine[a], mine[b - 1], mean, mean)
        for (a, b), mean in zip(pairwise(ends), means, strict=True)
    )


def _since(
    series: Series, sample: Sample, dates: Sequence[datetime.date]
) -> tuple[Size | None, datetime.date, datetime.date]:
    """The last result of the last report against the one before."""
    mine = series.tested
    if len(mine) < 2 or mine[-1] != len(dates) - 1:
        return None, dates[0], dates[-1]
    last, before = (
        sample.part(sample.size - 1, sample.size),
        sample.part(sample.size - 2, sample.size - 1),
    )
    return last.mean.minus(before.mean), dates[mine[-2]], dates[mine[-1]]


def _appear(series: Series, dates: Sequence[datetime.date]) -> list[Appearance]:
    """Neighbouring reports of which one names the effect and the other would have."""
    seen = [i for i, e in enumerate(series.entries) if e.state in ("named", "not named")]
    found = []
    for a, b in pairwise(seen):
        first, second = series.entries[a], series.entries[b]
        if first.state == second.state:
            continue
        appeared = second.state == "named"
        named, absent = (second, first) if appeared else (first, second)
        assert named.size is not None
        for part, value, u, smallest in zip(
            series.parts, named.size.value, named.size.u, absent.smallest, strict=True
        ):
            if smallest is not None and abs(value) - _COVERAGE * u > smallest:
                what = "appeared" if appeared else "disappeared"
                found.append(
                    Appearance(
                        what,
                        part.name,
                        part.unit,
                        float(value),
                        float(u),
                        smallest,
                        dates[a],
                        dates[b],
                    )  # fmt: skip
                )
    return found
