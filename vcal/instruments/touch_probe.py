"""Touch probe: the machine's own probe on a sphere, in a ring or on the faces of a step gauge.

A row is one contact: the axis positions at which the probe triggers. `ball_array` takes centres
that a cycle of the control computed from several contacts; here each contact counts, with the
stylus, the size of the artefact and the direction of approach. A sphere that stays clamped while
rotary axes turn gives their axis average lines (ISO 230-7, ISO 10791-6); a step gauge gives the
positioning of linear axes (ISO 230-2), in any direction.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from ..bounds import Noise, Uncertainty, Within
from ..effects.base import Effect, Response
from ..errors import KeyedError, RowError, StudyError
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS, group
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector
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
from .conditions import ROTARY, file_column, linear_plan, linear_plan_table
from .follow import cause
from .frame import displaced
from .marks import Mark

Artefact = Literal["sphere", "ring", "step_gauge"]

_XYZ = ("X", "Y", "Z")
_DERIVED = ("approach_rad",)
_REACH_M = 2e-3
"""Largest plausible distance of a contact from the surface."""
_STEPS, _FOUND_M = 20, 1e-12
_PROBE_M = 1e-4
"""Step of the differences by which the direction of a contact follows, m."""
_INDEPENDENT = 1e-3
"""Least part of a column of the design matrix that the columns before it do not contain."""
_MOVES = 0.05
"""Least component of the direction of approach along an axis that then moves."""
_FEWEST = 3
_FOLDS = 5
_STRAIGHT = 0.01
"""Largest relative error of the spacing of faces."""


class TouchProbeSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "touch_probe"``."""

    artefact: Artefact
    """What is touched: a ``sphere`` from outside, a ``ring`` from inside, or the faces of a
    ``step_gauge``."""
    diameter_mm: (
        Annotated[float, Within(0.1, 5000.0, "no sphere or ring gauge is smaller or larger")] | None
    ) = None
    """Calibrated diameter of the sphere or the ring."""
    diameter_u_um: Uncertainty = 0.0
    """Its standard uncertainty."""
    ring_axis: Literal["X", "Y", "Z"] = "Z"
    """Axis of the frame of the workpiece along which the axis of the ring lies."""
    gauge: FileName | None = None
    """Table of the step gauge beside the study file: face, position_mm."""
    face_u_um: Uncertainty = 0.0
    """Standard uncertainty of the position of each face."""
    stylus_radius_mm: Annotated[float, Within(0.0, 100.0, "no stylus has a ball of 200 mm")]
    """Effective radius of the stylus tip; 0 where the control has corrected the positions."""
    stylus_u_um: Uncertainty | None = None
    """Its standard uncertainty. Without it, the radius is unknown."""
    probe_sigma_um: Noise
    """Repeatability of the probe, one standard deviation along the direction of approach."""

    @model_validator(mode="after")
    def _complete(self) -> Self:
        needed = "gauge" if self.artefact == "step_gauge" else "diameter_mm"
        if getattr(self, needed) is None:
            raise ValueError(
                f"found artefact = {self.artefact!r} without {needed}, expected it; add {needed}"
            )
        if self.artefact == "ring" and 2.0 * self.stylus_radius_mm >= (self.diameter_mm or 0.0):
            raise ValueError(
                f"found a stylus of the radius {self.stylus_radius_mm:g} mm in a ring of the "
                f"diameter {self.diameter_mm:g} mm, expected a smaller one; correct one of them"
            )
        return self


