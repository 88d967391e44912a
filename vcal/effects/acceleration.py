"""Effects of acceleration: a structure that bends while it is driven.

Below its first mode, the response of a machine to the motion of its axes is d = E a + D j + S s,
the first terms of its frequency response times (i omega)^2: a is the acceleration, j and s are its
first and second derivatives in time. For one mode of the angular frequency w and the damping ratio
zeta, D = -2 zeta/w E and S = -1/w^2 E (1 - 4 zeta^2).
"""

import abc
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


class _Crosstalk(Effect):
    """Base class of displacements of the tool point by a matrix times a derivative of the motion of
    the axes: d_i = sum_j M_ij u_j.
    """

    unit: ClassVar[str]
    """Unit of the matrix."""
    sigma: ClassVar[float]
    """Prior standard deviation of its elements."""
    axes: tuple[str, ...] = eqx.field(static=True)

    @abc.abstractmethod
    def columns(self, plan: Plan) -> Mapping[str, Array]:
        """The derivative u of every axis, SI (n,)."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"matrix_{i}{j}", self.unit, sigma=self.sigma)
            for i in _LETTERS
            for j in self.axes
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        columns = self.columns(plan)
        return {(f"tool.{i}", f"matrix_{i}{j}"): columns[j] for i in _LETTERS for j in self.axes}


@register
class AccelerationCrosstalk(_Crosstalk):
    """Displacement of the tool point in proportion to acceleration, d = E a.

    E is a matrix (um s^2/m) with the in-talk on its diagonal and the cross-talk off it:
    ``matrix_XZ`` is the displacement along X per acceleration of Z. It is the quasi-static
    compliance of the machine to its own inertial forces, below the first mode: a drive that pushes
    at a distance h from the centre of gravity of a mass m tilts it by m h a/k_phi, k_phi = sum of
    k_i r_i^2 of its carriages (Nguyen, Weikert, Wegener 2012). The acceleration is that of the
    commanded motion of an axis on either side of the bed, the displacement that of the tool against
    the workpiece.
    """

    name = "acceleration_crosstalk"
    summary = "in-talk and cross-talk: displacements in proportion to acceleration"
    remedy = (
        "Check the stiffness of the drive train, the bearings and the guideways across the "
        "motion, and where the scale sits relative to the tool; lower the acceleration, or use "
        "the control's cross-talk compensation where it has one."
    )
    unit = "um s2/m"
    sigma = 1.0

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"a_{axis}" for axis in self.axes)

    def columns(self, plan: Plan) -> Mapping[str, Array]:
        return {j: plan.covariate(f"a_{j}") for j in self.axes}

    def matrix(self, values: Mapping[str, float]) -> np.ndarray:
        """E (3, axes) from values by parameter."""
        return np.array([[values[f"matrix_{i}{j}"] for j in self.axes] for i in _LETTERS])

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if all(joint.kind == "prismatic" for joint in setup.chain.joints):
            yield cls(axes=setup.chain.axes)


_PACES = 2.0
"""Least ratio of omega^2 of the fastest and the slowest circle that separates the derivatives."""


def paces_differ(plan: Plan, axes: Iterable[str]) -> bool:
    """Whether a plan has circles whose angular velocities separate the effects of position,
    acceleration and its second derivative: at one angular velocity, all three are proportional.
    Where there are several data sets, each must have circles, of any angular velocity.
    """
    if not plan.has(*_motion(axes), *_runs(plan.sets)):
        return False
    squared = np.asarray(_squared_pace(plan, axes))
    return bool(squared.max() > _PACES * squared.min())


def _runs(sets: Iterable[str]) -> list[str]:
    """Groups that number the circles: one for every data set, where there are several."""
    return [of_set(name, "run") for name in sets] or ["run"]


def _motion(axes: Iterable[str]) -> list[str]:
    return [f"{kind}_{axis}" for kind in ("v", "a") for axis in axes]


def _squared_pace(plan: Plan, axes: Iterable[str]) -> Array:
    axes = list(axes)
    columns = ([plan.covariate(f"{kind}_{axis}") for axis in axes] for kind in ("v", "a"))
    v, a = (namespace(*its).stack(its, axis=1) for its in columns)
    # Runs are numbered within one data set; with several, the rows of the others hold -1.
    numbers = np.stack([np.asarray(plan.groups[name]) for name in _runs(plan.sets)], axis=1)
    _, run = np.unique(numbers, axis=0, return_inverse=True)
    return squared_pace(run.reshape(-1), v, a)


class _Derivative(_Crosstalk):
    """Base class of displacements in proportion to a derivative of acceleration on circles.

    It is a candidate only where `AccelerationCrosstalk` is in the model: it corrects the response
    of a structure without dynamics. On a circle of angular velocity omega, the first derivative of
    the acceleration is -omega^2 v, the second -omega^2 a.
    """

    of: ClassVar[str]
    """Covariate to which the derivative is proportional on a circle."""
    sets: tuple[str, ...] = eqx.field(static=True, default=())
    """Data sets with circles, where there are several."""

    @property
    def needs(self) -> tuple[str, ...]:
        return (*_motion(self.axes), *_runs(self.sets))

    @property
    def indicators(self) -> tuple[str, ...]:
        return tuple(f"{self.of}_{axis}" for axis in self.axes)

    def columns(self, plan: Plan) -> Mapping[str, Array]:
        squared = _squared_pace(plan, self.axes)
        return {j: -squared * plan.covariate(f"{self.of}_{j}") for j in self.axes}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        beside = any(effect.name == AccelerationCrosstalk.name for effect in setup.declared)
        axes = setup.chain.axes
        if beside and paces_differ(setup.plan, axes):
            yield cls(axes=axes, sets=setup.plan.sets)


@register
class JerkCrosstalk(_Derivative):
    """Displacement of the tool point in proportion to jerk, d = D j, in addition to d = E a: the
    phase lag of a damped structure.

    D is a matrix (nm s^3/m); ``matrix_XZ`` is the displacement along X per jerk of Z. It is
    searched on circles, where j = -omega^2 v.
    """

    name = "jerk_crosstalk"
    summary = "damping of the structure: displacements in proportion to jerk"
    remedy = (
        "Check damping elements, the foundation and loose connections of the structure; limit the "
        "jerk."
    )
    of = "v"
    unit = "nm s3/m"
    sigma = 0.3


@register
class SnapCrosstalk(_Derivative):
    """Displacement of the tool point in proportion to the second derivative of acceleration,
    d = S s, in addition to d = E a: the contribution of a mode near the frequency of the motion.

    S is a matrix (nm s^4/m); ``matrix_XZ`` is the displacement along X per snap of Z. It is
    searched on circles, where s = -omega^2 a.
    """

    name = "snap_crosstalk"
    summary = "first mode of the structure: displacements that grow faster than acceleration"
    remedy = (
        "Find the first natural frequency of the structure by a frequency response; limit the "
        "jerk, or filter the commands at that frequency."
    )
    of = "a"
    unit = "nm s4/m"
    sigma = 0.01
