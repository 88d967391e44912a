"""Families of functions of one axis position, with the prior of their coefficients.

The prior of an error motion is a covariance of the coefficients of the *declared family's own*
basis. Replacing the family by polynomials of too low a degree is the most frequent cause of false
effects: the part that the polynomials cannot represent looks like a physical effect.
"""

import abc
import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..distributions import Uniform, Univariate
from ..numerics.arrays import Array, namespace
from ..numerics.eigen import eigh
from ..numerics.record import Record


@functools.cache
def unit_uniform() -> Uniform:
    """Uniform distribution between -1 and 1."""
    with jax.ensure_compile_time_eval():  # it is cached, and must not be part of a trace
        return Uniform(-1.0, 1.0)


class Basis(Record):
    """Functions of one position with independent, zero-mean coefficients."""

    sigma: eqx.AbstractVar[np.ndarray]
    """Prior standard deviation of each coefficient (k,), in the unit of the error motion (SI)."""
    labels: eqx.AbstractVar[tuple[str, ...]]
    """Name of each coefficient."""

    @property
    def law(self) -> Univariate | None:
        """Distribution whose standardised form is that of the coefficients; None: normal."""
        return None

    @abc.abstractmethod
    def functions(self, x: Float[Array, " n"]) -> Float[Array, "n k"]:
        """Values (n, k) of the basis functions at positions `x` (m or rad)."""


class Fourier(Basis):
    """E(u) = a0 + a1 u + sum_n b_n sin(n pi u) + c_n cos(n pi u), u in [-1, 1] over the travel.

    The coefficients have uniform distributions with the given amplitudes as half-widths, so that
    their variance is amplitude^2 / 3. `harmonics` are (n, amplitude of b_n, amplitude of c_n), in
    the unit of the error motion (SI). Terms of amplitude zero are left out.
    """

    sigma: np.ndarray
    labels: tuple[str, ...] = eqx.field(static=True)
    travel: np.ndarray
    waves: np.ndarray
    """Per coefficient: n of sine and cosine terms, 0 for the others."""

    def __init__(
        self,
        travel: Sequence[float],
        a0: float,
        a1: float,
        harmonics: Sequence[tuple[float, float, float]],
    ):
        terms = [("a0", 0.0, a0), ("a1", 0.0, a1)]
        for i, (n, b, c) in enumerate(harmonics, start=1):
            terms += [(f"b{i}", n, b), (f"c{i}", n, c)]
        terms = [term for term in terms if term[2] != 0.0]
        self.labels = tuple(label for label, _, _ in terms)
        self.waves = np.array([n for _, n, _ in terms])
        self.sigma = np.array([amplitude for _, _, amplitude in terms]) / np.sqrt(3.0)
        self.travel = np.asarray(travel, float)

    @property
    def law(self) -> Univariate:
        return unit_uniform()

    def functions(self, x: Float[Array, " n"]) -> Float[Array, "n k"]:
        return _fourier(x, self.travel, self.labels, self.waves)


class Matern(Basis):
    """A Gaussian process with Matern-5/2 kernel on the travel, in its Karhunen-Loeve basis.

    k(d) = s^2 (1 + r + r^2/3) exp(-r), r = sqrt(5) |d| / l, with the correlation length l =
    smoothness * travel. The eigenfunctions of the kernel (Nystroem, 200 nodes) are kept until they
    explain 99.999 % of the variance: a truncated part of a hundredth of the size would appear as an
    effect where errors are a hundred times the noise.

    With `around`, for a full turn, the distance is the chord 2 sin(angle / 2), whose maximum 2
    takes the place of the travel; the functions are then periodic.
    """

    sigma: np.ndarray
    labels: tuple[str, ...] = eqx.field(static=True)
    travel: np.ndarray
    length: float
    nodes: np.ndarray
    weights: np.ndarray
    around: bool = eqx.field(static=True)

    def __init__(
        self, travel: Sequence[float], sigma: float, smoothness: float, around: bool = False
    ):
        low, high = (0.0, 2.0 * np.pi) if around else travel
        self.around = around
        self.travel = np.asarray(travel, float)
        self.length = smoothness * (2.0 if around else high - low)
        self.nodes = np.linspace(low, high, 200, endpoint=not around)
        kernel = self._kernel(self.nodes)
        values, vectors = eigh(kernel)
        values, vectors = values[::-1], vectors[:, ::-1]
        kept = int(np.searchsorted(np.cumsum(values) / values.sum(), 0.99999)) + 1
        # Scaled so that every coefficient has the declared sigma, with functions of unit variance.
        self.weights = vectors[:, :kept] / np.sqrt(values[:kept])
        self.sigma = np.full(kept, sigma)
        self.labels = tuple(f"k{i}" for i in range(kept))

    def functions(self, x: Float[Array, " n"]) -> Float[Array, "n k"]:
        return self._kernel(x) @ self.weights

    def _kernel(self, x: Float[Array, " n"]) -> Float[Array, "n nodes"]:
        apart = x[:, None] - self.nodes
        apart = 2.0 * namespace(apart).sin(0.5 * apart) if self.around else apart
        distance = np.sqrt(5.0) * abs(apart) / self.length
        return (1.0 + distance + distance**2 / 3.0) * namespace(distance).exp(-distance)


