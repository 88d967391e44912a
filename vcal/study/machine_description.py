"""The tables of a machine's description for its dynamics."""

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
# What machines have, with much to spare. Beyond it a number is of another unit, or matrices have
# too few digits left to tell what holds a body.
Mass = Annotated[float, Field(ge=1e-3, le=1e6)]
Inertia = Annotated[float, Field(ge=1e-4, le=1e9)]
Length = Annotated[float, Field(ge=-1e5, le=1e5)]
Stiffness = Annotated[float, Field(ge=0, le=1e6)]
Turning = Annotated[float, Field(ge=0, le=1e9)]
Viscous = Annotated[float, Field(ge=0, le=1e6)]
Triple = tuple[Length, Length, Length]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class BodySettings(_Table):
    """``[[body]]``: a rigid body."""

    name: str
    on: str | None = None
    """What it rides with, ``"bed"`` or an axis; its own name by default."""
    mass_kg: Mass
    inertia_kg_m2: tuple[Inertia, Inertia, Inertia]
    """About its centre of gravity, about X, Y, Z; none more than the sum of the others."""
    centre_mm: Triple
    """Centre of gravity at the axis positions zero."""


class SpringSettings(_Table):
    """``[[spring]]``: carriages of a guideway, mounts of a foundation, bearings."""

    name: str
    between: tuple[str, str]
    """Two bodies, or a body and ``"ground"``."""
    on: str | None = None
    """What the points ride with; the first body's link by default."""
    points_mm: Annotated[tuple[Triple, ...], Field(min_length=1)]
    stiffness_N_per_um: tuple[Stiffness, Stiffness, Stiffness]  # noqa: N815
    """Of one point, along X, Y, Z."""
    turning_Nm_per_mrad: tuple[Turning, Turning, Turning] = (0.0, 0.0, 0.0)  # noqa: N815
    """Of one point, about X, Y, Z."""
    damping_Ns_per_mm: tuple[Viscous, Viscous, Viscous] = (0.0, 0.0, 0.0)  # noqa: N815
    """Viscous, of one point, beside the damping of all."""


class DriveSettings(_Table):
    """``[[drive]]``: one per axis."""

    axis: str
    base: str | None = None
    """Body that it pushes from; the one towards the bed by default."""
    point_mm: Triple
    """Where its force attacks."""
    screw_N_per_um: Annotated[float, Field(ge=1e-3, le=1e6)] | None = None  # noqa: N815
    """Stiffness of screw, nut and bearings; a linear motor without it."""
    motor_mass_kg: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Inertia of motor and screw as a mass along the axis, J (2 pi / pitch)^2; no less than 1 g
    beside a screw.
    """
    scale_mm: Triple | None = None
    """Where the scale is read; at the drive by default."""
    measured: Literal["scale", "motor"] = "scale"
    """By a linear scale, or by the motor's encoder."""


class FrictionSettings(_Table):
    """``[[friction]]``: of the guideway of one axis."""

    axis: str
    point_mm: Triple | None = None
    """Where it acts; where the drive attacks by default."""
    coulomb_N: Positive  # noqa: N815
    stiction_N: Positive | None = None  # noqa: N815
    """No less than `coulomb_N`, which it is by default."""
    stribeck_mm_per_s: Positive = 1.0
    presliding_um: Positive
    """How far the contacts bend before they slide."""
    viscous_Ns_per_mm: Annotated[float, Field(ge=0)] = 0.0  # noqa: N815


class ToolPointSettings(_Table):
    """``[tool_point]``."""

    point_mm: Triple
    tool: str | None = None
    """Body with the tool; the last one on the tool's side by default."""
    work: str | None = None
    """Body with the workpiece; the last one on its side by default."""


class ControllerSettings(_Table):
    """``[controller]``: gains of all axes, or one per axis; what is left out is proposed."""

    position_gain_per_s: Positive | tuple[Positive, ...] | None = None
    """Kv."""
    bandwidth_rad_per_s: Positive | tuple[Positive, ...] | None = None
    """w_v of the velocity loop; Kp = m w_v."""
    integral_time_ms: Positive | tuple[Positive, ...] | None = None
    """Tn."""
    feed_forward: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the set velocity added to the velocity command."""
    delay_ms: Annotated[float, Field(ge=0)] = 0.0
    sample_time_ms: Positive = 1.0


class LimitSettings(_Table):
    """``[limits]``: of every axis."""

    velocity_m_per_min: Positive = np.inf
    acceleration_m_per_s2: Positive = np.inf
    jerk_m_per_s3: Positive = np.inf


class MachineDescription(_Table):
    """The whole file."""

    chain: str
    """ISO 10791-6, such as ``"w X b Y Z t"``."""
    damping: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Damping ratio of all springs at `damping_hz`."""
    damping_hz: Positive | None = None
    """The first mode by default."""
    body: Annotated[tuple[BodySettings, ...], Field(min_length=1)]
    spring: tuple[SpringSettings, ...] = ()
    drive: Annotated[tuple[DriveSettings, ...], Field(min_length=1)]
    friction: tuple[FrictionSettings, ...] = ()
    tool_point: ToolPointSettings
    controller: ControllerSettings = ControllerSettings()
    limits: LimitSettings = LimitSettings()
