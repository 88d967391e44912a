"""Calibration curves: a polynomial through points with uncertainty, and its use in both directions.

    y = f(x) = sum_j c_j x^j

is fitted by least squares (ISO/TS 28037 for the straight line):

    ordinary        no uncertainties: the scatter about the curve is estimated
    weighted        u(y_i)                                                    (clause 6)
    generalised     the covariance matrix of the y_i                          (clause 9)
    errors in both  u(x_i) and u(y_i), or covariance matrices of all          (clauses 7, 8, 10)

The last one has the true x_i among its unknowns and is found by iteration; its covariance is that
of the linearised problem at the minimum, as in the standard.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float
from scipy.linalg import solve_triangular as solve_lower
from scipy.special import chdtrc

from ..distributions import MultivariateNormal, MultivariateT
from ..numerics.arrays import Array
from ..numerics.least_squares import Status, covariance, least_squares
from ..numerics.spatial import require_float64
from .budget import coverage_factor
from .curve_points import (
    checked_points,
    covariance_matrix,
    lower_root,
    standard_uncertainties,
    values_with_u,
)
from .intervals import check_coverage

_POINTS, _TERMS = 8, 4
"""Points and coefficients for which an iterated fit is compiled at least."""

_SAME, _FLAT = 1e-6, 1e-6
"""Distance of roots that are one, of half the range; slope that is none, of the coefficients."""

Method = Literal["ordinary", "weighted", "generalised", "errors in both"]


@dataclass(frozen=True)
class Prediction:
    """Values of a calibration curve, or of its inverse, with their uncertainties."""

    value: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"] = field(repr=False)
    """Covariance of the values, which share the curve."""
    dof: Float[np.ndarray, " n"]
    """Effective degrees of freedom (Welch and Satterthwaite)."""
    coverage: float
    """Coverage probability of `U`."""
    extrapolated: np.ndarray
    """Whether x lies outside of the range of the calibration points (n,)."""

    @property
    def u(self) -> Float[np.ndarray, " n"]:
        """Standard uncertainties."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def k(self) -> Float[np.ndarray, " n"]:
        """Coverage factors."""
        return coverage_factor(self.dof, self.coverage)

    @property
    def U(self) -> Float[np.ndarray, " n"]:
        """Expanded uncertainties k u."""
        return self.k * self.u


