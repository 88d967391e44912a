"""Vibration: an oscillation at one frequency in every run, whatever the feed rate of its circle."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincc

from ...identification.fit import Fit
from ...machine.plan import of_set
from ..screening.significance import SILENT

_CHANCE = 1e-3
"""Probability by chance, over all frequencies and readings, below which a vibration is reported."""
_A_PART = 0.1
"""Least share of the variance of a reading that it must describe."""
_EVERYWHERE = 0.3
"""Least fraction of that share in the runs of every feed rate. An error that belongs to the circle
has a different frequency at each."""
_AT_ONCE = 1_000_000
"""Most products of frequencies and readings that are evaluated together."""
_FINE = 4.0
"""Frequencies that are tried within the width of a peak, which is the inverse of the longest run.
"""


@dataclass(frozen=True)
class Vibration:
    """An oscillation of one reading at a fixed frequency."""

    reading: str
    hz: float
    amplitude_um: float
    """Median over the runs."""
    share: float
    """Share of the residual variance of this reading."""
    p_value: float
    data_set: str = ""
    """Its data set, where there are several."""

    @property
    def words(self) -> str:
        """The vibration in words, within a sentence."""
        where = f"{self.reading} of {self.data_set}" if self.data_set else self.reading
        return (
            f"a vibration of {self.hz:.3g} Hz in every run, of {self.amplitude_um:.2g} um in "
            f"{where}, describes {100.0 * self.share:.0f} % of its scatter"
        )


def vibration(fit: Fit) -> Vibration | None:
    """The strongest vibration in the residual; None where there is none beyond chance.

    None also where all runs have one feed rate, because a frequency in time is then one on the
    circle. Several data sets are evaluated separately, since each has its own runs and times; the
    p-value covers all of them.

    Least-squares periodograms (Lomb 1976, Astrophys. Space Sci. 39, 447-462) of all runs, each with
    its own phase, are summed. The sum of squares that cosine and sine explain, in units of the
    remaining variance, is chi-square distributed with two degrees of freedom per run.
    """
    plan = fit.measurement.plan
    timed = [s for s in plan.sets or ("",) if plan.has(_own(s, "run"), _own(s, "t_run"))]
    found = [one for s in timed if (one := _in_set(fit, s, len(timed))) is not None]
    return max(found, key=lambda one: one.share, default=None)


def _own(data_set: str, name: str) -> str:
    """The name of a covariate or group in one data set of several, or in the only one."""
    return of_set(data_set, name) if data_set else name


def _in_set(fit: Fit, data_set: str, sets: int) -> Vibration | None:
    """The strongest vibration in one of the `sets` data sets."""
    plan, instrument = fit.measurement.plan, fit.model.instrument
    used = fit.used & plan.parts[data_set]
    readings = instrument.members.get(data_set, instrument).readings
    t, run = (plan.values(_own(data_set, name)) for name in ("t_run", "run"))
    rows = [np.flatnonzero((run == number) & used) for number in np.unique(run[used])]
    rows = [mine[np.argsort(t[mine])] for mine in rows if len(mine) > _FINE]
    length = np.array([np.ptp(t[mine]) for mine in rows])
    # Runs whose durations agree within a few per cent have the same feed rate.
    pace = np.unique(np.round(np.log(length) / 0.05), return_inverse=True)[1] if rows else []
    if len(np.unique(pace)) < 2:
        return None
    finest = min(float(np.median(np.diff(t[mine]))) for mine in rows)
    step = 1.0 / (_FINE * length.max())
    hz = np.arange(1.0 / length.min(), 0.5 / finest, step)
    if not len(hz):
        return None
    # Columns that belong to readings of other instruments are zero.
    left = fit.residual[:, : len(readings)]
    unit = math.sqrt(float((left[used] ** 2).mean())) or 1.0
    residual = left / unit
    scatter = np.array([((residual[m] - residual[m].mean(0)) ** 2).sum(0) for m in rows])
    silent = scatter.sum(0) <= SILENT

    def taken(hz: np.ndarray) -> np.ndarray:
        """Sum of squares by runs, frequencies and readings; the frequencies are split to limit
        memory.
        """
        parts = np.array_split(hz, -(-len(hz) * max(map(len, rows)) // _AT_ONCE))
        return np.array(
            [np.concatenate([_taken(t[m], residual[m], part) for part in parts]) for m in rows]
        )

    whole = np.where(silent, np.inf, scatter.sum(0))
    at, reading = np.unravel_index(int(np.argmax(taken(hz).sum(0) / whole)), (len(hz), len(whole)))
    near = hz[at] + step * np.linspace(-1.0, 1.0, 81)
    by_run = taken(near)[:, :, reading]
    best = by_run[:, k := int(np.argmax(by_run.sum(0)))]
    own, part = best / scatter[:, reading], float(best.sum() / whole[reading])
    dof = sum(map(len, rows)) - 3.0 * len(rows)
    statistic = part * dof / max(1.0 - part, SILENT)
    trials = sets * len(hz) / _FINE * len(whole)
    p_value = min(1.0, trials * float(gammaincc(len(rows), statistic / 2)))
    everywhere = min(float(np.median(own[pace == k])) for k in np.unique(pace))
    if p_value > _CHANCE or part < _A_PART or everywhere < _EVERYWHERE * part:
        return None
    count = np.array([len(mine) for mine in rows])
    size = unit * float(np.median(np.sqrt(2.0 * best / count)))
    name = readings[int(reading)]
    return Vibration(name, float(near[k]), 1e6 * size, part, p_value, data_set)


def _taken(t: np.ndarray, left: np.ndarray, hz: np.ndarray) -> np.ndarray:
    """Sum of squares (f, m) that cosine and sine of every frequency explain of readings (n, m),
    with their mean removed.
    """
    y = left - left.mean(0)
    turn = 2.0 * np.pi * hz[:, None] * (t - t.mean())
    cosine, sine = np.cos(turn), np.sin(turn)
    cosine, sine = (wave - wave.mean(1, keepdims=True) for wave in (cosine, sine))
    cc, ss, cs = ((a * b).sum(1) for a, b in ((cosine, cosine), (sine, sine), (cosine, sine)))
    cy, sy = cosine @ y, sine @ y
    determinant = np.maximum(cc * ss - cs**2, 1e-12 * len(t) ** 2)[:, None]
    return (ss[:, None] * cy**2 - 2 * cs[:, None] * cy * sy + cc[:, None] * sy**2) / determinant
