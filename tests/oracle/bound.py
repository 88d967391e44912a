"""The bound to approach: the linear minimum-mean-square error in the declared family's own basis.

With y = f(theta) + noise, theta = (error motions' coefficients, effects' amplitudes, nuisances),
whitened J and prior deviations s, the estimate minimises |J s x - r|^2 + |x|^2.  A coefficient
uniform within +/- a has s = a / sqrt 3; a station or a pose is free.  A few Gauss-Newton steps with
finite differences: slow and plain on purpose.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .effects import Effect, ball_positions, in_si, tool_point
from .instruments import Tracker, align, tracker_noise, tracker_readings
from .kinematics import SQUARENESS, TABLE_COLUMNS, Array, ErrorTable, Machine, rotation_matrix
from .kinematics import with_errors as set_errors
from .multilateration import range_noise, reflector
from .study import Study

FREE = 1.0  # m or rad: no prior to speak of
Unknown = tuple[Effect, str, float]
"""An effect, the key that holds its amplitude, and the amplitude's prior sigma (SI)."""


@dataclass(frozen=True)
class Bound:
    """The estimate, and what it leaves at the check points."""

    machine: Machine
    effects: list[dict[str, Any]]
    amplitudes: Array
    """Estimated amplitudes of the unknown effects, SI."""
    sigmas: Array
    """Their posterior standard deviations."""
    chi2_dof: float
    """Whitened residual sum of squares over its effective degrees of freedom."""
    cost: float
    """chi2 plus the prior's part."""
    check_rms_before: float
    """Volumetric error at the check points, rms after rigid alignment, uncompensated, m."""
    check_rms: float
    """The same with the estimate, m."""


def family_columns(table: ErrorTable) -> tuple[list[tuple[str, int]], Array]:
    """Return the free coefficients (component, column) and their prior standard deviations."""
    free = [
        (name, i)
        for name, row in table.items()
        for i, value in enumerate(row)
        if value and not TABLE_COLUMNS[i].startswith("n")
    ]
    return free, np.array([1e-6 * table[n][i] for n, i in free]) / np.sqrt(3)


def _machine(nominal: Machine, free: Sequence[tuple[str, int]], values: Array) -> Machine:
    rows = {n: np.zeros(8) for n in nominal.table}
    for name, row in nominal.table.items():
        if name not in SQUARENESS:
            rows[name][[2, 5]] = row[2], row[5]
    for (name, i), value in zip(free, values, strict=True):
        rows[name][i] = value
    return set_errors(nominal, rows)


def _effects(
    unknown: Sequence[Unknown], amplitudes: Array, known: Sequence[Effect]
) -> list[dict[str, Any]]:
    found = [{**in_si(e), key: a} for (e, key, _), a in zip(unknown, amplitudes, strict=True)]
    return [*map(in_si, known), *found]


def _laterated(study: Study) -> tuple[Predict, Array, Array]:
    """Ranges alone: a place and a dead path of every station, without a prior."""
    told: Mapping[str, Any] = study.setup["instrument"]
    names, tools = list(told["stations"]), list(told["tools"])
    places = 1e-3 * np.array([told["stations"][k]["station_mm"] for k in names])
    offsets = 1e-3 * np.array([told["tools"][k] for k in tools])
    station = np.array([names.index(k) for k in study.data["station"]])
    tool = np.array([tools.index(k) for k in study.data["tool"]])
    y, count = 1e-3 * study.data["range_mm"], len(names)
    first = np.linalg.norm(
        reflector(study.nominal, study.run, offsets, tool) - places[station], axis=1
    )
    dead = np.array([np.median((first - y)[station == i]) for i in range(count)])
    sigma = range_noise(y + dead[station], *(
        1e-6 * told[k] for k in ("range_sigma_um", "range_sigma_um_per_m")
    ))  # fmt: skip

    def residual(machine: Machine, effects: list[dict[str, Any]], nuisance: Array) -> Array:
        moved = places + nuisance[: 3 * count].reshape(count, 3)
        p = reflector(machine, study.run, offsets, tool, effects)
        far = np.linalg.norm(p - moved[station], axis=1)
        return (far - dead[station] - nuisance[3 * count :][station] - y) / sigma

    return residual, np.full(4 * count, FREE), np.full(4 * count, 1e-5)


Predict = Callable[[Machine, list[dict[str, Any]], Array], Array]


