"""The space of ball arrays: poses of the artefact, and positions of its balls."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...bounds import ArtefactLength, Seconds, Within
from ...instruments.ball_array import BallArray
from ...machine.chain import Chain
from ...machine.plan import Plan
from ...model.forward import Model
from ...numerics.arrays import Array
from ..plan_space import DesignSettings, PlanSpace, Subject, Varied, path_m, register
from .array_bounds import ArraySpace
from .ball_information import (
    DERIVED,
    LOOSE_M,
    ArrayPoses,
    Conditions,
    Touches,
    derived,
    probed,
    without_poses,
)

_OF_SHAPE = ("along_beam", "tilt")
"""Covariates that depend on the direction of the artefact's long axis."""
_EXACT_M = 1e-9
"""Distance from the nominal balls, m, below which positions are planned, as no machine is so exact.
"""

_DIGITS_MM = 1e-6
"""Rounding error of a table with ten digits."""

_Limit = Annotated[float, Within(0.0, 2e4, "no artefact is 20 m wide")]


class BallArrayDesign(DesignSettings):
    """Keys of ``[design]`` for ``kind = "ball_array"``."""

    poses: bool = True
    """Whether orientations and positions of the artefact vary."""
    across_mm: tuple[_Limit, _Limit] = (0.0, 0.0)
    """Largest distance of balls from the axis of the artefact, in two directions; zero keeps the
    present balls."""
    along: bool = False
    """Whether the positions of the balls along the artefact vary, at a fixed length."""
    spacing_mm: ArtefactLength = 50.0
    """Least distance of neighbouring balls along the artefact, where they vary."""
    seconds_per_pose: Seconds = 300.0
    """Time to set the artefact up in a pose."""
    seconds_per_ball: Seconds = 20.0
    """Time to measure a ball."""


class Placed(NamedTuple):
    """An artefact in its poses, in the frame of its certificate, with conditions."""

    poses: ArrayPoses
    covariates: Mapping[str, Float[Array, "m N"]]
    excess: Float[Array, ""]
    penalty: Float[Array, ""]


class _Frame(NamedTuple):
    """The artefact's own frame with x along it: b = centre + turn b_own."""

    turn: np.ndarray
    centre: np.ndarray

    def own(self, poses: ArrayPoses) -> ArrayPoses:
        turned = poses.rotation @ self.turn
        origin = poses.origin + poses.rotation @ self.centre
        return ArrayPoses((poses.balls - self.centre) @ self.turn, turned, origin)

    def certificate(self, poses: ArrayPoses) -> ArrayPoses:
        turned = poses.rotation @ self.turn.T
        origin = poses.origin - turned @ self.centre
        return ArrayPoses(poses.balls @ self.turn.T + self.centre, turned, origin)