class ArtefactPlace(Effect):
    """Position of the artefact in every set-up and, of a step gauge, its alignment, relative to
    their initial values: flat priors. Components that the contacts of a set-up do not show, such
    as a step gauge across its line, keep their initial values.
    """

    name = "artefact_place"
    summary = "position and alignment of the artefact in each set-up"
    kind = "nuisance"
    where = "instrument"
    uses = ("setup",)
    seen: tuple[tuple[int, str], ...] = eqx.field(static=True, default=())
    """Set-up and component of every parameter."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{k}.{c}", "um" if c in _XYZ else "urad", scale=1000.0) for k, c in self.seen
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        index = plan.groups["setup"]
        return {(f"artefact.{c}", f"{k}.{c}"): (index == k) * 1.0 for k, c in self.seen}


class _One(Effect):
    """Base class of an error that is the same in all rows, on one port of the group ``size``."""

    where = "instrument"
    port: str = eqx.field(static=True, default="")
    sigma: float = 0.0
    """Standard uncertainty, m; 0 for an unknown size."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        if self.sigma == 0.0:
            return (Parameter("error", "um", scale=100.0),)
        return (Parameter("error", "um", sigma=self.sigma / 1e-6),)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, "error"): np.ones(plan.rows)}


class StylusRadius(_One):
    """Error of the effective stylus radius, known with an uncertainty."""

    name = "stylus_radius"
    summary = "error of the effective radius of the stylus tip"


class UnknownStylusRadius(_One):
    """Error of the effective stylus radius, with a flat prior."""

    name = "stylus_radius_unknown"
    summary = "effective radius of the stylus tip"
    kind = "nuisance"


class ArtefactRadius(_One):
    """Error of the calibrated radius of a sphere or a ring."""

    name = "artefact_radius"
    summary = "error of the calibrated radius of the sphere or the ring"


class FaceCalibration(Effect):
    """Error of the calibrated position of each face of a step gauge."""

    name = "face_calibration"
    summary = "uncertain calibrated positions of the faces"
    where = "instrument"
    uses = ("face",)
    faces: tuple[int, ...] = eqx.field(static=True, default=())
    sigma: float = 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"{face}", "um", sigma=self.sigma / 1e-6) for face in self.faces)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        index = plan.groups["face"]
        return {("size.position", f"{face}"): (index == face) * 1.0 for face in self.faces}


