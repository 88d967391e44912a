"""What a laser tracker, a ball array and a set of reflectors read (SI, exact geometry)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from .effects import (
    Effect,
    Run,
    ball_positions,
    bend_readings,
    checked,
    frame_drift,
    joint_angles,
    joint_tilts,
    read_back,
    tool_point,
)
from .kinematics import Arm, Array, Machine, arm_frames, euler_xyz
from .plans import ArmPlan, BallPlan

UM = 1e-6


@dataclass(frozen=True)
class Tracker:
    """Pose in the workpiece frame and one-sigma noise of a laser tracker."""

    station: Array
    """Centre (3,) in m."""
    euler: Array
    """Angles of R = Rx Ry Rz (3,) in rad."""
    range_sigma: float = 1.3 * UM
    range_sigma_per_m: float = 0.27 * UM
    angle_sigma: float = 2.5 * UM


def tracker_readings(
    tracker: Tracker, p: Array, t: Array | None = None, effects: Iterable[Effect] = ()
) -> Array:
    """Return noise-free range (m), azimuth, elevation (rad), (n, 3), of points p (n, 3).

    v = R' (p - station); range |v|, azimuth atan2(v_y, v_x), elevation asin(v_z / |v|).  A
    drifting station stands at station + d(t), turned by exp(w t) R.
    """
    effects = list(effects)
    d, turned = frame_drift(effects, np.zeros(len(p)) if t is None else t)
    r = turned @ euler_xyz(tracker.euler)
    v = np.einsum("nji,nj->ni", r, p - tracker.station - d)
    distance = np.linalg.norm(v, axis=-1)
    azimuth = np.arctan2(v[:, 1], v[:, 0])
    ideal = np.stack([distance, azimuth, np.arcsin(v[:, 2] / distance)], axis=1)
    return bend_readings(ideal, effects)


def tracker_points(tracker: Tracker, readings: Array) -> Array:
    """Return the points p (n, 3) of readings (n, 3): the inverse of tracker_readings."""
    distance, azimuth, elevation = readings.T
    flat = distance * np.cos(elevation)
    v = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )
    return tracker.station + v @ euler_xyz(tracker.euler).T


def tracker_noise(tracker: Tracker, readings: Array) -> Array:
    """Return the standard deviation of every reading (n, 3); the range's grows linearly."""
    sigma = np.full(readings.shape, tracker.angle_sigma)
    sigma[:, 0] = tracker.range_sigma + tracker.range_sigma_per_m * readings[:, 0]
    return sigma


def measure_tracker(
    machine: Machine,
    run: Run,
    tracker: Tracker,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
    noise_factor: float = 1.0,
) -> Array:
    """Return range, azimuth, elevation (n, 3) with noise_factor times the tracker's noise."""
    effects = checked(effects, "laser_tracker")
    ideal = tracker_readings(tracker, tool_point(machine, run, effects), run.t, effects)
    noise = rng.standard_normal(ideal.shape) * tracker_noise(tracker, ideal)
    return ideal + noise_factor * noise


def solve_positions(
    machine: Machine,
    run: Run,
    target: Array,
    effects: Iterable[Effect] = (),
    tolerance: float = 1e-12,
    steps: int = 30,
) -> Array:
    """Return axis positions q (n, 3) at which the tool point sits at target (n, 3), in m.

    Fixed point q <- q + target - tcp(q), all points at once: d tcp / d q is the identity to some
    1e-4 (1e-2 with a short pitch), so that a handful of steps reach 1e-12 m.
    """
    effects = list(effects)
    q = target - machine.tool_offset
    for _ in range(steps):
        miss = target - tool_point(machine, run.at(q), effects, sensor=True)
        q = q + miss
        if np.abs(miss).max() < tolerance:
            return q
    raise RuntimeError(f"the tool point is still {np.abs(miss).max():.1e} m off the ball")


