"""Derivatives from values of a function alone, with an estimate of their error.

Differences over a sequence of steps h, h/2, h/4 ... are extrapolated to h = 0 (Richardson 1911).
The entry of the tableau with the least estimated error is taken (Ridders 1982, Advances in
Engineering Software 4, 75). The first step is of the size of the uncertainty of the input, so that
noise of the function does little harm; smaller ones follow until the error is small.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

Batch = Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, "n m"]]
"""Points -> values of m outputs at each."""

_STEPS, _SECOND_STEPS = 8, 6
_ROUNDS = 4
"""Sequences of _STEPS steps at most, each from the last step of the one before."""
_ENOUGH = 1e-7
"""Estimated error of a derivative, as a share of it, at which no further sequence follows."""
_COMPARED = 3
"""Entries of a tableau that are compared for the estimated error."""
_GROWTH = 3.0
"""Growth of a difference over the sequence from which it has no limit, together with _VAGUE."""
_VAGUE = 0.1
"""Share of a derivative above which its estimated error says that it has no limit."""
_JUMP = 10.0
"""Jump of a derivative in units of its estimated error from which it is one."""
_NOISE = 1e-6
"""Share of a derivative below which a jump is none."""


@dataclass(frozen=True)
class First:
    """First derivatives (m, k) of m outputs; NaN where there is none."""

    derivative: Float[np.ndarray, "m k"]
    error: Float[np.ndarray, "m k"]
    """Estimated error; where the derivatives of both sides differ, half of their difference."""
    kink: Bool[np.ndarray, "m k"]
    """Where the derivatives of both sides differ; the derivative is their mean."""


@dataclass(frozen=True)
class Second:
    """Derivatives with respect to r directions; NaN where there is none (`vcal.uncertainty.taylor`
    for the shapes).
    """

    a: Float[np.ndarray, "m r"]
    H: Float[np.ndarray, "m r r"]
    T: Float[np.ndarray, "m r"]
    t: Float[np.ndarray, "m r"]
    errors: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def extrapolated(
    values: Float[np.ndarray, "n ..."], order: int = 2
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Limits of differences over steps h, h/2, h/4 ..., element by element, and their errors.

    `order` is the first power of h in the error of a difference, and the step between its powers.
    The limit is NaN, and the error infinite, where no two neighbours of the tableau are finite.
    """
    column, entries, doubts = np.asarray(values, float), [], []
    with np.errstate(invalid="ignore", over="ignore"):
        for power in range(1, len(values)):
            factor = 2.0 ** (order * power)
            better = (factor * column[1:] - column[:-1]) / (factor - 1.0)
            doubt = np.maximum(np.abs(better - column[1:]), np.abs(better - column[:-1]))
            entries.append(better)
            doubts.append(np.where(np.isfinite(doubt), doubt, np.inf))
            column = better
        entry, doubt = np.concatenate(entries), np.concatenate(doubts)
        rank = np.argsort(doubt, axis=0)[:_COMPARED]
        first, least = (np.take_along_axis(one, rank, 0) for one in (entry, doubt))
        # Neighbours may agree by chance where the function is noisy: the next best entries, too.
        spread = np.where(np.isfinite(least), np.abs(first - first[0]), 0.0).max(0)
    found = np.isfinite(least[0])
    error = np.where(found, np.maximum(least[0], spread), np.inf)
    return np.where(found, first[0], np.nan), error


def first_differences(
    function: Batch,
    x: Float[np.ndarray, " k"],
    step: Float[np.ndarray, " k"],
    value: Float[np.ndarray, " m"],
) -> First:
    """First derivatives at `x`, where the function is `value`, from steps of at most `step`.

    Central differences, or those of one side where the function is not finite on the other; 16 to
    64 values of the function per input.
    """
    found = _sequence(function, x, step, value)
    for _ in range(_ROUNDS - 1):
        with np.errstate(invalid="ignore"):
            enough = found.error <= _ENOUGH * np.abs(found.derivative)
        if enough.all():
            break
        step = step * 0.5**_STEPS
        other = _sequence(function, x, step, value)
        better = other.error < found.error
        found = First(
            *(
                np.where(better, new, old)
                for new, old in (
                    (other.derivative, found.derivative),
                    (other.error, found.error),
                    (other.kink, found.kink),
                )
            )
        )
    return found


