"""Static R-test: at which angles of the rotary axes the sphere is seen, and where it stands."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from ...instruments.follow import carried_apart, followed
from ...instruments.static_r_test import StaticRTest
from ...machine.chain import Chain
from ...model.forward import Model
from ...numerics.arrays import Array
from ..plan_space import Subject, Varied, register
from .points import Placed, PointsDesign, PointSpace, check_bounds

_CLEAR = 0.01
"""Share of a linear axis's travel that a search leaves clear at its ends."""
_WEIGHT = 0.1
"""By what a search counts a plan worse, of which one axis is at the end of its travel."""


class StaticRTestDesign(PointsDesign):
    """Keys of ``[design]`` for ``kind = "static_r_test"``; its points are angles."""

    places: bool = False
    """Whether the sphere, or the probes on the table, may stand elsewhere in every run, within the
    bounds below.
    """
    place_low_mm: tuple[float, float, float] | None = None
    """Lowest place in the frame of the workpiece."""
    place_high_mm: tuple[float, float, float] | None = None
    """Highest place."""

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.places:
            check_bounds("places", "place", self.place_low_mm, self.place_high_mm)
        return self


@register
@dataclass(frozen=True)
class StaticRTestSpace(PointSpace):
    """Angles of the rotary axes within their travel, and places on the table within bounds.

    The linear axes follow what is on the table (`followed`), by which a row stays as far from the
    place of its run as it is in the plan. They may need more travel than there is: `excess` says by
    how much, and `penalty` keeps a search away from that. Directions of travel and other conditions
    of a row stay.
    """

    kind = "static_r_test"
    Settings = StaticRTestDesign
    rotary = True
    lacking = (
        "linear axes that get to the sphere; bring its places nearer to the rotary axes, by the "
        "plan or by design.place_low_mm and design.place_high_mm"
    )

    # --- where it begins ------------------------------------------------------------------------
    @classmethod
    def of(cls, subject: Subject, model: Model, settings: StaticRTestDesign) -> Self:
        chain = subject.chain
        if axis := carried_apart(chain):
            raise subject.refusal(
                "points",
                f"the rotary axis {axis} between linear axes in {chain.text!r}, which turns one "
                "against another",
                "linear axes that stay square to each other, as they follow the sphere",
                "judge plans of your own with `vcal uncertainty`",
            )
        return super().of(subject, model, settings)

    @classmethod
    def stands(cls, subject: Subject, settings: StaticRTestDesign) -> tuple[np.ndarray, np.ndarray]:
        assert isinstance(subject.instrument, StaticRTest)
        places = subject.instrument.places
        low, high = settings.place_low_mm, settings.place_high_mm
        if not settings.places or low is None or high is None:
            return places.ravel(), np.zeros((0, 2))
        return places.ravel(), np.tile(np.column_stack([low, high]) * 1e-3, (len(places), 1))

    def following(self, count: int, varied: Sequence[Varied]) -> Self:
        # On the sphere as it stands since the last run.
        space = super().following(count, varied)
        point = self.place.reshape(-1, 3)[space.runs]
        return dataclasses.replace(
            space, position=np.asarray(followed(self.chain, space.position, point))
        )

    # --- what a point stands for ----------------------------------------------------------------
    @property
    def chosen(self) -> tuple[int, ...]:
        return tuple(i for i, joint in enumerate(self.chain.joints) if joint.turns)

    @property
    def runs(self) -> np.ndarray:
        """Place of every row's run among those of the instrument (n,)."""
        return np.searchsorted(self.device.runs, self.index["run"])

    def reached(
        self, position: Float[Array, "n axes"], station: Float[Array, " s"]
    ) -> Float[Array, "n axes"]:
        off = self.chain.tool_point(self.position) - self.place.reshape(-1, 3)[self.runs]
        return followed(self.chain, position, station.reshape(-1, 3)[self.runs] + off)

    def standing(self, station: Float[Array, " s"]) -> StaticRTest:
        return eqx.tree_at(lambda i: i.places, self.device, station.reshape(-1, 3))

    @classmethod
    def follows(cls, chain: Chain) -> tuple[str, ...]:
        del chain
        return ()

    def following_from(self, placed: Placed) -> Mapping[str, Any]:
        del placed
        return {}

    # --- whether the linear axes get there ------------------------------------------------------
    def excess(self, placed: Placed) -> Float[Array, ""]:
        return self._beyond(placed).max()

    def penalty(self, placed: Placed) -> Float[Array, ""]:
        clear = _CLEAR * np.ptp(self.chain.travel[self._following], axis=1)
        return 1.0 + _WEIGHT * ((self._beyond(placed, clear) / clear) ** 2).sum()

    def _beyond(self, placed: Placed, clear: Any = 0.0) -> Float[Array, "n f"]:
        """By how much the axes that follow stand out of their travel less what is left clear, m."""
        low, high = self.chain.travel[self._following].T
        x = jnp.asarray(placed.position)[:, self._following]
        return jnp.maximum(jnp.maximum(low + clear - x, x - high + clear), 0.0)

    @property
    def _following(self) -> np.ndarray:
        return np.array([i for i in range(len(self.chain.joints)) if i not in self.chosen])