@dataclass(frozen=True)
class CalibrationCurve:
    """A polynomial fitted by `calibration_curve`."""

    method: Method
    coefficients: Float[np.ndarray, " p"]
    """c_0, c_1, ...: intercept, slope and so on."""
    covariance: Float[np.ndarray, "p p"]
    """Covariance of the coefficients."""
    dof: float
    """Degrees of freedom of the covariance: infinite where the uncertainties are known."""
    chi_squared: float
    """Minimum of the weighted sum of squares; of the plain one for an ordinary fit."""
    chi_dof: int
    """Number of points less number of coefficients."""
    scatter: float | None
    """Estimated factor of the uncertainties of the points, sqrt(chi_squared / chi_dof); for an
    ordinary fit the standard deviation of a reading. None where they are known.
    """
    low: float
    """Smallest x of the points."""
    high: float
    residual: Float[np.ndarray, " n"] = field(repr=False)
    """y_i - f(x_i) at the x as they were stated."""
    _centred: Float[np.ndarray, " p"] = field(repr=False)
    """Coefficients in powers of t = (x - middle) / half, in which large x keep their digits."""
    _centred_covariance: Float[np.ndarray, "p p"] = field(repr=False)

    @property
    def u(self) -> Float[np.ndarray, " p"]:
        """Standard uncertainties of the coefficients."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def p_value(self) -> float:
        """Probability of a chi-squared at least as large where curve and uncertainties are right.

        Raises `ValueError` where the scatter was estimated, as there is nothing to compare with,
        and for as many coefficients as points.
        """
        if self.scatter is not None:
            raise ValueError(
                "the scatter about the curve was estimated, so that chi-squared says nothing; "
                "state the uncertainties of the points for a test"
            )
        if not self.chi_dof:
            raise ValueError("found as many coefficients as points, expected more points to test")
        return float(chdtrc(self.chi_dof, self.chi_squared))

    def consistent(self, significance: float = 0.05) -> bool:
        """Whether the points agree with the curve within their uncertainties (ISO/TS 28037, 6.3).

        Chi-squared does not exceed its quantile at 1 - `significance`. Raises as `p_value` does.
        """
        check_coverage(1.0 - significance)
        return self.p_value >= significance

    @property
    def distribution(self) -> MultivariateNormal | MultivariateT:
        """Joint distribution of the coefficients, an input of an evaluation of uncertainty."""
        if math.isinf(self.dof):
            return MultivariateNormal(self.coefficients, self.covariance)
        return MultivariateT(self.coefficients, self.covariance, self.dof)

    def predict(
        self,
        x: Any,
        u_x: Any = 0.0,
        *,
        reading: float | Literal["scatter"] | None = None,
        coverage: float = 0.95,
    ) -> Prediction:
        """f(x) of one or more x (n,) with standard uncertainties `u_x` (ISO/TS 28037, 11.2).

            u^2 = g V g' + (f'(x) u_x)^2,   g = df/dc

        This is the curve itself. `reading` adds the standard uncertainty of a reading to come:
        a number, or ``"scatter"``, the estimated standard deviation of an ordinary fit. Raises
        `ValueError` for values that are not finite or do not match, and for a scatter that was not
        estimated.
        """
        check_coverage(coverage)
        at, own = values_with_u("x", x, u_x)
        rows, slope = self._rows(at)
        curve = rows @ self._centred_covariance @ rows.T
        single = self._single(reading)
        parts = [(np.diag(curve), self.dof), ((slope * own) ** 2, math.inf)]
        extra = (slope * own) ** 2 + single**2
        if reading == "scatter":  # from the same residuals as the curve
            parts[0] = (parts[0][0] + single**2, self.dof)
        else:
            parts.append((np.full(len(at), single**2), math.inf))
        dof = _welch_satterthwaite(parts)
        return Prediction(
            rows @ self._centred, curve + np.diag(extra), dof, coverage, self._outside(at)
        )

    def inverse(
        self,
        y: Any,
        u_y: Any = None,
        *,
        dof_y: float = math.inf,
        readings: int = 1,
        near: float | None = None,
        coverage: float = 0.95,
    ) -> Prediction:
        """x from one or more y (n,) with standard uncertainties `u_y` (ISO/TS 28037, 11.1).

            u^2(x) = (u^2(y) + g V g') / f'(x)^2

        `dof_y` are the degrees of freedom of `u_y`. Without `u_y`, y is a mean of `readings` that
        scatter about the curve as the points of an ordinary fit did. A polynomial that takes the
        value more than once within the range of the points needs `near`, next to which x is taken;
        outside of the range the nearest x is taken, and marked.

        Raises `ValueError` for a y that the curve does not take, or takes several times without
        `near`; where the curve has no slope; and without `u_y` where the scatter is unknown.
        """
        check_coverage(coverage)
        shared = u_y is None
        if shared and readings < 1:
            raise ValueError(f"readings: found {readings}, expected at least 1")
        single = self._single("scatter") / math.sqrt(readings) if shared else u_y
        values, own = values_with_u("y", y, single)
        at = np.array([self._root(float(value), near) for value in values])
        rows, slope = self._rows(at)
        half = self._middle_half[1]
        flat = np.flatnonzero(np.abs(slope) * half <= _FLAT * np.abs(self._centred).max())
        if len(flat):
            raise ValueError(
                f"y: found {values[flat[0]]} where the curve has no slope, at x = {at[flat[0]]}; x "
                "cannot be determined there"
            )
        curve = rows @ self._centred_covariance @ rows.T
        parts = [(np.diag(curve), self.dof), (own**2, dof_y)]
        if shared:
            parts = [(np.diag(curve) + own**2, self.dof)]
        total = (curve + np.diag(own**2)) / np.outer(slope, slope)
        return Prediction(at, total, _welch_satterthwaite(parts), coverage, self._outside(at))

    @property
    def _middle_half(self) -> tuple[float, float]:
        return 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)

    def _rows(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Powers of t (n, p) at these x, and f'(x)."""
        middle, half = self._middle_half
        t = (x - middle) / half
        slope = np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyder(self._centred))
        return np.vander(t, len(self._centred), increasing=True), slope / half

    def _outside(self, x: np.ndarray) -> np.ndarray:
        return (x < self.low) | (x > self.high)

    def _single(self, reading: float | Literal["scatter"] | None) -> float:
        """Standard uncertainty of a single reading."""
        if reading != "scatter":
            return 0.0 if reading is None else float(reading)
        if self.method != "ordinary" or self.scatter is None:
            raise ValueError(
                f"the scatter of a single reading is not known from a {self.method} fit; state its "
                "standard uncertainty"
            )
        return self.scatter

    def _root(self, y: float, near: float | None) -> float:
        middle, half = self._middle_half
        shifted = self._centred.copy()
        shifted[0] -= y
        size = np.abs(self._centred).max()
        roots = np.polynomial.polynomial.polyroots(np.trim_zeros(shifted, "b"))
        real = roots.real[np.abs(roots.imag) <= 1e-7 * (1.0 + np.abs(roots.real))]
        real = np.array([_polished(shifted, t, size) for t in real])
        if not len(real):
            raise ValueError(
                f"y: found {y}, which the curve does not take for any x; check the value"
            )
        x = middle + half * real
        if near is not None:
            return float(x[np.argmin(np.abs(x - near))])
        inside = x[np.abs(real) <= 1.0 + 1e-12]
        if len(inside) > 1 and np.ptp(inside) > _SAME * half:
            raise ValueError(
                f"y: found {y}, which the curve takes at x = "
                f"{' and '.join(f'{v:.6g}' for v in np.sort(inside))}; state near which x it is"
            )
        return float(inside[0] if len(inside) else x[np.argmin(np.abs(real))])


