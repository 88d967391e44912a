"""Expected error after compensation where the truth has effects that are not fitted.

    found = K (J_t t + n),      e = t - found

t are the amplitudes of the truth, J_t the derivative of the readings by them, n the noise, K the
linear estimate of the fitted amplitudes, and e the remaining error, which is the whole amplitude
where it is not fitted. All t and n are independent, so that the mean square of the volumetric
error, tr(G E E'), is a sum over the effects of the truth and the noise of the readings.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..geometry.volumetric import Gram
from ..identification.posterior import jacobian
from ..machine.plan import Plan
from ..model.forward import Model
from ..model.prior import Amplitudes
from ..numerics.arrays import Array
from ..numerics.normal_draws import standard_normal
from .campaign import virtual_pair
from .linear import sources
from .quantities import Pair


@dataclass(frozen=True)
class Left:
    """Expected error after compensation, m."""

    aligned: Mapping[str, float]
    """Root mean square after the best rigid alignment, m, by effect of the truth and by noise of
    the readings (`vcal.uncertainty.linear.sources`).
    """
    raw: Mapping[str, float]

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square of all sources together, m: aligned and raw."""
        return _root_sum(self.aligned), _root_sum(self.raw)


def fitted_places(pair: Pair) -> Int[np.ndarray, " k"]:
    """Index of every amplitude of the truth among the fitted ones; -1 where it is not fitted."""
    places = {(e.key, e.parameter.name): i for i, e in enumerate(pair.fit.entries)}
    return np.array([places.get((e.key, e.parameter.name), -1) for e in pair.truth.entries], int)


def expected_error(truth: Model, fit: Model, plan: Plan, gram: Gram) -> Left:
    """Expected volumetric error after identification of `fit` from `plan` and compensation.

    Machine and instrument are those of `truth`, and `gram` maps its amplitudes to the mean square
    volumetric error (`volumetric_gram`). Both models have the same chain and instrument. Amplitudes
    in both models need the same prior standard deviation. Random effects of the truth count as
    noise. Raises as `vcal.uncertainty.virtual_pair` does, and `ValueError` for priors that differ
    and for an effect of the machine that only `fit` has, as `gram` has no entry for it.
    """
    pair = virtual_pair(truth, fit, plan)
    gain = _gain(pair)
    found: tuple[dict[str, float], dict[str, float]] = {}, {}
    for name, source in sources(pair).items():
        e = (0.0 if source.parameters is None else source.parameters) - source.through(gain)
        for parts, G in zip(found, gram, strict=True):
            parts[name] = max(float(np.einsum("ai,ab,bi->", e, G, e)), 0.0) ** 0.5
    return Left(*found)


def drawn_errors(
    truth: Model, fit: Model, plan: Plan, gram: Gram, *, draws: int, seed: int
) -> Float[np.ndarray, "draws 2"]:
    """Volumetric errors, aligned and raw, m, of single machines drawn from `truth`.

    Machines and noise are those of `monte_carlo` with the same seed; the estimate is the linear
    one. Raises as `expected_error` does, and `ValueError` for a truth with random effects.
    """
    if truth.random:
        raise ValueError(
            f"truth: found the random effect {truth.random[0].key!r}, expected none, as random "
            "effects are not drawn here; use `monte_carlo`"
        )
    pair = virtual_pair(truth, fit, plan)
    gain, J = _gain(pair), np.asarray(jacobian(truth, plan))
    J = J.reshape(-1, J.shape[-1])
    sigma = np.asarray(pair.simulator.sigma)
    index = np.arange(draws, dtype=np.uint32)
    drawn = _drawn(pair.simulator.amplitudes, jax.random.key(seed), index, sigma.shape)
    theta, noise = map(np.asarray, drawn)
    noise = (noise * sigma).reshape(draws, -1)
    left = theta @ (np.eye(J.shape[1]) - gain @ J).T - noise @ gain.T
    squares = [np.einsum("na,ab,nb->n", left, G, left, optimize=True) for G in gram]
    return np.sqrt(np.maximum(np.stack(squares, 1), 0.0))


@eqx.filter_jit
def _drawn(
    amplitudes: Amplitudes, key: Array, index: Array, shape: tuple[int, ...]
) -> tuple[Float[Array, "draws k"], Float[Array, "draws n m"]]:
    """Machines and noise as drawn by `vcal.model.simulate.draw`."""

    def one(i: Array) -> tuple[Array, Array]:
        machine, noise, _ = jax.random.split(jax.random.fold_in(key, i), 3)
        return amplitudes.sample(machine), standard_normal(noise, shape)

    return jax.vmap(one)(index)


def _gain(pair: Pair) -> Float[np.ndarray, "k r"]:
    """The linear estimate of the truth's amplitudes from the readings; zero where not fitted.

    Raises `ValueError` for priors that differ, and for effects that only the fit has.
    """
    true = {entry.key for entry in pair.truth.entries}
    for effect in pair.fit.effects:
        if effect.kind == "systematic" and effect.where == "machine" and effect.key not in true:
            raise ValueError(
                f"fit: found {effect.key!r}, which the truth lacks, expected the effects of the "
                "truth or fewer; add it to the truth, or use `monte_carlo`"
            )
    known, fitted = fitted_places(pair), pair.fit.entries
    for entry, place in zip(pair.truth.entries, known, strict=True):
        p = entry.parameter
        if place >= 0 and not np.isclose(p.step, fitted[place].parameter.step):
            raise ValueError(
                f"{entry.key}, {p.name}: found different standard deviations in truth and fit, "
                "expected the same prior for an amplitude of both models"
            )
    gain = np.asarray(pair.batch.gain)
    # The last row, with index -1, stands for amplitudes that are not fitted.
    return np.concatenate([gain, np.zeros((1, gain.shape[1]))])[known]


def _root_sum(parts: Mapping[str, float]) -> float:
    return float(np.sqrt(sum(v**2 for v in parts.values())))
