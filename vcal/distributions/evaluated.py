"""Distributions that an evaluation assigns: from readings (Type A) and from certificates (Type B).

Each of them is computed once, when it is constructed, and then behaves as the distribution that
JCGM 101 assigns to it: Student's t where the standard uncertainty has degrees of freedom, normal
where it is known. The GUM takes the scale of that t and its degrees of freedom, Monte Carlo draws
from the same t, so that both take the same input.
"""

import math
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.special import fdtrc, ndtri, stdtrit

from ..numerics.arrays import Array
from .base import Univariate
from .normal import Normal, StudentT
from .registry import register

Meaning = Literal["scale", "std"]
"""What a standard uncertainty with degrees of freedom is of Student's t: its scale (JCGM 100 G.3,
JCGM 101 6.4.9.7), or its standard deviation, which is larger by sqrt(nu / (nu - 2)).
"""


class Evaluated(Univariate):
    """A distribution that an evaluation assigns; subclasses are final."""

    assigned: eqx.AbstractVar[Univariate]
    """The distribution itself."""

    @property
    def mean(self) -> Float[Array, ""]:
        """The estimate."""
        return self.assigned.mean

    @property
    def std(self) -> Array:
        return self.assigned.std

    @property
    def u(self) -> float:
        """Standard uncertainty in the sense of JCGM 100: the scale of a t."""
        return float(jnp.sqrt(self.assigned.stated_covariance[0, 0]))

    @property
    def dof(self) -> Float[Array, ""]:
        """Degrees of freedom of the standard uncertainty."""
        return self.assigned.dof

    @property
    def stated_covariance(self) -> Float[Array, "1 1"]:
        return self.assigned.stated_covariance

    @property
    def tail_index(self) -> Float[Array, ""]:
        return self.assigned.tail_index

    @property
    def symmetric(self) -> bool:
        return self.assigned.symmetric

    @property
    def support(self) -> tuple[Array, Array]:
        return self.assigned.support

    @property
    def kinds(self) -> tuple[str, ...]:
        return self.assigned.kinds

    def cdf(self, x: Array) -> Array:
        return self.assigned.cdf(x)

    def log_density(self, x: Array) -> Array:
        return self.assigned.log_density(x)

    def inverse(self, p: Array, q: Array) -> Array:
        return self.assigned.inverse(p, q)

    def from_score(self, z: Array) -> Array:
        return self.assigned.from_score(z)

    def score_series(self, order: int) -> Float[Array, " order"]:
        return self.assigned.score_series(order)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        return self.assigned.sample(key, shape)


class PooledDeviation(NamedTuple):
    """A standard deviation from several sets of repeats, with its degrees of freedom."""

    s: float
    dof: float


class Anova(NamedTuple):
    """One-way analysis of variance of J groups with N readings in all (JCGM 100, H.5)."""

    between: float
    """Mean square between groups, s_a^2."""
    within: float
    """Mean square within groups, s_b^2."""
    dof_between: float
    """J - 1."""
    dof_within: float
    """N - J."""
    s_between: float
    """Standard deviation between groups, sqrt(max(0, s_a^2 - s_b^2) / n_0); n_0 is the number of
    readings of a group, (N - sum n_j^2 / N) / (J - 1) where it differs.
    """
    s_within: float
    """Standard deviation within a group, s_b."""
    F: float
    """s_a^2 / s_b^2."""
    p: float
    """Probability of an F at least as large where there is no effect between groups."""


@register
class Repeats(Evaluated):
    """Mean of n independent readings (Type A; JCGM 100, 4.2; JCGM 101, 6.4.9).

    `values` (n,). The standard uncertainty is s / sqrt(n), with s the standard deviation of the
    readings and n - 1 degrees of freedom; the distribution is a scaled and shifted t.

    `s` replaces the standard deviation of these readings by a known one with `dof` degrees of
    freedom, such as a pooled one of earlier sets (JCGM 100, 4.2.4; `pooled_deviation`); one
    reading is enough then. Raises `ValueError` for fewer than two readings without `s`, readings
    that are not finite or all equal, and an `s` or `dof` that is not above zero.
    """

    name: ClassVar[str] = "repeats"
    assigned: Univariate
    n: Float[Array, ""]
    s: Float[Array, ""]

    def __init__(self, values: Any, *, s: float | None = None, dof: float | None = None):
        x = _readings(self.name, values, 1 if s is not None else 2)
        if s is None:
            if dof is not None:
                raise ValueError(
                    f"{self.name}: found dof = {dof} without s; the degrees of freedom of the "
                    "readings' own standard deviation are n - 1, give dof with a known s only"
                )
            spread, nu = _spread(self.name, x), len(x) - 1.0
        else:
            spread, nu = _above_zero(self.name, "s", s), math.inf if dof is None else float(dof)
        self.n, self.s = jnp.asarray(float(len(x))), jnp.asarray(spread)
        self.assigned = _assigned(self.name, x.mean(), spread / math.sqrt(len(x)), nu)