def calibration_curve(
    x: Any,
    y: Any,
    degree: int = 1,
    *,
    u_y: Any = None,
    u_x: Any = None,
    covariance_y: Any = None,
    covariance_x: Any = None,
    covariance_xy: Any = None,
    known: bool = True,
) -> CalibrationCurve:
    """Fit a polynomial of `degree` to points x (n,), y (n,) by least squares (ISO/TS 28037).

    `u_y` and `u_x` are standard uncertainties, a number or (n,); `covariance_y`, `covariance_x`
    (n, n) take their place where values are correlated, and `covariance_xy` (n, n) holds
    cov(x_i, y_j). What is given decides on the method, see the module. With `known` false the
    uncertainties are known up to a common factor, which is estimated (ISO/TS 28037, annex E); the
    degrees of freedom are then those of the residuals, and the coefficients are a multivariate t.

    Raises `ValueError` for points that are not finite or do not match, fewer different x than
    coefficients, too few points to estimate a scatter, uncertainties that are not above zero, a
    covariance matrix that is not one or singular, uncertainties of x without those of y, and where
    the iteration does not converge.
    """
    require_float64()
    x, y = checked_points(x, y, degree)
    low, high = float(x.min()), float(x.max())
    half = 0.5 * (high - low)
    t = (x - 0.5 * (low + high)) / half
    n, p = len(x), degree + 1
    noise = _noise(n, u_y, u_x, covariance_y, covariance_x, covariance_xy)
    estimated = noise.method == "ordinary" or not known
    if estimated and n <= p:
        raise ValueError(
            f"found {n} points for {p} coefficients, which leaves none to estimate the scatter; "
            "take more points, or state their uncertainties"
        )
    basis = np.vander(t, p, increasing=True)
    centred, spread, chi = _linear(basis, y, noise.y)
    if noise.method == "errors in both":
        centred, spread, chi = _iterated(t, y, centred, noise.in_units(half))
    scatter = math.sqrt(chi / (n - p)) if estimated else None
    if scatter is not None:
        spread = spread * scatter**2
    powers = _to_powers(p, 0.5 * (low + high), half)
    return CalibrationCurve(
        method=noise.method,
        coefficients=powers @ centred,
        covariance=powers @ spread @ powers.T,
        dof=math.inf if scatter is None else float(n - p),
        chi_squared=chi,
        chi_dof=n - p,
        scatter=scatter,
        low=low,
        high=high,
        residual=y - basis @ centred,
        _centred=centred,
        _centred_covariance=spread,
    )


