"""The space of a touch probe: places of the artefact, angles of the rotary axes, and contacts."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from pydantic import model_validator

from ...bounds import Coordinate, Seconds, Within
from ...instruments.conditions import ROTARY
from ...instruments.follow import carried_apart, followed
from ...instruments.touch_probe import ArtefactPlace, TouchProbe
from ...machine.chain import Chain
from ...machine.plan import Plan
from ...machine.ports import COMPONENTS
from ...model.forward import Model
from ...numerics.arrays import Array
from ...numerics.spatial import rotation
from ..plan_space import DesignSettings, Subject, Varied, beyond_m, path_m, register
from .laser_tracker import work_space
from .points import check_bounds
from .setups import LOOSE_M, Block, Own, SetupSpace

_XYZ = ("X", "Y", "Z")
_FOLLOWS = ("approach_rad", *(f"dir_{axis}" for axis in _XYZ))
"""Covariates that follow from the approach."""
_CLEAR = 0.01
"""Share of the travel of a linear axis that a search keeps clear at its ends."""
_WEIGHT = 0.1
"""Penalty of a plan with one axis at the end of its travel."""
_MOVES = 0.05
"""Least component of the direction of approach along an axis that then moves, as in the data."""
_TURN = 1e-9
"""Change of an angle from row to row, rad, with which a new setting of the rotary axes begins."""
_POLE = 1e-12


class TouchProbeDesign(DesignSettings):
    """Keys of ``[design]`` for ``kind = "touch_probe"``."""

    contacts: bool = True
    """Whether the contacts may be anywhere on the upper part of a sphere, or around a ring."""
    lowest_deg: Annotated[
        float,
        Within(-60.0, 90.0, "the stem is in the way below, and the pole is above", open_high=True),
    ] = 0.0
    """Lowest contact on a sphere, as an angle above its equator as seen along the stylus."""
    angles: bool = True
    """Whether the rotary axes may stand elsewhere within their travel, in every setting."""
    places: bool = False
    """Whether the artefact may stand elsewhere in every set-up, within the bounds below."""
    place_low_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Lowest coordinates of its position in the workpiece frame: the centre of a sphere or a ring,
    the middle of the contacts of a step gauge. Without rotary axes, those of the tool point by
    default."""
    place_high_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Highest coordinates of its position in the workpiece frame."""
    directions: bool = False
    """Whether a step gauge may point elsewhere in every set-up."""
    seconds_per_setup: Seconds = 600.0
    """Time to clamp the artefact."""
    seconds_per_contact: Seconds = 5.0
    """Time of a contact."""

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if (self.place_low_mm is None) != (self.place_high_mm is None):
            check_bounds("places", "place", self.place_low_mm, self.place_high_mm)
        if self.place_low_mm is not None:
            check_bounds("places", "place", self.place_low_mm, self.place_high_mm)
        return self


class Placed(NamedTuple):
    """Contacts with conditions, and where the artefact of every set-up is."""

    position: Float[Array, "n axes"]
    covariates: Mapping[str, Float[Array, " n"]]
    place: Float[Array, "s 3"]
    direction: Float[Array, "s 3"]
    """Direction of a step gauge; zero for other artefacts."""


@register
@dataclass(frozen=True)
class TouchProbeSpace(SetupSpace):
    """Places of the artefact, directions of a step gauge, angles of the rotary axes, and contacts.

    Rows that follow each other at one setting of the rotary axes stay together. Contacts with a
    sphere are azimuths and elevations in the frame of the tool, those with a ring azimuths about
    its axis; a step gauge keeps its faces. The linear axes follow the surface (`followed`). They
    may exceed their travel: `excess` is the amount, and `penalty` keeps a search away from it.
    Directions of the rotary axes and other conditions of a row are fixed.
    """

    kind = "touch_probe"
    Settings = TouchProbeDesign
    rotary = True
    planned = ("face", "approach")
    lacking = (
        "linear axes that reach the artefact; move its places closer to the rotary axes, in the "
        "plan or by design.place_low_mm and design.place_high_mm"
    )

    index: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Numbers of the set-up, of the face and of other groups of every row."""
    setting: Int[np.ndarray, " n"] = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    """Index of the setting of the rotary axes of every row."""
    outward: Float[np.ndarray, "n 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Unit vector from the centre to the tip: of a sphere in the frame of the tool, of a ring in
    that of the workpiece."""
    aside: Float[np.ndarray, "n 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Offset of a contact from the place along the axis of a ring, m; zero for other artefacts."""
    room: Float[np.ndarray, "3 2"] = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))
    """Bounds of the places, m; empty where they are fixed."""
    present: Plan | None = None
    """The present plan."""

    # --- construction ---------------------------------------------------------------------------
    @classmethod
    def of(cls, subject: Subject, model: Model, settings: TouchProbeDesign) -> Self:
        chain, device, plan = subject.chain, subject.instrument, subject.plan
        assert isinstance(device, TouchProbe)
        _check_axes(subject)
        setup = np.searchsorted(device.setups, np.asarray(plan.groups["setup"]))
        position = np.asarray(plan.position)
        turning = position[:, [i for i, axis in enumerate(chain.axes) if axis in ROTARY]]
        new = (np.abs(np.diff(turning, axis=0)) > _TURN).any(1) | (np.diff(setup) != 0)
        arm = chain.tool_point(position) - np.asarray(device.places)[setup]
        across = np.isin(np.arange(3), device.across)
        outward = np.where(across, arm, 0.0)
        outward = outward / np.linalg.norm(outward, axis=1, keepdims=True)
        if device.artefact_kind == "sphere":
            outward = np.einsum("nji,nj->ni", chain.tool_frame(position)[0], outward)
        found = cls(
            chain=chain,
            device=device,
            settings=settings,
            position=position,
            known={n: np.asarray(v) for n, v in plan.covariates.items() if n not in _FOLLOWS},
            setup=setup,
            numbers=device.setups,
            index={name: np.asarray(values) for name, values in plan.groups.items()},
            setting=np.concatenate([[0], np.cumsum(new)]),
            outward=outward,
            aside=np.where(across | (len(device.faces) > 0), 0.0, arm),
            room=_room(subject, settings),
            present=plan,
        )
        if not len(found.start):
            raise subject.refusal(
                "places",
                "a plan of which nothing may change",
                "contacts, angles, places or directions that may",
                "set one of these keys to true",
            )
        return found

    def following(self, count: int, varied: Sequence[Varied]) -> Self:
        # Every further set-up has the settings and the contacts of the last one.
        rows = np.flatnonzero(self.setup == len(self.numbers) - 1)
        every, n = np.tile(rows, count), len(rows)
        own = np.unique(self.setting[rows], return_inverse=True)[1].ravel()
        known = {name: np.full(n * count, values[-1]) for name, values in self.known.items()}
        if "approach" in known:
            known["approach"] = self.known["approach"][every]
        numbers = tuple((max(self.numbers) + 1 + np.arange(count)).tolist())
        index = {name: values[every] for name, values in self.index.items()}
        index["setup"] = np.repeat(numbers, n)
        device = dataclasses.replace(
            self.device,
            setups=numbers,
            places=np.repeat(self.device.places[-1:], count, axis=0),
            directions=np.repeat(self.device.directions[-1:], count, axis=0),
            middles=np.repeat(self.device.middles[-1:], count),
        )
        return dataclasses.replace(
            self,
            device=device,
            settings=self.settings.model_copy(update={"contacts": True, "angles": True}),
            position=self.position[every],
            known=known,
            setup=np.repeat(np.arange(count), n),
            numbers=numbers,
            index=index,
            setting=np.tile(own, count) + (own.max() + 1) * np.repeat(np.arange(count), n),
            outward=self.outward[every],
            aside=self.aside[every],
            present=None,
            varied=tuple(v for v in varied if v.name not in _FOLLOWS),
            anywhere=True,
        )

    # --- numbers within bounds ------------------------------------------------------------------
    @property
    def blocks(self) -> Mapping[str, Block]:
        s, found, kind = self.settings, dict[str, Block](), self.device.artefact_kind
        if len(self.room):
            low, high = self.room.T
            found["places"] = Block((np.asarray(self.device.places) - low) / (high - low))
        if s.directions and kind == "step_gauge":
            found["directions"] = Block(np.zeros((len(self.numbers), 2)), -0.5 * np.pi, 0.5 * np.pi)
        if s.angles and len(self._turning):
            low, high = self.chain.travel[self._turning].T
            first = np.unique(self.setting, return_index=True)[1]
            found["angles"] = Block((self.position[first][:, self._turning] - low) / (high - low))
        if s.contacts and kind != "step_gauge":
            found["azimuths"] = Block(np.zeros(len(self.setup)), -np.pi, np.pi)
        if s.contacts and kind == "sphere":
            found["elevations"] = Block(np.arcsin(np.clip(self.outward[:, 2], -1.0, 1.0)),
                                        np.deg2rad(s.lowest_deg), 0.5 * np.pi)  # fmt: skip
        return found

    # --- the placed measurement -----------------------------------------------------------------
    @property
    def nominal(self) -> Placed:
        device = self.device
        covariates = dict(self._placed(self.position, self.outward, device.places,
                                       device.directions, {}).covariates)  # fmt: skip
        if self.present is not None:
            covariates |= dict(self.present.covariates)
        return Placed(self.position, covariates, device.places, device.directions)  # type: ignore[arg-type]

    def at(self, values: Mapping[str, Array], conditions: Mapping[str, Array]) -> Placed:
        device, position = self.device, jnp.asarray(self.position)
        place, direction = jnp.asarray(device.places), jnp.asarray(device.directions)
        if "places" in values:
            place = self.room[:, 0] + np.ptp(self.room, axis=1) * values["places"]
        if "directions" in values:
            about = jnp.einsum("sk,skc->sc", values["directions"], self._beside)
            direction = jax.vmap(lambda v, d: rotation(v) @ d)(about, direction)
        if "angles" in values:
            low, high = self.chain.travel[self._turning].T
            angles = (low + (high - low) * values["angles"])[self.setting]
            position = position.at[:, np.array(self._turning)].set(angles)
        outward = jnp.asarray(self.outward)
        if "azimuths" in values:
            outward = self._pointing(values["azimuths"], values.get("elevations"))
        return self._placed(position, outward, place, direction, conditions)

    def _pointing(self, azimuth: Array, elevation: Array | None) -> Array:
        """Unit vectors (n, 3) at azimuths from the present ones about the axis of the stylus or of
        the ring, and at elevations above the plane across it.
        """
        about = 2 if elevation is not None else self._ring_axis
        first, second = (about + 1) % 3, (about + 2) % 3
        a = np.arctan2(self.outward[:, second], self.outward[:, first]) + azimuth
        e = jnp.zeros_like(azimuth) if elevation is None else elevation
        parts = {first: jnp.cos(e) * jnp.cos(a), second: jnp.cos(e) * jnp.sin(a), about: jnp.sin(e)}
        return jnp.stack([parts[i] for i in range(3)], axis=1)

    @property
    def _ring_axis(self) -> int:
        return next(i for i in range(3) if i not in self.device.across)

    def _placed(
        self,
        position: Array,
        outward: Array,
        place: Array,
        direction: Array,
        conditions: Mapping[str, Array],
    ) -> Placed:
        device = self.device
        away = self._out(position, outward, direction)
        if device.faces:
            along, way = self._faces
            far = along - way * device.stylus - np.asarray(device.middles)[self.setup]
            arm = far[:, None] * jnp.asarray(direction)[self.setup]
        else:
            size = device.radius + (-1.0 if self._inside else 1.0) * device.stylus
            arm = size * away + self.aside
        point = jnp.asarray(place)[self.setup] + arm
        position = followed(self.chain, position, point)
        approach = away if self._inside or device.faces else -away
        moved = followed(self.chain, position, point + approach) - position
        found = {}
        for axis in _XYZ:
            step = moved[:, self.chain.axes.index(axis)]
            found[f"dir_{axis}"] = jnp.where(jnp.abs(step) > _MOVES, jnp.sign(step), 0.0)
        in_tool = jnp.einsum("nji,nj->ni", _tool_frames(self.chain, position), approach)
        level = (in_tool[:, :2] ** 2).sum(1) > _POLE  # at the pole there is no azimuth
        x, y = jnp.where(level, in_tool[:, 0], 1.0), jnp.where(level, in_tool[:, 1], 0.0)
        found["approach_rad"] = jnp.arctan2(y, x)
        return Placed(position, {**self.known, **found, **conditions}, place, direction)

    def _out(self, position: Array, outward: Array, direction: Array) -> Array:
        """Unit vector in the frame of the workpiece from the centre to the tip of every row; of a
        step gauge the direction of approach.
        """
        if self.device.faces:
            return self._faces[1][:, None] * jnp.asarray(direction)[self.setup]
        if self._inside:
            return jnp.asarray(outward)
        return jnp.einsum("nij,nj->ni", _tool_frames(self.chain, position), outward)

    @property
    def _inside(self) -> bool:
        return self.device.artefact_kind == "ring"

    @property
    def _faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Position along the gauge and side of every contact (n,)."""
        device, face = self.device, self.index["face"]
        place = np.searchsorted(device.faces, face)
        return np.asarray(device.positions)[place], np.asarray(self.known["approach"])

    @property
    def _beside(self) -> Float[np.ndarray, "s 2 3"]:
        """Two unit vectors across every present direction of a step gauge."""
        return np.stack([np.linalg.svd(d[None])[2][1:] for d in np.asarray(self.device.directions)])

    @property
    def _turning(self) -> list[int]:
        """Columns of the rotary axes."""
        return [i for i, axis in enumerate(self.chain.axes) if axis in ROTARY]

    # --- travel of the linear axes --------------------------------------------------------------
    def excess(self, placed: Placed) -> Float[Array, ""]:
        return self._beyond(placed).max()

    def penalty(self, placed: Placed) -> Float[Array, ""]:
        clear = _CLEAR * np.ptp(self.chain.travel[self._linear], axis=1)
        return 1.0 + _WEIGHT * ((self._beyond(placed, clear) / clear) ** 2).sum()

    def _beyond(self, placed: Placed, clear: Any = 0.0) -> Float[Array, "n f"]:
        x = jnp.asarray(placed.position)[:, np.array(self._linear)]
        return beyond_m(self.chain.travel[self._linear], x, clear)

    @property
    def _linear(self) -> list[int]:
        return [i for i, axis in enumerate(self.chain.axes) if axis not in ROTARY]

    # --- unknowns -------------------------------------------------------------------------------
    @property
    def own(self) -> Own:
        device, count = self.device, len(self.numbers)
        components = COMPONENTS if device.faces else _XYZ
        seen = tuple((k, c) for k in self.numbers for c in components)
        place = ArtefactPlace(seen=seen)
        columns = np.arange(len(seen)).reshape(count, -1)
        every = device.effects(Plan(self.chain.axes, self.position, self.known, self.index))
        shared = tuple(e for e in every if not isinstance(e, ArtefactPlace))
        scale = np.array([float(p.step) for p in place.amplitudes])[columns[0]]
        return Own(shared, (place,), columns, np.diag((scale / LOOSE_M) ** 2))

    def seen_by(self, placed: Placed) -> tuple[TouchProbe, Plan]:
        device = dataclasses.replace(self.device, places=placed.place, directions=placed.direction)
        return device, Plan(self.chain.axes, placed.position, placed.covariates, self.index)

    # --- output ---------------------------------------------------------------------------------
    def instrument(self, placed: Placed) -> TouchProbe:
        plan = Plan(self.chain.axes, np.asarray(placed.position), self.known, self.index)
        return self.device.at_contacts(self.chain, plan)

    def plan(self, placed: Placed) -> Plan:
        if self.present is not None and placed.position is self.position:
            return self.present
        own = {n: np.asarray(v) for n, v in placed.covariates.items() if n not in _FOLLOWS}
        plan = Plan(self.chain.axes, np.asarray(placed.position), own, self.index)
        return self.device.at_contacts(self.chain, plan).approached(self.chain, plan)

    def seconds(self, placed: Placed) -> float:
        s, position = self.settings, np.asarray(placed.position)
        fixed = len(self.numbers) * s.seconds_per_setup + len(position) * s.seconds_per_contact
        return float(fixed + path_m(position[:, self._linear]) * s.seconds_per_metre)


def _tool_frames(chain: Chain, position: Float[Array, "n axes"]) -> Float[Array, "n 3 3"]:
    """Orientation of the tool in the frame of the workpiece of every row; may be traced."""
    still = jnp.zeros((len(chain.joints), 6))
    return jax.vmap(lambda q: chain.pose_as_arrays(q, still)[0])(jnp.asarray(position))


def _check_axes(subject: Subject) -> None:
    chain = subject.chain
    for joint in chain.joints:
        if not np.isfinite(np.asarray(joint.travel)).all():
            raise subject.refusal(
                "angles", f"axis {joint.name} without bounds", "bounds of every axis",
                "declare its travel",
            )  # fmt: skip
    if axis := carried_apart(chain):
        raise subject.refusal(
            "angles",
            f"the rotary axis {axis} between linear axes in {chain.text!r}, which turns one "
            "against another",
            "linear axes that stay square to each other, as they follow the artefact",
            "judge plans of your own with `vcal uncertainty`",
        )


def _room(subject: Subject, settings: TouchProbeDesign) -> Float[np.ndarray, "c 2"]:
    """Bounds of the places, m; empty where they are fixed."""
    if not settings.places:
        return np.zeros((0, 2))
    low, high = settings.place_low_mm, settings.place_high_mm
    if low is not None and high is not None:
        return 1e-3 * np.column_stack([low, high])
    if not subject.chain.linear:
        raise subject.refusal(
            "places",
            "true without bounds on a machine with rotary axes",
            "place_low_mm and place_high_mm",
            "add both, such as the ends of the table",
        )
    return np.column_stack(work_space(subject.chain))
