"""The record of a virtual calibration for programs: the content of ``result.json``."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...study.study import Study
from ...uncertainty.comparison import Comparison
from ...uncertainty.virtual import STATISTICS, WHEN, VirtualCalibration
from ..html.provenance import plain, provenance_record
from ..html.text import number, percent

UNCERTAINTY_SCHEMA = "vcal-uncertainty/1"
VERDICTS = ("passed", "failed", "undecided")
_EVERY = 0.99
"""Share of the machines from which on all are said to improve."""
_OFTEN = 0.1
"""Share of draws solved one by one from which on a note says so."""


def sentence(result: VirtualCalibration) -> str:
    """The answer in one sentence."""
    if result.faultless:
        return (
            "No error of the machine is declared, so that there is nothing to improve. Declare "
            "its possible errors under [model.geometric], or as [[model.effect]]."
        )
    before, after = (result.volumetric("rms", when) for when in WHEN)
    span = "{} µm ({} to {} µm)".format
    from_, to = (span(number(v.mean), number(v.low), number(v.high, 3)) for v in (before, after))
    share = percent(result.coverage)
    if result.improved > _EVERY:
        return (
            f"This plan reduces the rms volumetric error from {from_} to {to}: mean and interval "
            f"of {share} of the machines."
        )
    return (
        f"With this plan the rms volumetric error changes from {from_} to {to} (mean and interval "
        f"of {share} of the machines); it decreases on only {percent(result.improved)} of them."
    )


def notes(result: VirtualCalibration) -> list[str]:
    """Limitations of the results."""
    ensemble = result.ensemble
    found = []
    if ensemble.interrupted:
        found.append(
            f"Interrupted after {ensemble.draws} draws; the results are those of these draws. The "
            "same command continues from there."
        )
    if result.campaign.failed:
        found.append(
            f"For {result.campaign.failed} of {ensemble.draws} draws the identification failed or "
            "gave a result that is not a number; they are excluded from every statistic."
        )
    if ensemble.adaptive is not None and not ensemble.adaptive.settled:
        unstable = int((~ensemble.adaptive.stable).sum())
        found.append(
            f"{unstable} of {len(ensemble.labels)} results were not yet stable when the draws "
            "ended (JCGM 101, 7.9.4)."
        )
    if not result.nodes:
        found.append(
            "Errors are evaluated at the tool point of the declared chain. Errors that unknown "
            "targets on the tool compensate in every reading count in full."
        )
    if result.campaign.retried > _OFTEN:
        found.append(
            f"{percent(result.campaign.retried)} of the draws were too far from the nominal "
            "machine for the shared curvature and were solved one by one, which is slow."
        )
    undecided = result.parameters.verdicts.count("undecided")
    if undecided:
        found.append(
            f"Clause 8 is undecided for {undecided} of {len(result.parameters.labels)} parameters: "
            "the scatter of the Monte Carlo results could reverse the verdict, or there are fewer "
            f"than the {2 * ensemble.step} draws that are needed to estimate it. More draws decide."
        )
    ratio = result.rms_gum / result.rms_monte_carlo if result.rms_monte_carlo else 1.0
    if not 0.9 < ratio < 1.1:
        found.append(
            f"The rms volumetric error by the GUM ({number(result.rms_gum)} µm) and by Monte Carlo "
            f"({number(result.rms_monte_carlo)} µm) differ: the problem is not linear over its "
            "priors, and the shares of the sources are only approximate."
        )
    return found


def record(
    result: VirtualCalibration,
    study: Study,
    *,
    settings: Mapping[str, Any],
    command: str = "",
    seconds: float = math.nan,
) -> dict[str, Any]:
    """All results of a virtual calibration as plain values; see `UNCERTAINTY_SCHEMA`.

    Numbers that do not exist are None, so that the record is strict JSON.
    """
    found: dict[str, Any] = {
        "schema": UNCERTAINTY_SCHEMA,
        "name": study.name,
        "sentence": sentence(result),
        "coverage": result.coverage,
        "volumetric_error_um": {
            when: {
                statistic: result.volumetric(statistic, when)._asdict() for statistic in STATISTICS
            }
            for when in WHEN
        },
        "improved_share": result.improved,
        "rms_after_um": {
            "gum": result.rms_gum,
            "monte_carlo": result.rms_monte_carlo,
            "known": result.known,
        },
        "sources": [c._asdict() for c in result.contributions],
        "parameters": _parameters(result),
        "error_motions": [m._asdict() for m in result.motions],
        "straight_lines": _lines(result),
        "clause_8": {
            name: {verdict: c.verdicts.count(verdict) for verdict in VERDICTS}
            for name, c in (
                ("parameters", result.parameters),
                ("error_motions", result.motion_comparison),
                ("straight_lines", result.lines),
            )
        },
        "not_identifiable": {
            "directions": result.directions,
            "determined": result.determined,
            "combinations": list(result.unseen),
            "parameters": list(result.hardly),
        },
        "field": {
            "position_m": np.asarray(result.points.position),
            "axes": list(result.points.axes),
            "before_um": result.bounds("before"),
            "after_um": result.bounds("after"),
        },
        "draws": _draws(result),
        "interrupted": result.ensemble.interrupted,
        "notes": notes(result),
        **provenance_record(study, settings, command, seconds),
    }
    return plain(found)


def _parameters(result: VirtualCalibration) -> list[dict[str, Any]]:
    c = result.parameters
    places = {label: i for i, label in enumerate(c.labels)}
    return [
        {"effect": key, "parameter": p.name, "unit": p.unit, "prior": p.sigma}
        | _compared(c, places[f"{key}: {p.name} [{p.unit}]"])
        for key, p in result.entries
    ]


def _lines(result: VirtualCalibration) -> list[dict[str, Any]]:
    rows = []
    for i, label in enumerate(result.lines.labels):
        name, _, unit = label.rpartition(" [")
        own = {"name": name, "unit": unit.rstrip("]"), "prior": result.lines_before[i]}
        rows.append(own | _compared(result.lines, i))
    return rows


def _draws(result: VirtualCalibration) -> dict[str, Any]:
    ensemble, campaign = result.ensemble, result.campaign
    return {
        "done": ensemble.draws,
        "failed": campaign.failed,
        "retried_share": campaign.retried,
        "gradients_per_draw": campaign.gradients,
        "quantiles": ensemble.kept,
        "settled": None if ensemble.adaptive is None else ensemble.adaptive.settled,
    }


def _compared(c: Comparison, i: int) -> dict[str, Any]:
    """One output by the GUM and by Monte Carlo, and the verdict of clause 8."""
    columns = {"value": c.value, "u": c.u, "low": c.low, "high": c.high}
    gum, monte_carlo = ({name: x[i, way] for name, x in columns.items()} for way in (0, 1))
    return {"gum": gum, "monte_carlo": monte_carlo, "delta": c.delta[i], "verdict": c.verdicts[i]}
