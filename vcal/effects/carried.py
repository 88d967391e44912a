"""What a joint carries, the moment of its weight about the joint, and the base class of effects
that tilt what is carried in proportion to this moment.
"""

import abc
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Self

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..machine.chain import Chain, Joint
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from ..numerics.record import Record
from .base import Effect, Response, Setup

_KEPT = 0.03
"""Patterns of load below this share of the strongest one are left out."""
_OFF_AXIS_M = 0.05
"""Assumed distance of a tool's centre of mass from the axis of the last joint."""
_LEAST_M = 1e-6
"""Rms variation of a lever arm below which it is constant."""

Stiffness = Literal["one", "two"]
"""Whether the stiffness is equal about all horizontal axes, or differs between two of them."""


class Carried(NamedTuple):
    """The frame of a joint and the places of what it carries, nominal, in the frame of the bed."""

    frame: Float[Array, "n 3 3"]
    """Frame in which the error twist of the joint acts."""
    origin: Float[Array, "n 3"]
    """Point about which its error rotation turns, m."""
    start: Float[Array, "n 3"]
    """End of the link before the joint, m."""
    end: Float[Array, "n 3"]
    """End of the joint's own link, m."""
    axis: Float[Array, "n 3"]
    """Direction of its motion."""
    masses: Float[Array, "n k 3"]
    """Ends of its own link and of all links behind it, where weights may act, m."""
    tool: Float[Array, "n 3 3"]
    """Frame of the last link."""


def carried(chain: Chain, position: Float[Array, "n axes"], joint: str) -> Carried:
    """What a joint carries at axis positions (n, axes), m or rad; positions may be traced."""
    xp = namespace(position)
    place = chain.axes.index(joint)
    side = chain.tool_side if place in chain.tool_side else chain.workpiece_side
    rows = position.shape[0]
    r, t = xp.zeros((rows, 3, 3)) + np.eye(3), xp.zeros((rows, 3))
    found, masses = None, []
    for i in side:
        one, start = chain.joints[i], t
        before, after = np.asarray(one.before), np.asarray(one.after)
        t, r = t + r @ before[:3, 3], r @ before[:3, :3]
        direction = np.asarray(one.direction) * one.sign
        axis = r @ direction
        turn = _turns(direction, position[:, i], xp) if one.turns else None
        if turn is None:
            t = t + position[:, i, None] * axis
        turned = r if turn is None else r @ turn
        # A rotary axis has its errors in the frame of what carries it.
        frame, origin = (turned if one.kind == "revolute" else r), t
        r = turned
        t, r = t + r @ after[:3, 3], r @ after[:3, :3]
        if i == place:
            found = frame, origin, start, t, axis
        if found is not None:
            masses.append(t)
    assert found is not None
    return Carried(*found, xp.stack(masses, 1), r)


def _turns(direction: np.ndarray, angle: Array, xp) -> Array:
    """Rotations (n, 3, 3) about a unit vector (Rodrigues)."""
    x, y, z = direction
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = xp.sin(angle)[:, None, None], xp.cos(angle)[:, None, None]
    return np.eye(3) + sine * k + (1.0 - cosine) * (k @ k)


def moments(chain: Chain, it: Carried, about: Float[Array, "n 3"]) -> Float[Array, "n k 3"]:
    """Moment (c - about) x g of gravity per unit weight at every place c, in m, in the frame of the
    bed, with g the unit vector of gravity.

    Places are `Carried.masses`; for an arm, the contributions of a tool whose centre of mass lies
    50 mm off the flange along its X and its Y follow.
    """
    xp = namespace(it.masses)
    arms = it.masses - about[:, None]
    if chain.arm:
        off = _OFF_AXIS_M * xp.swapaxes(it.tool[:, :, :2], 1, 2)
        arms = xp.concatenate([arms, off], 1)
    return xp.cross(arms, -np.array(chain.up))


