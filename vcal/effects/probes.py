"""Effects of probes: a touch probe, and the probes of an R-test."""

from collections.abc import Iterable, Mapping

import jax
import numpy as np
from jaxtyping import Float

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .acceleration import paces_differ
from .base import Effect, Response, Setup
from .forms import AtInstrument
from .registry import register

_XYZ = "XYZ"
_USUAL = 1.4e-6 / 3e-3
"""u/range of a device of U = 2.8 um (k = 2) at the end of a range of 3 mm."""


@register
class ProbeLobing(AtInstrument):
    """A probe whose pre-travel depends on the direction of approach: a0 + a3 cos(3 phi + phi0).

    phi is the azimuth of the approach about the probe's axis, in the frame of the tool (column
    ``approach_rad``); the error of the tool point lies along the approach. Kinematic probes on
    three supports have three lobes; a0 is the error of the effective tip radius.
    """

    name = "probe_lobing"
    summary = "pre-travel of a touch probe that depends on the direction of approach"
    # A probe touches balls; without balls no reading has a direction of approach.
    requires_port = "ball.X"
    uses = ("approach_rad",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, "um", sigma=2.0) for name in ("radius", "sine3", "cosine3"))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phi = plan.covariate("approach_rad")
        xp = namespace(phi)
        ways = {"tool.X": xp.cos(phi), "tool.Y": xp.sin(phi)}
        sizes = {
            "radius": xp.ones_like(phi),
            "sine3": xp.sin(3.0 * phi),
            "cosine3": xp.cos(3.0 * phi),
        }
        return {(port, name): way * size for port, way in ways.items()
                for name, size in sizes.items()}  # fmt: skip


@register
class ProbeMatrix(Effect):
    """Errors of the probes' sensitivities and directions: a displacement p is read as (1 + S) p.

    S has nine independent elements; their standard deviation u/range gives the standard uncertainty
    u of a coordinate at the end of the range. There is one S for all runs: circles of one
    acceleration cannot separate it from the structure of the machine, those of several can. Scale
    errors of the axes and their squareness have the same effect on all readings, and are reported
    under this name.
    """

    name = "probe_matrix"
    summary = (
        "sensitivities and directions of the probes of an R-test; or scales, squareness of axes"
    )
    where = "instrument"
    shown_by = tuple(_XYZ)
    sigma: float = 0.0
    """u/range."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        size = self.sigma / 1e-6
        return tuple(Parameter(f"S_{i}{j}", "um/m", sigma=size) for i in _XYZ for j in _XYZ)

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
    """Axis positions (m) in the middle of the travel of each run, where the probes read zero."""
    x = plan.position
    runs, run = np.unique(np.asarray(plan.groups["run"]), return_inverse=True)
    if isinstance(x, jax.Array):
        low, high = (find(x, run, len(runs)) for find in (jax.ops.segment_min, jax.ops.segment_max))
        return (0.5 * (low + high))[run]
    low, high = np.full((len(runs), 3), np.inf), np.full((len(runs), 3), -np.inf)
    np.minimum.at(low, run, x)
    np.maximum.at(high, run, x)
    return (0.5 * (low + high))[run]
