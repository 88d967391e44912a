"""The inputs of an evaluation of uncertainty: named quantities and their joint distribution."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float, PRNGKeyArray, UInt32, UInt64
from scipy.linalg import block_diag

from ..numerics.arrays import Array
from ..numerics.counter_draws import (
    normal,
    polar,
    random_words,
    row_key,
    seed_words,
    threefry,
    uniform,
)
from ..numerics.record import Record
from ..registry import nearest
from .base import Distribution, Raw
from .copula import GaussianCopula
from .dependence import Measure, score_correlation

_RAW = {
    "normal": normal,
    "uniform": uniform,
    "polar": lambda words: jnp.stack(polar(words), axis=1),
}
"""Random numbers (rows, count) of a kind, or (rows, 2, count), from words (rows, count)."""

Correlation = Mapping[tuple[str, str], float]
"""(name, name) -> correlation of two univariate inputs, of the normal scores unless stated."""


class Inputs(Record):
    """Named quantities with a joint distribution; flattened, a vector of k numbers.

    `distributions` gives every input its distribution, univariate (its value is a number) or
    multivariate (an array (d,)). `correlation` couples univariate inputs pair by pair by a Gaussian
    copula. `correlation_of` states of what it is: ``"scores"``, the correlation of the normal
    scores, which is that of the quantities themselves for normal distributions only;
    ``"product_moment"``, that of the quantities; ``"spearman"`` or ``"kendall"``, a rank
    correlation (`vcal.distributions.dependence`). `covariance` is always that of the quantities.
    Pairs that are not named are uncorrelated::

        Inputs({"x": Normal(0, 1), "y": Uniform(0, 1)}, correlation={("x", "y"): 0.5})

    Raises `ValueError` for no inputs, one that is no distribution, an unknown name, a multivariate
    input in `correlation`, a pair of a name with itself or stated twice, a correlation outside
    [-1, 1] or what the two distributions can have, or correlations that cannot all hold (with the
    smallest eigenvalue).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    _distributions: tuple[Distribution, ...]
    _groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    """Positions of the inputs that each copula couples."""
    _copulas: tuple[GaussianCopula, ...]

    def __init__(
        self,
        distributions: Mapping[str, Distribution],
        correlation: Correlation | None = None,
        correlation_of: Measure = "scores",
    ):
        if not distributions:
            raise ValueError("inputs: found none, expected at least one named distribution")
        for name, d in distributions.items():
            if not isinstance(d, Distribution):
                raise ValueError(
                    f"inputs: found {d!r} for {name!r}, expected a distribution; a quantity that "
                    "is known exactly belongs into the function itself"
                )
        self.names = tuple(distributions)
        self._distributions = tuple(distributions.values())
        matrix = self._correlation_matrix(
            {} if correlation is None else correlation, correlation_of
        )
        self._groups = _connected(matrix)
        self._copulas = tuple(
            GaussianCopula(
                [self._distributions[i] for i in group],  # pyright: ignore[reportArgumentType]
                matrix[np.ix_(group, group)],
                [self.names[i] for i in group],
            )
            for group in self._groups
        )

    @property
    def distributions(self) -> dict[str, Distribution]:
        """Distribution of every input by name, in order."""
        return dict(zip(self.names, self._distributions, strict=True))

    @property
    def size(self) -> int:
        """Numbers k in the flattened inputs."""
        return self._starts[-1]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the flattened inputs (k,): ``"V"``, or ``"phi[1]"`` for element 1 from 0 of an
        input that is an array.
        """
        return tuple(
            label
            for name, d in self.distributions.items()
            for label in ((name,) if d.shape == () else (f"{name}[{i}]" for i in range(d.shape[0])))
        )

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the distributions of the flattened inputs (k,)."""
        return tuple(kind for d in self._distributions for kind in d.kinds)

    @property
    def mean(self) -> dict[str, Array]:
        """Expectation of every input: the estimates."""
        return {name: d.mean for name, d in self.distributions.items()}

    @property
    def flat_mean(self) -> Float[Array, " k"]:
        """Expectation of the flattened inputs (k,)."""
        return self.flatten(self.mean)

    @property
    def dof(self) -> Float[Array, " k"]:
        """Degrees of freedom of the standard uncertainties of the flattened inputs (k,)."""
        return jnp.concatenate([jnp.ravel(d.dof) for d in self._distributions])

    @property
    def covariance(self) -> Float[Array, "k k"]:
        """Covariance of the flattened inputs (k, k), computed at every call.

        Raises `ValueError` where one has none.
        """
        return self._assembled(lambda d: d.covariance)

    @property
    def stated_covariance(self) -> Float[Array, "k k"]:
        """Covariance in the sense of JCGM 100 (`Distribution.stated_covariance`), with the
        correlations of `covariance`.

        Raises `ValueError` where an input without a standard deviation is correlated with another.
        """
        return self._assembled(lambda d: d.stated_covariance)

    @property
    def std(self) -> Float[Array, " k"]:
        """Standard uncertainties of the flattened inputs (k,)."""
        variances = [jnp.diagonal(d.covariance) for d in self._distributions]
        return jnp.sqrt(jnp.concatenate(variances))

    @property
    def coupled(self) -> bool:
        """Whether correlations of univariate inputs are declared."""
        return bool(self._groups)

    @property
    def independent(self) -> bool:
        """Whether the flattened inputs are all independent of each other; not inside `jit`."""
        return not self._groups and all(d.independent for d in self._distributions)

    @property
    def symmetric(self) -> bool:
        """Whether every input is symmetric about its mean; not inside `jit`."""
        return all(d.symmetric for d in self._distributions)

    def flatten(self, values: Mapping[str, Any]) -> Float[Array, " k"]:
        """Values by name as a vector of k numbers.

        Raises `ValueError` for a name that is missing or unknown, or a value of another shape.
        """
        if set(values) != set(self.names):
            for name in values:
                self._position(name, "values")
            missing = ", ".join(name for name in self.names if name not in values)
            raise ValueError(f"values: {missing} missing, expected {', '.join(self.names)}")
        parts = []
        for name, d in self.distributions.items():
            value = jnp.asarray(values[name], dtype=float)
            if value.shape != d.shape:
                raise ValueError(
                    f"values: found {name} of shape {value.shape}, expected {d.shape}, as its "
                    "distribution has"
                )
            parts.append(jnp.ravel(value))
        return jnp.concatenate(parts)

    def unflatten(self, vector: Float[Array, "... k"]) -> dict[str, Array]:
        """Values by name from a vector of k numbers; leading axes remain.

        Raises `ValueError` for another length.
        """
        if vector.shape[-1] != self.size:
            raise ValueError(
                f"vector: found {vector.shape[-1]} numbers, expected {self.size}, one for every "
                "label"
            )
        return {
            name: jnp.reshape(
                vector[..., start : start + math.prod(d.shape)], (*vector.shape[:-1], *d.shape)
            )
            for start, (name, d) in zip(self._starts, self.distributions.items(), strict=False)
        }

    def replaced(self, name: str, distribution: Distribution) -> "Inputs":
        """The same inputs with another distribution of one; the correlations of the scores stay.

        Raises `ValueError` for an unknown name, a correlated input that becomes multivariate, or
        something that is no distribution.
        """
        self._position(name, "replaced")
        correlation = {
            (self.names[a], self.names[b]): float(copula.correlation[i, j])
            for group, copula in zip(self._groups, self._copulas, strict=True)
            for i, a in enumerate(group)
            for j, b in enumerate(group)
            if i < j
        }
        return Inputs(self.distributions | {name: distribution}, correlation)

    def sample(self, key: PRNGKeyArray) -> dict[str, Array]:
        """One draw of every input by name: a pure function of the key.

        Every input has a key of its own, derived from its position, so that an input added at the
        end does not change the draws of the others. Inputs of one copula share the key of the
        first.
        """
        found: dict[str, Array] = {}
        coupled = {i for group in self._groups for i in group}
        for i, d in enumerate(self._distributions):
            if i not in coupled:
                found[self.names[i]] = d.sample(jax.random.fold_in(key, i))
        for group, copula in zip(self._groups, self._copulas, strict=True):
            drawn = copula.sample(jax.random.fold_in(key, group[0]))
            found |= {self.names[i]: drawn[place] for place, i in enumerate(group)}
        return {name: found[name] for name in self.names}

    def row_keys(self, seed: int, blocks: UInt32[np.ndarray, " b"]) -> UInt64[np.ndarray, "b rows"]:
        """Keys of the rows of random numbers from which `draws` makes these blocks of draws.

        As for `sample`, every input has keys of its own, derived from the seed, the number of the
        block and the position of the input. Raises `ValueError` for a seed that is no whole number
        of 64 bits.
        """
        place = [(i, e) for i, d in self._sources for e in range(_rows(d))]
        position, element = np.array(place, np.uint32).T
        own = threefry(seed_words(seed), (np.asarray(blocks, np.uint32)[:, None], position))
        return row_key(threefry(own, (element, np.ones_like(element))))

    def draws(
        self, keys: UInt64[Array, " rows"], count: int
    ) -> dict[str, Float[Array, "count ..."]]:
        """The `count` draws of a block by name, draws along the first axis: a pure function of the
        keys of the block (`row_keys`) and `count`.
        """
        sources = self._sources
        ends = np.cumsum([_rows(d) for _, d in sources]).tolist()
        at = {i: slice(end - _rows(d), end) for end, (i, d) in zip(ends, sources, strict=True)}
        drawn: dict[int, Array] = {}
        for kind in get_args(Raw):
            mine = [(i, d) for i, d in sources if d.raw == kind]
            drawn |= _from_raw(kind, mine, [keys[at[i]] for i, _ in mine], count)
        for i, d in sources:
            if d.raw is None:
                words = jnp.stack([keys[at[i]][0] >> np.uint64(32), keys[at[i]][0]])
                own = jax.random.wrap_key_data(words.astype(jnp.uint32), impl="threefry2x32")
                drawn[i] = d.sample(own, (count,))
        for group in self._groups:
            together = drawn[group[0]]
            drawn |= {i: together[:, n] for n, i in enumerate(group)}
        return {name: drawn[i] for i, name in enumerate(self.names)}

    @property
    def _sources(self) -> list[tuple[int, Distribution]]:
        """Position and distribution of what is drawn together: an input, or a group's copula."""
        coupled = {i for group in self._groups for i in group}
        alone = [(i, d) for i, d in enumerate(self._distributions) if i not in coupled]
        return alone + [(g[0], c) for g, c in zip(self._groups, self._copulas, strict=True)]

    def _assembled(self, matrix_of: Callable[[Distribution], Array]) -> Float[Array, "k k"]:
        """A matrix of the flattened inputs from the matrices of the inputs and of the copulas."""
        starts = self._starts
        single = [matrix_of(d) for d in self._distributions]
        if not self._groups and not any(isinstance(one, Tracer) for one in single):
            return np.asarray(block_diag(*single))
        matrix = jnp.zeros((self.size, self.size))
        for start, d in zip(starts, self._distributions, strict=False):
            n = math.prod(d.shape)
            matrix = matrix.at[start : start + n, start : start + n].set(matrix_of(d))
        for group, copula in zip(self._groups, self._copulas, strict=True):
            at = np.array([starts[i] for i in group])
            matrix = matrix.at[np.ix_(at, at)].set(matrix_of(copula))
        return matrix

    @property
    def _starts(self) -> tuple[int, ...]:
        """Position of the first number of every input, and their total."""
        sizes = [math.prod(d.shape) for d in self._distributions]
        return (0, *np.cumsum(sizes).tolist())

    def _position(self, name: str, where: str) -> int:
        if name not in self.names:
            raise ValueError(
                f"{where}: unknown input {name!r}{nearest(name, self.names)}, expected one of "
                f"{', '.join(self.names)}"
            )
        return self.names.index(name)

    def _correlation_matrix(
        self, correlation: Correlation, measure: Measure
    ) -> Float[np.ndarray, "n n"]:
        matrix = np.eye(len(self.names))
        stated: set[frozenset[str]] = set()
        for pair, r in correlation.items():
            if isinstance(pair, str) or len(pair) != 2:
                raise ValueError(
                    f"correlation: found {pair!r}, expected a pair of names such as ('x', 'y')"
                )
            i, j = (self._position(name, "correlation") for name in pair)
            if i == j or frozenset(pair) in stated:
                raise ValueError(
                    f"correlation: found {pair}, "
                    + ("a name with itself" if i == j else "which is stated twice")
                    + ", expected every pair of two inputs at most once"
                )
            for name in pair:
                if self.distributions[name].shape != ():
                    raise ValueError(
                        f"correlation: {name} is multivariate, expected two univariate inputs; "
                        "put all that is correlated with it into its covariance"
                    )
            if not -1.0 <= r <= 1.0:
                raise ValueError(
                    f"correlation: found {r} for {pair}, expected a number from -1 to 1"
                )
            stated.add(frozenset(pair))
            margins = (self._distributions[i], self._distributions[j])
            matrix[i, j] = matrix[j, i] = score_correlation(
                float(r),
                measure,
                *margins,  # pyright: ignore[reportArgumentType]
                ", ".join(pair),
            )
        return matrix


