"""The space of a static R-test: angles of the rotary axes, and positions of the sphere."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from ...bounds import Coordinate
from ...instruments.follow import carried_apart, followed
from ...instruments.static_r_test import StaticRTest
from ...machine.chain import Chain
from ...model.forward import Model
from ...numerics.arrays import Array
from ..plan_space import Subject, Varied, beyond_m, register
from .points import Placed, PointsDesign, PointSpace, check_bounds

_CLEAR = 0.01
"""Share of the travel of a linear axis that a search keeps clear at its ends."""
_WEIGHT = 0.1
"""Penalty of a plan with one axis at the end of its travel."""


class StaticRTestDesign(PointsDesign):
    """Keys of ``[design]`` for ``kind = "static_r_test"``; its points are angles."""

    places: bool = False
    """Whether the position of the sphere, or of the probes on the table, varies in every run,
    within the bounds below.
    """
    place_low_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Lowest coordinates of the position in the workpiece frame."""
    place_high_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Highest coordinates of the position in the workpiece frame."""

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.places:
            check_bounds("places", "place", self.place_low_mm, self.place_high_mm)
        return self


@register
@dataclass(frozen=True)
class StaticRTestSpace(PointSpace):
    """Angles of the rotary axes within their travel, and positions on the table within bounds.

    The linear axes follow the object on the table (`followed`), so that a row keeps its distance
    from the position of its run. They may exceed their travel: `excess` is the amount, and
    `penalty` keeps a search away from it. Directions of travel and other conditions of a row are
    fixed.
    """

    kind = "static_r_test"
    Settings = StaticRTestDesign
    rotary = True
    lacking = (
        "linear axes that reach the sphere; move its positions closer to the rotary axes, in the "
        "plan or by design.place_low_mm and design.place_high_mm"
    )

    # --- construction ---------------------------------------------------------------------------
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
        # The sphere stays at its position of the last run.
        space = super().following(count, varied)
        point = self.place.reshape(-1, 3)[space.runs]
        return dataclasses.replace(
            space, position=np.asarray(followed(self.chain, space.position, point))
        )

    # --- the placed measurement -----------------------------------------------------------------
    @property
    def chosen(self) -> tuple[int, ...]:
        return tuple(i for i, joint in enumerate(self.chain.joints) if joint.turns)

    @property
    def runs(self) -> np.ndarray:
        """Index of the run of every row among those of the instrument (n,)."""
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

    # --- travel of the linear axes --------------------------------------------------------------
    def excess(self, placed: Placed) -> Float[Array, ""]:
        return self._beyond(placed).max()

    def penalty(self, placed: Placed) -> Float[Array, ""]:
        clear = _CLEAR * np.ptp(self.chain.travel[self._following], axis=1)
        return 1.0 + _WEIGHT * ((self._beyond(placed, clear) / clear) ** 2).sum()

    def _beyond(self, placed: Placed, clear: Any = 0.0) -> Float[Array, "n f"]:
        """Distance by which the following axes exceed their travel minus the clearance, m."""
        x = jnp.asarray(placed.position)[:, self._following]
        return beyond_m(self.chain.travel[self._following], x, clear)

    @property
    def _following(self) -> np.ndarray:
        return np.array([i for i in range(len(self.chain.joints)) if i not in self.chosen])