@register
@dataclass(frozen=True)
class BallArraySpace(PlanSpace):
    """Rotations and positions of the poses (`ArraySpace`), balls across and along the artefact."""

    kind = "ball_array"
    Settings = BallArrayDesign
    group = "pose"
    lacking = "room for the artefact; take a smaller one"

    chain: Chain
    device: BallArray
    settings: BallArrayDesign
    space: ArraySpace
    frame: _Frame
    numbers: tuple[int, ...]
    """Numbers of the balls, ordered along the artefact."""
    pose_numbers: tuple[int, ...]
    known: Mapping[str, np.ndarray]
    """Recorded covariates (m, N)."""
    touched: np.ndarray
    """Whether each ball is touched in each pose (m, N)."""
    row: np.ndarray
    """Row of the study's plan of every touch (m, N); -1 where there is none."""
    nominal_poses: ArrayPoses
    """Declared poses, in the frame of the certificate."""
    found: np.ndarray
    """Positions in the study's plan (rows, axes), m."""
    varied: tuple[Varied, ...] = ()
    anywhere: bool = False
    beam: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))

    @classmethod
    def of(cls, subject: Subject, model: Model, settings: BallArrayDesign) -> Self:
        device, plan, chain = subject.instrument, subject.plan, subject.chain
        assert isinstance(device, BallArray)
        frame, order = _own_frame(device)
        poses = ArrayPoses(
            device.centres[order],  # type: ignore[arg-type]  (numpy, so that nothing is compiled)
            device.pose_rotation,  # type: ignore[arg-type]
            device.pose_origin,  # type: ignore[arg-type]
        )
        own = frame.own(poses)
        _check_artefact(subject, model, settings, np.asarray(own.balls), device.numbers[order])
        numbers, groups = device.numbers[order], device.pose_numbers
        row = np.full((len(groups), len(numbers)), -1)
        place = {int(ball): i for i, ball in enumerate(numbers)}
        at = np.searchsorted(groups, np.asarray(plan.groups["pose"]))
        row[at, [place[int(b)] for b in np.asarray(plan.groups["ball"])]] = np.arange(plan.rows)
        recorded = [name for name in plan.covariates if name not in DERIVED]
        space = ArraySpace(
            own,
            {axis: tuple(chain.joint(axis).travel.tolist()) for axis in "XYZ"},
            poses=settings.poses,
            across=(settings.across_mm[0] * 1e-3, settings.across_mm[1] * 1e-3),
            along=settings.along,
            spacing=settings.spacing_mm * 1e-3 if settings.along else 0.0,
            tool=tuple(np.asarray(chain.tool_offset).tolist()),
        )
        return cls(
            chain=chain,
            device=device,
            settings=settings,
            space=space,
            frame=frame,
            numbers=tuple(numbers.tolist()),
            pose_numbers=tuple(groups.tolist()),
            known={name: _filled(np.asarray(plan.covariates[name]), row) for name in recorded},
            touched=row >= 0,
            row=row,
            nominal_poses=poses,
            found=np.asarray(plan.position),
            beam=device.beam()[0],
        )

    def following(self, count: int, varied: Sequence[Varied]) -> Self:
        last = {name: np.full((count, len(self.numbers)), v[-1, -1])
                for name, v in self.known.items()}  # fmt: skip
        first = max(self.groups) + 1
        alike = np.zeros(count, int)
        poses = ArrayPoses(
            self.nominal_poses.balls,
            self.nominal_poses.rotation[alike],
            self.nominal_poses.origin[alike],
        )
        fixed = dataclasses.replace(
            self.space,
            nominal=self.frame.own(poses),
            poses=True,
            across=(0.0, 0.0),
            along=False,
            spacing=0.0,
        )
        return dataclasses.replace(
            self,
            space=fixed,
            pose_numbers=tuple(range(first, first + count)),
            known=last,
            touched=np.ones((count, len(self.numbers)), bool),
            row=np.full((count, len(self.numbers)), -1),
            nominal_poses=poses,
            varied=tuple(varied),
            anywhere=True,
        )

    @property
    def groups(self) -> tuple[int, ...]:
        return self.pose_numbers

    @property
    def taken(self) -> bool:
        planned = np.asarray(self.nominal_poses.position(self.chain))[self.touched]
        found = self.found[self.row[self.touched]][:, _order(self.chain)]
        return bool(np.abs(planned - found).max() > _EXACT_M)

    @property
    def low(self) -> Float[np.ndarray, " d"]:
        return np.concatenate([self.space.low, self._ends(lambda v: v.low)])

    @property
    def high(self) -> Float[np.ndarray, " d"]:
        return np.concatenate([self.space.high, self._ends(lambda v: v.high)])

    @property
    def start(self) -> Float[np.ndarray, " d"]:
        return np.concatenate([self.space.start, self._ends(lambda v: 0.5 * (v.low + v.high))])

    def scattered(self, key: Array) -> Float[np.ndarray, " d"]:
        if not self.anywhere:
            return self.space.scattered(key)
        turns, shares, others = jax.random.split(key, 3)
        m = len(self.groups)
        quaternion = np.array(jax.random.normal(turns, (m, 4)))
        drawn = np.concatenate(
            [_turn_vectors(quaternion), np.array(jax.random.uniform(shares, (m, 3)))], 1
        )
        z = self.start
        z[: 6 * m] = drawn.ravel()
        rest = np.array(jax.random.uniform(others, (len(z) - 6 * m,)))
        z[6 * m :] = (self.low + (self.high - self.low) * np.r_[np.zeros(6 * m), rest])[6 * m :]
        return np.clip(z, self.low, self.high)

    @property
    def nominal(self) -> Placed:
        return Placed(self.nominal_poses, self.known, np.zeros(()), np.ones(()))  # type: ignore[arg-type]

    def placed(self, z: Float[Array, " d"]) -> Placed:
        own = len(self.space.low)
        made = self.space.candidate(z[:own])
        chosen = z[own:].reshape(len(self.varied), len(self.groups))
        covariates: dict[str, Any] = dict(self.known)
        for varied, values in zip(self.varied, chosen, strict=True):
            covariates[varied.name] = jnp.broadcast_to(values[:, None], self.touched.shape)
        return Placed(self.frame.certificate(made.poses), covariates, made.excess, made.penalty)

    def excess(self, placed: Placed) -> Float[Array, ""]:
        return placed.excess

    def penalty(self, placed: Placed) -> Float[Array, ""]:
        return placed.penalty

    def settled(self, placed: Placed) -> Placed:
        covariates = dict(placed.covariates)
        for v in self.varied:
            if v.step:
                up = np.asarray(covariates[v.name]) >= 0.5 * (v.low + v.high)
                covariates[v.name] = np.where(up, v.high, v.low)
        return placed._replace(covariates=covariates)

    def information(
        self, placed: Placed, model: Model, weights: Float[Array, " g"]
    ) -> Float[Array, "k+s k+s"]:
        covariates = {**placed.covariates, **derived(placed.poses, self.beam, self.chain.up)}
        conditions = Conditions(self.groups, self.numbers, covariates)
        seen = probed(model, placed.poses, self.device.probe_sigma, conditions)
        if not self.touched.all():
            there = jnp.repeat(jnp.asarray(self.touched, float), 3, axis=1)[:, :, None]
            seen = Touches(*(part * there for part in seen))
        if not len(self.shared):
            seen = seen._replace(balls=seen.balls[:, :, :0])
        both = without_poses(seen)
        weighed = both * weights[:, None, None]
        # One product of tall matrices instead of one per pose.
        return weighed.reshape(-1, both.shape[-1]).T @ both.reshape(-1, both.shape[-1])

    @property
    def shared(self) -> Float[np.ndarray, "s s"]:
        u = self.device.position_sigma
        if u == 0.0:
            return np.zeros((0, 0))
        return np.eye(3 * len(self.numbers)) * (u**-2 + LOOSE_M**-2)

    def instrument(self, placed: Placed) -> BallArray:
        return dataclasses.replace(
            self.device,
            centres=np.asarray(placed.poses.balls),
            numbers=np.array(self.numbers),
            pose_numbers=np.array(self.groups),
            pose_rotation=np.asarray(placed.poses.rotation),
            pose_origin=np.asarray(placed.poses.origin),
        )

    def plan(self, placed: Placed) -> Plan:
        position = np.asarray(placed.poses.position(self.chain))[:, :, _inverse_order(self.chain)]
        # Rows in the order of the study; further rows along the artefact.
        poses, balls = np.nonzero(self.touched)
        order = np.argsort(self.row[poses, balls], kind="stable")
        poses, balls = poses[order], balls[order]
        covariates = {**placed.covariates, **derived(placed.poses, self.beam, self.chain.up)}
        return Plan(
            self.chain.axes,
            position[poses, balls],
            {name: np.asarray(values)[poses, balls] for name, values in covariates.items()},
            {"pose": np.array(self.groups)[poses], "ball": np.array(self.numbers)[balls]},
        )

    def seconds(self, placed: Placed) -> float:
        s = self.settings
        moving = path_m(np.asarray(self.plan(placed).position)) * s.seconds_per_metre
        touching = self.touched.sum() * s.seconds_per_ball
        return float(len(self.groups) * s.seconds_per_pose + touching + moving)

    def artefact(self, placed: Placed) -> Mapping[str, np.ndarray]:
        # In the order of the certificate.
        order = [self.numbers.index(int(ball)) for ball in self.device.numbers]
        balls = np.asarray(placed.poses.balls)[order] * 1e3
        return {
            "ball": self.device.numbers,
            **{f"{c}_mm": balls[:, i] for i, c in enumerate("xyz")},
        }

    def _ends(self, of) -> np.ndarray:
        return np.repeat([of(v) for v in self.varied], len(self.groups)).astype(float)