@register
class TouchProbe(TableInstrument):
    """The reading is the gap between tip and surface at the positions of a contact, which is zero.

    With the tool point p (the centre of the tip) in the frame of the workpiece, the stylus radius r
    and the place of the artefact of the set-up::

        |p - c| - (R + r)                     sphere, centre c and radius R
        (R - r) - |p - c| across the axis     ring
        -w ((p - o) . d - s) - r              face at s of a step gauge along d from o, which is
                                              approached along w d, w = 1 or -1

    The reading is implicit, as of the `ball_array`: a fit takes the gap at the recorded positions,
    whose derivative by them has unit length, so that the noise of the probe enters it unchanged.

    The directions of travel of X, Y and Z follow from the approach, for axes that move in it, and
    so does its azimuth in the frame of the tool, ``approach_rad`` (`probe_lobing`). Columns of the
    table have precedence.
    """

    kind = "touch_probe"
    dimension = 1
    rotary = True
    Settings = TouchProbeSettings
    derived = _DERIVED
    # Contacts along an axis, or in a ring, are at one commanded position of the other axes.
    steady = ("x_mm", "y_mm", "z_mm")

    artefact_kind: Artefact = eqx.field(static=True)
    across: tuple[int, ...] = eqx.field(static=True)
    """Coordinates that count: all but that along the axis of a ring."""
    sigma: float
    stylus: float
    """Radius of the tip, m."""
    stylus_sigma: float | None
    radius: float
    """Radius of the sphere or the ring, m; 0 for a step gauge."""
    radius_sigma: float
    faces: tuple[int, ...] = eqx.field(static=True)
    positions: np.ndarray
    """Positions of the faces (faces,), m."""
    face_sigma: float
    setups: tuple[int, ...] = eqx.field(static=True)
    places: np.ndarray
    """Initial centres c; of a step gauge the point of its line at `middles` (setups, 3), m."""
    directions: np.ndarray
    """Initial directions d of a step gauge (setups, 3); zero for others."""
    middles: np.ndarray
    """Position along the step gauge at `places` (setups,), m."""
    seen: tuple[tuple[int, str], ...] = eqx.field(static=True)
    """Set-up and component that its contacts show."""

    @property
    def ports(self) -> tuple[str, ...]:
        return group("artefact") + group("size", ("stylus", "radius", "position"))

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        if len(self.positions) == 0:
            return (Mark("artefact", np.asarray(self.places), free=True),)
        along = np.asarray(self.positions) - np.asarray(self.middles)[:, None]
        gauges = self.places[:, None] + along[..., None] * self.directions[:, None]
        return tuple(Mark("face", places, joined=True, free=True) for places in gauges)

    @property
    def readings(self) -> tuple[str, ...]:
        return ("gap",)

    @classmethod
    def columns(
        cls, settings: TouchProbeSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        own = [Column(name="setup", low=0, integer=True)]
        if settings.artefact == "step_gauge":
            own += [
                Column(name="face", low=0, integer=True),
                Column(name="approach", low=-1, high=1, integer=True),
            ]
        return own

    @classmethod
    def build(
        cls,
        settings: TouchProbeSettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        faces, positions = np.zeros(0, int), np.zeros(0)
        if settings.gauge is not None and settings.artefact == "step_gauge":
            faces, positions = _gauge(settings.gauge, table, load)
        setup = np.asarray(table["setup"], int)
        setups = np.unique(setup)
        _check_rows(setup, setups, np.full(len(setups), _FEWEST))
        ring = settings.artefact == "ring"
        built = cls(
            artefact_kind=settings.artefact,
            across=tuple(i for i in range(3) if not ring or _XYZ[i] != settings.ring_axis),
            sigma=settings.probe_sigma_um * 1e-6,
            stylus=settings.stylus_radius_mm * 1e-3,
            stylus_sigma=None if settings.stylus_u_um is None else settings.stylus_u_um * 1e-6,
            radius=0.5e-3 * (settings.diameter_mm or 0.0) * (len(faces) == 0),
            radius_sigma=0.5e-6 * settings.diameter_u_um * (len(faces) == 0),
            faces=tuple(int(f) for f in faces),
            positions=positions,
            face_sigma=settings.face_u_um * 1e-6,
            setups=tuple(int(k) for k in setups),
            places=np.zeros((len(setups), 3)),
            directions=np.zeros((len(setups), 3)),
            middles=np.zeros(len(setups)),
            seen=(),
        )
        plan = built._indexed(chain, table)
        built._check_follows(chain, plan)
        built = built.at_contacts(chain, plan)
        unknown = built._seen(plan, chain.tool_point(np.asarray(plan.position)))[1]
        _check_rows(setup, setups, unknown + 1)
        return built

    def at_contacts(self, chain: Chain, plan: Plan) -> Self:
        """The same probe with the artefact of every set-up where the contacts of a plan are."""
        points = chain.tool_point(np.asarray(plan.position))
        placed = self._placed(plan, points)
        return dataclasses.replace(placed, seen=tuple(placed._seen(plan, points)[0]))

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        return self.approached(chain, self._indexed(chain, table))

    def approached(self, chain: Chain, plan: Plan) -> Plan:
        """A plan with the covariates that follow from its approaches; its own have precedence."""
        position = np.asarray(plan.position)
        turn, point = chain.tool_frame(position)
        away = self._approach(plan, point)
        in_tool = np.einsum("nji,nj->ni", turn, away)
        found = {"approach_rad": np.arctan2(in_tool[:, 1], in_tool[:, 0])}
        by_axes = np.einsum("nij,ni->nj", _motion(chain, position), away)
        for i, axis in enumerate(_XYZ):
            way = np.where(np.abs(by_axes[:, i]) > _MOVES, np.sign(by_axes[:, i]), 0.0)
            if way.any():
                found[f"dir_{axis}"] = way
        return Plan(plan.axes, plan.position, {**found, **plan.covariates}, plan.groups)

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.zeros((len(table["setup"]), 1))

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        motion = [f"dir_{axis}" for axis in _XYZ]
        return linear_plan_table(plan, (*_DERIVED, *motion))

    def rows(self, plan: Plan) -> Any:
        place = np.searchsorted(self.setups, np.asarray(plan.groups["setup"]))
        place = np.clip(place, 0, len(self.setups) - 1)
        along, way = self._along(plan)
        return self.places[place], self.directions[place], along - self.middles[place], way

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        place, direction, along, way = row
        stylus, radius, position = ports["size"]
        tip = self.stylus + stylus
        if self.artefact_kind == "step_gauge":
            turn, origin = displaced(np.eye(3), place, ports["artefact"])
            far = (tool - origin).dot(turn @ Vector.of(direction))
            return [-way * (far - along - position) - tip]
        arm = tool - Vector.of(place) - Vector.of(ports["artefact"][:3])
        parts = [arm.parts[i] for i in self.across]
        far = jnp.sqrt(sum(p * p for p in parts))
        size = self.radius + radius
        return [size - tip - far] if self.artefact_kind == "ring" else [far - size - tip]

    def record(
        self, plan: Plan, ideal: Callable[[Plan], np.ndarray], noise: np.ndarray
    ) -> tuple[Plan, np.ndarray]:
        """The axis positions q at which the gap is zero, with the noise of the probe along the
        approach.

        q <- q - gap g / |g|^2 with g the derivative of the gap by the positions of X, Y and Z.
        Raises `StudyError` where the iteration does not converge.
        """
        order = [plan.axes.index(axis) for axis in _XYZ]
        position, slope = np.array(plan.position), self._slopes(plan, ideal)
        step = slope / (slope**2).sum(1, keepdims=True)
        for _ in range(_STEPS):
            gap = np.asarray(ideal(plan.with_position(position)))
            position[:, order] -= gap * step
            if np.abs(gap).max() < _FOUND_M:
                break
        else:
            raise StudyError(
                f"no axis positions at a contact: found a gap of {np.abs(gap).max():.3g} m after "
                f"{_STEPS} steps, expected less than {_FOUND_M:g} m; reduce the declared errors"
            )
        position[:, order] += np.asarray(noise) * step
        return plan.with_position(position), np.zeros_like(noise)

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.full((plan.rows, 1), self.sigma)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.ones((plan.rows, 1))

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        found: tuple[Effect, ...] = (ArtefactPlace(seen=self.seen),) if self.seen else ()
        if self.stylus_sigma is None:
            found += (UnknownStylusRadius(port="size.stylus"),)
        elif self.stylus_sigma > 0.0:
            found += (StylusRadius(port="size.stylus", sigma=self.stylus_sigma),)
        if self.radius_sigma > 0.0:
            found += (ArtefactRadius(port="size.radius", sigma=self.radius_sigma),)
        if self.face_sigma > 0.0 and self.faces:
            found += (FaceCalibration(faces=self.faces, sigma=self.face_sigma),)
        return found

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # Whole set-ups, whose unknowns connect their contacts. With few of them, whole settings of
        # the rotary axes, or every fifth contact.
        setup = np.searchsorted(self.setups, np.asarray(plan.groups["setup"]))
        if len(self.setups) >= _FOLDS:
            return setup, False
        turning = [np.asarray(plan.x(axis)) for axis in plan.axes if axis in ROTARY]
        if turning:
            settings, index = np.unique(
                np.column_stack([setup, *turning]), axis=0, return_inverse=True
            )
            if len(settings) >= 2 * _FOLDS:
                return index.ravel() % _FOLDS, False
        return np.arange(plan.rows) % _FOLDS, False

    # --- start and directions -------------------------------------------------------------------
    def _indexed(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        """The plan without what follows from the approach."""
        return linear_plan(chain, table, groups=("setup", "face"))

    def _along(self, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
        """Position along the gauge and side of every contact (n,); zeros for other artefacts."""
        if not self.faces:
            return np.zeros(plan.rows), np.zeros(plan.rows)
        face = np.searchsorted(self.faces, np.asarray(plan.groups["face"]))
        face = np.clip(face, 0, len(self.faces) - 1)
        return self.positions[face], np.asarray(plan.covariate("approach"))

    def _placed(self, plan: Plan, points: Float[np.ndarray, "n 3"]) -> Self:
        """The same with places from nominal tool points (n, 3) at the contacts."""
        setup = np.asarray(plan.groups["setup"])
        along, way = self._along(plan)
        places, directions, middles = [], [], []
        for k in self.setups:
            mine = setup == k
            if self.faces:
                place, direction, middle = _line(points[mine], (along - way * self.stylus)[mine])
            else:
                size = self.radius + (-1.0 if len(self.across) < 3 else 1.0) * self.stylus
                place, direction, middle = points[mine].mean(0), np.zeros(3), 0.0
                own = list(self.across)
                place[own] = _centre(points[mine][:, own], size)
            places.append(place)
            directions.append(direction)
            middles.append(middle)
        return dataclasses.replace(
            self,
            places=np.stack(places),
            directions=np.stack(directions),
            middles=np.array(middles),
        )

    def _gaps(self, plan: Plan, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """The nominal gap at tool points (n, 3)."""
        place, direction, along, way = self.rows(plan)
        arm = points - place
        if self.faces:
            return -way * ((arm * direction).sum(1) - along) - self.stylus
        far = np.linalg.norm(arm[:, list(self.across)], axis=1)
        if self.artefact_kind == "ring":
            return self.radius - self.stylus - far
        return far - self.radius - self.stylus

    def _approach(self, plan: Plan, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Direction of approach (n, 3) in the frame of the workpiece, of unit length: against the
        growing gap.
        """
        place, direction, _, way = self.rows(plan)
        if self.faces:
            return way[:, None] * direction
        arm = points - place
        arm[:, [i for i in range(3) if i not in self.across]] = 0.0
        out = arm / np.linalg.norm(arm, axis=1, keepdims=True)
        return out if self.artefact_kind == "ring" else -out

    def _check_follows(self, chain: Chain, plan: Plan) -> None:
        """Raise `RowError` where a contact is not at the surface of the artefact."""

        def off(points: np.ndarray) -> np.ndarray:
            return np.abs(self._placed(plan, points)._gaps(plan, points))

        position = np.asarray(plan.position)
        found = off(chain.tool_point(position))
        row = int(np.argmax(found))
        if found[row] > _REACH_M:
            raise RowError(
                row,
                "columns " + ", ".join(file_column(axis, chain.axes)[0] for axis in chain.axes),
                f"a contact {1e3 * found[row]:.4g} mm from the surface of the artefact",
                f"contacts within {1e3 * _REACH_M:g} mm of it",
                cause(chain, chain.axes, position, off, _REACH_M)
                or "correct the positions, the column setup, the size of the artefact or "
                "stylus_radius_mm",
            )

    def _seen(
        self, plan: Plan, points: Float[np.ndarray, "n 3"]
    ) -> tuple[list[tuple[int, str]], np.ndarray]:
        """Set-up and component that the contacts show beside an unknown stylus radius, and the
        number of unknowns of every set-up.
        """
        setup, away = np.asarray(plan.groups["setup"]), self._approach(plan, points)
        place = self.rows(plan)[0]
        columns = {c: away[:, i] for i, c in enumerate(_XYZ)}
        if self.faces:
            lever = np.cross(self.rows(plan)[1], points - place)
            size = max(float(np.abs(points - place).max()), 1e-9)
            side = self._along(plan)[1]
            columns |= {c: side * lever[:, i] / size for i, c in enumerate(COMPONENTS[3:])}
        seen: list[tuple[int, str]] = []
        unknown = np.zeros(len(self.setups), int)
        for i, k in enumerate(self.setups):
            mine = setup == k
            known = [np.ones(mine.sum())] if self.stylus_sigma is None else []
            for c, column in columns.items():
                rest = column[mine]
                if known:
                    basis = np.column_stack(known)
                    rest = rest - basis @ np.linalg.lstsq(basis, rest, rcond=1e-9)[0]
                if np.sqrt((rest**2).mean()) > _INDEPENDENT:
                    known.append(column[mine])
                    seen.append((k, c))
            unknown[i] = len(known)
        return seen, unknown

    def _slopes(self, plan: Plan, ideal: Callable[[Plan], np.ndarray]) -> Float[np.ndarray, "n 3"]:
        """Derivative (n, 3) of the gap by the positions of X, Y and Z."""
        position, slopes = np.asarray(plan.position), []
        for axis in _XYZ:
            step = _PROBE_M * (np.array(plan.axes) == axis)
            ends = [np.asarray(ideal(plan.with_position(position + s * step))) for s in (1, -1)]
            slopes.append((ends[0] - ends[1])[:, 0] / (2.0 * _PROBE_M))
        return np.stack(slopes, axis=1)


def _motion(chain: Chain, position: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, "n 3 3"]:
    """Derivative of the nominal tool point by the positions of X, Y and Z, column by column."""
    columns = []
    for axis in _XYZ:
        step = 0.5 * (np.array(chain.axes) == axis)
        columns.append(chain.tool_point(position + step) - chain.tool_point(position - step))
    return np.stack(columns, axis=2)


def _gauge(
    file: str, table: Mapping[str, np.ndarray], load: Loader
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the faces, ascending, and their positions, m."""
    calibrated = load(
        file,
        [
            Column(name="face", low=0, integer=True, unique_with=("face",)),
            Column(name="position_mm", low=-1e5, high=1e5),
        ],
    )
    faces = np.asarray(calibrated["face"], int)
    for row, face in enumerate(np.asarray(table["face"], int)):
        if face not in faces:
            raise RowError(
                row,
                "column face",
                f"{face}",
                f"a face of {file} ({', '.join(str(f) for f in faces)})",
                f"correct the index, or add the face to {file}",
            )
    approach = np.asarray(table["approach"])
    if (approach == 0).any():
        raise RowError(
            int(np.argmax(approach == 0)),
            "column approach",
            "0",
            "1 for a face approached in the sense of rising positions of the gauge, -1 against it",
            "correct the column",
        )
    if np.ptp(positions := np.asarray(calibrated["position_mm"], float)) == 0.0:
        raise KeyedError(
            "instrument.gauge",
            "all faces at one position",
            "positions along the gauge",
            f"correct {file}",
        )
    order = np.argsort(faces)
    return faces[order], 1e-3 * positions[order]


def _check_rows(setup: np.ndarray, setups: np.ndarray, fewest: np.ndarray) -> None:
    for k, least in zip(setups, fewest, strict=True):
        mine = np.flatnonzero(setup == k)
        if len(mine) < least:
            raise RowError(
                int(mine[0]),
                "column setup",
                f"{counted(len(mine), 'contact')} in set-up {k}",
                f"at least {least}, as every set-up has unknowns of its own",
                "measure more, or leave them out",
            )


def _line(
    points: Float[np.ndarray, "n 3"], along: Float[np.ndarray, " n"]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Middle and direction of the line p = o + s d through points (n, 3) at s (n,), m, by least
    squares, and s at the middle.
    """
    middle = float(along.mean())
    rise = along - middle
    spread = float(rise @ rise)
    slope = (rise @ (points - points.mean(0))) / spread if spread > 0.0 else np.zeros(3)
    length = float(np.linalg.norm(slope))
    if not abs(length - 1.0) < _STRAIGHT:
        # Not the spacing of the faces: the check of the gaps tells it by the first contact.
        return points.mean(0), slope / (length or 1.0), middle
    return points.mean(0), slope / length, middle


def _centre(points: Float[np.ndarray, "n k"], radius: float) -> Float[np.ndarray, " k"]:
    """Centre c of the sphere or the circle |p - c| = radius by Gauss-Newton steps from the linear
    solution; along directions that the points do not determine, it is that of their mean.
    """
    middle = points.mean(0)
    arm = points - middle
    matrix = np.column_stack([2.0 * arm / radius, np.ones(len(arm))])
    right = ((arm**2).sum(1) - radius**2) / radius
    centre = middle + np.linalg.lstsq(matrix, right, rcond=1e-6)[0][:-1]
    for _ in range(_STEPS):
        arm = points - centre
        far = np.linalg.norm(arm, axis=1)
        if not far.min() > 0.0:
            break
        step = np.linalg.lstsq(-arm / far[:, None], radius - far, rcond=1e-6)[0]
        centre = centre + step
        if np.abs(step).max() < _FOUND_M:
            break
    return centre
