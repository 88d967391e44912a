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


def _lobes(phi: Array, order: int) -> Mapping[str, Array]:
    """Sine and cosine of a number of lobes over the azimuth, by the names of their amplitudes."""
    xp = namespace(phi)
    return {f"sine{order}": xp.sin(order * phi), f"cosine{order}": xp.cos(order * phi)}


def _along_approach(phi: Array, sizes: Mapping[str, Array]) -> Response:
    """Displacements of the tool point along an approach of azimuth phi, in the tool's frame."""
    xp = namespace(phi)
    ways = {"tool.X": xp.cos(phi), "tool.Y": xp.sin(phi)}
    return {(port, name): way * size for port, way in ways.items() for name, size in sizes.items()}


@register
class ProbeLobing(Effect):
    """A probe whose pre-travel depends on the direction of approach: a0 + a3 cos(3 phi + phi0).

    phi is the azimuth of the approach about the probe's axis, in the frame of the tool (column
    ``approach_rad``, which a `touch_probe` derives); the error of the tool point lies along the
    approach. Kinematic probes on three supports have three lobes; a0 is the error of the effective
    tip radius.
    """

    name = "probe_lobing"
    summary = "pre-travel of a touch probe that depends on the direction of approach"
    remedy = "Qualify the stylus again in several directions; the machine is not affected."
    where = "instrument"
    uses = ("approach_rad",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, "um", sigma=2.0) for name in ("radius", "sine3", "cosine3"))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phi = plan.covariate("approach_rad")
        sizes = {"radius": namespace(phi).ones_like(phi), **_lobes(phi, 3)}
        return _along_approach(phi, sizes)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        # A probe touches balls or surfaces; no other reading has a direction of approach.
        if "ball.X" in setup.layout or "size.stylus" in setup.layout:
            yield cls()


@register
class ProbeTwoLobes(AtInstrument):
    """A probe whose pre-travel has two lobes: a2 cos(2 phi + phi0), phi as of `probe_lobing`.

    Bending of the stylus differs between the two directions across it, and a tip that is not round
    or a misaligned probe has this form too.
    """

    name = "probe_two_lobes"
    summary = "pre-travel of a touch probe with two lobes over the direction of approach"
    remedy = (
        "Qualify the stylus again in several directions, and check its trigger force; the machine "
        "is not affected."
    )
    requires_port = "size.stylus"
    uses = ("approach_rad",)
    odds = 0.5

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, "um", sigma=2.0) for name in ("sine2", "cosine2"))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phi = plan.covariate("approach_rad")
        return _along_approach(phi, _lobes(phi, 2))


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
    remedy = (
        "Calibrate the sensitivities of the displacement sensors again; the machine is not "
        "affected."
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