@register
class Groups(Evaluated):
    """Mean of readings in groups, such as days, operators or set-ups (JCGM 100, H.5).

    `values` are J lists of readings; or `means`, `s` and `n` state the mean, standard deviation and
    number of readings of every group. The estimate is the mean of the group means. With `between`
    (the default), its standard uncertainty is the standard deviation of the group means over
    sqrt(J), with J - 1 degrees of freedom: it contains what varies between groups. Without, all
    readings are taken as one set of N: the estimate is their mean, and the standard uncertainty
    sqrt(SS / (N - 1) / N) with N - 1 degrees of freedom (H.5.2.5). `anova.p` says which applies;
    the default is also valid where there is no effect between groups.

    Raises `ValueError` for fewer than two groups, a group that is empty, no group with two
    readings, or readings that are not finite or all equal.
    """

    name: ClassVar[str] = "groups"
    assigned: Univariate
    between: bool = eqx.field(static=True)
    _table: Float[Array, "6"]

    def __init__(
        self,
        values: Any = None,
        *,
        means: Any = None,
        s: Any = None,
        n: Any = None,
        between: bool = True,
    ):
        m, deviation, count = _summaries(self.name, values, means, s, n)
        self.between = bool(between)
        groups, total = len(m), count.sum()
        grand = (count * m).sum() / total
        outer = (count * (m - grand) ** 2).sum()
        inner = ((count - 1.0) * deviation**2).sum()
        typical = (total - (count**2).sum() / total) / (groups - 1.0)
        dof = groups - 1.0, total - groups
        self._table = jnp.asarray([outer / dof[0], inner / dof[1], *dof, typical, total])
        if between:
            value, u, nu = m.mean(), m.std(ddof=1) / math.sqrt(groups), dof[0]
        else:
            value, nu = grand, total - 1.0
            u = math.sqrt((outer + inner) / nu / total)
        if not u > 0.0:
            raise ValueError(
                f"{self.name}: found means that are all {m[0]}, expected some scatter; state the "
                "resolution of the readings as a rectangular distribution instead"
            )
        self.assigned = _assigned(self.name, value, u, nu)

    @property
    def anova(self) -> Anova:
        """The analysis of variance; not inside `jit`."""
        outer, inner, a, b, typical, _ = np.asarray(self._table).tolist()
        ratio = outer / inner if inner > 0.0 else math.inf
        p = float(fdtrc(a, b, ratio))
        spread = math.sqrt(max(0.0, outer - inner) / typical)
        return Anova(outer, inner, a, b, spread, math.sqrt(inner), ratio, p)


@register
class Series(Evaluated):
    """Mean of n readings one after the other that are correlated, evenly spaced (JCGM 100, 4.2.7).

        n_eff = n / (1 + 2 sum_k (1 - k/n) r_k),    u^2 = s^2 (n - 1) / (n (n_eff - 1))

    with s the standard deviation of the readings and r_k their autocorrelation at lag k; n_eff - 1
    degrees of freedom (Zieba 2010, Metrology and Measurement Systems 17, 3). Without correlation
    it is `Repeats`. The autocorrelation is estimated up to the lag before its first value at or
    below zero (Zieba and Ramza 2011, ibid. 18, 529), or stated: `correlation` are r_1, r_2, ...

    Estimates of r_k are too small on average for a short series: take at least some ten times the
    length of the correlation. Raises `ValueError` for fewer than three readings, readings that are
    not finite or all equal, correlations outside [-1, 1] or more than n - 1 of them, and where
    fewer than two effective readings are left.
    """

    name: ClassVar[str] = "series"
    assigned: Univariate
    n: Float[Array, ""]
    n_eff: Float[Array, ""]
    s: Float[Array, ""]

    def __init__(self, values: Any, *, correlation: Any = None):
        x = _readings(self.name, values, 3)
        spread, n = _spread(self.name, x), len(x)
        r = _autocorrelation(x) if correlation is None else _stated_lags(correlation, n)
        inflation = 1.0 + 2.0 * float(((1.0 - np.arange(1, len(r) + 1) / n) * r).sum())
        effective = n / inflation if inflation > 0.0 else math.nan
        if not effective >= 2.0:
            raise ValueError(
                f"{self.name}: found {n} readings worth {effective:.2g} independent ones, expected "
                "at least 2; measure longer, or check the stated correlation"
            )
        self.n, self.n_eff, self.s = (jnp.asarray(float(v)) for v in (n, effective, spread))
        u = spread * math.sqrt((n - 1.0) / (n * (effective - 1.0)))
        self.assigned = _assigned(self.name, x.mean(), u, effective - 1.0)


