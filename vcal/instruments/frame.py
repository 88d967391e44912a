"""The unknown pose of an instrument's frame, as a nuisance."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..effects.base import Effect, Response
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
    """Pose of the instrument's frame from its nominal one: s0 + (X, Y, Z), R0 exp(A, B, C)."""

    name = "station"
    summary = "pose of the instrument's frame"
    kind = "nuisance"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return pose_parameters()

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        one = np.ones(plan.rows)
        return {(f"frame.{c}", c): one for c in COMPONENTS}


def displaced(rotation: Array, origin: Array, twist: Sequence[Scalar]) -> tuple[Rotation, Vector]:
    """A frame after the displacement `twist`: R0 exp(A, B, C) and s0 + (X, Y, Z)."""
    turn = Rotation.of(rotation) @ exp(Vector.of(twist[3:]))
    return turn, Vector.of(origin) + Vector.of(twist[:3])
