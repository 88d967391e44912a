"""The unknown pose of an instrument's frame, as a nuisance."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from ..effects.base import Effect, Response
from ..effects.station import at_station
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector, exp


def pose_parameters(prefix: str = "") -> tuple[Parameter, ...]:
    """Six parameters of a pose with flat priors; the solver's unit is 1 mm or 1 mrad."""
    return tuple(
        Parameter(f"{prefix}{c}", "um" if c in "XYZ" else "urad", scale=1000.0) for c in COMPONENTS
    )


class Station(Effect):
    """Pose of the instrument's frame from its nominal one: s0 + (X, Y, Z), R0 exp(A, B, C).

    An instrument at several stations has one such effect for each, in the rows of that station.
    """

    name = "station"
    summary = "pose of the instrument's frame"
    kind = "nuisance"
    where = "instrument"
    components: str = eqx.field(static=True, default="XYZABC")
    """The components that are unknown: ``"XYZ"`` of an instrument that reads distances only."""
    number: int = eqx.field(static=True, default=-1)
    """Index of the station in the group ``"station"``; -1 where there is only one."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(p for p in pose_parameters() if p.name in self.components)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        one = at_station(plan, self.number)
        return {(f"frame.{c}", c): one for c in self.components}

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        return at_station(plan, self.number) > 0.0


def displaced(rotation: Array, origin: Array, twist: Sequence[Scalar]) -> tuple[Rotation, Vector]:
    """A frame after the displacement `twist`: R0 exp(A, B, C) and s0 + (X, Y, Z)."""
    turn = Rotation.of(rotation) @ exp(Vector.of(twist[3:]))
    return turn, Vector.of(origin) + Vector.of(twist[:3])
