"""The GUM uncertainty framework (JCGM 100 and 102) by automatic differentiation."""

import math
from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..distributions import Inputs, Univariate
from ..numerics.arrays import Array
from ..numerics.differences import Batch, First, Second, first_differences, second_differences
from ..numerics.eigen import eigh
from ..numerics.spatial import require_float64
from .budget import Budget, Source
from .cautions import departure_notes
from .evaluation import Evaluation, Flat, Function, compiled_for, evaluation_of
from .intervals import check_coverage
from .outputs import labels_of
from .taylor import Taylor, first_derivatives, first_order, second_order, values_at

_SCALED = ("t", "multivariate_t")
"""Distributions with a scale as u, as the GUM accounts for their tails in k."""
_UNCORRELATED = 1e-12
"""Size of a correlation below which it is a rounding error."""
_REACH, _NODES = 37.0, 7401
"""Range of normal scores for the integration of moments."""
_RANK = 1e-14
"""Share of the trace of a correlation matrix below which an eigenvalue is a rounding error."""


def propagate(
    function: Function,
    inputs: Inputs,
    order: Literal[1, 2] = 1,
    coverage: float = 0.95,
    moments: Literal["normal", "own"] = "normal",
    t: Literal["scale", "std"] = "scale",
) -> Budget:
    """Uncertainty of the outputs of a measurement function by the GUM.

        y = f(x),   cov(y) = c S c',   c = df/dx          (JCGM 100, 5.1.2, 5.2.2; JCGM 102, 6.2)

    with S the covariance of the inputs. `function` takes their values by name and gives a number
    (an output called ``"y"``), an array, or a dictionary of these.

    A function written in JAX is differentiated automatically. Where that gives no finite
    derivative, and for any other function, of plain numbers, derivatives are differences that are
    extrapolated to a step of zero (`vcal.numerics.differences`), and a note states the effect of
    their estimated error on u.

    `order` 2 adds the next terms of the series to value and variance (`vcal.uncertainty.taylor`;
    JCGM 100, H.1.7). They assume normal inputs, which may be correlated. With `moments` ``"own"``,
    an input that is uncorrelated with all others contributes its own third and fourth moment; for
    x^2 of a rectangular x, this gives 0.89 instead of 1.41 u(x)^2. Student's t stays normal, as the
    GUM treats it as a normal quantity with an uncertain u, and accounts for its tails in k.

    The standard uncertainty of Student's t is therefore its scale s/sqrt(n) with nu degrees of
    freedom (JCGM 100, 4.2.3, G.3), and not the larger standard deviation sqrt(nu/(nu - 2))
    s/sqrt(n) of JCGM 101, 6.4.9.4, which includes the tails and does not exist for nu <= 2. Two or
    three repeated observations are sufficient, unless they are correlated with another input. With
    `t` ``"std"``, u is that standard deviation, as a known one: k is normal then, and u the one of
    a Monte Carlo, whose inputs are the same in both cases.

    Effective degrees of freedom (JCGM 100, G.4.1) are those of Welch and Satterthwaite over
    *groups* that are independent of each other, v_g = c_g S_g c_g':

        nu_eff = (sum_g v_g)^2 / sum_g (v_g^2 / nu_g)

    A group consists of inputs connected by correlations, or of the elements of one multivariate
    input. If its covariance comes from n joint observations of all its members, v_g is a sample
    variance and nu_g = n - 1 exactly (Willink 2007, Metrologia 44, 340). A `MultivariateT` of d
    quantities keeps the n - d degrees of freedom and the larger scale of JCGM 102, 5.3.2, which
    gives a larger u. No agreed formula exists for a group whose members have different degrees of
    freedom: the smallest number is used, and a note reports it. The second-order terms have no
    degrees of freedom: nu_eff is that of the first-order part, or the smallest number of all inputs
    where that part is zero.

    Raises `ValueError` if the function fails at the estimates or takes an unknown input, if it or a
    derivative is not finite there, also by differences, if a second-order variance is negative, if
    an input without a standard deviation is correlated with another, and for invalid settings;
    `TypeError` for inputs that are no `Inputs`.
    """
    require_float64()
    _check_settings(order, moments, t)
    check_coverage(coverage)
    how = evaluation_of(function, inputs)
    labels = labels_of(how.outputs)
    source = _source(inputs, t)
    root, alone = _root(source)
    point = _Point(how, Flat(function, inputs), source, root)
    _check_finite(np.isfinite(point.value[:, None]), labels, "value")
    _check_finite(np.isfinite(point.sensitivity), labels, "derivative")
    taylor = first_order(point.sensitivity @ root)
    if order == 2:
        shapes = _shapes(inputs, source, alone) if moments == "own" else np.zeros((2, len(alone)))
        taylor = point.second(*shapes)
        _check_finite(taylor.finite[:, None], labels, "second or third derivative")
    variance = _checked_variance(taylor, labels)
    u = np.sqrt(variance)
    nu_eff, notes = effective_dof(source, point.sensitivity)
    if order == 1:
        notes += _blind(labels, taylor, source)
    notes += point.notes(labels, u, taylor)
    notes += departure_notes(labels, point.value, u, taylor, point.moved)
    return Budget(
        labels=labels,
        value=point.value + taylor.shift,
        u=u,
        nu_eff=nu_eff,
        coverage=coverage,
        order=order,
        source=source,
        sensitivity=point.sensitivity,
        taylor=taylor,
        notes=notes,
    )


