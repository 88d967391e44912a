"""The tables of the file that describes the dynamics of a machine."""

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ..bounds import Within

# A number beyond these bounds is in another unit, or leaves the matrices too few digits for the
# check that every body is supported.
Mass = Annotated[
    float, Within(1e-3, 1e6, "no body of a machine is lighter than 1 g or heavier than 1000 t")
]
Inertia = Annotated[float, Within(1e-4, 1e9, "no body of a machine turns more easily or heavily")]
Length = Annotated[float, Within(-1e5, 1e5, "no point of a machine is more than 100 m away")]
Stiffness = Annotated[float, Within(0.0, 1e6, "no guideway or mount holds more than 1000 GN/m")]
Turning = Annotated[float, Within(0.0, 1e9, "no joint holds more than 1e12 Nm/rad")]
Viscous = Annotated[float, Within(0.0, 1e6, "no damper of a machine is stronger")]
Force = Annotated[float, Within(1e-3, 1e6, "no guideway rubs with less than 1 mN or with 100 t")]
Gain = Annotated[float, Within(1e-3, 1e5, "no drive is slower or faster than its motor by as much")]
Time = Annotated[float, Within(1e-3, 1e5, "no loop integrates within 1 us or over 100 s")]
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
    screw_N_per_um: (  # noqa: N815
        Annotated[
            float, Within(1e-3, 1e6, "no screw is softer than a spring or stiffer than 1000 GN/m")
        ]
        | None
    ) = None
    """Axial stiffness of screw, nut and bearings; without it, the drive is a linear motor."""
    motor_mass_kg: Annotated[float, Within(0.0, 1e6, "no motor acts like more than 1000 t")] = 0.0
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
    coulomb_N: Force  # noqa: N815
    """Coulomb friction force."""
    stiction_N: Force | None = None  # noqa: N815
    """Static friction force, at least `coulomb_N`; equal to it by default."""
    stribeck_mm_per_s: Annotated[
        float, Within(1e-4, 1e4, "no guideway slides at a lower or a higher speed only")
    ] = 1.0
    """Stribeck velocity."""
    presliding_um: Annotated[float, Within(1e-3, 1e4, "contacts deflect by micrometres")]
    """Presliding displacement, by which the contacts deflect before they slide."""
    viscous_Ns_per_mm: Viscous = 0.0  # noqa: N815


class ToolPointSettings(_Table):
    """``[tool_point]``."""

    point_mm: Triple
    tool: str | None = None
    """Body that holds the tool; the last one on the tool side by default."""
    work: str | None = None
    """Body that holds the workpiece; the last one on the workpiece side by default."""


class ControllerSettings(_Table):
    """``[controller]``: one gain for all axes, or one per axis. Missing gains are proposed."""

    position_gain_per_s: Gain | tuple[Gain, ...] | None = None
    """Gain Kv of the position loop."""
    bandwidth_rad_per_s: Gain | tuple[Gain, ...] | None = None
    """Bandwidth w_v of the velocity loop; Kp = m w_v."""
    integral_time_ms: Time | tuple[Time, ...] | None = None
    """Integral time Tn of the velocity loop."""
    feed_forward: Annotated[float, Within(0.0, 1.0, "it is a share")] = 0.0
    """Share of the set velocity added to the velocity command."""
    delay_ms: Annotated[float, Within(0.0, 1e4, "no control answers after 10 s")] = 0.0
    sample_time_ms: Annotated[
        float,
        Within(1e-3, 1e3, "no control samples faster than 1 MHz or slower than 1 Hz"),
    ] = 1.0


_Limit = Annotated[float, Within(1e-6, 1e9, "no axis is limited to less, and none can do more")]


class LimitSettings(_Table):
    """``[limits]``: limits of the set motion of every axis."""

    velocity_m_per_min: _Limit = np.inf
    acceleration_m_per_s2: _Limit = np.inf
    jerk_m_per_s3: _Limit = np.inf


class MachineDescription(_Table):
    """The whole file."""

    chain: str
    """Kinematic chain by ISO 10791-6, such as ``"w X b Y Z t"``."""
    damping: Annotated[float, Within(0.0, 1.0, "from 1 on, nothing vibrates", open_high=True)] = 0.0
    """Damping ratio of all springs at `damping_hz`."""
    damping_hz: (
        Annotated[float, Within(1e-2, 1e5, "no mode of a machine is slower or faster")] | None
    ) = None
    """Frequency of the damping ratio; that of the first mode by default."""
    body: Annotated[tuple[BodySettings, ...], Field(min_length=1)]
    spring: tuple[SpringSettings, ...] = ()
    drive: Annotated[tuple[DriveSettings, ...], Field(min_length=1)]
    friction: tuple[FrictionSettings, ...] = ()
    tool_point: ToolPointSettings
    controller: ControllerSettings = ControllerSettings()
    limits: LimitSettings = LimitSettings()
