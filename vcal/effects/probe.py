"""Effects of a touch probe."""

from collections.abc import Iterable, Mapping

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup
from .registry import register


@register
class ProbeLobing(Effect):
    """A probe whose pre-travel depends on the direction of approach: a0 + a3 cos(3 phi + phi0).

    phi is the azimuth of the approach about the probe's axis, in the frame of the tool (column
    ``approach_rad``); the tool point is off by that much along the approach. Kinematic probes on
    three supports have three lobes; a0 is what the effective tip radius was wrong by.
    """

    name = "probe_lobing"
    summary = "pre-travel of a touch probe that depends on the direction of approach"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, "um", sigma=2.0) for name in ("radius", "sine3", "cosine3"))

    @property
    def needs(self) -> tuple[str, ...]:
        return ("approach_rad",)

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

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        # Balls are what is touched; without them no approach leads to a reading.
        if "ball.X" in setup.layout:
            yield cls()