class _Point:
    """Value and derivatives of a measurement function at the estimates."""

    def __init__(self, how: Evaluation, flat: Flat, source: Source, root: Float[np.ndarray, "k r"]):
        self.how, self.flat, self.source, self.root = how, flat, source, root
        self.first: First | None = None
        """Derivatives by differences, where these are used."""
        self.doubt: Float[np.ndarray, " m"] | float = 0.0
        """Estimated error of the variance by the differences."""
        if how.plain is None:
            self.value, self.sensitivity, self.moved = first_derivatives(flat, source.value, root)
        else:
            x = source.value
            rows = how.plain.rows(np.concatenate([x[None], x + root.T, x - root.T]))
            self.value = rows[0]
            self.moved = rows[1:].reshape(2, root.shape[1], -1)
            self.sensitivity = np.full((len(self.value), len(x)), np.nan)
        missing = ~np.isfinite(self.sensitivity)
        if missing.any() and np.isfinite(self.value).all():
            found = first_differences(self.batch, source.value, source.u, self.value)
            self.first = First(
                found.derivative, np.where(missing, found.error, 0.0), found.kink & missing
            )
            self.sensitivity = np.where(missing, found.derivative, self.sensitivity)
            part = 2.0 * np.abs(self.sensitivity) * self.first.error * source.u**2
            self.doubt = part.sum(1)

    @property
    def batch(self) -> Batch:
        """The function of many points."""
        if self.how.plain is not None:
            return self.how.plain.rows
        return lambda points: values_at(self.flat, points)

    def second(self, skewness: Float[np.ndarray, " r"], excess: Float[np.ndarray, " r"]) -> Taylor:
        """The series of second order, by differences for outputs that are not finite otherwise."""
        if self.how.plain is None:
            taylor = second_order(self.flat, self.source.value, self.root, skewness, excess)
            if taylor.finite.all():
                return taylor
            missing, parts = ~taylor.finite, (taylor.a, taylor.H, taylor.T, taylor.t)
        else:
            missing, parts = np.ones(len(self.value), bool), None
        found = second_differences(self.batch, self.source.value, self.root, self.value)
        self.doubt = np.where(missing, _doubt(found), 0.0)
        a, H, T, t = found.a, found.H, found.T, found.t
        if parts is not None:
            a, H, T, t = (
                np.where(missing.reshape(-1, *[1] * (p.ndim - 1)), q, p)
                for p, q in zip(parts, (a, H, T, t), strict=True)
            )
        return Taylor(a, H, T, t, skewness, excess)

    def notes(
        self, labels: Sequence[str], u: Float[np.ndarray, " m"], taylor: Taylor
    ) -> tuple[str, ...]:
        """Notes on derivatives by differences."""
        doubt = np.broadcast_to(self.doubt, u.shape)
        numerical = self.how.plain is not None or self.first is not None or bool(doubt.any())
        if not numerical:
            return ()
        if self.first is not None and self.first.kink.any():
            at = np.argwhere(self.first.kink)[:5].tolist()
            listed = ", ".join(f"{labels[i]} to {self.source.labels[j]}" for i, j in at)
            return (
                "derivatives are differences, extrapolated to a step of zero: those of both sides "
                f"differ for {listed}, so that the function has a kink at the estimates, and the "
                "mean of both is used; use Monte Carlo",
            )
        effect = np.divide(0.5 * doubt, u**2, out=np.zeros_like(u), where=u > 0.0)
        worst = int(np.argmax(effect))
        return (
            "derivatives are differences, extrapolated to a step of zero: by their estimated "
            f"error, u of {labels[worst]} may be off by {_percent(float(effect[worst]))}",
        )