@register
class Certificate(Evaluated):
    """A value with its expanded uncertainty U from a certificate (JCGM 100, 4.3.3; 101, 6.4.9.7).

    Either `k` states the coverage factor, u = U / k, or `coverage` the coverage probability:
    k = t_p(dof) then, which is normal for infinite `dof`. With finite `dof` the distribution is a
    t. `u_is` states what u is of it: ``"scale"``, as the standards do, or ``"std"``, its standard
    deviation, for which dof must exceed 2. A certificate that states k and coverage but no degrees
    of freedom implies them: see `degrees_of_freedom`.

    Raises `ValueError` for a U, k or dof that is not above zero, a coverage outside (0, 1), and
    unless exactly one of k and coverage is given.
    """

    name: ClassVar[str] = "certificate"
    assigned: Univariate
    U: Float[Array, ""]
    k: Float[Array, ""]

    def __init__(
        self,
        value: float,
        U: float,
        *,
        k: float | None = None,
        coverage: float | None = None,
        dof: float = math.inf,
        u_is: Meaning = "scale",
    ):
        half = _above_zero(self.name, "U", U)
        nu = float(dof)
        if not nu > 0.0:
            raise ValueError(f"{self.name}: found dof = {dof}, expected a number above 0")
        if (k is None) == (coverage is None):
            raise ValueError(
                f"{self.name}: found {'neither' if k is None else 'both'} of k and coverage, "
                "expected one: k as it is stated, or the coverage probability, from which it "
                "follows with dof"
            )
        factor = _factor(nu, coverage) if coverage is not None else _above_zero(self.name, "k", k)
        self.U, self.k = jnp.asarray(half), jnp.asarray(factor)
        u = half / factor
        if u_is == "std" and math.isfinite(nu):
            self.assigned = StudentT.from_std(float(value), u, nu)
        elif u_is in ("scale", "std"):
            self.assigned = _assigned(self.name, float(value), u, nu)
        else:
            raise ValueError(f"{self.name}: found u_is = {u_is!r}, expected 'scale' or 'std'")


def pooled_deviation(groups: Any = None, *, s: Any = None, n: Any = None) -> PooledDeviation:
    """Standard deviation within several sets of repeats (JCGM 100, 4.2.4, H.3.6).

        s_p^2 = sum_j (n_j - 1) s_j^2 / sum_j (n_j - 1)

    with sum_j (n_j - 1) degrees of freedom. `groups` are lists of readings, whose means may differ;
    or `s` and `n` state standard deviation and number of readings of every set. Raises
    `ValueError` where no set has two readings, and for readings that are not finite.
    """
    name = "pooled standard deviation"
    means = (
        None
        if groups is not None
        else np.zeros(np.shape(np.atleast_1d(s if s is not None else [])))
    )
    _, deviation, count = _summaries(name, groups, means, s, n, least=1)
    dof = float((count - 1.0).sum())
    found = math.sqrt(float(((count - 1.0) * deviation**2).sum()) / dof)
    return PooledDeviation(_above_zero(name, "s", found), dof)


def degrees_of_freedom(k: float, coverage: float) -> float:
    """The nu for which t_p(nu) = k: what a stated k implies for a coverage probability p.

    A certificate may state k = 2.28 for 95.45 % without nu (JCGM 101, 6.4.9.7; EA-4/02, Annex E).
    `inf` where k is that of the normal distribution to four digits. Raises `ValueError` for a k
    that is smaller, and for one above that of nu = 1.
    """
    normal, most = _factor(math.inf, coverage), _factor(1.0, coverage)
    if abs(k - normal) < 5e-4 * normal:
        return math.inf
    if not normal < k <= most:
        raise ValueError(
            f"k: found {k}, expected a number from {normal:.4g} (normal) to {most:.4g} (dof = 1) "
            f"for a coverage probability of {coverage}"
        )
    low, high = 0.0, math.log(1e9)  # of log nu
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _factor(math.exp(middle), coverage) > k else (low, middle)
    return math.exp(0.5 * (low + high))