def horizontal(chain: Chain) -> tuple[tuple[str, np.ndarray], tuple[str, np.ndarray]]:
    """Two horizontal unit vectors of the bed, with the name of the axis nearest to each."""
    up = np.asarray(chain.up)
    names = [i for i in range(3) if i != int(np.abs(up).argmax())]
    first = np.eye(3)[names[0]] - up[names[0]] * up
    first = first / np.linalg.norm(first)
    second = np.cross(up, first)
    second = second * (np.sign(second[names[1]]) or 1.0)
    return ("xyz"[names[0]], first), ("xyz"[names[1]], second)


class Patterns(Record):
    """Independent patterns of a load, load @ weights: each of unit rms on the plan from which it
    was derived.
    """

    weights: np.ndarray
    main: np.ndarray
    """Main direction of the varying load of every pattern (patterns, components)."""
    turns: np.ndarray
    """Rms of the varying load of every pattern (patterns, components)."""
    shares: tuple[float, ...] = eqx.field(static=True)
    """Strength of each, as a share of the strongest one, with equal weights in all places."""

    def both(self, axes: Sequence[tuple[str, np.ndarray]]) -> bool:
        """Whether the load varies about both horizontal axes."""
        parts = np.stack([np.abs(self.turns @ np.abs(e)) for _, e in axes])
        return bool((np.linalg.norm(parts, axis=1) > _KEPT).all())

    @classmethod
    def of(cls, load: Float[np.ndarray, "n k c"]) -> Self | None:
        """Patterns of the varying part of a load per unit weight; None where it is constant."""
        n, places, _ = load.shape
        changing = np.swapaxes(load - load.mean(0), 1, 2).reshape(-1, places)
        _, s, vt = np.linalg.svd(changing, full_matrices=False)
        if s[0] < _LEAST_M * np.sqrt(n):
            return None
        kept = int((s > _KEPT * s[0]).sum())
        # The sign of a singular vector is arbitrary: the place with the largest weight pulls down.
        strongest = vt[np.arange(kept), np.abs(vt[:kept]).argmax(1)]
        weights = vt[:kept].T * np.sign(strongest) / s[:kept] * np.sqrt(n)
        loads = np.einsum("nkc,kp->pnc", load - load.mean(0), weights)
        main = np.linalg.svd(loads, full_matrices=False)[2][:, 0]
        main *= np.sign(main[np.arange(kept), np.abs(main).argmax(1)])[:, None]
        rms = np.sqrt(np.mean(loads**2, axis=1))
        return cls(weights, main, rms, tuple((s[:kept] / s[0]).tolist()))


