"""Ball array: axis positions at which a probe finds the balls of a calibrated artefact."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from ..bounds import Noise, Uncertainty, Within
from ..effects.base import Artefact, Effect, Response
from ..errors import RowError, StudyError
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS, group
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector
from ..numerics.spatial import best_rigid
from ..words import counted
from .base import (
    Column,
    FileName,
    InstrumentSettings,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .conditions import ROTARY, linear_plan, linear_plan_table
from .follow import check_follows
from .frame import displaced, pose_parameters
from .marks import Mark

_FOUND_M = 1e-12
_STEPS = 20
_LEAST_APART_MM = 0.1
"""Least distance of two balls: closer ones are one ball, or in another unit."""
_AGAIN_MM = 2.0
"""Largest plausible distance between two readings of one ball in one pose."""
_BAR = 0.1
"""Ratio of breadth to length below which a picture shows the balls as a bar."""
_LINE = 1e-5
"""Ratio of breadth to length of balls on one line: the rounding of a certificate."""
_PROBE_M = 1e-3
"""Step of the differences by which the directions of turned linear axes are found."""
_FOLDS = 5
"""Number of folds of settings of the rotary axes."""
_LEAST_SPAN = 0.01
"""Least distance of the supports as a share of the artefact's length."""
_DERIVED = (
    *(f"gravity_{c}" for c in "xyz"),
    *(f"ball_{c}" for c in "xyz"),
    "tilt",
    "along_beam",
)
"""Covariates of the plan that follow from the poses and the artefact."""


_XYZ = ("X", "Y", "Z")


_LARGE = "no artefact is 20 m long"
_Share = Annotated[float, Within(-1e3, 1e3, "it is a share of a length, which is checked further")]


class BallArraySettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "ball_array"``."""

    artefact: FileName
    """Table of the calibrated centres of the balls beside the study file."""
    probe_sigma_um: Noise
    """Noise of each coordinate of a ball, one standard deviation."""
    ball_position_u_um: Uncertainty = 0.0
    """Standard uncertainty of each calibrated coordinate."""
    supports: tuple[_Share, _Share] = (0.2203, 0.7797)
    """Where the artefact rests, as shares of its length; it bends between the supports."""

    @model_validator(mode="after")
    def _supported(self) -> Self:
        low, high = self.supports
        if not (0.0 <= low <= 1.0 and 0.0 <= high <= 1.0 and high - low >= _LEAST_SPAN):
            raise ValueError(
                f"found supports = [{low:g}, {high:g}], expected two shares of the artefact's "
                f"length from 0 to 1, the lower first and at least {_LEAST_SPAN:g} apart; correct "
                "them, such as [0.22, 0.78]"
            )
        return self


class ArtefactPoses(Effect):
    """Pose of the artefact in every set-up relative to its initial value: six parameters with flat
    priors per pose, three where only one of its balls is measured.
    """

    name = "artefact_pose"
    summary = "pose of the artefact in each set-up"
    kind = "nuisance"
    where = "instrument"
    poses: tuple[int, ...] = ()
    placed: tuple[int, ...] = ()
    """Poses with one ball, in which the orientation of the artefact is not observable."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            p
            for pose in self.poses
            for p, c in zip(pose_parameters(f"{pose}."), COMPONENTS, strict=True)
            if c in self._free(pose)
        )

    def _free(self, pose: int) -> tuple[str, ...]:
        return _XYZ if pose in self.placed else COMPONENTS

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        index = plan.groups["pose"]
        return {
            (f"target.{c}", f"{pose}.{c}"): (index == pose) * 1.0
            for pose in self.poses
            for c in self._free(pose)
        }


class BallCalibration(Effect):
    """Error of each calibrated ball centre, with the standard uncertainty of the certificate."""

    name = "ball_calibration"
    summary = "uncertain calibrated ball positions"
    where = "instrument"
    balls: tuple[int, ...] = ()
    sigma: float = 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{ball}.{c}", "um", sigma=self.sigma / 1e-6)
            for ball in self.balls
            for c in "XYZ"
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        index = plan.groups["ball"]
        return {
            (f"ball.{c}", f"{ball}.{c}"): (index == ball) * 1.0
            for ball in self.balls
            for c in "XYZ"
        }