@dataclass(frozen=True)
class _Noise:
    """What is known of the points: standard uncertainties (n,), or covariance matrices."""

    method: Method
    y: np.ndarray
    """u(y) (n,), or cov(y) (n, n)."""
    x: np.ndarray | None = None
    joint: np.ndarray | None = None
    """Covariance (2n, 2n) of all x and y, where any are correlated."""

    def in_units(self, half: float) -> "_Noise":
        """The same for x in units of `half`."""
        x = None if self.x is None else self.x / half
        joint = self.joint
        if joint is not None:
            scale = np.ones(len(joint))
            scale[: len(joint) // 2] /= half
            joint = joint * np.outer(scale, scale)
        return _Noise(self.method, self.y, x, joint)


def _noise(
    n: int, u_y: Any, u_x: Any, covariance_y: Any, covariance_x: Any, covariance_xy: Any
) -> _Noise:
    for name, u, matrix in (("y", u_y, covariance_y), ("x", u_x, covariance_x)):
        if u is not None and matrix is not None:
            raise ValueError(f"found u_{name} and covariance_{name}, expected one of the two")
    y = (
        standard_uncertainties("u_y", u_y, n)
        if u_y is not None
        else covariance_matrix("covariance_y", covariance_y, n)
    )
    x = standard_uncertainties("u_x", u_x, n, zero=True) if u_x is not None else None
    x = covariance_matrix("covariance_x", covariance_x, n) if covariance_x is not None else x
    if x is None and covariance_xy is None:
        if y is None:
            return _Noise("ordinary", np.ones(n))
        return _Noise("weighted" if y.ndim == 1 else "generalised", y)
    if y is None or x is None:
        raise ValueError(
            "found uncertainties of x alone, expected those of y too"
            if y is None
            else "found covariance_xy without uncertainties of x, expected u_x or covariance_x"
        )
    if x.ndim == y.ndim == 1 and covariance_xy is None:
        if not x.any():
            return _Noise("weighted", y)
        return _Noise("errors in both", y, x)
    blocks = [np.diag(part**2) if part.ndim == 1 else part for part in (x, y)]
    between = np.zeros((n, n))
    if covariance_xy is not None:
        between = np.asarray(covariance_xy, float)
        if between.shape != (n, n):
            raise ValueError(f"covariance_xy: found shape {between.shape}, expected {(n, n)}")
    joint = np.block([[blocks[0], between], [between.T, blocks[1]]])
    lower_root("covariance of x and y", joint)
    return _Noise("errors in both", y, joint=joint)


def _linear(
    basis: np.ndarray, y: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Coefficients, their covariance and chi-squared of a fit that is linear in them."""
    if noise.ndim == 1:
        white = np.column_stack([basis, y]) / noise[:, None]
    else:
        root = lower_root("covariance_y", noise)
        white = solve_lower(root, np.column_stack([basis, y]), lower=True)
    q, r = np.linalg.qr(white[:, :-1])
    inverse = np.linalg.inv(r)
    found = inverse @ (q.T @ white[:, -1])
    residual = white[:, -1] - white[:, :-1] @ found
    return found, inverse @ inverse.T, float(residual @ residual)


def _iterated(
    t: np.ndarray, y: np.ndarray, start: np.ndarray, noise: _Noise
) -> tuple[np.ndarray, np.ndarray, float]:
    """The same with the true t among the unknowns."""
    n, p = len(t), len(start)
    joint = noise.joint
    exact = np.zeros(n, bool)
    if joint is None:
        x = np.zeros(n) if noise.x is None else noise.x
        exact = x == 0.0
        joint = np.diag(np.concatenate([np.where(exact, 1.0, x), noise.y]) ** 2)
    # Unused points up to the next power of two, and unused coefficients: one compiled program
    # serves many numbers of points and of coefficients.
    size, terms = max(_POINTS, 1 << (n - 1).bit_length()), max(_TERMS, p)
    at = np.concatenate([np.arange(n), size + np.arange(n)])
    root = np.eye(2 * size)
    root[np.ix_(at, at)] = lower_root("covariance of x and y", joint)
    padded = {name: np.zeros(size) for name in ("t", "y", "exact", "used")}
    padded["exact"][n:] = 1.0
    for name, values in (("t", t), ("y", y), ("exact", exact), ("used", 1.0)):
        padded[name][:n] = values
    padded |= {"root": root, "fitted": (np.arange(terms) < p).astype(float)}
    first = np.concatenate([start, np.zeros(terms - p), padded["t"]])
    data = jax.tree.map(jnp.asarray, padded)
    found = least_squares(_whitened, jnp.asarray(first), data, noise=1.0)
    if not bool(found.converged):
        raise ValueError(
            "the curve with uncertainties in x and y was not found: "
            f"{Status(int(found.status)).prose}; check the points and their uncertainties"
        )
    spread = np.asarray(covariance(found, scaled=False))[:p, :p]
    return np.asarray(found.value)[:p], spread, float(found.cost)


def _whitened(theta: Array, data: dict[str, Array]) -> Array:
    """Residuals of x and y, whitened. Unknowns: the coefficients, and the true t of every point.

    An unknown that is not used stays where it is: that of a point with an exact x, of an unused
    point, or of an unused coefficient.
    """
    coefficients, true = jnp.split(theta, [len(data["fitted"])])
    powers = data["fitted"] * coefficients
    at = jnp.where(data["exact"] > 0.0, data["t"], true)
    of_y = data["used"] * (data["y"] - jnp.polyval(powers[::-1], at))
    white = solve_triangular(data["root"], jnp.concatenate([data["t"] - true, of_y]), lower=True)
    return jnp.concatenate([white, (1.0 - data["fitted"]) * coefficients])


def _to_powers(p: int, middle: float, half: float) -> Float[np.ndarray, "p p"]:
    """Matrix from coefficients in powers of (x - middle) / half to those in powers of x."""
    found = np.zeros((p, p))
    for j in range(p):
        found[: j + 1, j] = np.polynomial.polynomial.polypow([-middle / half, 1.0 / half], j)
    return found


def _polished(coefficients: np.ndarray, t: float, size: float) -> float:
    """A root after Newton steps, which restore the digits that eigenvalues lose."""
    slope = np.polynomial.polynomial.polyder(coefficients)
    for _ in range(3):
        d = np.polynomial.polynomial.polyval(t, slope)
        if abs(d) <= 1e-12 * size:
            break
        t = float(t - np.polynomial.polynomial.polyval(t, coefficients) / d)
    return t


def _welch_satterthwaite(parts: list[tuple[np.ndarray, float]]) -> Float[np.ndarray, " n"]:
    total = np.sum([v for v, _ in parts], axis=0)
    scatter = np.sum([v**2 / nu for v, nu in parts], axis=0)
    return np.divide(total**2, scatter, out=np.full_like(total, np.inf), where=scatter > 0.0)
