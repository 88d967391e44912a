"""The common space of instruments whose rows are freely placed points."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...bounds import Seconds
from ...identification.posterior import whitened
from ...instruments.base import TableInstrument
from ...machine.chain import Chain
from ...machine.plan import Plan
from ...model.forward import Model
from ...numerics.arrays import Array
from ..plan_space import DesignSettings, PlanSpace, Subject, Varied, path_m

_SHARE = 0.15
"""Scatter of a random start as a share of the travel."""


class PointsDesign(DesignSettings):
    """Keys of ``[design]`` shared by all instruments with free points."""

    points: bool = True
    """Whether the points may be anywhere within the travel."""
    seconds_per_point: Seconds = 10.0
    """Time to measure a point."""


class Placed(NamedTuple):
    """Points with conditions, and the position of the instrument (empty where irrelevant)."""

    position: Float[Array, "n axes"]
    covariates: Mapping[str, Float[Array, " n"]]
    station: Float[Array, " s"]


@dataclass(frozen=True)
class PointSpace(PlanSpace):
    """Positions within the travel of every axis; subclasses define what follows from a position."""

    group = "point"

    chain: Chain
    device: Any
    settings: Any
    position: np.ndarray
    known: Mapping[str, np.ndarray]
    """Recorded covariates (n,), without those that follow from the positions."""
    index: Mapping[str, np.ndarray]
    """Group indices of the rows."""
    numbering: tuple[int, ...]
    place: np.ndarray
    """Position of the instrument, m; empty where irrelevant."""
    room: np.ndarray
    """Bounds (s, 2) of its position; empty for a fixed instrument."""
    varied: tuple[Varied, ...] = ()
    anywhere: bool = False

    # --- definitions of a subclass --------------------------------------------------------------
    @classmethod
    @abc.abstractmethod
    def follows(cls, chain: Chain) -> tuple[str, ...]:
        """Covariates that follow from the positions."""

    @abc.abstractmethod
    def following_from(self, placed: Placed) -> Mapping[str, Float[Array, " n"]]:
        """Values of the covariates that follow from the positions; may be traced."""

    @abc.abstractmethod
    def standing(self, station: Float[Array, " s"]) -> TableInstrument:
        """The instrument at a position; may be traced."""

    @property
    def chosen(self) -> tuple[int, ...]:
        """Columns of the positions that a point chooses freely; all by default."""
        return tuple(range(len(self.chain.axes)))

    def reached(
        self, position: Float[Array, "n axes"], station: Float[Array, " s"]
    ) -> Float[Array, "n axes"]:
        """Positions with the columns that follow from the chosen ones; may be traced."""
        del station
        return position

    @classmethod
    def stands(cls, subject: Subject, settings: Any) -> tuple[np.ndarray, np.ndarray]:
        """Position of the instrument, and the bounds of its position."""
        del subject, settings
        return np.zeros(0), np.zeros((0, 2))

    # --- construction ---------------------------------------------------------------------------
    @classmethod
    def of(cls, subject: Subject, model: Model, settings: Any) -> Self:
        chain, plan = subject.chain, subject.plan
        for joint in chain.joints:
            if not np.isfinite(np.asarray(joint.travel)).all():
                raise subject.refusal(
                    "points", f"axis {joint.name} without bounds", "bounds of every axis",
                    "declare its travel",
                )  # fmt: skip
        place, room = cls.stands(subject, settings)
        own = {*cls.follows(chain)}
        known = {n: np.asarray(v) for n, v in plan.covariates.items() if n not in own}
        index = {name: np.asarray(values) for name, values in plan.groups.items()}
        return cls(
            chain=chain,
            device=subject.instrument,
            settings=settings,
            position=np.asarray(plan.position),
            known=known,
            index=index,
            numbering=_numbers(index, cls.group, plan.rows),
            place=place,
            room=room,
        )

    def following(self, count: int, varied: Sequence[Varied]) -> Self:
        index = {}
        for name, values in self.index.items():
            fresh = len(np.unique(values)) == len(values)
            index[name] = (
                values.max() + 1 + np.arange(count) if fresh else np.full(count, values[-1])
            )
        first = max(self.numbering) + 1
        return dataclasses.replace(
            self,
            settings=self.settings.model_copy(update={"points": True}),
            position=np.tile(self.chain.travel.mean(1), (count, 1)),
            known={name: np.full(count, values[-1]) for name, values in self.known.items()},
            index=index,
            numbering=tuple(range(first, first + count)),
            room=np.zeros((0, 2)),
            varied=tuple(varied),
            anywhere=True,
        )

    @property
    def taken(self) -> bool:
        return True  # measured plans are recognised by their readings

    # --- numbers within bounds: shares of the travel and of the room, then conditions -------------
    @property
    def low(self) -> Float[np.ndarray, " d"]:
        return np.concatenate([np.zeros(self._placed_numbers), self._ends(0)])

    @property
    def high(self) -> Float[np.ndarray, " d"]:
        return np.concatenate([np.ones(self._placed_numbers), self._ends(1)])

    @property
    def start(self) -> Float[np.ndarray, " d"]:
        parts = []
        if self.settings.points:
            low, high = self._chosen_travel().T
            parts.append(((self.position[:, self.chosen] - low) / (high - low)).ravel())
        if len(self.room):
            parts.append((self.place - self.room[:, 0]) / np.ptp(self.room, axis=1))
        parts.append(0.5 * (self._ends(0) + self._ends(1)))
        return np.clip(np.concatenate(parts), self.low, self.high)

    def scattered(self, key: Array) -> Float[np.ndarray, " d"]:
        width = self.high - self.low
        if self.anywhere:
            return self.low + width * np.array(jax.random.uniform(key, (len(width),)))
        drawn = np.array(jax.random.normal(key, (len(width),)))
        return np.clip(self.start + _SHARE * width * drawn, self.low, self.high)

    # --- the placed measurement -----------------------------------------------------------------
    @property
    def nominal(self) -> Placed:
        return Placed(self.position, self.known, self.place)  # type: ignore[arg-type]

    def placed(self, z: Float[Array, " d"]) -> Placed:
        n = len(self.numbering)
        position, station = jnp.asarray(self.position), jnp.asarray(self.place)
        used = 0
        if self.settings.points:
            low, high = self._chosen_travel().T
            used = n * len(self.chosen)
            shares = z[:used].reshape(n, -1)
            position = position.at[:, np.array(self.chosen)].set(low + (high - low) * shares)
        if len(self.room):
            shares = z[used : used + len(self.room)]
            station = self.room[:, 0] + np.ptp(self.room, axis=1) * shares
            used += len(self.room)
        covariates = dict(self.known)
        for varied, values in zip(self.varied, z[used:].reshape(-1, n), strict=True):
            covariates[varied.name] = values
        return Placed(self.reached(position, station), covariates, station)

    def excess(self, placed: Placed) -> Float[Array, ""]:
        return jnp.zeros(())

    def settled(self, placed: Placed) -> Placed:
        covariates = dict(placed.covariates)
        for v in self.varied:
            if v.step:
                up = np.asarray(covariates[v.name]) >= 0.5 * (v.low + v.high)
                covariates[v.name] = np.where(up, v.high, v.low)
        return placed._replace(covariates=covariates)

    # --- information ----------------------------------------------------------------------------
    @property
    def groups(self) -> tuple[int, ...]:
        return self.numbering

    def information(
        self, placed: Placed, model: Model, weights: Float[Array, " g"]
    ) -> Float[Array, "k+s k+s"]:
        instrument = self.standing(placed.station)
        plan = self._plan(placed)
        whole = Model(
            model.chain, instrument, (*model.effects, *instrument.effects(plan), *model.random)
        )
        J = whitened(whole, plan)
        weighed = J * weights[:, None, None]
        return weighed.reshape(-1, J.shape[-1]).T @ J.reshape(-1, J.shape[-1])

    @property
    def shared(self) -> Float[np.ndarray, "s s"]:
        effects = self.device.effects(self._plan(self.nominal))
        every = (e for e in effects if e.kind != "random")
        return np.diag([float(p.informed) for e in every for p in e.amplitudes])

    # --- output ---------------------------------------------------------------------------------
    def instrument(self, placed: Placed) -> TableInstrument:
        return self.standing(np.asarray(placed.station))  # type: ignore[arg-type]

    def plan(self, placed: Placed) -> Plan:
        plan = self._plan(placed)
        covariates = {name: np.asarray(values) for name, values in plan.covariates.items()}
        return Plan(plan.axes, np.asarray(plan.position), covariates, plan.groups)

    def seconds(self, placed: Placed) -> float:
        s, position = self.settings, np.asarray(placed.position)
        # Rotary axes move during linear travel; only an arm needs time for its rotations.
        linear = [i for i, joint in enumerate(self.chain.joints) if not joint.turns]
        way = path_m(position[:, linear] if linear else position) * s.seconds_per_metre
        return float(len(self.numbering) * s.seconds_per_point + way)

    def _plan(self, placed: Placed) -> Plan:
        covariates = {**placed.covariates, **self.following_from(placed)}
        return Plan(self.chain.axes, placed.position, covariates, self.index)

    def _chosen_travel(self) -> np.ndarray:
        return self.chain.travel[np.array(self.chosen)]

    def _ends(self, which: int) -> np.ndarray:
        ends = [(v.low, v.high)[which] for v in self.varied]
        return np.repeat(np.array(ends, float), len(self.numbering))

    @property
    def _placed_numbers(self) -> int:
        points = len(self.numbering) * len(self.chosen)
        return self.settings.points * points + len(self.room)


def check_bounds(
    key: str, name: str, low: Sequence[float] | None, high: Sequence[float] | None
) -> None:
    """Raise `ValueError` where bounds of a position, mm, are missing or exchanged.

    `key` is the key that requires them, `name` the start of their own keys.
    """
    if low is None or high is None:
        raise ValueError(
            f"found {key} = true without bounds, expected {name}_low_mm and {name}_high_mm; "
            "add both"
        )
    for c, a, b in zip("xyz", low, high, strict=True):
        if not a < b:
            raise ValueError(
                f"found {name}_low_mm {a:g} and {name}_high_mm {b:g} in {c}, expected the first "
                "below the second; exchange or correct them"
            )


def _numbers(index: Mapping[str, np.ndarray], name: str, rows: int) -> tuple[int, ...]:
    """The numbers of the points in the data where they differ; otherwise counted from zero."""
    own = index.get(name, np.arange(rows))
    return tuple(own.tolist()) if len(np.unique(own)) == rows else tuple(range(rows))
