"""The record of a closed loop for programs: the content of ``report.json``."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ...compensation.computed_tests import LineTest
from ...effects.previous import posterior_of
from ...geometry.acceptance import GeometricTest
from ...geometry.error_motions import ErrorMotionTable
from ...geometry.positioning_lines import PositioningTest
from ...identification.fit import Fit
from ...loop.detectable import Detectable
from ...loop.outcome.closure import Closure, Errors, FoundEffect
from ...loop.outcome.confirmed import Confirmation, confirmations
from ...loop.outcome.misdeclared import Misdeclared
from ...loop.outcome.unexplained import Unexplained
from ...loop.screening.candidates import Untestable
from ...loop.weighing.cross_validation import Rms
from ...machine.plan import Plan
from ...plots import column_of
from ...study.data_sets import DataSet
from ...study.identified_machine import stated_of
from ...study.study import Study
from ..html.provenance import plain, provenance_record
from .computed import computed_record
from .could_be_seen import could_be_seen_record
from .decision import Decided, volumetric_record
from .derived import (
    Listed,
    declared,
    intervals_in_file,
    missing_columns,
    parameters,
    shares_by_column,
    untested_beside,
)
from .positioning import positioning_record
from .standards import standards_record
from .what_to_do import reach_record, reaches

SCHEMA = "vcal-report/1"


def record(
    closure: Closure,
    study: Study,
    tests: Sequence[GeometricTest] = (),
    positioned: Sequence[PositioningTest] = (),
    lines: Sequence[LineTest] = (),
    *,
    motions: Sequence[ErrorMotionTable] = (),
    seen: Detectable | None = None,
    volumetric: Decided | None = None,
    command: str = "",
    seconds: float = math.nan,
) -> dict[str, Any]:
    """All results of a closure as plain values; see `SCHEMA`.

    `tests` of the geometry are the content of `geometry`, `motions` that of `error_motions`,
    `positioned` that of `positioning`, which only studies with such tests have, `lines` that of
    `computed_tests`, which an arm does not have. A study with several data sets also has
    `data_sets`, the share of each; one with a double ball bar also has `circular_tests`. `seen` is
    the content of `smallest_sizes`, which an interrupted search does not have; `volumetric` that of
    `volumetric_error` and, where a tolerance is set, of `acceptance`. `stated` repeats what the
    study states of machine and measurement.

    An effect whose `placement` is a class of several, ``"X|Y"``, has the parameters of its
    `fitted_placement`. `unexplained` has a `size_um` and a `share_of_variance`, which `size_is` and
    `share_is` define: for an empirical description, its largest displacement and its share of the
    chi-square beyond the noise; otherwise an rms, and a share of the variance of the residual.
    Columns and their values are those of the data file. Numbers that do not exist are None, so
    that the record is strict JSON.
    """
    plan, moved = closure.after.measurement.plan, reaches(closure)
    settings = {
        **closure.settings,
        "effects": closure.searched,
        "effects_asked_for": closure.settings.get("effects", []),
    }
    found: dict[str, Any] = {
        "schema": SCHEMA,
        "name": study.name,
        "verdict": closure.verdict,
        "sentence": closure.sentence,
        "effects": [
            {**_effect(closure, one), **reach_record(moved.get(one.effect.key))}
            for one in closure.effects
        ],
        "hints": [
            {
                "effect": hint.effect.name,
                "placement": hint.placement,
                "probability": hint.probability,
                "reason": hint.hint,
            }
            for hint in closure.hints
        ],
        "no_gain": closure.no_gain,
        "declared_sizes": _sizes(closure.sizes),
        "declared": [
            {"effect": e.name, "placement": e.placement, "parameters": _parameters(listed)}
            for e, listed in declared(closure)
        ],
        "errors": {name: _errors(errors) for name, errors in closure.errors.items()},
        "geometry": [_test(test) for test in tests],
        "error_motions": [_motion(motion) for motion in motions],
        "unexplained": _unexplained(closure.unexplained, closure.after),
        "variance": closure.variance,
        "noise_scale": closure.noise_scale,
        "noise_components": [
            {"reading": part.name, "factor": part.factor, "u": part.u}
            for part in closure.noise_components
        ],
        "suspected_readings": [
            {**_place(one.row, plan), "distance": one.distance, "p_value": one.p_value}
            for one in closure.suspected
        ],
        "blank_readings": [
            {"file": file, "rows": list(rows)}
            for file, rows in closure.after.measurement.blank.items()
        ],
        "rejected": [
            {
                "effect": tried.effect,
                "placement": tried.placement,
                "p_value": tried.p_value,
                "reason": tried.reason,
            }
            for tried in (*closure.rejected, *closure.passed_over)
        ],
        "untestable": [
            {"effect": item.effect, "placement": item.placement, "reason": _reason(item, plan)}
            for item in closure.untestable
        ],
        "vibration": None if closure.vibration is None else asdict(closure.vibration),
        "unseen": list(dict.fromkeys(closure.unseen)),
        **provenance_record(study, settings, command, seconds),
        "notes": list(closure.notes),
        "interrupted": closure.interrupted,
    }
    if study.chain.arm and (posterior := _posterior(closure.after, study)) is not None:
        found["posterior"] = posterior
    several = [_data_set(closure, one) for one in study.sets if one.name]
    recorded = [_confirmation(one) for one in confirmations(closure)]
    found |= {"data_sets": several} if several else {}
    found |= {"recorded_responses": recorded} if recorded else {}
    found |= standards_record(closure, study)
    found |= computed_record(lines)
    found |= could_be_seen_record(seen) | volumetric_record(volumetric)
    about = {k: v for k, v in stated_of(study).items() if k in ("machine", "measurement")}
    found |= {"stated": about} if about else {}
    found |= {"positioning": [positioning_record(one) for one in positioned]} if positioned else {}
    return plain(found)


def _motion(one: ErrorMotionTable) -> dict[str, Any]:
    """Curve of an error motion, or a location error, which has no positions."""
    values = (one.value, one.u, one.information)
    shown, u, share = ([float(f"{v:.6g}") for v in column] for column in values)
    return {
        "name": one.name,
        "axis": one.axis,
        "position_unit": one.position_unit,
        "position": [float(f"{x:.9g}") for x in one.position],
        "unit": one.unit,
        "value": shown,
        "standard_uncertainty": u,
        "information_share": share,
    }


def _confirmation(one: Confirmation) -> dict[str, Any]:
    return {
        "column": one.column,
        "effect": one.effect,
        "coefficient": one.coefficient,
        "expanded_uncertainty": one.expanded,
        "across": one.across,
        "across_expanded_uncertainty": one.across_expanded,
        "share": one.share,
        "p_value": one.p_value,
    }


def _sizes(found: Misdeclared | None) -> dict[str, Any] | None:
    """Declared sizes that do not fit."""
    if found is None:
        return None
    return {
        "p_value": found.test.p_value,
        "ratio": found.test.ratio,
        "factors": dict(found.factors),
        "used": found.used,
        "gross": found.test.gross,
        "largest": [
            {
                "effect": key,
                "parameter": p.name,
                "value": value,
                "unit": p.unit,
                "declared_sigmas": times,
            }
            for key, p, times, value in found.test.largest
        ],
    }


def _posterior(fit: Fit, study: Study) -> dict[str, Any] | None:
    """Expectation and covariance of the geometric errors of an arm, for ``[model] from`` of a later
    campaign; None without any.
    """
    for effect, place in zip(fit.model.effects, fit.model.places, strict=True):
        own = range(len(fit.theta))[place]
        values = np.array([value for _, _, value, _ in fit.parameter_values()][place])
        steps = np.array([p.step / p.si for _, p in fit.entries[place]])
        covariance = fit.covariance[np.ix_(own, own)] * np.outer(steps, steps)
        known = posterior_of(effect, values, covariance)
        if known is None:
            continue
        parameters, mean, matrix = known
        return {
            "machine": study.chain.text,
            "parameters": [
                {"name": p.name, "unit": p.unit, "value": float(value)}
                for p, value in zip(parameters, mean, strict=True)
            ],
            "covariance": [
                [float(f"{v:.9g}") for v in row[: i + 1]] for i, row in enumerate(matrix.tolist())
            ],
        }
    return None


def _test(test: GeometricTest) -> dict[str, Any]:
    return {
        "name": test.name,
        "what": test.what,
        "axis": test.axis,
        "value": test.value,
        "unit": test.unit,
        "standard_uncertainty": test.u,
        "information_share": test.information,
    }


def _reason(item: Untestable, plan: Plan) -> str:
    missing = missing_columns(item, plan)
    return f"the data have no {', '.join(missing)}" if missing else item.reason


def _place(row: int, plan: Plan) -> dict[str, Any]:
    """A row of the data by its number in its table, from 1, and its data set of several."""
    name, number = plan.place(row)
    return {"row": number + 1, **({"data_set": name} if name else {})}


def _effect(closure: Closure, found: FoundEffect) -> dict[str, Any]:
    return {
        "effect": found.effect.name,
        "placement": found.placement,
        "fitted_placement": found.effect.placement,
        "parameters": _parameters(parameters(closure, found)),
        "status": found.status,
        "found": not found.hint,
        "probability": found.probability,
        "chance": found.chance,
        "p_value": found.p_value,
        "log_evidence": found.log_evidence,
        "delta_bic": found.delta_bic,
        "heldout_gain": found.heldout_gain,
        "equivalent": list(found.equivalent),
        "alternatives": [
            {
                "effect": name,
                "placement": placement,
                "probability": probability,
                "indistinguishable_shapes": found.shapes_of(name, placement),
            }
            for name, placement, probability in found.alternatives
        ],
        "separation": found.separation,
        "indistinguishable_shapes": [dict(shape) for shape in found.shapes],
        "untested": [
            {"effects": keys, "missing": columns}
            for columns, keys in untested_beside(closure, found).items()
        ],
    }


def _parameters(listed: Listed) -> list[dict[str, Any]]:
    return [
        {"name": name, "value": value, "unit": unit, "standard_uncertainty": u}
        for name, value, unit, u in listed
    ]


def _errors(errors: Errors) -> dict[str, float | None]:
    return {
        "check_rms_um": _value(errors.check),
        "check_raw_rms_um": _value(errors.check_raw),
        "heldout_rms_um": _value(errors.heldout),
        "fit_rms_um": _value(errors.fit),
        "chi2_per_dof": errors.chi2_per_dof,
        "u_check_rms_um": errors.check.u if errors.check else None,
        "u_heldout_rms_um": errors.heldout.u,
    }


def _data_set(closure: Closure, one: DataSet) -> dict[str, Any]:
    """One of several data sets, with its share of the errors."""
    return {
        "name": one.name,
        "file": one.file,
        "instrument": one.settings.kind,
        "rows": one.plan.rows,
        "noise_scale": closure.noise_scales[one.name],
        "errors": {
            column: {
                "heldout_rms_um": errors.sets[one.name].heldout.value,
                "fit_rms_um": errors.sets[one.name].fit.value,
                "chi2_per_dof": errors.sets[one.name].chi2_per_dof,
            }
            for column, errors in closure.errors.items()
        },
    }


def _value(rms: Rms | None) -> float | None:
    return None if rms is None else rms.value


def _unexplained(what: Unexplained | None, fit: Fit) -> dict[str, Any] | None:
    if what is None:
        return None
    plan = fit.measurement.plan
    shares = shares_by_column(what, plan)
    return {
        "depends_on": list(shares),
        "shares": list(shares.values()),
        "products": [
            {"columns": [column_of(a, plan)[0], column_of(b, plan)[0]], "share": share}
            for a, b, share in what.products
        ],
        "where": [
            {"column": column, "low": low, "high": high}
            for column, low, high in intervals_in_file(what, fit)
        ],
        "direction": what.direction,
        "size_um": what.size_um,
        "size_is": what.size_is,
        "share_of_variance": what.share_of_variance,
        "share_is": what.share_is,
        "p_value": what.p_value,
        "reason": what.reason,
    }
