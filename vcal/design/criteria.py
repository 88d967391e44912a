"""Criteria of a plan: a positive number to minimise, as a function of a posterior covariance."""

import abc
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..geometry.volumetric import Gram, expected_rms
from ..identification.posterior import expanded
from ..model.forward import Model
from ..numerics.arrays import Array
from ..registry import Catalogue

MICRO = 1e-6
_POWER = 24.0
"""Order of the norm that replaces the maximum of many uncertainties in a search. It exceeds the
maximum by at most 30 % for 600 equal ones, and by a few percent in practice."""


class ErrorMotion(NamedTuple):
    """One error motion or location error, or a combination of several (a squareness of two paths),
    as linear functions of the amplitudes.
    """

    name: str
    unit: str
    """``"um"``, ``"urad"`` or ``"um/m"``."""
    position: Float[np.ndarray, " n"]
    """Positions along its axis, m or rad; empty for a single number, such as a squareness."""
    functionals: Float[np.ndarray, "n k"]
    """Value at every position (one for a single number), SI."""
    amplitudes: tuple[int, ...]
    """Indices of its coefficients among those of the declared family; empty for a combination."""


class Judged(NamedTuple):
    """A declared family of errors, and the errors that follow from its amplitudes."""

    model: Model
    """Chain, instrument and the judged effects, without nuisances of the instrument."""
    gram: Gram
    motions: tuple[ErrorMotion, ...]
    chosen: tuple[int, ...]
    """Indices of the motions that count for the criterion."""

    @property
    def precision(self) -> Float[np.ndarray, " k"]:
        """Prior precision of the amplitudes in solver units: one, or zero for a flat prior."""
        return np.array([float(e.parameter.informed) for e in self.model.entries])

    def largest(self, covariance: Float[Array, "k k"]) -> Float[Array, " q"]:
        """Largest U (k = 2) of every error motion over its positions, um or urad."""
        return jnp.stack([expanded(m.functionals, covariance).max() / MICRO for m in self.motions])


class Criterion(abc.ABC):
    """Base class of all criteria; subclasses are final."""

    name: ClassVar[str]
    """Name in study files."""
    words: ClassVar[str]
    """Name in reports."""
    unit: ClassVar[str]

    @abc.abstractmethod
    def of(self, judged: Judged, covariance: Float[Array, "k k"]) -> Float[Array, ""]:
        """The criterion of a covariance."""

    def smooth(self, judged: Judged, covariance: Float[Array, "k k"]) -> Float[Array, ""]:
        """The objective of a search: the criterion, or a smooth substitute where it has kinks."""
        return self.of(judged, covariance)

    @abc.abstractmethod
    def together(self, values: Float[Array, " f"]) -> Float[Array, ""]:
        """Average of the criterion over several families."""


CRITERIA: Catalogue[type[Criterion]] = Catalogue("goal")
"""Every criterion by the name of its goal."""


@CRITERIA.register
class Volume(Criterion):
    """Expected rms volumetric error after compensation, aligned: sqrt(tr(G C))."""

    name = "volume"
    words = "expected rms volumetric error after compensation"
    unit = "um"

    def of(self, judged: Judged, covariance: Float[Array, "k k"]) -> Float[Array, ""]:
        return expected_rms(jnp.asarray(judged.gram.aligned), covariance) / MICRO

    def together(self, values: Float[Array, " f"]) -> Float[Array, ""]:
        return jnp.sqrt((values**2).mean())


@CRITERIA.register
class Largest(Criterion):
    """Largest expanded uncertainty of the chosen errors; a microradian counts as a micrometre.

    A search minimises the norm (sum_i U_i^p)^(1/p), p = 24, which has no kinks.
    """

    name = "largest"
    words = "largest expanded uncertainty U (k = 2) of the chosen errors"
    unit = "um or urad"

    def of(self, judged: Judged, covariance: Float[Array, "k k"]) -> Float[Array, ""]:
        return _uncertainties(judged, covariance).max()

    def smooth(self, judged: Judged, covariance: Float[Array, "k k"]) -> Float[Array, ""]:
        U = _uncertainties(judged, covariance)
        top = U.max()
        return top * ((U / top) ** _POWER).sum() ** (1.0 / _POWER)

    def together(self, values: Float[Array, " f"]) -> Float[Array, ""]:
        return values.mean()


@CRITERIA.register
class Determinant(Criterion):
    """Geometric mean of the posterior standard deviations of the chosen errors' amplitudes, in
    units of their priors: det(C)^(1/(2 n)), a readable number for D-optimal plans.
    """

    name = "determinant"
    words = "geometric mean of the remaining standard deviations of the chosen errors"
    unit = "of the prior"

    def of(self, judged: Judged, covariance: Float[Array, "k k"]) -> Float[Array, ""]:
        places = sorted({i for k in judged.chosen for i in judged.motions[k].amplitudes})
        own = covariance[np.ix_(places, places)]
        scale = jnp.sqrt(jnp.diagonal(own))
        _, log = jnp.linalg.slogdet(own / scale[:, None] / scale)
        return jnp.exp((0.5 * log + jnp.log(scale).sum()) / len(places))

    def together(self, values: Float[Array, " f"]) -> Float[Array, ""]:
        return jnp.exp(jnp.log(values).mean())


def averaged(
    function: Callable[[Judged, Float[Array, "k k"]], Float[Array, ""]],
    criterion: Criterion,
    families: Sequence[Judged],
    covariances: Sequence[Float[Array, "k k"]],
) -> Float[Array, ""]:
    """The average of a criterion, or of its smooth substitute, over several families."""
    each = [function(j, C) for j, C in zip(families, covariances, strict=True)]
    return criterion.together(jnp.stack(each))


def _uncertainties(judged: Judged, covariance: Float[Array, "k k"]) -> Float[Array, " n"]:
    rows = np.concatenate([judged.motions[k].functionals for k in judged.chosen])
    return expanded(rows, covariance) / MICRO
