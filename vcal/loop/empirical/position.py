"""Errors at one position of an axis."""

from collections.abc import Mapping

import numpy as np

from ...effects.base import Response
from ...machine.parameters import Parameter
from ...machine.plan import Plan
from ...numerics.arrays import Array, namespace
from .base import Code, Empirical, Interval, Read, range_of


class LocalBump(Empirical):
    """A Gaussian bump in one error motion: a exp(-((x - centre)/width)^2 / 2)."""

    name = "local_bump"
    summary = "empirical: local error"
    words = "a local error"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("height", self.unit, sigma=10.0),
            Parameter("centre", self._length(), shape=True),
            Parameter("width", self._length(), shape=True, coordinate="log"),
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        u = (plan.x(self.placement) - shape["centre"]) / shape["width"]
        return {(self.port, "height"): namespace(u).exp(-0.5 * u * u)}

    def decided_by(self, plan: Plan) -> tuple[np.ndarray, ...]:
        return (np.asarray(plan.x(self.placement)),)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        low, high = range_of(plan, self.placement)
        span = (high - low) or 1.0
        return {
            "centre": np.linspace(low, high, 41),
            # Bumps wider than a tenth of the travel belong to the declared family and its
            # smoothness.
            "width": np.geomspace(span / 80.0, span / 10.0, 4),
        }

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        half = 2.0 * shape["width"]
        return (Interval(self.placement, shape["centre"] - half, shape["centre"] + half),)

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        del plan
        return (
            [f"u = ({read(self.placement)} - {shape['centre']:.6g}) / {shape['width']:.4g}"],
            {(self.port, "height"): "jnp.exp(-0.5 * u * u)"},
        )


class Kink(Empirical):
    """An error motion whose slope changes at one position: a max(0, x - at), as at a joint of two
    guideways.
    """

    name = "kink"
    summary = "empirical: change of slope at one position"
    words = "a kink"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        slope = f"{self.unit}/{'rad' if self._length() == 'rad' else 'm'}"
        return (
            Parameter("slope", slope, sigma=50.0),
            Parameter("at", self._length(), shape=True),
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        beyond = plan.x(self.placement) - shape["at"]
        return {(self.port, "slope"): namespace(beyond).maximum(beyond, 0.0)}

    def decided_by(self, plan: Plan) -> tuple[np.ndarray, ...]:
        return (np.asarray(plan.x(self.placement)),)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        low, high = range_of(plan, self.placement)
        return {"at": low + (high - low) * np.linspace(0.1, 0.9, 33)}

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        return (Interval(self.placement, shape["at"], range_of(plan, self.placement)[1]),)

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        del plan
        return (
            [f"x = {read(self.placement)}"],
            {(self.port, "slope"): f"jnp.maximum(x - {shape['at']:.6g}, 0.0)"},
        )
