"""The GUM uncertainty framework (JCGM 100 and 102) by automatic differentiation."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..distributions import Inputs, Univariate
from ..numerics.arrays import Array
from ..numerics.spatial import require_float64
from ..registry import nearest
from .budget import Budget, Source
from .intervals import check_coverage
from .outputs import Output, labels_of
from .taylor import Taylor, first_derivatives, first_order, second_order

Function = Callable[[dict[str, Array]], Any]
"""Values of the inputs by name -> a number, an array, or a dictionary of these."""

_UNNAMED = "y"
_SCALED = ("t", "multivariate_t")
"""Distributions with a scale as u, as the GUM accounts for their tails in k."""
_UNCORRELATED = 1e-12
"""Size of a correlation below which it is a rounding error."""
_REACH, _NODES = 37.0, 7401
"""Range of normal scores for the integration of moments."""
_RANK = 1e-14
"""Share of the trace of a correlation matrix below which an eigenvalue is a rounding error."""


class Flat(eqx.Module):
    """A measurement function from the vector of all inputs to the vector of all outputs."""

    function: Function
    inputs: Inputs

    def __call__(self, x: Float[Array, " k"]) -> Float[Array, " m"]:
        values = named(self.function(self.inputs.unflatten(x)))
        return jnp.concatenate([jnp.ravel(value) for value in values.values()])


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
    (an output called ``"y"``), an array, or a dictionary of these. It is written in JAX and has
    derivatives at the estimates.

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

    Raises `ValueError` if the function is not written in JAX or takes an unknown input, if it or a
    derivative is not finite at the estimates, if a second-order variance is negative, if an input
    without a standard deviation is correlated with another, and for invalid settings; `TypeError`
    for inputs that are no `Inputs`.
    """
    require_float64()
    _check_settings(order, moments, t)
    check_coverage(coverage)
    labels = labels_of(outputs_of(function, inputs))
    source = _source(inputs, t)
    flat = Flat(function, inputs)
    value, sensitivity = first_derivatives(flat, source.value)
    _check_finite(np.isfinite(value[:, None]), labels, "value")
    _check_finite(np.isfinite(sensitivity), labels, "derivative")
    root, alone = _root(source)
    taylor = first_order(sensitivity @ root)
    if order == 2:
        shapes = _shapes(inputs, source, alone) if moments == "own" else np.zeros((2, len(alone)))
        taylor = second_order(flat, source.value, root, *shapes)
        _check_finite(taylor.finite[:, None], labels, "second or third derivative")
    variance = _checked_variance(taylor, labels)
    nu_eff, notes = effective_dof(source, sensitivity)
    if order == 1:
        notes += _blind(labels, taylor, source)
    return Budget(
        labels=labels,
        value=value + taylor.shift,
        u=np.sqrt(variance),
        nu_eff=nu_eff,
        coverage=coverage,
        order=order,
        source=source,
        sensitivity=sensitivity,
        taylor=taylor,
        notes=notes,
    )


def named(values: Any) -> dict[str, Array]:
    """Outputs of a measurement function by name; a single one is called ``"y"``.

    A complex output ``"S"`` is two real ones, ``"S.re"`` and ``"S.im"``. Raises `ValueError` for a
    value that is neither a number nor an array.
    """
    found = dict(values) if isinstance(values, Mapping) else {_UNNAMED: values}
    try:
        arrays = {str(name): jnp.asarray(value) for name, value in found.items()}
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the measurement function gave {values!r}, expected a number, an array, or a "
            "dictionary of these"
        ) from error
    real: dict[str, Array] = {}
    for name, array in arrays.items():
        if jnp.iscomplexobj(array):
            real |= {f"{name}.re": jnp.real(array), f"{name}.im": jnp.imag(array)}
        else:
            real[name] = jnp.asarray(array, dtype=float)
    return real


def outputs_of(function: Function, inputs: Inputs) -> tuple[Output, ...]:
    """Names and shapes of the outputs of a measurement function, in its own order.

    Raises `ValueError` if the function is not written in JAX, has no output, or takes an unknown
    input, and `TypeError` for inputs that are no `Inputs`.
    """
    if not isinstance(inputs, Inputs):
        raise TypeError(
            f"inputs: found {inputs!r}, expected Inputs; write Inputs({{'x': Normal(0, 1)}}), with "
            "a distribution for every quantity"
        )
    names: list[str] = []

    def in_order(x: Array) -> list[Array]:
        # JAX would return a dictionary in alphabetical order.
        values = named(function(inputs.unflatten(x)))
        names.extend(values)
        return list(values.values())

    try:
        shapes = [found.shape for found in jax.eval_shape(in_order, inputs.flat_mean)]
    except jax.errors.JAXTypeError as error:
        raise ValueError(
            "the measurement function is not written in JAX: it turns a value into a plain number "
            "or a condition; use jax.numpy, and jax.numpy.where in place of if "
            f"({str(error).splitlines()[0]})"
        ) from error
    except KeyError as error:
        name = next(iter(error.args), None)
        if not isinstance(name, str) or name in inputs.names:
            raise
        raise ValueError(
            f"the measurement function takes the input {name!r}{nearest(name, inputs.names)}, "
            f"expected one of {', '.join(inputs.names)}; correct the name, or add it to the inputs"
        ) from error
    if not any(math.prod(shape) for shape in shapes):
        raise ValueError("the measurement function gave no outputs, expected at least one")
    return tuple(Output(name, shape) for name, shape in zip(names, shapes, strict=True))


def _source(inputs: Inputs, t: Literal["scale", "std"]) -> Source:
    """The inputs with their estimates, standard uncertainties and degrees of freedom by the GUM."""
    kinds = inputs.kinds
    dof = np.asarray(inputs.dof, float)
    if t == "std":
        covariance = np.asarray(inputs.covariance, float)
        dof = np.where(np.isin(kinds, _SCALED), np.inf, dof)
    else:
        covariance = np.asarray(inputs.stated_covariance, float)
    groups = _groups(inputs, covariance, dof)
    return Source(inputs.labels, kinds, np.asarray(inputs.flat_mean), covariance, dof, groups)


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
        scale = u[members]
        size, axes = np.linalg.eigh(
            source.covariance[np.ix_(members, members)] / np.outer(scale, scale)
        )
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
