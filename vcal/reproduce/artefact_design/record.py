"""What the record holds besides the table."""

from dataclasses import asdict
from typing import Any

import numpy as np

from ...design import ArrayPoses
from .influences import AIR_K, LOAD_KG, SIZES, TAU_H, WARM_K
from .results import Results
from .setting import KNOWN, PAIR_UM, POSES, PROBE_UM, SQUARENESS_URAD, TABLE_ONE, TOOL, WAVES
from .sweep import Drawn
from .timing import Design


def record(results: Results) -> dict[str, Any]:
    """All numbers behind the page, by section."""
    r = results
    return {
        "seed": r.seed,
        "draws": r.draws,
        "settings": {
            "observable": "coordinates of touches; distances for plain least squares",
            "probe_um": PROBE_UM,
            "pair_um": PAIR_UM,
            "tool_mm": [1e3 * v for v in TOOL],
            "table_one": {name: list(row) for name, row in TABLE_ONE.items()},
            "waves": {axis: list(w) for axis, w in WAVES.items()},
            "squareness_urad": SQUARENESS_URAD,
            "poses": {
                name: [{"centre_mm": [1e3 * v for v in p.centre], "direction": p.direction}
                       for p in make()]
                for name, make in POSES.items()
            },
        },
        "before_um": {"aligned": r.before_um[0], "raw": r.before_um[1]},
        "pose_sets_um": r.sets,
        "plain_least_squares": {k: [asdict(p) for p in r.plain[k]] for k in KNOWN},
        "sweeps": {
            known: [
                {"varied": varied, "value": value, "aligned_um": t.aligned, "raw_um": t.raw,
                 "plain_um": t.plain.aligned_um, "plain_order": t.plain.order,
                 "machines": _machines(r.exact[known].get((varied, value)))}
                for (varied, value), t in r.theory[known].items()
            ]
            for known in KNOWN
        },
        "influences": {
            "assumed": {n: {"what": w, "sigma": s} for n, (w, s) in SIZES.items()},
            "conditions": {"axes_K": WARM_K, "tau_h": TAU_H, "air_K": AIR_K, "load_kg": LOAD_KG},
            "rms_um": {k: {n: asdict(c) for n, c in r.costs[k].items()} for k in KNOWN},
            "machines_S": {name: _machines(one) for name, one in r.influenced.items()},
        },
        "searched": {
            known: {
                name: {"rms_um": one.optimised.rms_um, "nominal_um": one.optimised.nominal_um,
                       "gain": one.optimised.gain, "machines": _machines(one.checked),
                       "starts": [{"rms_um": f.value, "from_um": f.start, "steps": f.iterations,
                                   "converged": f.converged} for f in one.optimised.found],
                       "design": _design(one.optimised.poses)}
                for name, one in r.searched[known].items()
            }
            for known in KNOWN
        },
        "nominal": {k: _machines(one) for k, one in r.nominal.items()},
        "star_stylus": {
            k: {"straight_um": s.straight, "alternating_um": s.alternating, "searched_um": s.found,
                "gain": s.gain}
            for k, s in r.star.items()
        },
        "time": {
            k: {"share_for_nominal": t.share, "designs": [_timed(d) for d in t.designs],
                "front": [[d.balls, d.count] for d in t.front]}
            for k, t in r.trade.items()
        },
        "families": {
            shape: {
                "known": one.known,
                "names": list(one.families),
                "rms_um": {name: list(v) for name, v in one.rms_um.items()},
                "average_um": {name: one.average_um(name) for name in one.rms_um},
            }
            for shape, one in r.robust.items()
        },
    }  # fmt: skip


def _machines(one: Drawn | None) -> dict[str, Any] | None:
    if one is None:
        return None
    return {"rms_um": one.rms, "failed": one.failed, "gradients": one.gradients}


def _design(poses: ArrayPoses) -> dict[str, Any]:
    return {
        "balls_mm": 1e3 * np.asarray(poses.balls),
        "rotation": np.asarray(poses.rotation),
        "origin_mm": 1e3 * np.asarray(poses.origin),
    }


def _timed(one: Design) -> dict[str, Any]:
    return {
        "balls": one.balls,
        "poses": one.count,
        "seconds": one.seconds,
        "exchange_um": one.chosen.rms_um,
        "bound_um": one.chosen.bound_um,
        "rms_um": one.rms_um,
        "freedom": one.freedom,
    }
