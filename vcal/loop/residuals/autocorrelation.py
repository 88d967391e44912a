"""Autocorrelation: noise that is correlated in time.

A share s of the variance of the noise persists, with the correlation phi from one row to the next;
the rest is white. The innovation of a reading, given those before it,

    e_i = y_i - phi y_(i-1) + phi (1 - s) / F_(i-1) e_(i-1),
    F_i = P_i + 1 - s,  P_i = phi^2 P_(i-1) (1 - s) / F_(i-1) + s (1 - phi^2),  P_0 = s,

has the variance F_i and is white: the Kalman filter of an ARMA(1, 1) process (Box, Jenkins, Reinsel
2008, ch. 5 and 7). The linearised fit is repeated with these innovations; phi and s maximise its
marginal likelihood over a grid.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import gammaincc

from ...identification.fit import Fit
from ...machine.plan import DATA_SET
from ..screening.significance import SILENT

_PHI = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
_SHARE = (0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 0.97, 0.99, 0.999)
_COARSE = tuple((phi, s) for phi in (0.5, 0.8, 0.95, 0.99) for s in (0.2, 0.5, 0.9, 0.99))
_SUSPICIOUS = 3.0
"""Lag-one correlation, in its standard deviations under the null hypothesis, from which the grid is
evaluated."""
_BREAKS = ("run", "pose", DATA_SET)
"""Groups between which nothing persists, of every data set."""


@dataclass(frozen=True)
class Serial:
    """Noise that is correlated in time."""

    phi: float
    """Correlation from row to row of the part that persists."""
    share: float
    """Share of the variance that persists."""
    p_value: float
    """Probability of a gain as large as this under white noise."""
    log_bayes: float
    """Gain in log evidence over white noise."""

    @property
    def length(self) -> float:
        """Correlation length: rows after which the correlation has fallen by a factor e."""
        return float(-1.0 / np.log(self.phi))


def serial(fit: Fit) -> Serial | None:
    """The correlated noise that describes the residual best; None where the lag-one correlation is
    not significant.
    """
    if not persists(fit):
        return None
    data = _Sequence.of(fit)
    white, every = data.likelihood(), np.ones(len(fit.theta), bool)
    found = [(data.likelihood(every, phi, s), phi, s) for phi in _PHI for s in _SHARE]
    best, phi, share = max(found)
    gain = best - white
    p_value = float(gammaincc(1.0, max(gain, 0.0)))
    return Serial(phi, share, p_value, float(gain - np.log(len(found))))


def persists(fit: Fit) -> bool:
    """Whether the lag-one correlation of successive readings is suspicious."""
    return _Sequence.of(fit).suspicion >= _SUSPICIOUS


def gain_beside(fit: Fit, columns: np.ndarray) -> float:
    """Gain in log evidence by the parameters `columns` (k,), where the noise may be correlated: the
    fit with them over that without, each with the noise that suits it best, white or correlated.
    """
    data = _Sequence.of(fit)
    every = np.ones(len(fit.theta), bool)
    left = every.copy()
    left[columns] = False
    best = [
        max(data.likelihood(kept, *point) for point in ((0.0, 0.0), *_COARSE))
        for kept in (every, left)
    ]
    return best[0] - best[1]


@dataclass(frozen=True)
class _Sequence:
    """The linearised fit in the order of the readings, split into pieces between which nothing
    persists.
    """

    pieces: list[slice]
    residual: np.ndarray
    """Whitened residual (n, m) of the rows that were used."""
    jacobian: np.ndarray
    """(n, m, k)."""
    theta: np.ndarray
    precision: np.ndarray
    """Prior precision (k,), with shape parameters confined to their grids."""
    proper: np.ndarray
    """Whether a parameter has a proper prior (k,), which enters the evidence."""
    counted: np.ndarray
    """Which readings are present (n, m)."""

    @classmethod
    def of(cls, fit: Fit) -> "_Sequence":
        n, m = fit.residual.shape
        plan = fit.measurement.plan
        used = np.flatnonzero(fit.used)
        broken = [
            np.asarray(index)
            for name, index in plan.groups.items()
            if name.rpartition(":")[2] in _BREAKS
        ]
        if plan.has("t"):
            used = plan.in_time(used)
        elif broken:
            # Rows of one run or pose in succession, in the order of the file.
            used = used[np.lexsort([index[used] for index in broken])]
        marks = [index[used] for index in broken]
        breaks = np.zeros(len(used) - 1, bool)
        for mark in marks:
            breaks |= np.diff(mark) != 0
        ends = [0, *(np.flatnonzero(breaks) + 1), len(used)]
        return cls(
            [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)],
            fit.whitened.reshape(n, m)[used],
            fit.jacobian.reshape(n, m, -1)[used],
            fit.theta,
            fit.within_scans,
            fit.precision > 0.0,
            fit.counted[used],
        )

    @property
    def suspicion(self) -> float:
        """Lag-one correlation over its standard deviation under white noise."""
        total, count = 0.0, 0
        for p in self.pieces:
            total += float((self.residual[p][1:] * self.residual[p][:-1]).sum())
            count += int(self.counted[p][1:].sum())
        mean = max(float((self.residual**2).sum()) / self.counted.sum(), SILENT)
        return total / count**0.5 / mean if count else 0.0

    def likelihood(
        self, kept: np.ndarray | None = None, phi: float = 0.0, share: float = 0.0
    ) -> float:
        """ln p(readings), up to a constant, with the scale of the noise that maximises it. `kept`
        (k,) are the parameters that are fitted.
        """
        kept = np.ones(len(self.theta), bool) if kept is None else kept
        # The contribution of parameters that are left out returns to the residual.
        residual = self.residual + self.jacobian[:, :, ~kept] @ self.theta[~kept]
        both = np.concatenate([residual[:, :, None], self.jacobian[:, :, kept]], axis=2)
        log_determinant = 0.0
        if share > 0.0:
            both, log_determinant = self._innovations(both, phi, share)
        flat = both.reshape(-1, both.shape[2])
        r, jacobian = flat[:, 0], flat[:, 1:]
        theta, precision = self.theta[kept], self.precision[kept]
        square, cross, own = jacobian.T @ jacobian, jacobian.T @ r, float(r @ r)
        n = int(self.counted.sum())
        scale = 1.0
        for _ in range(3):
            factor = cho_factor(square / scale + np.diag(precision))
            pull = cross / scale - precision * theta
            delta = cho_solve(factor, pull)
            rest = own - 2.0 * cross @ delta + delta @ square @ delta
            inverse = cho_solve(factor, square / scale)
            scale = max(rest, 1e-300) / max(n - np.trace(inverse), 1.0)
        factor = cho_factor(square / scale + np.diag(precision))
        delta = cho_solve(factor, cross / scale - precision * theta)
        rest = own - 2.0 * cross @ delta + delta @ square @ delta
        proper = self.proper[kept]
        return float(
            -0.5 * (rest / scale + (theta + delta) ** 2 @ precision)
            - 0.5 * (n * np.log(scale) + log_determinant)
            - np.log(np.diag(factor[0])).sum()
            + 0.5 * np.log(precision[proper]).sum()
        )

    def _innovations(self, y: np.ndarray, phi: float, share: float) -> tuple[np.ndarray, float]:
        """Innovations of the rows of `y` (n, m, k) within each piece, in standard deviations, and
        ln det of the correlation matrix of all readings.

        The recursion runs over the rows of all pieces together.
        """
        pieces = sorted(self.pieces, key=lambda piece: piece.start - piece.stop)
        start = np.array([piece.start for piece in pieces])
        length = np.array([piece.stop - piece.start for piece in pieces])
        found, log_determinant = np.empty_like(y), 0.0
        p, f, white = share, 1.0, 1.0 - share
        found[start] = e = y[start]
        for i in range(1, length[0]):
            rows = start[length > i] + i
            back = phi * white / f
            p = phi * back * p + share * (1.0 - phi**2)
            f = p + white
            e = y[rows] - phi * y[rows - 1] + back * e[: len(rows)]
            found[rows] = e / np.sqrt(f)
            log_determinant += np.log(f) * self.counted[rows].sum()
        return found, float(log_determinant)
