"""Separation of two effects: how well a measurement can distinguish them.

Effect A is real with the amplitudes a, and B is fitted in its place, together with the declared
model. The remaining lack of fit is the noncentrality of the score test for A,

    lambda(A | B) = a' G a,    G = C' C - C' J (J' J + L)^-1 J' C,

with C the whitened columns of A, J those of the declared model, of B and of the unknowns that the
groups share, and L their prior precision. This is the test that the loop applies. Where only the
mean m and the covariance S of a are known, its expectation is m' G m + tr(G S). Which of the two is
real is unknown, so that the smaller of lambda(A | B) and lambda(B | A) counts.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import chdtri, chndtr

from ..effects.base import Effect
from ..errors import StudyError
from ..identification.posterior import eliminated
from ..model.forward import Model
from ..numerics.arrays import Array
from .plan_space import PlanSpace, Varied

ALPHA = 0.01
"""False-alarm probability of the test."""
_NOTHING = 1e-12


class Rival(NamedTuple):
    """An effect with the prior knowledge of its size."""

    effect: Effect
    """The effect, with the priors of the catalogue for its amplitudes."""
    moment: Float[np.ndarray, "a a"]
    """m m' + S of its amplitudes, in solver units."""
    sized: bool
    """Whether its size is given or estimated; otherwise it is that of its prior."""

    @classmethod
    def of(cls, effect: Effect) -> "Rival":
        """The rival of an effect with declared values.

        Amplitudes with a value have that size, others the size of their priors. Raises `StudyError`
        for a shape parameter, such as a pitch, without a value, and for a size of zero.
        """
        given = {name for name, *_ in effect.given}
        loose = [p.name for p in effect.shapes if p.name not in given]
        if loose:
            raise StudyError(
                f"effect {effect.key!r}: found the free shape parameter {loose[0]!r}, expected a "
                "value, as the expected lack of fit refers to one shape; give it, such as "
                f"{effect.name}:{effect.placement}:{effect.shapes[0].label}=..."
            )
        shapes = {p.name for p in effect.shapes}
        kept = tuple(item for item in effect.given if item[0] in shapes)
        plain = dataclasses.replace(effect, given=kept, priors=())
        mean, spread = [], []
        for known, own in zip(effect.amplitudes, plain.amplitudes, strict=True):
            mean.append(known.mean * known.si / own.step)
            spread.append((known.sigma * known.si / own.step) ** 2)
        moment = np.outer(mean, mean) + np.diag(spread)
        if not moment.any():
            raise StudyError(
                f"effect {effect.key!r}: found a size of zero, expected a nonzero one; give "
                "another, or none to use the size of its prior"
            )
        return cls(plain, moment, bool(given - shapes))


class Lambda(NamedTuple):
    """Expected lack of fit with the first effect real and the second fitted, and vice versa."""

    first: float
    second: float

    @property
    def smaller(self) -> float:
        """The smaller of the two, which counts."""
        return min(self.first, self.second)


class Separation(NamedTuple):
    """Two rivals in addition to a declared model."""

    model: Model
    """Declared effects, then those of the first rival, then those of the second."""
    rivals: tuple[Rival, Rival]

    @classmethod
    def of(cls, model: Model, first: Rival, second: Rival) -> "Separation":
        """The separation of two rivals; raises `StudyError` where both are the same effect."""
        if first.effect.alike(second.effect):
            raise StudyError(
                f"--separate: found {first.effect.key!r} twice, expected two effects; name another"
            )
        return cls(model.with_effects(first.effect, second.effect), (first, second))

    def varied(self, known: dict[str, np.ndarray]) -> list[Varied]:
        """Conditions on which either of them depends, within the range of the data.

        Time is left out, as it cannot be chosen.
        """
        found = []
        needs = dict.fromkeys((*self.rivals[0].effect.needs, *self.rivals[1].effect.needs))
        for name in needs:
            if name not in known or name == "t":
                continue
            if name.startswith("dir_"):
                found.append(Varied(name, -1.0, 1.0, step=True))
            elif np.ptp(known[name]) > 0.0:
                found.append(Varied(name, float(known[name].min()), float(known[name].max())))
        return found

    def lambdas(
        self, joint: Float[Array, "n n"], shared: Float[np.ndarray, "s s"]
    ) -> Float[Array, "2"]:
        """lambda(A | B) and lambda(B | A) from joint information (`PlanSpace.information`)."""
        k = len(self.model.entries)
        prior = np.diag([float(e.parameter.informed) for e in self.model.entries])
        precision = np.zeros((k + len(shared), k + len(shared)))
        precision[:k, :k], precision[k:, k:] = prior, shared
        counts = [len(r.effect.amplitudes) for r in self.rivals]
        ends = k - sum(counts), k - counts[1], k
        found = []
        for i, rival in enumerate(self.rivals):
            own = np.arange(ends[i], ends[i + 1])
            others = np.setdiff1d(np.arange(len(precision)), own)
            order = np.concatenate([own, others])
            rest = jnp.asarray(precision[np.ix_(others, others)])
            G = eliminated(joint[np.ix_(order, order)], jnp.zeros((len(own), len(own))), rest)
            found.append(jnp.einsum("ij,ij->", G, jnp.asarray(rival.moment)))
        return jnp.stack(found)

    def powers(self, found: Lambda) -> tuple[float, float]:
        """Power of both tests at `ALPHA`."""
        values = []
        for rival, size in zip(self.rivals, found, strict=True):
            count = len(rival.effect.amplitudes)
            values.append(float(1.0 - chndtr(chdtri(count, ALPHA), count, max(size, 0.0))))
        return values[0], values[1]


class Separating:
    """The objective of a search that separates two rivals, given the present data."""

    def __init__(self, separation: Separation, space: PlanSpace, held: Float[np.ndarray, "n n"]):
        self.separation, self.space, self.held = separation, space, held

    def lambdas(self, placed: Any, weight: float = 1.0) -> Float[Array, "2"]:
        """Noncentralities with the present data and further groups."""
        weights = jnp.full(len(self.space.groups), weight)
        joint = self.space.information(placed, self.separation.model, weights)
        return self.separation.lambdas(joint + self.held, self.space.shared)

    def smooth(self, z: Float[Array, " d"]) -> Float[Array, ""]:
        """1 / lambda(A | B) + 1 / lambda(B | A), dominated by the smaller; to be minimised."""
        placed = self.space.placed(z)
        value = (1.0 / jnp.maximum(self.lambdas(placed), _NOTHING)).sum()
        return value * self.space.penalty(placed)
