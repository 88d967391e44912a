"""Effects of an R-test: its probes."""

from collections.abc import Iterable, Mapping

import jax
import numpy as np
from jaxtyping import Float

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .acceleration import paces_differ
from .base import Effect, Response, Setup
from .registry import register

_XYZ = "XYZ"
_USUAL = 1.4e-6 / 3e-3
"""u/range of a device of U = 2.8 um (k = 2) at the end of a range of 3 mm."""


@register
class ProbeMatrix(Effect):
    """Errors of the probes' sensitivities and directions: a displacement p is read as (1 + S) p.

    S has nine independent elements; their standard deviation u/range makes the standard uncertainty
    of a coordinate u at the end of the range. One S for all runs: what circles of one acceleration
    cannot tell from the machine's structure, those of several can. Scale errors of the axes and
    their squareness are the same to all readings, and are told under this name.
    """

    name = "probe_matrix"
    summary = (
        "sensitivities and directions of the probes of an R-test; or scales, squareness of axes"
    )
    where = "instrument"
    sigma: float = 0.0
    """u/range."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        size = self.sigma / 1e-6
        return tuple(Parameter(f"S_{i}{j}", "um/m", sigma=size) for i in _XYZ for j in _XYZ)

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        return tuple(_XYZ)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        x = plan.position
        place = namespace(x).moveaxis(x - middle_of_runs(plan), 1, 0)
        return {
            (f"sphere.{i}", f"S_{i}{j}"): x for i in _XYZ for j, x in zip(_XYZ, place, strict=True)
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "sphere.X" in setup.layout and paces_differ(setup.plan, _XYZ):
            yield cls(sigma=_USUAL)


def middle_of_runs(plan: Plan) -> Float[Array, "n 3"]:
    """Axis positions (m) in the middle of what each run travels, where the probes are at zero."""
    x = plan.position
    runs, run = np.unique(np.asarray(plan.groups["run"]), return_inverse=True)
    if isinstance(x, jax.Array):
        low, high = (find(x, run, len(runs)) for find in (jax.ops.segment_min, jax.ops.segment_max))
        return (0.5 * (low + high))[run]
    low, high = np.full((len(runs), 3), np.inf), np.full((len(runs), 3), -np.inf)
    np.minimum.at(low, run, x)
    np.maximum.at(high, run, x)
    return (0.5 * (low + high))[run]
