"""Effects of a ball artefact: a wrong ball, bending under gravity, thermal expansion."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup
from .registry import register
from .thermal import REFERENCE_DEGC


@register
class BallError(Effect):
    """One ball is displaced from its certified position: a constant displacement of that ball."""

    name = "ball_error"
    summary = "wrong calibrated position of one ball"
    remedy = (
        "Clean the ball, check that it is tight, and calibrate the artefact again; the machine is "
        "not affected."
    )
    where = "instrument"
    uses = ("ball",)
    ball: int = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(c, "um", sigma=10.0) for c in "XYZ")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        touched = plan.groups["ball"] == self.ball
        here = namespace(touched).where(touched, 1.0, 0.0)
        return {(f"ball.{c}", c): here for c in "XYZ"}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "ball.X" in setup.layout and "ball" in setup.plan.groups:
            for ball in np.unique(np.asarray(setup.plan.groups["ball"])):
                yield cls(ball=int(ball), placement=f"ball {ball}")


def beam_deflection(along: Array, supports: tuple[float, float]) -> Array:
    """Deflection of a uniform beam under its own weight on two supports, per unit of w L^4/(E I).

    Euler-Bernoulli: y'''' = 1 with reactions at the supports, where y = 0. `along` and `supports`
    are shares of the length; the deflection is positive downwards.
    """
    a, b = supports
    right = (0.5 - a) / (b - a)
    left = 1.0 - right

    def free(s):
        xp = namespace(s)
        ramp_a, ramp_b = xp.maximum(s - a, 0.0), xp.maximum(s - b, 0.0)
        return s**4 / 24.0 - left * ramp_a**3 / 6.0 - right * ramp_b**3 / 6.0

    ya, yb = free(np.asarray(a)), free(np.asarray(b))
    return free(along) - ya - (yb - ya) * (along - a) / (b - a)


@register
class ArtefactBending(Effect):
    """The artefact sags as a beam on its two supports, in proportion to the transverse gravity.

    The displacement of a ball is sag w(s) g_t, with w the beam's deflection scaled to a largest
    value of one and g_t the component of the unit vector of gravity across the beam (length
    cos(tilt)). Where the supports let the balls sink vertically instead (`down`), g cos(tilt)
    replaces g_t; the two differ along the beam only.
    """

    name = "artefact_bending"
    summary = "sag of the artefact under its own weight"
    remedy = (
        "Support the artefact at its declared points, or declare its stiffness; the machine is "
        "not affected."
    )
    where = "instrument"
    uses = ("along_beam", "gravity_x", "gravity_y", "gravity_z")
    shown_by = ("along_beam", "tilt")
    supports: tuple[float, float] = eqx.field(static=True)
    beam: tuple[float, float, float] = eqx.field(static=True)
    down: bool = eqx.field(static=True, default=False)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("sag_down" if self.down else "sag", "um", sigma=5.0),)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        line = beam_deflection(np.linspace(0.0, 1.0, 201), self.supports)
        w = beam_deflection(plan.covariate("along_beam"), self.supports)
        w = w / np.max(np.abs(line))
        gravity = [plan.covariate(f"gravity_{c}") for c in "xyz"]
        lengthwise = sum(g * u for g, u in zip(gravity, self.beam, strict=True))
        xp = namespace(lengthwise)
        across = xp.sqrt(xp.maximum(1.0 - lengthwise**2, 0.0))
        name = self.parameters[0].name
        return {
            (f"ball.{c}", name): w * (g * across if self.down else g - lengthwise * u)
            for c, g, u in zip("XYZ", gravity, self.beam, strict=True)
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if setup.artefact is not None:
            for down in (False, True):
                yield cls(supports=setup.artefact.supports, beam=setup.artefact.beam, down=down)


@register
class ArtefactExpansion(Effect):
    """The artefact expands with the air: a ball calibrated at p is at (1 + alpha (T_air - 20 degC))
    p in the frame of the calibration, whose origin is fixed by the pose.
    """

    name = "artefact_expansion"
    summary = "thermal expansion of the artefact"
    remedy = (
        "Measure the temperature of the artefact itself and let it settle; declare its "
        "coefficient of expansion; the machine is not affected."
    )
    where = "instrument"
    uses = ("T_air", "ball_x", "ball_y", "ball_z")
    shown_by = ("T_air", "along_beam")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("alpha", "um/(m K)", sigma=10.0),)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        excess = plan.covariate("T_air") - REFERENCE_DEGC
        return {(f"ball.{c}", "alpha"): excess * plan.covariate(f"ball_{c.lower()}") for c in "XYZ"}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if setup.artefact is not None:
            yield cls()
