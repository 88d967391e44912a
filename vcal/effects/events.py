"""Effects of single events: a collision, a slip of a clamp or of a gear."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup, along, unit_of
from .clock import TIME, Clock, clock
from .registry import register
from .station import at_station, stations_of

_STANDS = {"frame": "XYZABC", "target": "XYZABC", "place": "XYZ"}
"""Ports of objects on the table: an instrument, an artefact, one sphere."""

_SLIP, _SKIP = 1000.0, 100.0
"""Largest displacements in prior standard deviations: a clamp or a magnet slips by millimetres, a
gear skips a tooth by less than a degree."""
_STAND_ODDS = 0.3
"""Prior odds of a displaced stand against a tool with the same displacement."""


@register
class Jump(Effect):
    """A step at an unknown moment t0: after it, the tool point, the angle of a joint, the frame of
    the instrument, or, on a table that turns, the artefact or the sphere is displaced.

    The deviation is (t > t0) times a translation (tool, sphere), a rotation about a joint, or
    (frame, artefact) a translation X, Y, Z along the machine's axes and a rotation A, B, C about
    the frame's own axes, which `euler_xyz_deg` turns for a tracker. The moment is scanned over the
    gaps between successive rows; the deviation is not differentiable in it. Its uncertainty
    comprises the choice of the gap and the position within it. Where the poses of an arm have
    numbers and no time, t is the number of the pose.
    """

    name = "jump"
    summary = "sudden displacement at an unknown moment"
    remedy = (
        "Find out what happened at that moment: a collision, a restart, a tool change, a touched "
        "reflector or stand. Check clamping and reference marks, and measure again."
    )
    ports: tuple[str, ...] = eqx.field(static=True)
    clock: Clock = eqx.field(static=True, default=TIME)
    station: int = eqx.field(static=True, default=-1)
    """Index of the station that is displaced; -1 where there is only one."""

    @property
    def _what(self) -> str:
        """What is displaced: the tool, a joint or a stand."""
        return self.placement.partition(" ")[0]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        sizes = tuple(
            Parameter(_size(port), unit_of(port), sigma=self._usual, largest=self._largest)
            for port in self.ports
        )
        return (*sizes, Parameter("at", self.clock.short, shape=True, smooth=False))

    @property
    def odds(self) -> float:  # type: ignore[override]
        """Lower for a translation of the stand: the readings cannot separate it from the tool's."""
        return _STAND_ODDS if self._what == "frame" and len(self.ports) == 3 else 1.0

    @property
    def _usual(self) -> float:
        return 20.0 if self._what in ("tool", *_STANDS) else 100.0

    @property
    def _largest(self) -> float:
        return _SLIP if self._what in ("tool", *_STANDS) else _SKIP

    @property
    def on_instrument(self) -> bool:
        return self._what in _STANDS

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.clock.name,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        later = self.clock.read(plan) > shape["at"]
        after = namespace(later).where(later, at_station(plan, self.station), 0.0)
        return {(port, _size(port)): after for port in self.ports}

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        return at_station(plan, self.station) > 0.0

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        t = self.edges(plan)["at"]
        if len(t) < 2:
            return {"at": t}
        gaps = 0.5 * (t[1:] + t[:-1])
        # At most 200 moments: closer ones give nearly the same step.
        return {"at": gaps[np.unique(np.linspace(0, len(gaps) - 1, 200).astype(int))]}

    def decided_by(self, plan: Plan) -> tuple[np.ndarray, ...]:
        # A row knows only which of the scanned moments lie before it.
        passed = np.searchsorted(self.scan(plan)["at"], np.asarray(self.clock.read(plan)))
        return passed, np.asarray(at_station(plan, self.station))

    def edges(self, plan: Plan) -> Mapping[str, np.ndarray]:
        return {"at": np.unique(np.asarray(self.clock.read(plan))[self.rows(plan)])}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        by = clock(setup)
        yield cls(ports=("tool.X", "tool.Y", "tool.Z"), clock=by, placement="tool")
        for joint in setup.chain.joints:
            if joint.turns:
                yield cls(ports=along(setup.chain, joint.name)[:1], clock=by, placement=joint.name)
        for stand, components in _STANDS.items():
            # Without rotary axes, a jump on the table equals one of the tool the other way.
            if f"{stand}.X" in setup.layout and (stand == "frame" or not setup.chain.linear):
                ports = tuple(p for c in components if (p := f"{stand}.{c}") in setup.layout)
                yield from _at_each(setup, stand, ports, by)
        if "frame.A" in setup.layout and setup.chain.linear:
            # A translation alone equals one of the tool in the other direction: without this
            # candidate, the tool would be preferred because a full motion has more parameters.
            yield from _at_each(setup, "frame", tuple(f"frame.{c}" for c in "XYZ"), by)


def _at_each(setup: Setup, stand: str, ports: tuple[str, ...], by: Clock) -> Iterable[Effect]:
    """A jump of a stand; of an instrument at several stations, one at each."""
    for number, name in stations_of(setup) if stand == "frame" else ((-1, ""),):
        place = f"{stand} {name}".strip()
        yield Jump(ports=ports, clock=by, station=number, placement=place)


def _size(port: str) -> str:
    """Name of the amplitude: ``"X"`` of ``"tool.X"``, ``"size"`` of ``"ECJ2"``."""
    return port.split(".")[1] if "." in port else "size"