def _tracker(study: Study) -> tuple[Predict, Array, Array]:
    told: Mapping[str, Any] = study.setup["instrument"]
    station = 1e-3 * np.array(told["station_mm"])
    euler = np.deg2rad(told["euler_xyz_deg"])
    scale = [1e-6 * told[k] for k in ("range_sigma_um", "range_sigma_um_per_m", "angle_sigma_urad")]
    d = study.data
    y = np.stack([1e-3 * d["range_mm"], d["azimuth_rad"], d["elevation_rad"]], axis=1)
    sigma = tracker_noise(Tracker(station, euler, *scale), y)

    def residual(machine: Machine, effects: list[dict[str, Any]], nuisance: Array) -> Array:
        tracker = Tracker(station + nuisance[:3], euler + nuisance[3:])
        p = tool_point(machine, study.run, effects)
        return ((tracker_readings(tracker, p, study.run.t, effects) - y) / sigma).ravel()

    return residual, np.full(6, FREE), np.full(6, 1e-5)


def _balls(study: Study) -> tuple[Predict, Array, Array]:
    told: Mapping[str, Any] = study.setup["instrument"]
    balls, run = study.artefact, study.run
    if balls is None or run.pose is None or run.ball is None:
        raise ValueError("a ball array's study needs artefact.csv and the columns pose and ball")
    first = tool_point(study.nominal, run)
    n = int(run.pose.max()) + 1
    rotation, origin = np.empty((n, 3, 3)), np.empty((n, 3))
    for k in range(n):
        own, seen = balls[run.ball[run.pose == k]], first[run.pose == k]
        corner = align(own, seen, np.vstack([np.zeros(3), np.eye(3)]))
        rotation[k], origin[k] = (corner[1:] - corner[0]).T, corner[0]
    probe, u = 1e-6 * told["probe_sigma_um"], 1e-6 * told["ball_position_u_um"]
    supports = tuple(told.get("supports", (0.22, 0.78)))

    def residual(machine: Machine, effects: list[dict[str, Any]], nuisance: Array) -> Array:
        pose, moved = nuisance[: 6 * n].reshape(n, 6), nuisance[6 * n :].reshape(balls.shape)
        r, o = rotation_matrix(pose[:, 3:]) @ rotation, origin + pose[:, :3]
        target = ball_positions(balls + moved, run, r, o, effects, supports)
        return ((tool_point(machine, run, effects, sensor=True) - target) / probe).ravel()

    prior = np.concatenate([np.full(6 * n, FREE), np.full(balls.size, u)])
    return residual, prior, np.full(prior.size, 1e-6)


def lmmse(
    study: Study,
    unknown: Sequence[Unknown] = (),
    known: Sequence[Effect] = (),
    steps: int = 3,
) -> Bound:
    """Estimate the error motions of a study, together with the amplitudes of the true effects.

    The noise counts as declared; `known` effects are modelled with the values given.
    """
    nominal = study.nominal
    free, spread = family_columns(nominal.table)
    kind = study.setup["instrument"]["kind"]
    if study.setup["instrument"].get("readings") == "range":
        kind = "multilateration"
    residual, loose, small = {
        "laser_tracker": _tracker, "ball_array": _balls, "multilateration": _laterated
    }[kind](study)  # fmt: skip
    m, e = len(free), len(unknown)
    prior = np.concatenate([spread, [s for _, _, s in unknown], loose])
    step = np.concatenate([prior[: m + e], small])

    def parts(x: Array) -> tuple[Machine, list[dict[str, Any]], Array]:
        return _machine(nominal, free, x[:m]), _effects(unknown, x[m : m + e], known), x[m + e :]

    x = np.zeros(prior.size)
    h = np.eye(prior.size)
    for _ in range(steps):
        r = residual(*parts(x))
        moved = x + np.diag(step)
        jacobian = np.stack([residual(*parts(p)) - r for p in moved], axis=1) * (prior / step)
        h = jacobian.T @ jacobian + np.eye(prior.size)
        x = x - prior * np.linalg.solve(h, jacobian.T @ r + x / prior)
    r = residual(*parts(x))
    covariance = np.linalg.inv(h)
    dof = r.size - (prior.size - np.trace(covariance))
    machine, effects, _ = parts(x)

    def check_rms(p: Array) -> float:
        off = align(p, study.check_tcp) - study.check_tcp
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    return Bound(
        machine,
        effects,
        x[m : m + e],
        (prior * np.sqrt(np.diag(covariance)))[m : m + e],
        float(r @ r / dof),
        float(r @ r + np.sum((x / prior) ** 2)),
        check_rms(tool_point(nominal, study.check_run)),
        check_rms(tool_point(machine, study.check_run, effects)),
    )
