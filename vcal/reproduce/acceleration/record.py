"""What the record holds besides the table."""

from dataclasses import asdict
from typing import Any

import numpy as np

from .results import Model, Results, RTestOf
from .setting import (
    DEVICE_U_UM,
    EXTERNAL_UM,
    INTERNAL_UM,
    LEVELS,
    RADIUS_M,
    RANGE_MM,
    SAMPLES,
    carriage_factors,
)


def record(results: Results) -> dict[str, Any]:
    """All numbers behind the page, by section."""
    r = results
    return {
        "seed": r.seed,
        "draws": r.draws,
        "setting": {
            "radius_mm": 1e3 * RADIUS_M,
            "levels_m_s2": LEVELS,
            "samples": SAMPLES,
            "external_sigma_um": EXTERNAL_UM,
            "internal_sigma_um": INTERNAL_UM,
            "device_U_um": DEVICE_U_UM,
            "range_mm": RANGE_MM,
        },
        "carriages_over_catalogue": carriage_factors(),
        "machines": {
            name: _model(model)
            for name, model in (
                ("catalogue", r.catalogue),
                ("true", r.true),
                ("identified", r.identified),
            )
        },
        "joint": {"matrix": r.joint.matrix, "u": r.joint.u, "chi2_per_dof": r.joint.chi2_per_dof},
        "joint_noise_only": {"matrix": r.joint_no_device.matrix, "u": r.joint_no_device.u},
        "evaluated": {
            "simulated": _evaluated(r.simulated, r.catalogue.matrix),
            "measured": _evaluated(r.measured, r.joint.matrix),
        },
        "identified": [
            {
                "name": unknown.name,
                "unit": unknown.unit,
                "value": value,
                "interval": interval,
                "z": z,
                "u_z": u,
                "told": told,
            }
            for unknown, value, interval, z, u, told in zip(
                r.found.unknowns,
                r.found.values,
                r.found.interval(),
                r.found.z,
                np.sqrt(np.diag(r.found.covariance)),
                r.found.told,
                strict=True,
            )
        ],
        "not_told": r.found.not_told(),
        "chi2": r.found.chi2,
        "readings": r.found.readings,
        "compensated": {
            "by circles": {name: asdict(c) for name, c in r.by_circles.items()},
            "by machine": {name: asdict(c) for name, c in r.by_machine.items()},
        },
        "campaign": _campaign(r),
    }


def _model(model: Model) -> dict[str, Any]:
    m = model.move
    return {
        "matrix": model.matrix,
        "natural_frequencies_hz": model.hz,
        "move": {
            "set_peak": m.set_peak,
            "peak": m.peak,
            "at_peak_um": m.at_peak_um,
            "ratio": m.ratio,
            "fitted": m.fitted,
        },
    }


def _evaluated(one: RTestOf, matrix: np.ndarray) -> dict[str, Any]:
    return {
        "amplitude_ratio": {f"{a:g}": ratio for a, ratio in one.ratio.items()},
        **{
            way: {
                "mean": found.mean,
                "dispersion": {f"{a:g}": d for a, d in found.dispersion(matrix).items()},
            }
            for way, found in one.ways.items()
        },
    }


def _campaign(results: Results) -> dict[str, Any]:
    c = results.campaign
    return {
        "machines": len(c.status),
        "stable": int(c.stable.sum()),
        "converged": int(c.converged.sum()),
        "steps_median": float(np.median(c.steps)),
        "chi2_per_reading": float(np.mean(c.chi2[c.converged]) / c.readings),
        "unknowns": [
            {
                "name": unknown.name,
                "u_median": float(np.median(c.u[c.converged, i])),
                "pull_mean": float(c.pulls[:, i].mean()),
                "pull_sd": float(c.pulls[:, i].std()),
                "within_U": float((np.abs(c.pulls[:, i]) < 2.0).mean()),
            }
            for i, unknown in enumerate(c.unknowns)
        ],
    }