def _doubt(found: Second) -> Float[np.ndarray, " m"]:
    """Bound of the error of the second-order variance of normal inputs by those of its parts."""
    a, H, T, _ = (np.abs(part) for part in (found.a, found.H, found.T, found.t))
    da, dH, dT, _ = found.errors
    return (2.0 * a * da + a * dT + T * da).sum(1) + (H * dH).sum((1, 2))


def _percent(share: float) -> str:
    return "less than 0.01 %" if share < 1e-4 else f"{100.0 * share:.2g} %"


def _source(inputs: Inputs, t: Literal["scale", "std"]) -> Source:
    """The inputs with their estimates, standard uncertainties and degrees of freedom by the GUM."""
    kinds = inputs.kinds
    if t == "std":
        numbers = inputs.flat_mean, inputs.dof, inputs.covariance
    elif inputs.coupled:
        numbers = inputs.flat_mean, inputs.dof, inputs.stated_covariance
    else:
        program, arrays = compiled_for(_stated, (inputs,))
        numbers = program(arrays)
    value, dof, covariance = (np.asarray(one, float) for one in numbers)
    if t == "std":
        dof = np.where(np.isin(kinds, _SCALED), np.inf, dof)
    groups = _groups(inputs, covariance, dof)
    return Source(inputs.labels, inputs.kinds, value, covariance, dof, groups)


def _stated(inputs: Inputs) -> tuple[Array, Array, Array]:
    return inputs.flat_mean, inputs.dof, inputs.stated_covariance


def _groups(
    inputs: Inputs, covariance: Float[np.ndarray, "k k"], dof: Float[np.ndarray, " k"]
) -> tuple[tuple[int, ...], ...]:
    """Indices of inputs that are connected by correlations or were estimated jointly."""
    u = np.sqrt(np.diag(covariance))
    linked = np.abs(covariance) > _UNCORRELATED * np.outer(u, u)
    names = np.repeat(
        np.arange(len(inputs.names)),
        [math.prod(d.shape) for d in inputs.distributions.values()],
    )
    linked |= (names[:, None] == names) & np.isfinite(dof)
    left, found = set(range(len(u))), []
    while left:
        group, edge = set(), {min(left)}
        while edge:
            group |= edge
            edge = {int(j) for i in edge for j in np.flatnonzero(linked[i])} - group
        left -= group
        found.append(tuple(sorted(group)))
    return tuple(group for group in found if len(group) > 1)


def _root(source: Source) -> tuple[Float[np.ndarray, "k r"], tuple[int, ...]]:
    """L with L L' = S, and for every column the index of its only input, or -1."""
    u, columns, alone = source.u, [], []
    for group in source.independent:
        members = [i for i in group if u[i] > 0.0]
        if not members:
            continue
        if len(members) == 1:
            block = np.zeros((len(u), 1))
            block[members] = u[members]
            columns.append(block)
            alone.append(members[0] if len(group) == 1 else -1)
            continue
        scale = u[members]
        size, axes = eigh(source.covariance[np.ix_(members, members)] / np.outer(scale, scale))
        kept = size > _RANK * len(members)
        block = np.zeros((len(u), int(kept.sum())))
        block[members] = scale[:, None] * axes[:, kept] * np.sqrt(size[kept])
        columns.append(block)
        alone += [members[0] if len(group) == 1 else -1] * block.shape[1]
    return np.concatenate([np.zeros((len(u), 0)), *columns], axis=1), tuple(alone)


def _shapes(inputs: Inputs, source: Source, alone: tuple[int, ...]) -> Float[np.ndarray, "2 r"]:
    """Skewness and excess kurtosis of the uncorrelated inputs; zero for the others."""
    distributions = list(inputs.distributions.values())
    first = np.cumsum([0, *(math.prod(d.shape) for d in distributions)])
    places = zip(first.tolist(), distributions, strict=False)
    own = {i: d for i, d in places if isinstance(d, Univariate)}
    found = np.zeros((2, len(alone)))
    for column, i in enumerate(alone):
        if i in own and source.distributions[i] not in _SCALED:
            found[:, column] = _shape(own[i])
    return found


