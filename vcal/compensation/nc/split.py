"""Where moves are split, so that straight lines and arcs between the ends follow the correction.

The corrected path is q(f) = p(f) + c(f) over the share f of a piece. Between two samples a control
drives a straight line, or the circle through the samples at both ends and in the middle, with a
linear height. The deviation e(f) of q from that is bounded by its largest value at the samples
between plus

    (1 / 8) max |second difference of e| (x / sin x)^2,  x = pi h / period

which is the largest deviation of a function from its chords between samples at distance h, with the
second derivative taken from second differences. The factor corrects these for a sine of the
shortest period that is allowed for; samples lie four to that period.
"""

import math
from typing import NamedTuple

import numpy as np

from .arcs import AXES, centre_through
from .moves import Piece
from .options import Displacement, NcOptions
from .solve import Points, corrections

_PER_PERIOD = 4
_CURVATURE = (0.25 * math.pi / math.sin(0.25 * math.pi)) ** 2
CHORD_SHARE, JUMP_SHARE = 0.7, 0.25
"""Parts of the tolerance: for the deviation between the ends, and for a start that is not at the
corrected position because the direction changed there."""
_TIMES = 3
"""How often a piece is sampled again."""
_AT_ONCE = 250_000
"""Samples that are held in memory."""


class Span(NamedTuple):
    """A part of a piece that is one block: corrected ends and middle (3,), mm, and shares."""

    start: list[float]
    middle: list[float]
    end: list[float]
    share: float
    """Of the length of the piece."""
    straight: bool


class Splitting(NamedTuple):
    """The spans of every piece, largest corrections (pieces,) in mm."""

    spans: list[list[Span]]
    largest: np.ndarray
    unresolved: list[int]
    """Pieces whose correction changes too fast to keep the tolerance."""


class _Samples(NamedTuple):
    """Samples of pieces, one piece after another."""

    first: np.ndarray
    """Index (pieces + 1,) of the first sample of every piece."""
    wanted: np.ndarray
    correction: np.ndarray


def sample_count(piece: Piece, options: NcOptions) -> int:
    """Number of intervals between samples, even for a piece that is corrected on its way."""
    if not piece.whole:
        return 0
    least = 2 if piece.arc is None else 4
    return max(least, 2 * math.ceil(0.5 * piece.length * _PER_PERIOD / options.shortest_period_mm))


def split(pieces: list[Piece], displacement: Displacement, options: NcOptions) -> Splitting:
    """Bisect pieces until every span keeps its part of the tolerance.

    A piece in which a span of two intervals does not is sampled four times as densely.
    """
    counts = np.array([sample_count(piece, options) for piece in pieces], dtype=np.int64)
    spans: list[list[Span]] = [[] for _ in pieces]
    largest = np.zeros(len(pieces))
    unresolved: list[int] = []
    groups = _groups(np.arange(len(pieces)), counts)
    sampled = np.zeros(len(pieces), np.int64)
    while groups:
        todo = groups.pop()
        part = [pieces[i] for i in todo]
        samples = _sampled(part, counts[todo], displacement, options)
        size = np.linalg.norm(samples.correction, axis=1)
        largest[todo] = np.maximum.reduceat(size, samples.first[:-1])
        fine = sampled[todo] == _TIMES
        failed = _bisect(part, samples, todo, spans, fine, options)
        unresolved += [int(todo[i]) for i in np.flatnonzero(failed & fine)]
        todo = todo[failed & ~fine]
        for i in todo:
            spans[i] = []
        counts[todo] *= 4
        sampled[todo] += 1
        groups += _groups(todo, counts)
    return Splitting(spans, largest, unresolved)


def _groups(pieces: np.ndarray, counts: np.ndarray) -> list[np.ndarray]:
    """Pieces in groups of a bounded number of samples."""
    if not len(pieces):
        return []
    group = np.cumsum(counts[pieces] + 1) // _AT_ONCE
    return np.split(pieces, np.flatnonzero(np.diff(group)) + 1)


def _sampled(
    pieces: list[Piece], counts: np.ndarray, displacement: Displacement, options: NcOptions
) -> _Samples:
    sizes = counts + 1
    first = np.concatenate([[0], np.cumsum(sizes)])
    owner = np.repeat(np.arange(len(pieces)), sizes)
    share = (np.arange(first[-1]) - first[owner]) / np.maximum(counts, 1)[owner]
    share[first[:-1][counts == 0]] = 1.0
    start, end = (np.array([getattr(p, k) for p in pieces]) for k in ("start", "end"))
    wanted = start[owner] + share[:, None] * (end - start)[owner]
    _on_arcs(pieces, owner, share, wanted)
    wanted[first[1:] - 1] = end
    directions = np.array([p.directions for p in pieces])
    tools = np.array([p.tool_length for p in pieces])
    # Most pieces begin where the one before ends: the correction there is computed once.
    again = (wanted[first[1:-1]] == end[:-1]).all(axis=1) & (tools[1:] == tools[:-1])
    again &= (directions[1:] == directions[:-1]).all(axis=1)
    new = np.ones(len(owner), bool)
    new[first[1:-1][again]] = False
    at = owner[new]
    given = tools[at] if options.tool_lengths_mm is not None else None
    found = 1e3 * corrections(displacement, Points(1e-3 * wanted[new], directions[at], given))
    return _Samples(first, wanted, found[np.cumsum(new) - 1])