def _rows(d: Distribution) -> int:
    """Rows of random numbers from which a distribution makes its draws."""
    return 1 if d.raw is None or d.raw == "polar" else math.prod(d.shape)


def _from_raw(
    kind: Raw, sources: Sequence[tuple[int, Distribution]], keys: Sequence[Array], count: int
) -> dict[int, Array]:
    """Draws of all inputs that are made from one kind of random numbers, in one go."""
    if not sources:
        return {}
    raw = _RAW[kind](random_words(jnp.concatenate(keys), count))
    ends = np.cumsum([_rows(d) for _, d in sources]).tolist()
    return {
        i: d.from_raw(raw[end - 1] if kind == "polar" else raw[end - _rows(d) : end])
        for end, (i, d) in zip(ends, sources, strict=True)
    }


def _connected(matrix: Float[np.ndarray, "n n"]) -> tuple[tuple[int, ...], ...]:
    """Groups of more than one input that correlations connect, directly or through others."""
    found, left = [], set(range(len(matrix)))
    while left:
        group, fresh = set(), {min(left)}
        while fresh:
            group |= fresh
            fresh = {int(j) for i in fresh for j in np.flatnonzero(matrix[i])} - group
        left -= group
        if len(group) > 1:
            found.append(tuple(sorted(group)))
    return tuple(found)
