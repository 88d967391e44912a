"""Coverage intervals of a scalar output from its ranked values: JCGM 101, 7.7."""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

Kind = Literal["symmetric", "shortest"]
"""Probabilistically symmetric (7.7.2, Note 2) or shortest (7.7.2, Note 3)."""
Ranked = Callable[[Int[np.ndarray, " n"]], Float[np.ndarray, " n"]]
"""Values of given ranks, counted from one in ascending order."""

_MANY, _PART = 100_000, 5_000


def coverage_interval(
    values: Float[np.ndarray, " n"], p: float, kind: Kind = "symmetric"
) -> tuple[float, float]:
    """Coverage interval [y_(r), y_(r+q)] of values in any order (JCGM 101, 7.7.2).

    `p` is the coverage probability. Raises `ValueError` as `interval_ranks` does.
    """
    if kind == "shortest":
        ordered = np.sort(values)
        low, high = interval_ranks(lambda ranks: ordered[ranks - 1], len(values), p, kind)
        return float(ordered[low - 1]), float(ordered[high - 1])
    low, high = interval_ranks(lambda ranks: values[ranks - 1], len(values), p, kind)
    return ranked_value(values, low), ranked_value(values, high)


def ranked_value(values: Float[np.ndarray, " n"], rank: int) -> float:
    """The value of a rank, counted from one in ascending order, of values in any order.

    A part of many values tells between which bounds it is; the others are only counted.
    """
    below = 0
    if len(values) > _MANY:
        part = np.sort(values[:: len(values) // _PART])
        share = rank / len(values)
        spread = 5.0 * math.sqrt(share * (1.0 - share) / len(part)) + 1.0 / len(part)
        at = np.array([share - spread, share + spread]) * len(part)
        low, high = part[np.clip(at.astype(int), 0, len(part) - 1)]
        below = np.count_nonzero(values < low)
        inside = values[(values >= low) & (values <= high)]
        if below < rank <= below + len(inside):
            values = inside
        else:
            below = 0
    return float(np.partition(values, rank - below - 1)[rank - below - 1])


def interval_ranks(
    ranked: Ranked,
    draws: int,
    p: float,
    kind: Kind = "symmetric",
    knots: Int[np.ndarray, " m"] | None = None,
) -> tuple[int, int]:
    """Ranks r and r + q of the ends of a coverage interval (JCGM 101, 7.7.2).

    q = p M where that is an integer, otherwise the integer part of p M + 1/2. Symmetric:
    r = (M - q)/2 or the integer part of (M - q + 1)/2; shortest: the r of 1 ... M - q for which
    y_(r+q) - y_(r) is least, the first of several. Where `ranked` is piecewise linear, the ranks of
    its `knots` suffice, as an interval of least width has an end at a knot.

    Raises `ValueError` for a probability outside (0, 1), an unknown kind, or too few draws.
    """
    check_coverage(p)
    count = math.floor(p * draws + 0.5)
    spare = draws - count
    if spare < 1:
        raise ValueError(
            f"found {draws} draws, expected more than {0.5 / (1.0 - p):.6g} for a coverage "
            f"probability of {p}; draw more"
        )
    if kind == "symmetric":
        low = (spare + 1) // 2
    elif kind == "shortest":
        low = _shortest(ranked, count, spare, knots)
    else:
        raise ValueError(f"interval: found kind {kind!r}, expected 'symmetric' or 'shortest'")
    return low, low + count


def check_coverage(p: float) -> None:
    """Raise `ValueError` for a coverage probability outside (0, 1)."""
    if not 0.0 < p < 1.0:
        raise ValueError(f"coverage probability: found {p}, expected a number above 0 and below 1")


def _shortest(ranked: Ranked, count: int, spare: int, knots: Int[np.ndarray, " m"] | None) -> int:
    if knots is None:
        low = np.arange(1, spare + 1)
    else:
        low = np.unique(np.clip(np.concatenate([knots, knots - count]), 1, spare))
    return int(low[np.argmin(ranked(low + count) - ranked(low))])