def _on_arcs(pieces: list[Piece], owner: np.ndarray, share: np.ndarray, wanted: np.ndarray) -> None:
    """Put the samples of arcs onto them; those at the ends stay where the program has them."""
    which = np.array([p.arc is not None for p in pieces])
    if not which.any():
        return
    rows = np.flatnonzero(which[owner] & (share > 0.0) & (share < 1.0))
    index = np.cumsum(which) - 1
    arcs = [p.arc for p in pieces if p.arc is not None]
    numbers = np.array([(*a.centre, *a.radius, a.angle, a.turn, *a.height) for a in arcs])
    cu, cv, r0, r1, angle, turn, w0, w1 = numbers[index[owner[rows]]].T
    f = share[rows]
    radius, a = r0 + f * (r1 - r0), angle + f * turn
    in_plane = (cu + radius * np.cos(a), cv + radius * np.sin(a), w0 + f * (w1 - w0))
    plane = np.array([a.plane for a in arcs])[index[owner[rows]]]
    for name, axes in AXES.items():
        of = plane == name
        for axis, values in zip(axes, in_plane, strict=True):
            wanted[rows[of], axis] = values[of]


def _bisect(
    pieces: list[Piece],
    samples: _Samples,
    names: np.ndarray,
    spans: list[list[Span]],
    fine: np.ndarray,
    options: NcOptions,
) -> np.ndarray:
    """Fill in the spans; which pieces (n,) need denser samples."""
    tolerance = 1e-3 * options.tolerance_um * CHORD_SHARE
    flat = 0.5 * min(options.resolution_mm, 25.4 * options.resolution_inch)
    owner = np.arange(len(pieces))
    low, high = samples.first[:-1].copy(), samples.first[1:] - 1
    corrected = samples.wanted + samples.correction
    plane = np.array([0 if p.arc is None else p.arc.plane for p in pieces])
    turn = np.array([0.0 if p.arc is None else p.arc.turn for p in pieces])
    failed = np.zeros(len(pieces), bool)
    accepted: list[tuple[np.ndarray, ...]] = []
    while len(owner):
        deviation, straight = _deviation(corrected, low, high, plane[owner], turn[owner], flat)
        ok = deviation <= tolerance
        short = high - low <= 2
        failed[owner[~ok & short]] = True
        done = ok | (short & fine[owner])
        accepted.append((owner[done], low[done], high[done], straight[done]))
        owner, low, high = owner[~done & ~short], low[~done & ~short], high[~done & ~short]
        middle = low + 2 * ((high - low + 2) // 4)
        owner = np.concatenate([owner, owner])
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    columns = [np.concatenate(c) for c in zip(*accepted, strict=True)]
    order = np.lexsort((columns[1], columns[0]))
    of, a, b, straight = (c[order] for c in columns)
    counts = np.diff(samples.first) - 1
    share = np.where(counts[of] > 0, (b - a) / np.maximum(counts[of], 1), 1.0)
    ends = (corrected[a], corrected[(a + b) // 2], corrected[b])
    found = (*ends, share, straight)
    for name, *span in zip(names[of].tolist(), *(c.tolist() for c in found), strict=True):
        spans[name].append(Span(*span))
    return failed


def _deviation(
    corrected: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    plane: np.ndarray,
    turn: np.ndarray,
    flat: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Bound (n,), mm, of the deviation of every span, and whether it is driven as a straight line.

    An arc whose middle is within `flat` of its chord is.
    """
    sizes = high - low + 1
    first = np.concatenate([[0], np.cumsum(sizes)])
    span = np.repeat(np.arange(len(low)), sizes)
    row = np.arange(first[-1]) - first[span] + low[span]
    share = (row - low[span]) / np.maximum(high - low, 1)[span]
    driven = corrected[low][span] + share[:, None] * (corrected[high] - corrected[low])[span]
    bent = np.zeros(len(plane))
    sagitta = corrected[(low + high) // 2] - 0.5 * (corrected[low] + corrected[high])
    for name, (_, _, w) in AXES.items():
        sagitta[plane == name, w] = 0.0
    straight = (plane == 0) | (np.linalg.norm(sagitta, axis=1) < flat)
    if not straight.all():
        circles = np.where(straight, 0, plane)
        _on_circles(corrected, low, high, circles, turn, span, share, driven)
    error = corrected[row] - driven
    found = np.maximum.reduceat(np.linalg.norm(error, axis=1), first[:-1])
    inner = np.flatnonzero((share[1:-1] > 0.0) & (share[1:-1] < 1.0)) + 1
    if len(inner):
        bend = np.zeros(len(error))
        second = error[inner + 1] - 2.0 * error[inner] + error[inner - 1]
        bend[inner] = np.linalg.norm(second, axis=1)
        bent = np.maximum.reduceat(bend, first[:-1])
    return found + 0.125 * _CURVATURE * bent, straight


def _on_circles(
    corrected: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    plane: np.ndarray,
    turn: np.ndarray,
    span: np.ndarray,
    share: np.ndarray,
    driven: np.ndarray,
) -> None:
    """Replace straight lines by the circles through start, middle and end, with linear height."""
    middle = (low + high) // 2
    for name, (u, v, _) in AXES.items():
        of = plane == name
        if not of.any():
            continue
        a, b, c = (corrected[k[of]][:, (u, v)] for k in (low, middle, high))
        with np.errstate(divide="ignore", invalid="ignore"):
            to = np.stack(centre_through(a.T, b.T, c.T), 1)  # type: ignore[type-var]
        centre, radius = a + to, np.hypot(*to.T)
        begin = np.arctan2(*(a - centre).T[::-1])
        end = np.arctan2(*(c - centre).T[::-1])
        way = np.sign(turn[of])
        angle = way * np.mod(way * (end - begin), 2 * np.pi)
        index = np.cumsum(of) - 1
        rows = np.flatnonzero(of[span])
        k = index[span[rows]]
        phi = begin[k] + share[rows] * angle[k]
        driven[rows, u] = centre[k, 0] + radius[k] * np.cos(phi)
        driven[rows, v] = centre[k, 1] + radius[k] * np.sin(phi)