def _sequence(
    function: Batch,
    x: Float[np.ndarray, " k"],
    step: Float[np.ndarray, " k"],
    value: Float[np.ndarray, " m"],
) -> First:
    """The derivatives from one sequence of steps."""
    k, h = len(x), 0.5 ** np.arange(_STEPS)
    moves = h[:, None, None] * np.diag(step)
    points = x + np.stack([moves, -moves])
    up, down = function(points.reshape(-1, k)).reshape(2, _STEPS, k, -1)
    width = (h[:, None] * step)[:, :, None]
    with np.errstate(invalid="ignore", over="ignore"):
        central, bend = (up - down) / (2.0 * width), (up + down - 2.0 * value) / (2.0 * width)
        right, left = (up - value) / width, (value - down) / width
    best, error = _limit(central, 2)
    jump, doubt = extrapolated(bend, 1)
    with np.errstate(invalid="ignore"):
        kink = np.abs(jump) > np.maximum(_JUMP * doubt, _NOISE * (np.abs(best) + np.abs(jump)))
    error = np.where(kink, np.maximum(error, np.abs(jump)), error)
    for side in (right, left):
        other, doubt = _limit(side, 1)
        taken = ~np.isfinite(best) & np.isfinite(other)
        best, error = np.where(taken, other, best), np.where(taken, doubt, error)
    return First(best.T, error.T, (kink & np.isfinite(best)).T)


def second_differences(
    function: Batch,
    x: Float[np.ndarray, " k"],
    root: Float[np.ndarray, "k r"],
    value: Float[np.ndarray, " m"],
) -> Second:
    """The derivatives of a second-order series in the directions `root`, from steps of at most one.

    2 r^2 + 2 r values of the function per step.
    """
    r = root.shape[1]
    one = np.eye(r)
    pairs = [(i, j) for i in range(r) for j in range(i)]
    unit = [way * one[i] for i in range(r) for way in (1.0, -1.0, 2.0, -2.0)]
    unit += [p * one[i] + q * one[j] for i, j in pairs for p in (1.0, -1.0) for q in (1.0, -1.0)]
    h = 0.5 ** np.arange(_SECOND_STEPS)
    z = (h[:, None, None] * np.array(unit)).reshape(-1, r)
    f = function(x + z @ root.T).reshape(len(h), len(unit), -1) - value
    single = f[:, : 4 * r].reshape(len(h), r, 4, -1)
    plus, minus, plus2, minus2 = (single[:, :, i] for i in range(4))
    step = h[:, None, None]
    m = f.shape[-1]
    with np.errstate(invalid="ignore", over="ignore"):
        a = (plus - minus) / (2.0 * step)
        t = (plus2 - 2.0 * plus + 2.0 * minus - minus2) / (2.0 * step**3)
        H, T = np.zeros((len(h), r, r, m)), t.copy()
        H[:, range(r), range(r)] = (plus + minus) / step**2
        double = f[:, 4 * r :].reshape(len(h), len(pairs), 4, m)
        for n, (i, j) in enumerate(pairs):
            pp, pm, mp, mm = (double[:, n, s] for s in range(4))
            H[:, i, j] = H[:, j, i] = (pp - pm - mp + mm) / (4.0 * h[:, None] ** 2)
            cube = 2.0 * h[:, None] ** 3
            T[:, i] += (pp + pm - mp - mm - 2.0 * (plus[:, i] - minus[:, i])) / cube
            T[:, j] += (pp + mp - pm - mm - 2.0 * (plus[:, j] - minus[:, j])) / cube
    limits = [_limit(values, 2) for values in (a, H, T, t)]
    found, errors = ([np.moveaxis(one[i], -1, 0) for one in limits] for i in (0, 1))
    return Second(*found, errors=(errors[0], errors[1], errors[2], errors[3]))


def _limit(values: Float[np.ndarray, "n ..."], order: int) -> tuple[np.ndarray, np.ndarray]:
    """Limits, NaN where the differences grow without one."""
    best, error = extrapolated(values, order)
    with np.errstate(invalid="ignore"):
        grows = np.abs(values[-1]) > _GROWTH * np.abs(values[0])
        grows &= (np.diff(np.abs(values), axis=0) > 0.0).all(0)
        lost = grows & (error > _VAGUE * np.abs(best))
    return np.where(lost, np.nan, best), np.where(lost, np.inf, error)
