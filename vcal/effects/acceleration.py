"""Effects of acceleration: a structure that bends while it is being driven."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ..arrays import Array
from ..parameters import Parameter
from ..plan import Plan
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