def _factor(nu: float, coverage: float) -> float:
    if not 0.0 < coverage < 1.0:
        raise ValueError(
            f"coverage: found {coverage}, expected a probability above 0 and below 1, such as 0.95"
        )
    q = 0.5 * (1.0 + coverage)
    return float(ndtri(q) if math.isinf(nu) else stdtrit(nu, q))


def _assigned(name: str, value: float, u: float, nu: float) -> Univariate:
    """A t of this scale, normal where u is known."""
    if not nu > 0.0:
        raise ValueError(f"{name}: found dof = {nu}, expected a number above 0")
    return Normal(value, u) if math.isinf(nu) else StudentT(value, u, nu)


def _readings(name: str, values: Any, least: int) -> Float[np.ndarray, " n"]:
    try:
        x = np.atleast_1d(np.asarray(values, dtype=float))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: found {values!r}, expected a list of numbers") from error
    if x.ndim != 1:
        raise ValueError(f"{name}: found readings of shape {x.shape}, expected a list (n,)")
    bad = np.flatnonzero(~np.isfinite(x))
    if len(bad):
        raise ValueError(
            f"{name}: found {x[bad[0]]} at position {bad[0]}, expected finite readings; leave out "
            "what was not observed"
        )
    if len(x) < least:
        raise ValueError(
            f"{name}: found {len(x)} reading{'' if len(x) == 1 else 's'}, expected at least "
            f"{least}; a single reading needs a known standard deviation s"
        )
    return x


def _spread(name: str, x: Float[np.ndarray, " n"]) -> float:
    spread = float(x.std(ddof=1))
    if not np.ptp(x) > 0.0:
        raise ValueError(
            f"{name}: found {len(x)} readings that are all {x[0]}, expected some scatter; state "
            "the resolution of the readings as a rectangular distribution instead"
        )
    return spread


def _above_zero(name: str, what: str, value: Any) -> float:
    found = float(value)
    if not (found > 0.0 and math.isfinite(found)):
        raise ValueError(f"{name}: found {what} = {value}, expected a finite number above 0")
    return found


def _summaries(
    name: str, values: Any, means: Any, s: Any, n: Any, least: int = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, standard deviation and number of readings of every group."""
    if values is not None:
        if any(stated is not None for stated in (s, n)):
            raise ValueError(f"{name}: found readings and s or n, expected one of the two")
        groups = [_readings(f"{name}: group {j}", group, 1) for j, group in enumerate(values)]
        m = np.array([group.mean() for group in groups])
        d = np.array([group.std(ddof=1) if len(group) > 1 else 0.0 for group in groups])
        count = np.array([float(len(group)) for group in groups])
    else:
        if any(stated is None for stated in (means, s, n)):
            raise ValueError(
                f"{name}: expected the readings of every group, or its mean, standard deviation s "
                "and number of readings n"
            )
        m, d = _readings(f"{name}: means", means, 1), _readings(f"{name}: s", s, 1)
        stated = _readings(f"{name}: n", n, 1)
        count = np.full(len(m), stated[0]) if len(stated) == 1 else stated
        if not len(m) == len(d) == len(count):
            raise ValueError(
                f"{name}: found {len(m)} means, {len(d)} standard deviations and {len(count)} "
                "numbers of readings, expected one of each for every group"
            )
        wrong = [j for j in range(len(m)) if d[j] < 0.0 or count[j] < 1.0 or count[j] % 1.0]
        if wrong:
            raise ValueError(
                f"{name}: group {wrong[0]}: found s = {d[wrong[0]]} and n = {count[wrong[0]]}, "
                "expected s of at least 0 and a whole number n of at least 1"
            )
    if len(m) < least:
        raise ValueError(f"{name}: found {len(m)} groups, expected at least {least}")
    if not (count > 1.0).any():
        raise ValueError(
            f"{name}: found one reading in every group, expected at least two in one of them; "
            "without, take the readings as one set"
        )
    return m, d, count


def _autocorrelation(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " k"]:
    """r_1, r_2, ... before the first that is not above zero."""
    apart = x - x.mean()
    total, found = float(apart @ apart), []
    for lag in range(1, len(x) - 1):
        r = float(apart[lag:] @ apart[:-lag]) / total
        if r <= 0.0:
            break
        found.append(r)
    return np.array(found)


def _stated_lags(correlation: Any, n: int) -> Float[np.ndarray, " k"]:
    r = _readings("series: correlation", correlation, 0)
    if len(r) > n - 1 or (np.abs(r) > 1.0).any():
        raise ValueError(
            f"series: correlation: found {len(r)} values from {r.min():g} to {r.max():g}, expected "
            f"at most {n - 1} from -1 to 1, for lags 1, 2, ..."
        )
    return r
