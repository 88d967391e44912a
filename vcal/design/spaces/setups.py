"""The common space of instruments whose rows belong to set-ups with unknowns of their own."""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ...effects.base import Effect
from ...identification.posterior import eliminated, whitened
from ...instruments.base import TableInstrument
from ...machine.chain import Chain
from ...machine.plan import Plan
from ...model.forward import Model
from ...numerics.arrays import Array
from ..plan_space import PlanSpace, Varied

LOOSE_M = 1e-2
"""Standard deviation of the position of an artefact without any other knowledge: coordinates that
the readings of a set-up do not show have no other information."""
_SHARE = 0.15
"""Scatter of a random start as a share of the range of a number."""
_OTHER = 0.3
"""Share of the choices that a random start makes anew."""


class Block(NamedTuple):
    """Numbers of a vector of a space that belong together, with their bounds."""

    start: Float[np.ndarray, "..."]
    """Those of the present plan, of any shape."""
    low: float = 0.0
    high: float = 1.0
    levels: int = 0
    """Number of the choices 0, 1, ..., of which each number is one; 0 for continuous numbers."""


class Own(NamedTuple):
    """The unknowns of the instrument in a space of set-ups."""

    shared: tuple[Effect, ...]
    """Those that all set-ups have in common."""
    setup: tuple[Effect, ...]
    """Those of every set-up, which no other one contains."""
    columns: Int[np.ndarray, "s u"]
    """Place of the unknowns of every set-up among the parameters of `setup`."""
    loose: Float[np.ndarray, "u u"]
    """Their prior precision, in solver units: nearly nothing."""


@dataclass(frozen=True)
class SetupSpace(PlanSpace):
    """Set-ups whose rows stay together; subclasses define what may vary in them."""

    group = "setup"

    chain: Chain
    device: Any
    settings: Any
    position: Float[np.ndarray, "n axes"]
    """Positions of the present plan."""
    known: Mapping[str, np.ndarray]
    """Recorded covariates (n,), without those that follow from the positions."""
    setup: Int[np.ndarray, " n"]
    """Index of the set-up of every row, in `numbers`."""
    numbers: tuple[int, ...]
    varied: tuple[Varied, ...] = ()
    anywhere: bool = False

    # --- definitions of a subclass --------------------------------------------------------------
    @property
    @abc.abstractmethod
    def blocks(self) -> Mapping[str, Block]:
        """What may vary, by name; the order is that of a vector. Empty blocks are allowed."""

    @abc.abstractmethod
    def at(self, values: Mapping[str, Array], conditions: Mapping[str, Array]) -> Any:
        """The placed measurement of the `values` of the blocks, with `conditions` (n,) in addition
        to the recorded ones; may be traced.
        """

    @property
    @abc.abstractmethod
    def own(self) -> Own:
        """The unknowns of the instrument."""

    @abc.abstractmethod
    def seen_by(self, placed: Any) -> tuple[TableInstrument, Plan]:
        """The instrument and the plan whose derivatives count; may be traced."""

    # --- numbers within bounds ------------------------------------------------------------------
    @property
    def low(self) -> Float[np.ndarray, " d"]:
        return self._every(lambda b: b.low, lambda v: v.low)

    @property
    def high(self) -> Float[np.ndarray, " d"]:
        return self._every(lambda b: b.high, lambda v: v.high)

    @property
    def levels(self) -> Int[np.ndarray, " d"]:
        return self._every(lambda b: b.levels, lambda _: 0).astype(int)

    @property
    def start(self) -> Float[np.ndarray, " d"]:
        middle = [np.full(len(self.numbers), 0.5 * (v.low + v.high)) for v in self.varied]
        own = [np.ravel(b.start) for b in self.blocks.values()]
        return np.clip(np.concatenate([*own, *middle, []]), self.low, self.high)

    def scattered(self, key: Array) -> Float[np.ndarray, " d"]:
        keys = jax.random.split(key, 3)
        levels, start, width = self.levels, self.start, self.high - self.low
        share = np.array(jax.random.uniform(keys[0], (len(width),)))
        choice = np.minimum(np.floor(share * levels), levels - 1)
        if self.anywhere:
            return np.where(levels > 0, choice, self.low + share * width)
        anew = np.array(jax.random.uniform(keys[1], (len(width),))) < _OTHER
        moved = start + _SHARE * width * np.array(jax.random.normal(keys[2], (len(width),)))
        drawn = np.where(levels > 0, np.where(anew, choice, start), moved)
        return np.clip(drawn, self.low, self.high)

    def placed(self, z: Float[Array, " d"]) -> Any:
        values, used = {}, 0
        for name, block in self.blocks.items():
            part = z[used : used + block.start.size].reshape(block.start.shape)
            values[name] = jnp.round(part).astype(int) if block.levels else part
            used += block.start.size
        each = z[used:].reshape(len(self.varied), len(self.numbers))
        return self.at(
            values, {v.name: row[self.setup] for v, row in zip(self.varied, each, strict=True)}
        )

    def settled(self, placed: Any) -> Any:
        covariates = dict(placed.covariates)
        for v in self.varied:
            if v.step:
                up = np.asarray(covariates[v.name]) >= 0.5 * (v.low + v.high)
                covariates[v.name] = np.where(up, v.high, v.low)
        return placed._replace(covariates=covariates)

    # --- information ----------------------------------------------------------------------------
    @property
    def groups(self) -> tuple[int, ...]:
        return self.numbers

    @property
    def taken(self) -> bool:
        return True  # measured plans are recognised by their readings

    @property
    def rows(self) -> Sequence[Int[np.ndarray, " m"]]:
        """Rows of every set-up."""
        return [np.flatnonzero(self.setup == k) for k in range(len(self.numbers))]

    def information(
        self, placed: Any, model: Model, weights: Float[Array, " g"]
    ) -> Float[Array, "k+s k+s"]:
        own, (instrument, plan) = self.own, self.seen_by(placed)
        effects = (*model.effects, *own.shared, *own.setup, *model.random)
        J = whitened(Model(model.chain, instrument, effects), plan)
        kept = J.shape[-1] - own.columns.size
        flat, total = jnp.zeros((kept, kept)), jnp.zeros((kept, kept))
        for rows, columns, weight in zip(self.rows, own.columns, weights, strict=True):
            order = np.concatenate([np.arange(kept), kept + columns])
            part = J[rows].reshape(-1, J.shape[-1])[:, order]
            total = total + weight * eliminated(part.T @ part, flat, jnp.asarray(own.loose))
        return total

    @property
    def shared(self) -> Float[np.ndarray, "s s"]:
        return np.diag([float(p.informed) for e in self.own.shared for p in e.amplitudes])

    # --- parts ----------------------------------------------------------------------------------
    def _every(self, of_block: Any, of_varied: Any) -> np.ndarray:
        own = [np.full(b.start.size, of_block(b), float) for b in self.blocks.values()]
        more = [np.full(len(self.numbers), of_varied(v), float) for v in self.varied]
        return np.concatenate([*own, *more, []])