@dataclass(frozen=True)
class BallNoise:
    """One-sigma noise of a ball array, and the beam's supports as shares of its length."""

    probe_sigma: float = 0.7 * UM
    ball_position_u: float = 0.8 * UM
    supports: tuple[float, float] = (0.22, 0.78)


def measure_balls(
    machine: Machine,
    plan: BallPlan,
    noise: BallNoise,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
    noise_factor: float = 1.0,
) -> tuple[Array, Array, Array]:
    """Return positions found (n, 3), true positions (n, 3) and calibrated balls (b, 3).

    Calibrated = true + N(0, u); found = true axis position + N(0, probe sigma); both times
    noise_factor.
    """
    effects = checked(effects, "ball_array")
    run = plan.run
    target = ball_positions(plan.balls, run, plan.rotation, plan.origin, effects, noise.supports)
    q = solve_positions(machine, run, target, effects)
    certificate = rng.standard_normal(plan.balls.shape) * noise.ball_position_u
    probing = rng.standard_normal(q.shape) * noise.probe_sigma
    return q + noise_factor * probing, q, plan.balls + noise_factor * certificate


@dataclass(frozen=True)
class ArmReadings:
    """What an arm and its reflectors give."""

    read: Array
    """Joint values read back (n, j) in rad."""
    tool: Array
    """Reflectors on the tool in the tracker's frame (n, m, 3), m."""
    base: Array
    """Fixed reflectors in the tracker's frame (n, m, 3), m."""
    true_tool: Array
    """The reflectors on the tool in the base's frame, without noise (n, m, 3), m."""


def arm_points(arm: Arm, q: Array, tool: Array, tilts: Array | None = None) -> Array:
    """Return points fixed in the last frame, (m, 3), in the base's frame: (n, m, 3) m; of joints
    with further error rotations `tilts` (n, j, 3).
    """
    frames, origins = arm_frames(arm, q, rotation=tilts)
    return np.einsum("nij,mj->nmi", frames[:, -1], tool) + origins[:, -1, None]


def measure_reflectors(
    arm: Arm,
    plan: ArmPlan,
    rng: np.random.Generator,
    sigma: float = 10 * UM,
    effects: Iterable[Effect] = (),
    noise_factor: float = 1.0,
) -> ArmReadings:
    """Return every reflector in the tracker's frame with noise N(0, sigma) per coordinate.

    With a drift of the frame (d, w per second) the tracker sees p as exp(-w t) (p - d t).
    """
    effects = checked(effects, "reflectors")
    true = joint_angles(arm, plan.q, plan.t, effects)
    own = arm_points(arm, true, plan.tool, joint_tilts(arm, plan.q, effects))
    d, turned = frame_drift(effects, plan.t)
    fixed = np.broadcast_to(plan.base, (len(plan.t), *plan.base.shape))
    seen = []
    for points in (own, fixed):
        p = points @ plan.rotation.T + plan.origin
        p = np.einsum("nji,nmj->nmi", turned, p - d[:, None])
        seen.append(p + noise_factor * sigma * rng.standard_normal(p.shape))
    return ArmReadings(read_back(plan.q, true, effects), seen[0], seen[1], own)


def draw_arm_errors(
    arm: Arm, rng: np.random.Generator, translation: float = 5e-4, rotation: float = 2e-3
) -> Arm:
    """Draw each joint's constant error twist: N(0, translation) m and N(0, rotation) rad."""
    k = arm.joints
    return Arm(
        arm.a,
        arm.alpha,
        arm.d,
        arm.theta,
        arm.prismatic,
        translation * rng.standard_normal((k, 3)),
        rotation * rng.standard_normal((k, 3)),
    )


def align(p: Array, q: Array, points: Array | None = None) -> Array:
    """Return points (p if None) moved by the rigid motion that best takes p onto q (Kabsch)."""
    pc, qc = p - p.mean(axis=0), q - q.mean(axis=0)
    u, _, vt = np.linalg.svd(pc.T @ qc)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    moved = pc if points is None else points - p.mean(axis=0)
    return moved @ u @ flip @ vt + q.mean(axis=0)
