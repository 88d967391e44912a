"""Pose probe: position and orientation of a body on the tool of an arm, in a tracker's frame."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from ..bounds import Noise, Within
from ..effects.base import Effect, Response
from ..errors import RowError
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.arrays import Array, known
from ..numerics.eigen import eigh
from ..numerics.rigid import ORIGIN, Rotation, Scalar, Vector, exp
from .arm_follow import check_arm_follows
from .arm_table import arm_columns, arm_plan, arm_table
from .base import (
    Column,
    InstrumentSettings,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .frame import Station, displaced
from .marks import Mark
from .orientation import (
    CONVENTIONS,
    Convention,
    angles,
    between_frames,
    orientation_columns,
    orientation_names,
    orientation_table,
    orientations,
    turns,
    unturned,
)

_POSITION = ("x_mm", "y_mm", "z_mm")
_READ = ("x", "y", "z", "a", "b", "c")
_LARGEST_DEG = 15.0
"""Largest plausible error of the orientation of an arm, in half of the rows."""
_LEAST_SHARE = 1e-6
"""Least eigenvalue of a correlation matrix: a combination of readings without noise is none."""
_Share = Annotated[float, Within(-1.0, 1.0, "it is a correlation")]
_Row = tuple[_Share, _Share, _Share, _Share, _Share, _Share]


class PoseProbeSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "pose_probe"``."""

    position_sigma_um: Noise
    """Noise of each coordinate of the probe, one standard deviation."""
    orientation_sigma_urad: Noise
    """Noise of its orientation about each axis of the instrument's frame, one standard deviation.
    """
    orientation: Convention = "quaternion"
    """Columns of the orientation R, from the frame of the probe to that of the instrument:
    "quaternion" (qw, qx, qy, qz), "euler_xyz" (R = Rx Ry Rz of rx_deg, ry_deg, rz_deg), "euler_zyx"
    (R = Rz Ry Rx of the same) or "euler_zyz" (R = Rz Ry Rz of rz1_deg, ry_deg, rz2_deg)."""
    correlation: tuple[_Row, _Row, _Row, _Row, _Row, _Row] | None = None
    """Correlation matrix of the noise of x, y, z and of the rotations about x, y and z of the
    instrument's frame; none by default."""
    joints: Literal["commanded", "read"] = "commanded"
    """Which joint positions move the model: those commanded or those read back."""

    @model_validator(mode="after")
    def _correlated(self) -> Self:
        if self.correlation is None:
            return self
        matrix = np.array(self.correlation)
        if not np.allclose(matrix, matrix.T, atol=1e-9) or not np.allclose(np.diag(matrix), 1.0):
            raise ValueError(
                "found a correlation that is not symmetric with ones on the diagonal, expected six "
                "rows of six correlations of x, y, z and the rotations about x, y and z; correct it"
            )
        if np.linalg.eigvalsh(matrix).min() < _LEAST_SHARE:
            raise ValueError(
                "found a correlation with a combination of readings that has no noise, expected a "
                "positive definite matrix; make the correlations smaller"
            )
        return self


class ProbeFrame(Effect):
    """Position and orientation of the probe on the tool from their initial values: six parameters
    with flat priors.
    """

    name = "probe_frame"
    summary = "position and orientation of the probe on the tool"
    kind = "nuisance"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        places = tuple(Parameter(c, "um", scale=1000.0) for c in "XYZ")
        return (*places, *(Parameter(c, "urad", scale=1000.0) for c in "ABC"))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        one = np.ones(plan.rows)
        places: Response = {(f"point1.{c}", c): one for c in "XYZ"}
        return {**places, **{(f"turn.{c}", c): one for c in "ABC"}}


