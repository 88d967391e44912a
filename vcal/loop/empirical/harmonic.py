"""Errors that are periodic in an angle."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ...effects.base import Effect, Response, Setup
from ...machine.parameters import Parameter
from ...machine.plan import Plan
from ...numerics.arrays import Array, namespace
from .base import Code, Empirical, Read
from .covariates import angles_around, in_rad

CIRCLE = "circle_angle"
"""The covariate with the angle of the tool on its circle."""
_PORTS = tuple(f"tool.{c}" for c in "XYZ")
_PULLS, _PACES = (tuple(f"{kind}_{c}" for c in "XYZ") for kind in "av")
_WAYS = {"outwards": _PULLS, "around": (*_PULLS, *_PACES)}
"""Directions of an error on a circle, and the covariates that define them."""
_ORDERS = 60
"""Highest order that is tried."""


class Harmonic(Empirical):
    """An error of order n in a recorded angle phi: a cos(n phi) + b sin(n phi).

    It displaces the tool point along an axis or, on a circle, radially outwards or along the circle
    (in the sense of increasing angle). Orders are tried up to half the number of measured positions
    per turn.
    """

    name = "harmonic"
    summary = "empirical: periodic in an angle"
    words = "an error that is periodic in an angle"
    angle: str = eqx.field(static=True)
    highest: int = eqx.field(static=True, repr=False)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("cosine", self.unit, sigma=10.0),
            Parameter("sine", self.unit, sigma=10.0),
            Parameter("order", "1", shape=True, smooth=False, choice=True),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.angle, *_WAYS.get(self.port, ()))

    def depends_on(self, plan: Plan, shape: Mapping[str, float]) -> tuple[str, ...]:
        del plan, shape
        return (self.angle,)

    def said(self, shape: Mapping[str, float]) -> str:
        way = {"outwards": " outwards", "around": " around the circle"}.get(self.port, "")
        order = int(shape["order"])
        return f"an error{way} of {order} period{'s'[: order > 1]} per turn of an angle"

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phase = shape["order"] * (in_rad(plan, self.angle) * plan.covariate(self.angle))
        xp = namespace(phase)
        cosine, sine = xp.cos(phase), xp.sin(phase)
        found = {}
        for port, part in self._parts(plan).items():
            found[port, "cosine"], found[port, "sine"] = part * cosine, part * sine
        return found

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        del plan
        return {"order": np.arange(1.0, self.highest + 1.0)}

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        order = int(shape["order"])
        turn = f"{order * in_rad(plan, self.angle):.6g} * {read(self.angle)}"
        lines = [f"phase = {turn}  # {order} periods per turn"]
        waves = {"cosine": "jnp.cos(phase)", "sine": "jnp.sin(phase)"}
        if self.port not in _WAYS:
            return lines, {(self.port, name): wave for name, wave in waves.items()}

        def stacked(names: tuple[str, ...]) -> str:
            return f"jnp.stack([{', '.join(read(name) for name in names)}])"

        lines += [
            f"pull = {stacked(_PULLS)}  # towards the middle of the circle",
            "way = -pull / jnp.linalg.norm(pull, axis=0)",
        ]
        if self.port == "around":
            lines += [
                f"pace = {stacked(_PACES)}",
                "turning = jnp.sign(jnp.cross(way, pace, axis=0).sum(0))",
                "way = turning * pace / jnp.linalg.norm(pace, axis=0)",
            ]
        return lines, {
            (port, name): f"way[{i}] * {wave}"
            for i, port in enumerate(_PORTS)
            for name, wave in waves.items()
        }

    def _parts(self, plan: Plan) -> Mapping[str, Array | float]:
        """The components of the error's direction, by port."""
        if self.port not in _WAYS:
            return {self.port: 1.0}
        pull = np.array([plan.values(name) for name in _PULLS])
        way = -pull / np.linalg.norm(pull, axis=0)
        if self.port == "around":
            pace = np.array([plan.values(name) for name in _PACES])
            # Planes are named so that their third axis is the axis of rotation.
            turning = np.sign(np.cross(way, pace, axis=0).sum(0))
            way = turning * pace / np.linalg.norm(pace, axis=0)
        return dict(zip(_PORTS, way, strict=True))

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        plan = setup.plan
        if not all(port in setup.layout for port in _PORTS):
            return
        for angle in angles_around(plan):
            highest = max(1, min(_ORDERS, _per_turn(plan, angle) // 2))
            for port in _PORTS:
                yield cls(port=port, unit="um", angle=angle, highest=highest)
            if angle == CIRCLE:
                for way, needs in _WAYS.items():
                    if plan.has(*needs):
                        yield cls(port=way, unit="um", angle=angle, highest=highest)


def _per_turn(plan: Plan, angle: str) -> int:
    """Number of measured positions per turn. The angle on a circle recurs in every run, so that
    only the positions of one run count.
    """
    turn = np.mod(in_rad(plan, angle) * plan.values(angle), 2.0 * np.pi).round(3)
    runs = angle == CIRCLE and "run" in plan.groups
    run = np.asarray(plan.groups["run"]) if runs else np.zeros(plan.rows, int)
    return max(len(np.unique(turn[run == number])) for number in np.unique(run))