@register
class BallArray(TableInstrument):
    """The residual is tool point(measured position) - ball centre, in the workpiece frame.

    The ball centre is t + R (b + d), with the artefact pose (R, t), the calibrated centre b and its
    error d. The reading is implicit (the measured axis positions); a fit uses the explicit
    residual, whose derivative with respect to the positions is a rotation to 1e-4, so that
    isotropic probing noise enters it unchanged. Only simulation solves for the positions.

    On a machine with rotary axes, the artefact, which may be a single ball, stays clamped while
    they turn: a pose is one clamping.
    """

    kind = "ball_array"
    Settings = BallArraySettings
    derived = _DERIVED
    rotary = True

    centres: np.ndarray
    """Calibrated ball centres (balls, 3), m, by ball number."""
    numbers: np.ndarray
    """Ball numbers as in the artefact table."""
    probe_sigma: float
    position_sigma: float
    supports: tuple[_Share, _Share]
    pose_numbers: np.ndarray
    pose_rotation: np.ndarray
    pose_origin: np.ndarray
    single: tuple[int, ...] = ()
    """Poses in which one ball was measured."""

    @property
    def ports(self) -> tuple[str, ...]:
        return group("target") + group("ball", _XYZ) + group("read", _XYZ)

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        poses, balls = np.asarray(plan.groups["pose"]), self._ball_rows(plan)
        apart = np.linalg.svd(self.centres - self.centres.mean(0), compute_uv=False)
        bar = len(self.centres) > 1 and bool(apart[1] < _BAR * apart[0])
        found = []
        for k, pose in enumerate(self.pose_numbers):
            lone = pose in self.single  # the orientation of the artefact is not observable
            places = self.centres[np.unique(balls[poses == pose])] if lone else self.centres
            places = places @ self.pose_rotation[k].T + self.pose_origin[k]
            found.append(Mark("ball", places, joined=bar, free=True))
        return tuple(found)

    @property
    def readings(self) -> tuple[str, ...]:
        return _XYZ

    @classmethod
    def columns(
        cls, settings: BallArraySettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        return [Column(name=name, low=0, integer=True) for name in ("pose", "ball")]

    @classmethod
    def build(
        cls,
        settings: BallArraySettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        artefact = load(
            settings.artefact,
            [Column(name="ball", low=0, integer=True, unique_with=("ball",))]
            + [Column(name=f"{c}_mm", low=-2e4, high=2e4, why=_LARGE) for c in "xyz"],
        )
        _check_balls(settings.artefact, artefact["ball"], table["ball"])
        poses = np.unique(table["pose"]).astype(int)
        _check_poses(poses, table, chain.linear)
        centres_mm = np.column_stack([artefact[f"{c}_mm"] for c in "xyz"])
        _check_apart(settings.artefact, artefact["ball"], centres_mm)
        single = () if chain.linear else _single(poses, table)
        several = [pose for pose in poses if pose not in single]
        _check_lines(several, table, settings.artefact, artefact["ball"], centres_mm)
        built = cls(
            centres=centres_mm * 1e-3,
            numbers=artefact["ball"].astype(int),
            probe_sigma=settings.probe_sigma_um * 1e-6,
            position_sigma=settings.ball_position_u_um * 1e-6,
            supports=settings.supports,
            pose_numbers=poses,
            pose_rotation=np.tile(np.eye(3), (len(poses), 1, 1)),
            pose_origin=np.zeros((len(poses), 3)),
            single=single,
        )
        plan = linear_plan(chain, table)
        _check_turned(plan, single)
        _check_again(plan)
        check_follows(
            chain,
            plan,
            lambda nominal: built._placed(plan, nominal)._off(plan, nominal),
            "columns x_mm, y_mm, z_mm",
            "the machine, and the coordinates of the balls with the artefact",
        )
        return built

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        plan = linear_plan(chain, table)
        turn = None if chain.linear else chain.turn(np.asarray(plan.position))
        return self.start(chain, plan, np.zeros((plan.rows, 3))).with_geometry(plan, turn, chain.up)

    def with_geometry(
        self,
        plan: Plan,
        turn: np.ndarray | None = None,
        up: Sequence[float] = (0.0, 0.0, 1.0),
    ) -> Plan:
        """The plan with covariates derived from the artefact and its poses: direction of gravity,
        tilt of the beam, and every ball's position in the artefact's frame. `turn` (n, 3, 3) is the
        rotation from the bed's frame, in which `up` points against gravity, to the workpiece frame;
        identity where it is None.
        """
        index = np.searchsorted(self.pose_numbers, plan.groups["pose"])
        beam, along = self.beam()
        poses = self.pose_rotation[index]
        # Gravity in the artefact's frame.
        upward = np.broadcast_to(up, (plan.rows, 3)) if turn is None else turn @ np.asarray(up)
        down = -np.einsum("nij,ni->nj", poses, upward)
        derived = {f"gravity_{c}": down[:, i] for i, c in enumerate("xyz")}
        derived["tilt"] = np.arcsin(np.clip(-down @ beam, -1.0, 1.0))
        derived["along_beam"] = along[self._ball_rows(plan)]
        balls = self.centres[self._ball_rows(plan)]
        derived |= {f"ball_{c}": balls[:, i] for i, c in enumerate("xyz")}
        return Plan(plan.axes, plan.position, {**plan.covariates, **derived}, plan.groups)

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.zeros((len(table["ball"]), 3))

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        return linear_plan_table(plan, _DERIVED)

    def rows(self, plan: Plan) -> Any:
        pose = np.searchsorted(self.pose_numbers, np.asarray(plan.groups["pose"]))
        return (
            self.centres[self._ball_rows(plan)],
            self.pose_rotation[pose],
            self.pose_origin[pose],
        )

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        centre, r0, t0 = row
        turn, origin = displaced(r0, t0, ports["target"])
        ball = origin + turn @ (Vector.of(centre) + Vector.of(ports["ball"]))
        # Errors of the probe act in the frame of the tool.
        return (tool - ball + rotation @ Vector.of(ports["read"])).parts

    def record(
        self, plan: Plan, ideal: Callable[[Plan], np.ndarray], noise: np.ndarray
    ) -> tuple[Plan, np.ndarray]:
        """The axis positions q at which the tool point is in the ball centre, with probing noise.

        They are the fixed point of q <- q - T (tcp(q) - ball), from the nominal q: d tcp/d q is the
        inverse of T to 1e-4, so every step gains four digits; effects act at the position found. T
        is the identity where no rotary axis has turned. Raises `StudyError` where the iteration
        does not converge.
        """
        order = [plan.axes.index(axis) for axis in _XYZ]
        position, to_axes = np.array(plan.position), _to_axes(plan, ideal)
        for _ in range(_STEPS):
            off = ideal(plan.with_position(position))
            position[:, order] -= np.einsum("nij,nj->ni", to_axes, off)
            if np.abs(off).max() < _FOUND_M:
                break
        else:
            raise StudyError(
                f"no axis positions at the ball centres: found a step of {np.abs(off).max():.3g} m "
                f"after {_STEPS} steps, expected less than {_FOUND_M:g} m; reduce the declared "
                "errors"
            )
        position[:, order] += noise
        return plan.with_position(position), np.zeros_like(noise)

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.full((plan.rows, 3), self.probe_sigma)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.ones((plan.rows, 3))

    def start(self, chain: Chain, plan: Plan, readings: np.ndarray) -> Self:
        return self._placed(plan, chain.tool_point(np.asarray(plan.position)))

    def _placed(self, plan: Plan, nominal: np.ndarray) -> Self:
        """The same with poses fitted to nominal tool points (n, 3) at the balls."""
        balls = self.centres[self._ball_rows(plan)]
        rotations, origins = [], []
        for pose in self.pose_numbers:
            rows = np.asarray(plan.groups["pose"]) == pose
            if pose in self.single:
                r, t = np.eye(3), (nominal[rows] - balls[rows]).mean(0)
            else:
                r, t = best_rigid(balls[rows], nominal[rows])
            rotations.append(r)
            origins.append(t)
        return dataclasses.replace(
            self, pose_rotation=np.stack(rotations), pose_origin=np.stack(origins)
        )

    def _off(self, plan: Plan, nominal: np.ndarray) -> np.ndarray:
        """Distance (n,) of tool points (n, 3) from the balls in the current poses."""
        pose = np.searchsorted(self.pose_numbers, np.asarray(plan.groups["pose"]))
        balls = self.centres[self._ball_rows(plan)]
        found = np.einsum("nij,nj->ni", self.pose_rotation[pose], balls) + self.pose_origin[pose]
        return np.linalg.norm(nominal - found, axis=1)

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        effects: tuple[Effect, ...] = (
            ArtefactPoses(poses=tuple(int(p) for p in self.pose_numbers), placed=self.single),
        )
        if self.position_sigma > 0:
            balls = tuple(int(b) for b in self.numbers)
            effects += (BallCalibration(balls=balls, sigma=self.position_sigma),)
        return effects

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # Whole poses, since the six unknowns of a pose connect its balls. Where the artefact stays
        # clamped while rotary axes turn it, whole settings of these, whatever the order of rows.
        pose = np.searchsorted(self.pose_numbers, np.asarray(plan.groups["pose"]))
        turning = [np.asarray(plan.x(axis)) for axis in plan.axes if axis in ROTARY]
        if not turning or len(self.pose_numbers) >= _FOLDS:
            return pose, False
        _, first, setting = np.unique(
            np.column_stack([pose, *turning]), axis=0, return_index=True, return_inverse=True
        )
        place = np.argsort(np.argsort(first))[setting.ravel()]
        return place * _FOLDS // len(first), False

    @property
    def artefact(self) -> Artefact | None:
        """Supports and direction of the beam, for effects of the artefact; None for one ball."""
        if len(self.numbers) < 2:
            return None
        x, y, z = (float(v) for v in self.beam()[0])
        return Artefact(self.supports, (x, y, z))

    def beam(self) -> tuple[np.ndarray, np.ndarray]:
        """Direction of the artefact's long axis, from the ball with the lowest number to that with
        the highest, and each ball's position along it as a share; 0 for a single ball.
        """
        arm = self._from_centroid()
        direction = np.linalg.svd(arm)[2][0]
        along = arm @ direction
        if along[np.argmin(self.numbers)] > along[np.argmax(self.numbers)]:
            direction, along = -direction, -along
        return direction, (along - along.min()) / (np.ptp(along) or 1.0)

    def _from_centroid(self) -> np.ndarray:
        return self.centres - self.centres.mean(0)

    def _ball_rows(self, plan: Plan) -> np.ndarray:
        order = np.argsort(self.numbers)
        return order[np.searchsorted(self.numbers[order], np.asarray(plan.groups["ball"]))]


def _to_axes(plan: Plan, ideal: Callable[[Plan], np.ndarray]) -> np.ndarray:
    """T (n, 3, 3) with dq = T d tcp for the axes X, Y and Z: the identity without rotary axes."""
    if not {*plan.axes} & {*ROTARY}:
        return np.broadcast_to(np.eye(3), (plan.rows, 3, 3))
    position, slopes = np.asarray(plan.position), []
    for axis in _XYZ:
        step = _PROBE_M * (np.array(plan.axes) == axis)
        ends = (ideal(plan.with_position(position + sign * step)) for sign in (1.0, -1.0))
        slopes.append((next(ends) - next(ends)) / (2.0 * _PROBE_M))
    return np.linalg.inv(np.stack(slopes, axis=2))


def _single(poses: np.ndarray, table: Mapping[str, np.ndarray]) -> tuple[int, ...]:
    """The poses in which only one ball was measured."""
    return tuple(
        int(pose) for pose in poses if len(np.unique(table["ball"][table["pose"] == pose])) == 1
    )


def _check_turned(plan: Plan, single: Sequence[int]) -> None:
    """Raise `RowError` where a single ball was measured and no rotary axis turned it."""
    turning = np.stack([np.asarray(plan.x(axis)) for axis in plan.axes if axis in ROTARY] or [[]])
    for pose in single:
        rows = np.flatnonzero(np.asarray(plan.groups["pose"]) == pose)
        if not np.ptp(turning[:, rows], axis=1).any():
            raise RowError(
                int(rows[0]),
                "column pose",
                f"one ball in pose {pose}, at one setting of the rotary axes",
                "several settings of a rotary axis, which move it, or three balls at least",
                "measure it at other angles, or remove the pose",
            )


def _check_balls(file: str, calibrated: np.ndarray, found: np.ndarray) -> None:
    for row, ball in enumerate(found):
        if ball not in calibrated:
            known = ", ".join(str(int(b)) for b in calibrated)
            raise RowError(
                row,
                "column ball",
                f"{int(ball)}",
                f"a ball of {file} ({known})",
                f"correct the index or add the ball to {file}",
            )


def _check_again(plan: Plan) -> None:
    """Raise `RowError` where two readings of a ball in one pose, at one setting of the rotary axes,
    differ by more than plausible errors of the machine.
    """
    position, axes = np.asarray(plan.position), np.array(plan.axes)
    turning, moving = np.isin(axes, [*ROTARY]), np.isin(axes, _XYZ)
    pose, ball = (np.asarray(plan.groups[name]) for name in ("pose", "ball"))
    first: dict[tuple[float, ...], int] = {}
    for row, setting in enumerate(np.column_stack([pose, ball, position[:, turning]])):
        before = first.setdefault(tuple(setting), row)
        apart = 1e3 * np.linalg.norm(position[row, moving] - position[before, moving])
        if apart > _AGAIN_MM:
            raise RowError(
                row,
                "column ball",
                f"pose {int(pose[row])}, ball {int(ball[row])} again {apart:.3g} mm from where row "
                f"{before + 1} has it",
                f"the same place within {_AGAIN_MM:g} mm, or another ball or pose",
                "correct the index; an artefact that was moved is in another pose",
            )


def _check_poses(poses: np.ndarray, table: Mapping[str, np.ndarray], linear: bool) -> None:
    for pose in poses:
        mine = table["pose"] == pose
        # A rotary axis brings one ball to several positions.
        count = len(np.unique(table["ball"][mine])) if linear else int(mine.sum())
        if count < 3:
            raise RowError(
                int(np.argmax(mine)),
                "column pose",
                f"{counted(count, 'ball')} in pose {pose}",
                "at least 3 to find its six unknowns",
                "measure more balls or remove the pose",
            )


def _check_apart(file: str, balls: np.ndarray, centres_mm: np.ndarray) -> None:
    """Raise `StudyError` where two balls of the artefact are at the same position."""
    for i, centre in enumerate(centres_mm[1:], start=1):
        apart = np.linalg.norm(centres_mm[:i] - centre, axis=1)
        nearest = int(np.argmin(apart))
        if apart[nearest] < _LEAST_APART_MM:
            raise StudyError(
                f"{file}, columns x_mm, y_mm, z_mm: found balls {int(balls[nearest])} and "
                f"{int(balls[i])} {apart[nearest]:.3g} mm apart, expected every ball at a place of "
                f"its own, {_LEAST_APART_MM:g} mm apart at least; correct the row or the unit"
            )


def _check_lines(
    poses: Sequence[int],
    table: Mapping[str, np.ndarray],
    file: str,
    balls: np.ndarray,
    centres_mm: np.ndarray,
) -> None:
    """Raise `RowError` where all balls of a pose lie on one line, about which the rotation of the
    artefact is not observable.
    """
    for pose in poses:
        rows = np.flatnonzero(table["pose"] == pose)
        touched = centres_mm[np.isin(balls, table["ball"][rows])]
        length, breadth, *_ = np.linalg.svd(touched - touched.mean(0), compute_uv=False)
        if breadth < _LINE * length:
            listed = ", ".join(f"{int(ball)}" for ball in table["ball"][rows])
            raise RowError(
                int(rows[0]),
                "column ball",
                f"the balls {listed} of pose {int(pose)}, all on one line of {file}",
                "balls that span a plane, as the rotation about a line is not observable",
                "measure a ball off the line as well, or remove the pose",
            )