class ProbeCorrelation(Effect):
    """Noise that position and orientation share: independent in every row, along the eigenvectors
    of the declared correlation (`PoseProbe.noise`).
    """

    name = "probe_correlation"
    summary = "noise that the position and the orientation of the probe share"
    kind = "random"
    where = "instrument"
    shared: np.ndarray
    """Readings (6, k) per standard deviation of each shared part, m and rad."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"part{i + 1}", "1", sigma=1.0) for i in range(self.shared.shape[1]))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        one = np.ones(plan.rows)
        return {
            (f"read.{c}", f"part{i + 1}"): float(self.shared[k, i]) * one
            for i in range(self.shared.shape[1])
            for k, c in enumerate("XYZABC")
        }


@register
class PoseProbe(TableInstrument):
    """Position v = R'(p + R_tool r - s) and orientation R' R_tool P of a probe on the tool, in the
    frame of the instrument, with the pose (R, s) of that frame and the place r and orientation P of
    the probe on the tool as nuisances.

    Readings of the orientation are the rotation from its nominal value, about the axes of the
    instrument's frame: with D = (R' R_tool P) (R0' R_nominal P0)', the vector of (D - D') / 2,
    which is sin(angle) times the axis. R0 and P0 are the closed-form solution for the nominal arm.

    The covariance of the noise is D C D, with D the declared standard deviations and C the declared
    correlation. Its part s D D, with s the smallest eigenvalue of C, is independent in every
    reading; the rest is a random effect.
    """

    kind = "pose_probe"
    arms = True
    remembers = True
    Settings = PoseProbeSettings

    chain: Chain
    sigma: np.ndarray
    """Declared standard deviations (6,), m and rad."""
    correlation: np.ndarray
    convention: str
    joints: str
    station: np.ndarray
    orientation: np.ndarray
    point: np.ndarray
    """Initial place of the probe on the tool (3,), m."""
    probe: np.ndarray
    """Initial orientation of the probe on the tool (3, 3)."""

    @property
    def ports(self) -> tuple[str, ...]:
        return (
            *group("frame"),
            *group("point1", ("X", "Y", "Z")),
            *group("turn", ("A", "B", "C")),
            *group("read"),
        )

    @property
    def frame_pose(self) -> tuple[np.ndarray, np.ndarray]:
        return self.orientation, self.station

    @property
    def tool_places(self) -> Mapping[str, np.ndarray]:
        return {"point1": self.point}

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        place, frame = np.reshape(self.station, (1, 3)), np.asarray(self.orientation)
        station = Mark("instrument", place, frame=frame, free=True)
        return station, Mark("probe", np.reshape(self.point, (1, 3)), "tool", free=True)

    def seen_points(self, readings: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n k 3"]:
        return np.asarray(readings, float)[:, None, :3]

    @property
    def readings(self) -> tuple[str, ...]:
        return _READ

    @classmethod
    def columns(
        cls, settings: PoseProbeSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        found = arm_columns(axes, settings.joints)
        if readings:
            found += [Column(name=name, low=-1e5, high=1e5) for name in _POSITION]
            found += orientation_columns(settings.orientation)
        return found

    @classmethod
    def build(
        cls,
        settings: PoseProbeSettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        correlation = np.eye(6)
        if settings.correlation is not None:
            correlation = np.array(settings.correlation)
        sigma = np.repeat([settings.position_sigma_um, settings.orientation_sigma_urad], 3) * 1e-6
        start = np.zeros(3), np.eye(3), np.zeros(3), np.eye(3)
        if orientation_names(settings.orientation)[0] in table:
            start = _start(settings, chain, table)
        station, orientation, point, probe = start
        return cls(
            chain=chain,
            sigma=sigma,
            correlation=correlation,
            convention=settings.orientation,
            joints=settings.joints,
            station=station,
            orientation=orientation,
            point=point,
            probe=probe,
        )

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        readings = {*_POSITION, *orientation_names(self.convention)}
        return arm_plan(chain, table, self.joints, readings)

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        places = np.column_stack([table[name] for name in _POSITION]) * 1e-3
        seen = orientations(table, self.convention)
        nominal = self._nominal(self.plan(self.chain, table))
        return np.hstack([places, turns(seen @ np.swapaxes(nominal, 1, 2))])

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        places = {name: readings[:, i] * 1e3 for i, name in enumerate(_POSITION)}
        seen = unturned(readings[:, 3:]) @ self._nominal(plan)
        return (
            arm_table(plan, self.chain.commands) | places | orientation_table(seen, self.convention)
        )

    def _nominal(self, plan: Plan) -> Float[np.ndarray, "n 3 3"]:
        """Orientation of the probe in every row, for the nominal arm and the initial poses."""
        rotations, _ = self.chain.tool_frame(np.asarray(plan.position))
        return self.orientation.T @ rotations @ self.probe

    def rows(self, plan: Plan) -> Float[Array, "n 3 3"]:
        if known(plan.position):
            return self._nominal(plan)
        # A design traces the positions.
        still = jnp.zeros((len(self.chain.joints), 6))
        turn = jax.vmap(lambda q: self.chain.pose_as_arrays(q, still)[0])(plan.position)
        return self.orientation.T @ turn @ self.probe

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        rotation, tool = _computed_once(rotation, tool)
        turn, station = displaced(self.orientation, self.station, ports["frame"])
        place = Vector.of(self.point) + Vector.of(ports["point1"])
        seen = turn.T @ (tool + rotation @ place - station)
        away = _turned(Rotation.of(row), self._axes(turn, rotation, ports["turn"]))
        ideal = [*seen.parts, *away.parts]
        return [value + port for value, port in zip(ideal, ports["read"], strict=True)]

    def _axes(self, turn: Rotation, rotation: Rotation, twist: Sequence[Scalar]) -> list[Vector]:
        """Axes of the probe in the frame of the instrument. Products of vectors compile in seconds,
        those of rotations in minutes.
        """
        displacement, probe = exp(Vector.of(twist)).T.rows, Rotation.of(self.probe)
        return [turn.T @ (rotation @ (probe @ column)) for column in displacement]

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        least = np.linalg.eigvalsh(self.correlation)[0]
        return np.tile(np.sqrt(least) * self.sigma, (plan.rows, 1))

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        # An angle counts with the lever arm at which its noise is that of a position.
        lever = self.sigma[0] / self.sigma[3]
        return np.tile(np.repeat([1.0, lever], 3), (plan.rows, 1))

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        found = (Station(), ProbeFrame())
        size, vectors = eigh(self.correlation)
        rest = size - size[0]
        kept = rest > 1e-9
        if not kept.any():
            return found
        shared = self.sigma[:, None] * vectors[:, kept] * np.sqrt(rest[kept])
        return (*found, ProbeCorrelation(shared=shared))

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # The last fifth in time is never fitted: an arm is used after its calibration.
        in_time = np.argsort(np.asarray(plan.groups["pose"]), kind="stable")
        held = np.argsort(in_time) >= plan.rows - plan.rows // 5
        return np.where(held, 0, -1), True

    def clusters(self, plan: Plan) -> np.ndarray:
        return np.zeros(plan.rows, int)


def _computed_once(rotation: Rotation, tool: Vector) -> tuple[Rotation, Vector]:
    """The same rotation and point, as elements of one array. The compiler does not repeat the
    kinematics of the arm in what a sum of multiples of unit vectors is used for; without it, the
    six readings take minutes to compile.
    """
    parts = [*(c for row in rotation.rows for c in row.parts), *tool.parts]
    v = jnp.zeros(len(parts))
    for part, unit in zip(parts, np.eye(len(parts)), strict=True):
        v = v + part * unit
    rows = tuple(Vector(v[3 * i], v[3 * i + 1], v[3 * i + 2]) for i in range(3))
    return Rotation(rows), Vector(v[9], v[10], v[11])


def _turned(nominal: Rotation, axes: Sequence[Vector]) -> Vector:
    """sin(angle) times the axis of the rotation that turns the columns of `nominal` into `axes`:
    half the sum of the vector products of the columns.
    """
    total = ORIGIN
    for column, axis in zip(nominal.T.rows, axes, strict=True):
        total = total + column.cross(axis)
    return total * 0.5


def _start(
    settings: PoseProbeSettings, chain: Chain, table: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pose of the instrument and of the probe on the tool from the readings and the nominal arm:
    station, orientation, place and orientation of the probe, in closed form.

    Raises `RowError` where orientations do not follow the arm.
    """
    position = np.asarray(arm_plan(chain, table, settings.joints, ()).position)
    seen = 1e-3 * np.column_stack([table[name] for name in _POSITION])
    columns = f"columns {', '.join(_POSITION)}"
    check_arm_follows(chain, position, seen[:, None], columns, f"{settings.joints}_")
    rotations, origins = chain.tool_frame(position)
    seen = orientations(table, settings.orientation)
    orientation, probe = between_frames(rotations, seen)
    off = angles(orientation.T @ rotations @ probe @ np.swapaxes(seen, 1, 2))
    if np.median(off) > _LARGEST_DEG:
        row = int(np.argmax(off))
        raise RowError(
            row,
            f"columns {', '.join(orientation_names(settings.orientation))}",
            f"orientations in the convention {settings.orientation!r} that are {off[row]:.3g} deg "
            f"from the nominal arm, in half of the rows more than {np.median(off):.3g} deg",
            f"orientations that follow the joint positions to {_LARGEST_DEG:g} deg",
            _cause(settings.orientation, rotations, table)
            or "compare the convention of the orientation, and the signs, units and order of the "
            "joint positions, with the control and the instrument",
        )
    places = np.column_stack([table[name] for name in _POSITION]) * 1e-3
    # orientation v + s = o + rotation r is linear in s and r.
    n = len(places)
    equations = np.zeros((3 * n, 6))
    equations[:, :3] = np.tile(np.eye(3), (n, 1))
    equations[:, 3:] = -rotations.reshape(-1, 3)
    right = (origins - places @ orientation.T).ravel()
    found = np.linalg.lstsq(equations, right, rcond=None)[0]
    return found[:3], orientation, found[3:], probe


def _cause(
    convention: str, rotations: Float[np.ndarray, "n 3 3"], table: Mapping[str, np.ndarray]
) -> str:
    """The single change with which the orientations follow the arm; empty where there is none."""
    names = {*orientation_names(convention)}

    def follows(seen: np.ndarray) -> bool:
        s, t = between_frames(rotations, seen)
        off = angles(s.T @ rotations @ t @ np.swapaxes(seen, 1, 2))
        return bool(np.median(off) <= _LARGEST_DEG)

    for other in CONVENTIONS:
        same = {*orientation_names(other)} == names
        if other != convention and same and follows(orientations(table, other)):
            return f"they do as {other!r}: correct instrument.orientation"
    if follows(np.swapaxes(orientations(table, convention), 1, 2)):
        return (
            "their inverse does: give the rotation from the frame of the probe to that of the "
            "instrument"
        )
    return ""
