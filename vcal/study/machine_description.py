"""The tables of the file that describes the dynamics of a machine."""

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
# Wide bounds for any machine. A number beyond them is in another unit, or leaves the matrices too
# few digits for the check that every body is supported.
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
    """The link that carries it, ``"bed"`` or an axis; its own name by default."""
    mass_kg: Mass
    inertia_kg_m2: tuple[Inertia, Inertia, Inertia]
    """Moments of inertia about X, Y and Z through the centre of gravity."""
    centre_mm: Triple
    """Centre of gravity with all axes at zero."""


class SpringSettings(_Table):
    """``[[spring]]``: carriages of a guideway, mounts of a foundation, bearings."""

    name: str
    between: tuple[str, str]
    """Two bodies, or a body and ``"ground"``."""
    on: str | None = None
    """The link that carries the points; that of the first body by default."""
    points_mm: Annotated[tuple[Triple, ...], Field(min_length=1)]
    stiffness_N_per_um: tuple[Stiffness, Stiffness, Stiffness]  # noqa: N815
    """Stiffness of one point along X, Y, Z."""
    turning_Nm_per_mrad: tuple[Turning, Turning, Turning] = (0.0, 0.0, 0.0)  # noqa: N815
    """Rotational stiffness of one point about X, Y, Z."""
    damping_Ns_per_mm: tuple[Viscous, Viscous, Viscous] = (0.0, 0.0, 0.0)  # noqa: N815
    """Viscous damping of one point, in addition to the structural damping of all springs."""


class DriveSettings(_Table):
    """``[[drive]]``: one per axis."""

    axis: str
    base: str | None = None
    """Body that takes the reaction force; the next one towards the bed by default."""
    point_mm: Triple
    """Point of application of the drive force."""
    screw_N_per_um: Annotated[float, Field(ge=1e-3, le=1e6)] | None = None  # noqa: N815
    """Axial stiffness of screw, nut and bearings; without it, the drive is a linear motor."""
    motor_mass_kg: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Inertia of motor and screw as a mass along the axis, J (2 pi / pitch)^2; at least 1 g for a
    drive with a screw.
    """
    scale_mm: Triple | None = None
    """Reading point of the scale; the point of application of the drive by default."""
    measured: Literal["scale", "motor"] = "scale"
    """Position feedback: a linear scale, or the encoder of the motor."""


class FrictionSettings(_Table):
    """``[[friction]]``: friction of the guideway of one axis."""

    axis: str
    point_mm: Triple | None = None
    """Point of application; that of the drive by default."""
    coulomb_N: Positive  # noqa: N815
    """Coulomb friction force."""
    stiction_N: Positive | None = None  # noqa: N815
    """Static friction force, at least `coulomb_N`; equal to it by default."""
    stribeck_mm_per_s: Positive = 1.0
    """Stribeck velocity."""
    presliding_um: Positive
    """Presliding displacement, by which the contacts deflect before they slide."""
    viscous_Ns_per_mm: Annotated[float, Field(ge=0)] = 0.0  # noqa: N815


class ToolPointSettings(_Table):
    """``[tool_point]``."""

    point_mm: Triple
    tool: str | None = None
    """Body that holds the tool; the last one on the tool side by default."""
    work: str | None = None
    """Body that holds the workpiece; the last one on the workpiece side by default."""


class ControllerSettings(_Table):
    """``[controller]``: one gain for all axes, or one per axis. Missing gains are proposed."""

    position_gain_per_s: Positive | tuple[Positive, ...] | None = None
    """Gain Kv of the position loop."""
    bandwidth_rad_per_s: Positive | tuple[Positive, ...] | None = None
    """Bandwidth w_v of the velocity loop; Kp = m w_v."""
    integral_time_ms: Positive | tuple[Positive, ...] | None = None
    """Integral time Tn of the velocity loop."""
    feed_forward: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the set velocity added to the velocity command."""
    delay_ms: Annotated[float, Field(ge=0)] = 0.0
    sample_time_ms: Positive = 1.0


class LimitSettings(_Table):
    """``[limits]``: limits of the set motion of every axis."""

    velocity_m_per_min: Positive = np.inf
    acceleration_m_per_s2: Positive = np.inf
    jerk_m_per_s3: Positive = np.inf


class MachineDescription(_Table):
    """The whole file."""

    chain: str
    """Kinematic chain by ISO 10791-6, such as ``"w X b Y Z t"``."""
    damping: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Damping ratio of all springs at `damping_hz`."""
    damping_hz: Positive | None = None
    """Frequency of the damping ratio; that of the first mode by default."""
    body: Annotated[tuple[BodySettings, ...], Field(min_length=1)]
    spring: tuple[SpringSettings, ...] = ()
    drive: Annotated[tuple[DriveSettings, ...], Field(min_length=1)]
    friction: tuple[FrictionSettings, ...] = ()
    tool_point: ToolPointSettings
    controller: ControllerSettings = ControllerSettings()
    limits: LimitSettings = LimitSettings()