class Legendre(Basis):
    """Legendre polynomials of the given degrees on the travel, all with the same sigma."""

    sigma: np.ndarray
    labels: tuple[str, ...] = eqx.field(static=True)
    travel: np.ndarray
    degrees: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, travel: Sequence[float], degrees: Sequence[int], sigma: float):
        self.travel = np.asarray(travel, float)
        self.degrees = tuple(degrees)
        self.sigma = np.full(len(self.degrees), sigma)
        self.labels = tuple(f"P{degree}" for degree in self.degrees)

    def functions(self, x: Float[Array, " n"]) -> Float[Array, "n k"]:
        low, high = self.travel
        u = (2.0 * x - low - high) / (high - low)
        xp = namespace(u)
        values = [xp.ones_like(u), u]
        for n in range(1, max(self.degrees)):
            values.append(((2 * n + 1) * u * values[n] - n * values[n - 1]) / (n + 1))
        return xp.stack([values[degree] for degree in self.degrees], -1)


class Constant(Basis):
    """One constant: a location error, or a constant error of a link."""

    sigma: np.ndarray
    labels: tuple[str, ...] = eqx.field(static=True)
    distribution: Univariate | None

    def __init__(self, sigma: float, distribution: Univariate | None = None):
        self.sigma = np.array([sigma])
        self.labels = ("0",)
        self.distribution = distribution

    @property
    def law(self) -> Univariate | None:
        return self.distribution

    def functions(self, x: Float[Array, " n"]) -> Float[Array, "n k"]:
        return namespace(x).ones_like(x)[..., None]


class Together(Basis):
    """The functions of several families with normal coefficients, side by side: a constant error of
    a link and the error motion along its travel.
    """

    sigma: np.ndarray
    labels: tuple[str, ...] = eqx.field(static=True)
    parts: tuple[Basis, ...]

    def __init__(self, parts: Sequence[Basis]):
        self.parts = tuple(parts)
        self.sigma = np.concatenate([part.sigma for part in self.parts])
        self.labels = tuple(label for part in self.parts for label in part.labels)

    def functions(self, x: Float[Array, " n"]) -> Float[Array, "n k"]:
        values = [part.functions(x) for part in self.parts]
        return namespace(values[0]).concatenate(values, -1)


def summed(
    families: Sequence[Basis], coefficients: Sequence[Float[np.ndarray, " k"]], x: np.ndarray
) -> Float[np.ndarray, "n families"]:
    """Values E_j(x) = sum_k c_jk f_jk(x) of several families at the same positions `x` (n,), in the
    unit of the coefficients.

    What Fourier families over one travel have in common is evaluated once: the six error motions of
    an axis have the sines and cosines of the same waves.
    """
    found = np.zeros((len(x), len(families)))
    travels: dict[tuple[float, ...], dict[tuple[str, float], np.ndarray]] = {}
    for j, (family, own) in enumerate(zip(families, coefficients, strict=True)):
        if not isinstance(family, Fourier):
            found[:, j] = np.asarray(family.functions(x)) @ own
            continue
        terms = travels.setdefault(tuple(family.travel.tolist()), {})
        for label, n, value in zip(family.labels, family.waves.tolist(), own, strict=True):
            name = label if label[0] == "a" else label[0]
            terms.setdefault((name, n), np.zeros(len(families)))[j] += value
    for travel, terms in travels.items():
        labels, waves = zip(*terms, strict=True)
        functions = _fourier(x, np.array(travel), labels, np.array(waves))
        found += functions @ np.array([*terms.values()])
    return found


def _fourier(
    x: Float[Array, " n"], travel: Array, labels: tuple[str, ...], waves: Array
) -> Float[Array, "n k"]:
    """The functions of a `Fourier` family, by the first letter and the n of their labels."""
    if not labels:
        return np.zeros((*np.shape(x), 0))
    low, high = travel
    u = ((2.0 * x - low - high) / (high - low))[..., None]
    # All columns at once: the family of a machine has a hundred of them to compile.
    kind = np.array([label[0] for label in labels])
    angle = waves * (np.pi * u)
    xp = namespace(angle)
    if xp is np:  # nothing to compile, and a sine or cosine of each angle, not both
        values = np.where(np.array(labels) == "a1", u, 1.0)
        for letter, function in (("b", np.sin), ("c", np.cos)):
            own = kind == letter
            values[..., own] = function(angle[..., own])
        return values
    straight = xp.where(np.array(labels) == "a1", u, 1.0)
    wave = xp.where(kind == "b", xp.sin(angle), xp.cos(angle))
    return xp.where(kind == "a", straight, wave)