def _own_frame(device: BallArray) -> tuple[_Frame, np.ndarray]:
    """The frame of the artefact with x along its longest side, and the order of the balls in it."""
    beam, _ = device.beam()
    longest = int(np.argmax(np.abs(beam)))
    turn = np.roll(np.eye(3), longest, axis=0)
    # The middle of the sides, so that a designed artefact stays within its limits in a new design.
    centre = 0.5 * (device.centres.min(0) + device.centres.max(0))
    return _Frame(turn, centre), np.argsort((device.centres - centre) @ turn[:, 0], kind="stable")


def _check_artefact(
    subject: Subject,
    model: Model,
    settings: BallArrayDesign,
    balls: np.ndarray,
    numbers: np.ndarray,
) -> None:
    travel = np.stack([subject.chain.joint(axis).travel for axis in "XYZ"])
    if not np.isfinite(travel).all():
        raise subject.refusal(
            "poses", "a machine without travel_mm", "the travel of X, Y and Z", "declare it"
        )
    diagonal = float(np.linalg.norm(np.diff(travel, axis=1)))
    longest = float(np.linalg.norm(balls[:, None] - balls[None], axis=2).max())
    if longest > diagonal:
        raise subject.refusal(
            "poses",
            f"an artefact {1e3 * longest:.4g} mm long",
            f"at most {1e3 * diagonal:.4g} mm, the diagonal of the travel",
            "take a shorter artefact",
        )
    for i, limit in enumerate(settings.across_mm):
        off = np.abs(balls[:, 1 + i]) * 1e3
        if limit and off.max() > limit + _DIGITS_MM:
            raise subject.refusal(
                f"across_mm.{i}",
                f"{limit:g}, while ball {int(numbers[int(off.argmax())])} lies {off.max():.4g} mm "
                "from the artefact's axis",
                f"at least {off.max():.4g}",
                "allow more, or 0 to leave the balls as they are",
            )
    if settings.along:
        whole = 1e3 * float(np.ptp(balls[:, 0]))
        gaps = len(balls) - 1
        if settings.spacing_mm * gaps >= whole:
            raise subject.refusal(
                "spacing_mm",
                f"{settings.spacing_mm:g} between {len(balls)} balls, "
                f"{settings.spacing_mm * gaps:g} mm together",
                f"less than {whole / gaps:.4g}, as the artefact is {whole:.4g} mm long",
                "ask for less",
            )
        near = np.diff(balls[:, 0]) * 1e3
        if near.min() < settings.spacing_mm - _DIGITS_MM:
            first = int(near.argmin())
            raise subject.refusal(
                "spacing_mm",
                f"{settings.spacing_mm:g}, while balls {int(numbers[first])} and "
                f"{int(numbers[first + 1])} are {near.min():.4g} mm apart along the artefact",
                f"at most {near.min():.4g}",
                "ask for less, or start from other balls",
            )
    if settings.along or any(settings.across_mm):
        for effect in (*model.effects, *model.random):
            if set(effect.needs) & set(_OF_SHAPE):
                raise subject.refusal(
                    "along" if settings.along else "across_mm",
                    f"balls that move, and the declared effect {effect.key!r}, which depends on "
                    "the line of the artefact",
                    "one of them",
                    "keep the balls (across_mm = [0, 0], along = false), or remove the effect",
                )


def _filled(values: np.ndarray, row: np.ndarray) -> np.ndarray:
    """A covariate of every touch; balls that are not touched have the value of the first touch of
    the pose.
    """
    first = row.max(1, keepdims=True)
    return values[np.where(row >= 0, row, first)]


def _order(chain: Chain) -> list[int]:
    """Indices of X, Y and Z among the axes."""
    return [chain.axes.index(axis) for axis in "XYZ"]


def _inverse_order(chain: Chain) -> list[int]:
    return ["XYZ".index(axis) for axis in chain.axes]


def _turn_vectors(quaternion: np.ndarray) -> np.ndarray:
    """Rotation vectors (m, 3), uniform over all orientations, from normal numbers (m, 4)."""
    unit = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    unit = unit * np.where(unit[:, :1] < 0.0, -1.0, 1.0)
    half = np.arccos(np.clip(unit[:, :1], -1.0, 1.0))
    return 2.0 * half * unit[:, 1:] / np.maximum(np.sin(half), 1e-12)
