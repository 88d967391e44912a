"""What the record holds besides the table."""

from dataclasses import asdict
from typing import Any

from .better import PathBound, Step
from .cycles import Cycles
from .recipe import Lever
from .results import Results
from .table_four import PRINTED


def record(results: Results) -> dict[str, Any]:
    """All numbers behind the page, by section."""
    found = results.better
    return {
        "seed": results.seed,
        "draws": results.draws,
        "budget": [f._asdict() for f in results.figures],
        "seen": {name: asdict(one) for name, one in results.seen.items()},
        "table_four": {
            "printed": dict(PRINTED),
            "levers_m": asdict(Lever.seen()),
            "variants": [
                {"choices": v.name, "U_um": v.U, "exchanged": v.exchanged,
                 "as_printed": v.as_printed}
                for v in results.variants
            ],
        },
        "cycles": {name: _cycles(one) for name, one in results.cycles.items()},
        "influences_as_effects": {n: _cycles(one) for n, one in results.as_effects.items()},
        "second_device": {
            "repeats": results.verification.repeats,
            "within_3_um": results.verification.inside,
            "repeats_within_3_um": results.verification.all_inside,
            "normalised_errors_up_to_one": results.verification.agreeing,
            "straightnesses": [
                {"segment": a.segment, "component": a.component, "rmse_um": a.rmse[:3],
                 "expected_um": a.expected, "within_3_um": a.inside}
                for a in results.verification.agreements
            ],
            "reversals": [asdict(r) for r in results.verification.reversals],
        },
        "layouts": {
            "steps": [_step(s) for s in found.steps],
            "for_tool": _step(found.for_tool),
            "paths_tried": list(found.tried),
            "five_beams": [_path(p) for p in found.five],
            "six_beams": [_path(p) for p in found.six[:10]],
            "monte_carlo": {n: _cycles(one) for n, one in results.checked.items()},
        },
    }  # fmt: skip


def _cycles(one: Cycles) -> dict[str, Any]:
    return {
        "identified_U_um": one.identified,
        "by_beams_U_um": one.by_beams,
        "tool_U_um": one.tool.max(0),
        "tool_by_beams_U_um": None if one.tool_by_beams is None else one.tool_by_beams.max(0),
        "failed": one.campaign.failed,
    }


def _step(step: Step) -> dict[str, Any]:
    layout = step.layout
    return {
        "freedom": step.freedom,
        "U_um": step.U,
        "largest_um": step.largest,
        "tool_um": step.tool,
        "lever_mm": 1e3 * layout.lever,
        "segments": [
            {"number": s.number, "start_mm": [1e3 * v for v in s.start],
             "end_mm": [1e3 * v for v in s.end], "places_mm": 1e3 * p * s.length}
            for s, p in zip(layout.segments, layout.shares, strict=True)
        ],
    }  # fmt: skip


def _path(path: PathBound) -> dict[str, Any]:
    return {"corners": path.corners, "evenly_um": path.evenly, "bound_um": path.bound,
            "points": path.shares}  # fmt: skip
