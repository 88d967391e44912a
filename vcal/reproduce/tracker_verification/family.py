"""The family of machines with the printed initial error, and what the points can see of it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from ...identification.batch import Batch, prepare_batch
from ...model.forward import Model, tool_columns
from ...model.port_map import port_map
from ...numerics.arrays import Array
from .setting import Family, Setting, machine

_MACHINES = 12_000
_LEVERS = (0.5, 50.0)
"""Rotations in urad per um of translations: between these the spread is searched."""


@dataclass(frozen=True)
class Search:
    """A family, and how its initial error came out on the machines it was searched with."""

    family: Family
    mean_um: float
    sd_um: float
    machines: int
    spread_range: tuple[float, float]
    """Standard deviation over mean at both ends of the search: what the family can meet."""


def find_family(
    setting: Setting, mean_um: float, sd_um: float, seed: int = 0, machines: int = _MACHINES
) -> Search:
    """Sizes for which |d| over all points and machines has this mean and standard deviation.

    Two searches in one dimension, with the same standard normal draws throughout: sd / mean depends
    on the size of rotations over that of translations only (as far as errors are small), so that
    ratio is found first, and then the scale from the mean. Raises `ValueError` where no ratio gives
    that spread.
    """
    lengths = _Lengths(setting, machines, seed)
    wanted = sd_um / mean_um

    def spread(lever: float) -> float:
        size = lengths(Family(1.0, lever))
        return float(size.std() / size.mean())

    ends = spread(_LEVERS[0]), spread(_LEVERS[1])
    if not min(ends) < wanted < max(ends):
        raise ValueError(
            f"found a spread of {wanted:.3f} of the mean, expected one between {ends[0]:.3f} and "
            f"{ends[1]:.3f}, as this family of machines can have; choose other degrees"
        )
    lever = _root(lambda v: spread(v) - wanted, *_LEVERS, 1e-4)
    one = Family(1.0, lever)
    guess = mean_um / float(lengths(one).mean())
    scale = _root(
        lambda s: float(lengths(one.times(s)).mean()) - mean_um, 0.9 * guess, 1.1 * guess, 1e-6
    )
    found = lengths(one.times(scale))
    return Search(one.times(scale), float(found.mean()), float(found.std()), machines, ends)


def _root(f: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    found: Any = brentq(f, low, high, xtol=tolerance)
    return float(found)


class _Lengths:
    """|d| in um of a number of machines at all points, as a function of the family."""

    def __init__(self, setting: Setting, machines: int, seed: int):
        self.setting = setting
        model = machine(setting, Family(1.0, 1.0))
        parameters = [e.parameter for e in model.entries]
        self.turns = np.array([p.unit == "urad" for p in parameters])
        ports = port_map(model, setting.points)
        position, chain = setting.positions, model.chain
        nominal = jnp.stack(tool_columns(chain, position, [0.0] * len(model.layout)), -1)

        def length(theta: Float[Array, " k"]) -> Float[Array, " n"]:
            d = jnp.stack(tool_columns(chain, position, ports(theta)), -1) - nominal
            return jnp.linalg.norm(d, axis=-1)

        self.map = eqx.filter_jit(lambda theta: jax.lax.map(length, theta, batch_size=125))
        self.draws = jax.random.normal(jax.random.key(seed), (machines, len(parameters)))

    def __call__(self, family: Family) -> Float[np.ndarray, "machines n"]:
        sizes = np.where(self.turns, family.rotation_urad, family.translation_um)
        return np.asarray(self.map(self.draws * sizes)) / 1e-6


_ZERO = 1e-9
"""Singular values and columns below this share of the largest are rounding errors."""


@dataclass(frozen=True)
class Seen:
    """One error motion or squareness, and what the points say of it."""

    name: str
    coefficients: int
    share: float
    """Least of the information on a coefficient that comes from the data, 0 to 1."""
    most: float
    """Most of it."""
    silent: int
    """Coefficients that change no reading."""


@dataclass(frozen=True)
class Rank:
    """Rank of the whitened Jacobian at the nominal machine."""

    parameters: int
    rank: int
    singular: Float[np.ndarray, " k"]
    """Singular values, in prior standard deviations of the machines per standard deviation of the
    readings.
    """
    motions: tuple[Seen, ...]

    @property
    def silent(self) -> int:
        """Coefficients that change no reading at all."""
        return sum(m.silent for m in self.motions)


def rank_of(setting: Setting, family: Family) -> Rank:
    """Rank, singular values and what is seen of every error motion."""
    model = machine(setting, family)
    batch = prepare_batch(model, setting.plan)
    jacobian = np.asarray(batch.jacobian)
    singular = np.linalg.svd(jacobian, compute_uv=False)
    rank = int((singular > _ZERO * singular[0]).sum())
    return Rank(jacobian.shape[1], rank, singular, _motions(model, batch))


def _motions(model: Model, batch: Batch) -> tuple[Seen, ...]:
    names = [e.parameter.name.split(".")[0] for e in model.entries]
    length = np.linalg.norm(np.asarray(batch.jacobian), axis=0)
    share = 1.0 - np.diag(np.asarray(batch.inverse))
    found = []
    for name in dict.fromkeys(names):
        own = np.array([n == name for n in names])
        silent = int((length[own] <= _ZERO * length.max()).sum())
        silent_all = silent == own.sum()
        least, most = (0.0, 0.0) if silent_all else (share[own].min(), share[own].max())
        found.append(Seen(name, int(own.sum()), float(least), float(most), silent))
    return tuple(found)
