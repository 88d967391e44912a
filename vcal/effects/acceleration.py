"""Effects of acceleration: a structure that bends while it is being driven.

Below its first mode a machine answers to what its axes do by d = E a + D j + S s, the first terms
of its frequency response times (i omega)^2: a the acceleration, j and s its first and second
derivative in time. Of one mode of the angular frequency w and the damping ratio zeta,
D = -2 zeta/w E and S = -1/w^2 E (1 - 4 zeta^2).
"""

from collections.abc import Iterable, Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np

from ..machine.circles import squared_pace
from ..machine.parameters import Parameter
from ..machine.plan import Plan, of_set
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup
from .registry import register

_LETTERS = "XYZ"


@register
class AccelerationCrosstalk(Effect):
    """Displacement of the tool point in proportion to acceleration, d = E a.

    E is a matrix (um s^2/m): on the diagonal the in-talk, beside it the cross-talk, ``matrix_XZ``
    the displacement along X per acceleration of Z. It is the quasi-static compliance of the
    machine to its own inertial forces, below the first mode: a drive that pushes h beside the
    centre of gravity of a mass m tilts it by m h a/k_phi, k_phi = sum of k_i r_i^2 of its carriages
    (Nguyen, Weikert, Wegener 2012). The acceleration is that of the commanded motion of an axis, on
    whichever side of the bed it is, and the displacement that of the tool against the workpiece.
    """

    name = "acceleration_crosstalk"
    summary = "in-talk and cross-talk: displacements in proportion to acceleration"
    axes: tuple[str, ...] = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"matrix_{i}{j}", "um s2/m", sigma=1.0) for i in _LETTERS for j in self.axes
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"a_{axis}" for axis in self.axes)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {
            (f"tool.{i}", f"matrix_{i}{j}"): plan.covariate(f"a_{j}")
            for i in _LETTERS
            for j in self.axes
        }

    def matrix(self, values: Mapping[str, float]) -> np.ndarray:
        """E (3, axes) from values by parameter."""
        return np.array([[values[f"matrix_{i}{j}"] for j in self.axes] for i in _LETTERS])

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if all(joint.kind == "prismatic" for joint in setup.chain.joints):
            yield cls(axes=setup.chain.axes)


_PACES = 2.0
"""Ratio of omega^2 of the fastest and the slowest circle from which their derivatives differ."""


def paces_differ(plan: Plan, axes: Iterable[str]) -> bool:
    """Whether a plan has circles, of angular velocities that tell apart what goes with position,
    acceleration and the second derivative of that: at one pace all three are the same. Of several
    data sets each has to have circles, of whatever pace.
    """
    if not plan.has(*_motion(axes), *_runs(plan.sets)):
        return False
    squared = np.asarray(_squared_pace(plan, axes))
    return bool(squared.max() > _PACES * squared.min())


def _runs(sets: Iterable[str]) -> list[str]:
    """Groups that number the circles: one in every data set, where there are several."""
    return [of_set(name, "run") for name in sets] or ["run"]


def _motion(axes: Iterable[str]) -> list[str]:
    return [f"{kind}_{axis}" for kind in ("v", "a") for axis in axes]


def _squared_pace(plan: Plan, axes: Iterable[str]) -> Array:
    axes = list(axes)
    columns = ([plan.covariate(f"{kind}_{axis}") for axis in axes] for kind in ("v", "a"))
    v, a = (namespace(*its).stack(its, axis=1) for its in columns)
    # Runs count within one data set. Where there are several, -1 stands in the rows of others.
    numbers = np.stack([np.asarray(plan.groups[name]) for name in _runs(plan.sets)], axis=1)
    _, run = np.unique(numbers, axis=0, return_inverse=True)
    return squared_pace(run.reshape(-1), v, a)


class _Derivative(Effect):
    """Displacement in proportion to a derivative of acceleration on circles.

    It is there only beside `AccelerationCrosstalk`: a correction of what a structure that is stiff
    against its own pace would do. On a circle of angular velocity omega the first derivative of
    the acceleration is -omega^2 v, the second -omega^2 a.
    """

    of: ClassVar[str]
    """Covariate that goes with it on a circle."""
    unit: ClassVar[str]
    sigma: ClassVar[float]
    axes: tuple[str, ...] = eqx.field(static=True)
    sets: tuple[str, ...] = eqx.field(static=True, default=())
    """Data sets with circles, where there are several."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"matrix_{i}{j}", self.unit, sigma=self.sigma)
            for i in _LETTERS
            for j in self.axes
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (*_motion(self.axes), *_runs(self.sets))

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        return tuple(f"{self.of}_{axis}" for axis in self.axes)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        squared = _squared_pace(plan, self.axes)
        columns = {j: -squared * plan.covariate(f"{self.of}_{j}") for j in self.axes}
        return {
            (f"tool.{i}", f"matrix_{i}{j}"): column
            for i in _LETTERS
            for j, column in columns.items()
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        beside = any(effect.name == AccelerationCrosstalk.name for effect in setup.declared)
        axes = setup.chain.axes
        if beside and paces_differ(setup.plan, axes):
            yield cls(axes=axes, sets=setup.plan.sets)


@register
class JerkCrosstalk(_Derivative):
    """Displacement of the tool point in proportion to jerk, d = D j, beside d = E a: the phase by
    which a damped structure is late.

    D is a matrix (nm s^3/m), ``matrix_XZ`` the displacement along X per jerk of Z. It is looked for
    on circles, where j = -omega^2 v.
    """

    name = "jerk_crosstalk"
    summary = "damping of the structure: displacements in proportion to jerk"
    of = "v"
    unit = "nm s3/m"
    sigma = 0.3


@register
class SnapCrosstalk(_Derivative):
    """Displacement of the tool point in proportion to the second derivative of acceleration,
    d = S s, beside d = E a: what a mode near the pace of the motion adds to the quasi-static part.

    S is a matrix (nm s^4/m), ``matrix_XZ`` the displacement along X per snap of Z. It is looked for
    on circles, where s = -omega^2 a.
    """

    name = "snap_crosstalk"
    summary = "first mode of the structure: displacements that grow faster than acceleration"
    of = "a"
    unit = "nm s4/m"
    sigma = 0.01
