"""Draws from the priors of a model: the population of machines and instruments.

    theta = (X - mean) / std, X ~ prior

in solver units, so that a normal prior gives a standard normal number z. Other distributions follow
from such a number by x(z) = F^-1(Phi(z)). A change of the distribution of one parameter therefore
does not change the draws of the others.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from ..distributions import Distribution, Normal, Univariate
from ..distributions.matrix import square_root
from ..effects.base import Effect
from ..machine.plan import Plan
from ..numerics.arrays import Array
from .forward import Model


class DrawnShape(eqx.Module):
    """The prior of one shape parameter: declared, or uniform in the coordinate of its scan."""

    effect: int = eqx.field(static=True)
    index: int = eqx.field(static=True)
    name: str = eqx.field(static=True)
    coordinate: str = eqx.field(static=True)
    si: float = eqx.field(static=True)
    low: Float[Array, ""]
    high: Float[Array, ""]
    law: Univariate | None

    def sample(self, key: PRNGKeyArray) -> Float[Array, ""]:
        """A value (SI), from the key of the machine or instrument."""
        own = jax.random.fold_in(jax.random.fold_in(key, self.effect), 1)
        return self._at(jax.random.uniform(jax.random.fold_in(own, self.index)))

    @property
    def middle(self) -> Float[Array, ""]:
        """The median (SI)."""
        return self._at(jnp.asarray(0.5))

    def _at(self, share: Float[Array, ""]) -> Float[Array, ""]:
        if self.law is not None:
            return self.si * self.law.inverse(share, 1.0 - share)
        _, back = _COORDINATES[self.coordinate]
        return back(self.low + (self.high - self.low) * share)


_COORDINATES = {
    "linear": (lambda v: v, lambda v: v),
    "reciprocal": (lambda v: 1.0 / v, lambda v: 1.0 / v),
    "log": (jnp.log, jnp.exp),
}


def drawn_shapes(model: Model, plan: Plan) -> tuple[DrawnShape, ...]:
    """Priors of the shape parameters of a model that are not declared."""
    found = []
    for i, effect in enumerate(model.effects):
        declared = {name for name, *_ in effect.given}
        grids = effect.scan(plan) if effect.shapes else {}
        for k, p in enumerate(effect.shapes):
            if p.name not in declared:
                there, _ = _COORDINATES[p.coordinate]
                ends = there(jnp.asarray(grids[p.name], float))
                found.append(
                    DrawnShape(i, k, p.name, p.coordinate, p.si, ends.min(), ends.max(), p.law)
                )
    return tuple(found)


class _Alike(eqx.Module):
    """Amplitudes whose standardised distributions belong to one family."""

    place: tuple[int, ...] = eqx.field(static=True)
    """Positions of the amplitudes."""
    laws: Univariate
    """Their distributions; every parameter of these is an array over the amplitudes."""


class _Joint(eqx.Module):
    """Amplitudes of one effect that have a joint distribution."""

    effect: int = eqx.field(static=True)
    index: int = eqx.field(static=True)
    place: tuple[int, ...] = eqx.field(static=True)
    law: Distribution

    @property
    def std(self) -> Float[Array, " d"]:
        """Standard deviations (d,) of the amplitudes; one for an amplitude without variance."""
        variance = jnp.diagonal(self.law.covariance)
        return jnp.sqrt(jnp.where(variance > 0.0, variance, 1.0))


class Amplitudes(eqx.Module):
    """The prior of the amplitudes of some effects, in units of its standard deviations."""

    counts: tuple[int, ...] = eqx.field(static=True)
    """Number of amplitudes per effect."""
    informed: Float[Array, " k"]
    """One for an amplitude with a proper prior; zero for a flat prior: the amplitude is nominal."""
    alike: tuple[_Alike, ...]
    joint: tuple[_Joint, ...]

    @classmethod
    def of(cls, effects: Sequence[Effect]) -> "Amplitudes":
        """The prior of these effects, in their order."""
        groups: dict[Any, list[tuple[int, Univariate]]] = {}
        joint, counts, informed, start = [], [], [], 0
        for i, effect in enumerate(effects):
            own = effect.amplitudes
            for k, p in enumerate(own, start):
                if p.law is not None and not isinstance(p.law, Normal):
                    kind = jax.tree.structure(p.law), tuple(map(np.shape, jax.tree.leaves(p.law)))
                    groups.setdefault(kind, []).append((k, p.law))
            place = {p.name: k for k, p in enumerate(own, start)}
            for j, prior in enumerate(effect.priors):
                if not isinstance(prior.distribution, Univariate):
                    at = tuple(place[name] for name in prior.names)
                    joint.append(_Joint(i, j, at, prior.distribution))
            informed += [float(p.informed) for p in own]
            counts.append(len(own))
            start += len(own)
        alike = tuple(
            _Alike(
                tuple(k for k, _ in group),
                jax.tree.map(lambda *leaves: jnp.stack(leaves), *(law for _, law in group)),
            )
            for group in groups.values()
        )
        return cls(tuple(counts), jnp.asarray(informed, float), alike, tuple(joint))

    @property
    def root(self) -> Float[np.ndarray, "k k"]:
        """A (k, k) with A A' the covariance of the draws.

        It is the identity except for joint distributions and flat priors.
        """
        found = np.diag(np.asarray(self.informed))
        for part in self.joint:
            own = square_root(np.asarray(part.law.covariance))
            found[np.ix_(part.place, part.place)] = own / np.asarray(part.std)[:, None]
        return found

    def sample(self, key: PRNGKeyArray) -> Float[Array, " k"]:
        """One draw (k,); every effect has its own key, by its position."""
        drawn = [
            jax.random.normal(jax.random.fold_in(key, i), (count,))
            for i, count in enumerate(self.counts)
        ]
        return self.of_scores(jnp.concatenate(drawn), key) if drawn else jnp.zeros(0)

    def of_scores(self, score: Float[Array, " k"], key: PRNGKeyArray) -> Float[Array, " k"]:
        """The draw (k,) of independent standard normal numbers; of a key, where distributions are
        joint.
        """
        theta = self.shaped(score)
        for part in self.joint:
            own = jax.random.fold_in(jax.random.fold_in(key, part.effect), 2)
            law = part.law
            x = law.sample(jax.random.fold_in(own, part.index)) - law.mean
            theta = jnp.asarray(theta).at[np.array(part.place)].set(x / part.std)
        return self.informed * theta

    def shaped(self, score: Float[Array, "... k"]) -> Float[Array, "... k"]:
        """Draws of (X - mean) / std of every amplitude from independent standard normal numbers."""
        for part in self.alike:
            at = np.array(part.place)
            own = jax.vmap(_from_score, in_axes=(0, -1), out_axes=-1)(part.laws, score[..., at])
            score = jnp.asarray(score).at[..., at].set(own)
        return score


def _from_score(law: Univariate, score: Float[Array, "..."]) -> Float[Array, "..."]:
    return (law.from_score(score) - law.mean) / law.std