def _shape(distribution: Univariate) -> tuple[float, float]:
    """Skewness and excess kurtosis, by the trapezoidal rule over the normal score."""
    z = np.linspace(-_REACH, _REACH, _NODES)
    weight = np.exp(-0.5 * z**2)
    x = np.asarray(distribution.from_score(jnp.asarray(z)))
    with np.errstate(over="ignore", invalid="ignore"):
        x = x - np.average(x, weights=weight)
        second, third, fourth = (np.average(x**n, weights=weight) for n in (2, 3, 4))
    if not math.isfinite(fourth):
        raise ValueError(
            f"{distribution.name}: the fourth moment is beyond the range of float64; take moments "
            "'normal', or better Monte Carlo"
        )
    return float(third / second**1.5), float(fourth / second**2 - 3.0)


def _check_settings(order: int, moments: str, t: str) -> None:
    if t not in ("scale", "std"):
        raise ValueError(f"t: found {t!r}, expected 'scale' or 'std', what u is of Student's t")
    if order not in (1, 2):
        raise ValueError(f"order: found {order!r}, expected 1 or 2; beyond that use Monte Carlo")
    if moments not in ("normal", "own"):
        raise ValueError(f"moments: found {moments!r}, expected 'normal' or 'own'")
    if moments == "own" and order == 1:
        raise ValueError("moments: found 'own' at first order, which needs none; take order=2")


def _check_finite(finite: Bool[np.ndarray, "m n"], labels: Sequence[str], what: str) -> None:
    for i in np.flatnonzero(~finite.all(axis=1))[:1]:
        raise ValueError(
            f"the {what} of {labels[i]!r} at the estimates is not finite, where the GUM needs it; "
            "check the estimates, or use Monte Carlo"
        )


def _blind(labels: Sequence[str], taylor: Taylor, source: Source) -> tuple[str, ...]:
    """The note on outputs without a first-order sensitivity."""
    still = [label for label, v in zip(labels, taylor.linear, strict=True) if v == 0.0]
    if not still or not source.u.any():
        return ()
    names = ", ".join(still[:5]) + (f" and {len(still) - 5} more" if len(still) > 5 else "")
    return (
        f"{names} has no first-order sensitivity to any input; if a derivative vanishes at the "
        "estimates, take order=2 or Monte Carlo",
    )


def _checked_variance(taylor: Taylor, labels: Sequence[str]) -> Float[np.ndarray, " m"]:
    variance = taylor.variance
    for i in np.flatnonzero(variance < -1e-12 * taylor.linear)[:1]:
        raise ValueError(
            f"the second-order variance of {labels[i]!r} is negative ({variance[i]:.3g}, first "
            f"order {taylor.linear[i]:.3g}): the series does not hold over these uncertainties; "
            "use Monte Carlo"
        )
    return np.maximum(variance, 0.0)


def effective_dof(
    source: Source, sensitivity: Float[np.ndarray, "m k"]
) -> tuple[Float[np.ndarray, " m"], tuple[str, ...]]:
    """Effective degrees of freedom of every output, with notes on them."""
    total = np.zeros(len(sensitivity))
    scatter = np.zeros(len(sensitivity))
    smallest, notes = np.inf, []
    for group in source.independent:
        members = [i for i in group if source.u[i] > 0.0]
        if not members:
            continue
        dof = source.dof[members]
        if dof.min() < dof.max():
            names = ", ".join(source.labels[i] for i in members)
            notes.append(
                f"{names} are correlated but differ in their degrees of freedom, for which no "
                f"agreed formula exists: the smallest number, {dof.min():g}, is used for all"
            )
        c = sensitivity[:, members]
        part = np.maximum(((c @ source.covariance[np.ix_(members, members)]) * c).sum(1), 0.0)
        total += part
        scatter += part**2 / dof.min()
        smallest = min(smallest, float(dof.min()))
    known = np.divide(total**2, scatter, out=np.full_like(total, np.inf), where=scatter > 0.0)
    return np.where(total > 0.0, known, smallest), tuple(notes)