class GravityTilt(Effect):
    """Base class of a tilt of what a joint carries, in proportion to the moment of its weight.

    The tilt w is a rotation about horizontal axes: a load (n, places, 3), which is the moment of
    gravity per unit weight times a geometric factor, is summed over the unknown weights. A singular
    value decomposition reduces the sums that are possible on the plan to independent patterns of
    unit rms, so that a parameter is the rms tilt due to its pattern. With the stiffness ``"one"``,
    the tilt is in the direction of the moment (``tilt1``, ...); with ``"two"``, every horizontal
    axis of the bed has a parameter of its own (``about_x1``, ``about_y1``, ...).

    Independent of the plan are the tilts per unit of the load at every place (`amounts_to`).
    """

    usual: ClassVar[float]
    """Prior standard deviation of the strongest pattern, urad."""

    chain: Chain
    joint: str = eqx.field(static=True)
    """The joint at whose ports it acts."""
    patterns: Patterns
    stiffness: Stiffness = eqx.field(static=True, default="one")

    @classmethod
    @abc.abstractmethod
    def load(cls, chain: Chain, it: Carried, **more: Any) -> Float[Array, "n k 3"]:
        """The load per unit weight at every place, in the frame of the bed; `more` are the fields
        of a subclass on which it depends.
        """

    @property
    def more(self) -> Mapping[str, Any]:
        """Fields of a subclass on which the load depends."""
        return {}

    @abc.abstractmethod
    def moved(
        self, it: Carried, tilt: Float[Array, "n 3"]
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """A point and its displacement, m, where the tilt is `tilt` (rad), in the frame of the bed;
        what is carried rotates about this point.
        """

    @property
    def needs(self) -> tuple[str, ...]:
        place = self.chain.axes.index(self.joint)
        tool = place in self.chain.tool_side
        side = self.chain.tool_side if tool else self.chain.workpiece_side
        return tuple(self.chain.axes[i] for i in side[side.index(place) :])

    @property
    def _directions(self) -> tuple[tuple[str, np.ndarray], ...]:
        """Name of the parameters, and the projection of the load on the axes of the rotation."""
        both = horizontal(self.chain)
        if self.stiffness == "one":
            return ((self.prefix or "tilt", np.add.reduce([np.outer(e, e) for _, e in both])),)
        start = f"{self.prefix}_" if self.prefix else ""
        return tuple((f"{start}about_{name}", np.outer(e, e)) for name, e in both)

    @property
    def prefix(self) -> str:
        """Start of the names of the parameters, where instances of one placement differ in more
        than the stiffness.
        """
        return ""

    @property
    def indicators(self) -> tuple[str, ...]:
        return self.needs[1:3]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{name}{i}", "urad", sigma=self.usual * share)
            for name, _ in self._directions
            for i, share in enumerate(self.patterns.shares, start=1)
        )

    @property
    def amounts_to(self) -> Sequence[tuple[str, str, Mapping[str, float]]]:
        behind = self.needs[1:]
        places = [*behind, "flange", *(("off_x", "off_y") if self.chain.arm else ())]
        return tuple(
            (
                f"{name}_{place}",
                self.amount_unit,
                {f"{name}{i}": float(w) for i, w in enumerate(row, start=1)},
            )
            for name, _ in self._directions
            for place, row in zip(places, self.patterns.weights, strict=True)
        )

    amount_unit: ClassVar[str] = "urad/m"
    """Unit of the tilt per unit of the load."""

    def tilts(self, plan: Plan) -> Mapping[str, Float[Array, "n 3"]]:
        it = carried(self.chain, plan.position, self.joint)
        load = self.load(self.chain, it, **self.more)
        return {
            f"{name}{i + 1}": namespace(load).einsum(
                "nkc,k,ac->na", load, self.patterns.weights[:, i], projection
            )
            for name, projection in self._directions
            for i in range(len(self.patterns.shares))
        }

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        it = carried(self.chain, plan.position, self.joint)
        xp = namespace(it.origin)
        found = {}
        for name, tilt in self.tilts(plan).items():
            point, shift = self.moved(it, tilt)
            shift = shift + xp.cross(tilt, it.origin - point)
            for letters, vector in (("XYZ", shift), ("ABC", tilt)):
                own = xp.einsum("nba,nb->na", it.frame, vector)
                for k, letter in enumerate(letters):
                    found[f"E{letter}{self.joint}", name] = own[:, k]
        return found

    @classmethod
    def at(cls, setup: Setup, joint: str, placement: str, **more: Any) -> Iterator["GravityTilt"]:
        """Its instances at one joint, the one with the same stiffness about all axes first; `more`
        are further fields.
        """
        chain = setup.chain
        it = carried(chain, np.asarray(setup.plan.position, float), joint)
        patterns = Patterns.of(np.asarray(cls.load(chain, it, **more)))
        if patterns is None:
            return
        kinds: tuple[Stiffness, ...] = (
            ("one", "two") if patterns.both(horizontal(chain)) else ("one",)
        )
        for stiffness in kinds:
            yield cls(
                chain=chain,
                joint=joint,
                patterns=patterns,
                stiffness=stiffness,
                placement=placement,
                **more,
            )


def carriers(chain: Chain) -> list[Joint]:
    """The linear joints that carry another joint."""
    sides = (chain.tool_side, chain.workpiece_side)
    inner = [i for side in sides for i in side[:-1]]
    return [chain.joints[i] for i in sorted(inner) if chain.joints[i].kind == "prismatic"]
