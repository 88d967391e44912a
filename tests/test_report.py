"""The report: complete, strict, self-contained, and written whole or not at all."""

import base64
import dataclasses
import hashlib
import itertools
import json
import math
import os
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.text import Text

from oracle import error_motions, make_case
from report_schema import validated
from vcal import CATALOGUE, StudyError, close_loop, identify, load_machine, load_study, plots
from vcal.cli.show import show_closure
from vcal.compensation import verify
from vcal.effects import Setup, load_effects
from vcal.effects.data_set import OfDataSet
from vcal.geometry.acceptance import geometric_tests
from vcal.geometry.error_field import ErrorField
from vcal.geometry.error_motions import ErrorMotionTable
from vcal.history import read_history
from vcal.identification.model_averaging import Alternatives
from vcal.instruments.ball_array import BallCalibration
from vcal.instruments.conditions import file_column
from vcal.loop.empirical import LocalBump
from vcal.loop.empirical.covariates import correlation
from vcal.loop.outcome.closure import Rejected
from vcal.loop.outcome.unexplained import Interval, Unexplained
from vcal.loop.residuals.outliers import Outlier
from vcal.loop.residuals.variance_components import Component
from vcal.loop.screening.candidates import Untestable
from vcal.loop.screening.score_test import Peak
from vcal.loop.screening.screening import KindResult, Screening
from vcal.machine.plan import Plan, joined
from vcal.plots.labels import column_label
from vcal.plots.loop_search import search
from vcal.plots.residuals import _means as means
from vcal.plots.residuals import before_after, unexplained_views
from vcal.plots.style import AFTER, BEFORE, DOTS, figure, grid, ticks_apart
from vcal.plots.views import View, effect_view, residual_without
from vcal.registry import unchanged
from vcal.report import check_folder, effects_csv, formats, record, write_report
from vcal.report.html import text
from vcal.report.html.scripts import SCENE, script
from vcal.report.loop import write
from vcal.report.loop.derived import in_short, parameters
from vcal.report.loop.own_effect import own_effect
from vcal.report.loop.page import page
from vcal.report.loop.pictures import Picture, pictures
from vcal.report.loop.tested import _by_round
from vcal.study.simulated import parse_with
from vcal.study.study import looked_for

STATED = [
    "acceptance.volumetric_um=25",
    "acceptance.draws=400",
    "machine.serial_number=A 17",
    "measurement.operator=N. N.",
]
SEARCHED = ("backlash", "lateral_reversal", "screw_cyclic", "thermal_tilt", "artefact_bending")


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """Case, study and closure of a small tracker measurement with an undeclared backlash."""
    folder = tmp_path_factory.mktemp("report") / "study"
    backlash = {"effect": "backlash", "axis": "Y", "size_um": 15}
    case = make_case(
        "laser_tracker",
        seed=3,
        effects=[backlash],
        plan={"shape": (6, 5, 4)},
        n_check=60,
        folder=folder,
    )
    study = load_study(folder, STATED)
    assert study.measurement is not None
    closure = close_loop(
        study.model,
        study.measurement,
        check=study.check,
        effects=[CATALOGUE[name] for name in SEARCHED],
        draws=100,
    )
    return case, study, closure


@pytest.fixture(scope="module")
def written(closed, tmp_path_factory):
    """Folder of a report."""
    _, study, closure = closed
    out = tmp_path_factory.mktemp("written") / "deep" / "report"
    page = write_report(closure, study, out, command="vcal loop study", seconds=1.5)
    assert page == out / "index.html"
    return out


def strict(path):
    """The content of a record without NaN; that of report.json as its schema says."""

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    content = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    return validated(content) if path.name == "report.json" else content


@pytest.mark.thorough
def test_a_column_that_does_not_vary_is_like_no_other(closed):
    """Of two data sets the covariate of one may be the same wherever the other's is there."""
    fit = closed[2].after
    n = fit.measurement.rows
    x, still = np.arange(float(n)), np.where(np.arange(n) < n // 2, np.nan, 3.0)
    late = np.where(np.isfinite(still), x, np.nan)
    assert correlation(np.full(n, 3.0), x) == correlation(x, np.full(n, 3.0)) == 0.0
    assert correlation(x, 1.0 - 2.0 * x) == pytest.approx(1.0)
    jump = np.where(np.arange(n) < n // 2, 0.0, 3.0)
    plan = dataclasses.replace(fit.measurement.plan, covariates={"late": late, "jump": jump})
    seen = dataclasses.replace(fit, measurement=dataclasses.replace(fit.measurement, plan=plan))
    what = Unexplained(["late", "jump"], [0.5, 0.4], [], "Z", 4.0, 0.5, 1e-4, "so")
    assert unexplained_views(seen, what) == ["late", "jump"]


# --- the record --------------------------------------------------------------------------------

KEYS = {
    "schema": str,
    "name": str,
    "verdict": str,
    "sentence": str,
    "effects": list,
    "hints": list,
    "no_gain": str,
    "declared_sizes": type(None),
    "declared": list,
    "errors": dict,
    "geometry": list,
    "unexplained": type(None),
    "variance": dict,
    "noise_scale": float,
    "noise_components": list,
    "suspected_readings": list,
    "blank_readings": list,
    "rejected": list,
    "untestable": list,
    "vibration": type(None),
    "unseen": list,
    "error_motions": list,
    "cannot_be_seen": list,
    "smallest_sizes": list,
    "computed_tests": dict,
    "volumetric_error": dict,
    "acceptance": dict,
    "stated": dict,
    "settings": dict,
    "versions": dict,
    "seconds": float,
    "input_files": dict,
    "tables_read": list,
    "command": str,
    "notes": list,
    "interrupted": bool,
    "files": list,
    "sha256": dict,
}


def test_record_has_the_keys_and_types_of_its_schema(written):
    content = strict(written / "report.json")
    assert {key: type(value) for key, value in content.items()} == KEYS
    assert content["schema"] == "vcal-report/1"
    assert content["verdict"] == "named"
    assert content["seconds"] == 1.5
    (effect,) = content["effects"]
    assert effect["effect"] == "backlash"
    assert effect["placement"] == effect["fitted_placement"] == "Y"
    assert effect["status"] == "named"
    for key in ("p_value", "log_evidence", "delta_bic", "heldout_gain"):
        assert isinstance(effect[key], float)
    (size,) = effect["parameters"]
    assert set(size) == {"name", "value", "unit", "standard_uncertainty"}
    assert size["name"] == "size" and size["unit"] == "um"
    assert abs(size["value"] - 15.0) < 4.0 * size["standard_uncertainty"] < 8.0
    # Half of it on either side; the mean is not in the middle.
    assert 0.5 * abs(size["value"]) < effect["at_the_tool_um"]["largest"] < abs(size["value"])
    assert effect["at_the_tool_um"]["rms"] <= 0.51 * abs(size["value"])


def test_page_begins_with_the_decision(closed, written):
    content = strict(written / "report.json")
    page = (written / "index.html").read_text(encoding="utf-8")
    lead = re.search('<p class="lead">([^<]*)</p>', page)
    assert lead is not None and lead[1] == content["volumetric_error"]["sentence"]
    assert lead[1].endswith(content["acceptance"]["sentence"])
    before, after = (content["volumetric_error"][stage] for stage in ("before", "after"))
    assert before["largest_um"] > before["rms_um"] > after["rms_um"]
    # As `vcal verify` states it.
    machine = load_machine(written)
    machine = dataclasses.replace(machine, check=None, block=60)  # compiled already
    found = verify(machine, draws=400).aligned["working volume"]
    assert before["largest_um"] == pytest.approx(found.largest.mean, rel=1e-9)
    assert before["rms_um"] == pytest.approx(found.rms.mean, rel=1e-9)
    assert f"{closed[1].chain.text}, serial number A 17" in page and "by N. N." in page
    (found,) = (one for one in content["effects"] if one["effect"] == "backlash")
    size = re.escape(f"{abs(found['parameters'][0]['value']):.3g}")
    words = (
        rf"Reversal error along \(or about\) the axis, {size} µm: backlash Y moves the tool point"
    )
    assert re.search(words, page)
    assert content["stated"] == {
        "machine": {"serial_number": "A 17"},
        "measurement": {"operator": "N. N."},
    }


def test_a_report_is_read_for_the_history_of_its_machine(written):
    content = strict(written / "report.json")
    found = read_history(written.parent, written=True)
    (report,) = found.reports
    assert (report.folder, found.serial_number) == ("report", "A 17")
    series = {one.series.name: one.series for one in found.outcomes}
    for one in content["geometry"]:
        if one["information_share"] > 0.05:
            size = series[f"{one['name']}: {one['what']}"].entries[0].size
            assert size is not None
            assert (size.value[0], size.u[0]) == pytest.approx(
                (one["value"], one["standard_uncertainty"])
            )
    for name in ("volumetric error, rms", "check points, rms before compensation"):
        assert series[name].entries[0].state == "measured"
    for one in content["effects"]:
        key = f"{one['effect']} {one['placement']}"
        (entry,) = series[key].entries
        known = {p["name"]: p for p in one["parameters"]}
        assert entry.state == "named" and entry.size is not None
        for part, value, u in zip(series[key].parts, entry.size.value, entry.size.u, strict=True):
            wanted = known[part.name]["value"], known[part.name]["standard_uncertainty"]
            assert (value, u) == pytest.approx(wanted)


def test_record_tells_errors_before_and_after(written):
    errors = strict(written / "report.json")["errors"]
    assert list(errors) == ["uncompensated", "before", "after"]
    for values in errors.values():
        assert list(values) == [
            "check_rms_um",
            "check_raw_rms_um",
            "heldout_rms_um",
            "fit_rms_um",
            "chi2_per_dof",
            "u_check_rms_um",
            "u_heldout_rms_um",
        ]
        assert all(isinstance(v, float) and v > 0 for v in values.values())
    assert errors["after"]["check_rms_um"] < errors["before"]["check_rms_um"]


def test_record_names_inputs_and_versions(closed, written):
    _, study, _ = closed
    content = strict(written / "report.json")
    assert content["input_files"] == dict(study.hashes)
    assert {"setup.toml", "data.csv", "check.csv", "errors.csv"} <= set(content["input_files"])
    assert set(content["versions"]) == {"vcal", "python", "jax", "jaxlib", "optimistix", "numpy"}
    assert content["settings"]["seed"] == 0
    assert content["settings"]["study"]["instrument"]["kind"] == "laser_tracker"


def test_what_is_unexplained_is_told_in_columns_of_the_file(closed):
    _, study, closure = closed
    what = Unexplained(
        depends_on=["X", "T_Y", "t"],
        shares=[0.5, 0.2, 0.1],
        where=[Interval("X", 0.2, 0.45), Interval("T_Y", 20.5, 21.0)],
        direction="Z",
        size_um=12.0,
        share_of_variance=0.5,
        p_value=1e-9,
        reason="for the test",
        size_is="rms",
        share_is="of all",
    )
    told = record(dataclasses.replace(closure, verdict="unexplained", unexplained=what), study)
    assert told["unexplained"]["depends_on"] == ["x_mm", "T_y_degC", "t_s"]
    assert told["unexplained"]["where"] == [
        {"column": "x_mm", "low": 200.0, "high": 450.0},
        {"column": "T_y_degC", "low": 20.5, "high": 21.0},
    ]
    assert told["sentence"].endswith("an error along Z where x_mm is 200 to 450.")
    said = page(dataclasses.replace(closure, unexplained=what), study, [], [])
    assert "<td>size</td><td>12.0 µm (rms)</td>" in said
    assert "<td>share</td><td>50 % (of all)</td>" in said
    assert [told["unexplained"][key] for key in ("size_is", "share_is")] == ["rms", "of all"]


def test_page_says_what_was_tried_and_why_nothing_is_named(closed):
    """No more than those that were asked for, and none where no more may be added."""
    _, study, closure = closed
    kinds = sum(looked_for(kind) for kind in CATALOGUE.values())
    what = Unexplained(["X"], [0.5], [], "Z", 12.0, 0.5, 1e-9, "so")

    def said(asked, most=6, **changed):
        settings = {**closure.settings, "effects": asked, "max_effects": most}
        found = dataclasses.replace(closure, settings=settings, unexplained=what, **changed)
        return page(found, study, [], [])

    tried = [*SEARCHED, "of_ones_own"]
    few = said(tried, untestable=[])
    told = f"5 of the {kinds} kinds in the catalogue and 1 of your own"
    assert f"none of the effects that were tested, {told}, explains it.</p>" in few
    assert f"The search was restricted to {told}. Each of them was tested at every place" in few
    assert f"for every effect that was requested ({told}) and that can occur on this" in few
    every = said(list(CATALOGUE), untestable=[])
    assert "none of the effects that were tested explains it.</p>" in every
    assert "<p>Every kind of effect was tested at every place" in every
    assert "for every effect that can occur on this machine" in every
    assert "No effect is identified for it.</p>" in said(tried, most=1)
    unbegun = said(tried, untestable=[], screenings=[])
    assert "the necessary columns for" not in unbegun and "The search had not begun" in unbegun


def test_page_says_what_effects_of_one_data_set_are(closed):
    """Their line is that of the kind, whatever the data set."""
    _, study, closure = closed
    kind = CATALOGUE["encoder_eccentricity"]
    effect = OfDataSet.of(kind(angle="azimuth", placement="azimuth"), "hall")
    peak = Peak(effect, {}, np.ones(2), 9.0, 3.0, 2)
    screening = Screening(
        [KindResult(kind.name, [peak], 2, 9.0, 3.0, 1e-3)], 1e-3, 3.0, 1.0, [effect]
    )
    found = dataclasses.replace(closure, screenings=[screening], unseen=[effect.key])
    said = page(found, study, [], [])
    assert "property object" not in said and said.count(f"<td>{kind.summary}</td>") > 1


@pytest.mark.thorough
def test_page_says_where_doubt_is_part_of_the_uncertainty(closed, monkeypatch):
    _, study, closure = closed
    certain = dataclasses.replace(closure, alternatives=[])
    doubted = dataclasses.replace(
        closure, alternatives=[Alternatives(closure.after, ((1.0, closure.before),))]
    )
    assert [("u also includes what" in page(one, study, [], [])) for one in (certain, doubted)] == [
        0,
        1,
    ]
    assert "no allowance for the choice of the model" not in page(certain, study, [], [])
    monkeypatch.setattr(plots, "cut", lambda figure: plots.Pieces(b"", (), 0.0, False))
    monkeypatch.setattr(plots, "error_motions", lambda tables: None)
    for one in (certain, doubted):
        (shown,) = (p for p in pictures(one, ["a table"]) if p.name == "error_motions")
        assert ("the data give no information" in shown.caption) == (one is certain)
    (found,) = closure.effects
    rivals = dataclasses.replace(found, alternatives=[("jump", "", 0.01)])
    described = SimpleNamespace(effect=LocalBump(port="tool.Z", unit="um", placement="X"))
    what = Unexplained([], [], [], "Z", 4.0, 0.5, 1e-4, "so", empirical=described)  # type: ignore[arg-type]
    part = "is part of the uncertainty of the error at the check points"
    for changed, count in (({"effects": [rivals]}, 1), ({"unexplained": what}, 1), ({}, 0)):
        said = page(dataclasses.replace(closure, **changed), study, [], [])
        assert said.count(part) == count


def test_shares_of_the_variance(closed):
    """Of what the declared model leaves: all of it, whatever was found."""
    _, _, closure = closed
    assert sum(closure.variance.values()) == pytest.approx(1.0)
    before, after = (closure.errors[n].chi2_per_dof for n in ("before", "after"))
    assert closure.variance["named effects"] == pytest.approx((before - after) / before)
    assert closure.variance["noise"] == pytest.approx(min(after, 1.0) / before)


@pytest.mark.parametrize("direction, count", [("Z", 4), ("mixed", 12)])
def test_an_effect_of_ones_own_to_start_from(closed, tmp_path, direction, count):
    """A file that runs as it is: slopes and curvatures of the two first covariates."""
    _, study, closure = closed
    what = Unexplained(["X", "T_Y", "t"], [0.5, 0.2, 0.1], [], direction, 12.0, 0.5, 1e-9, "a test")
    text = own_effect(dataclasses.replace(closure, verdict="unexplained", unexplained=what))
    assert text is not None
    (told,) = (line for line in text.splitlines() if "p-value" in line)
    assert "taken from these data" in told and "too small" in told and len(told) <= 100
    (tmp_path / "own_effect.py").write_text(text)
    (cls,) = load_effects(tmp_path / "own_effect.py")
    setup = Setup(study.chain, study.model.layout, study.plan, study.model.effects)
    (effect,) = cls.candidates(setup)
    assert effect.needs == ("X", "T_Y") and len(effect.parameters) == count
    response = effect.response(study.plan, {})
    x = np.asarray(study.plan.x("X"))
    u = 2.0 * (x - x.min()) / np.ptp(x) - 1.0
    np.testing.assert_allclose(response["tool.Z", "slope1_Z"], u, atol=1e-4)
    np.testing.assert_allclose(response["tool.Z", "curve1_Z"], u * u, atol=1e-4)
    fit = identify(study.model.with_effects(effect), study.measurement)
    assert fit.converged
    assert own_effect(closure) is None


def test_an_effect_of_ones_own_reads_what_all_data_sets_have(closed):
    """Not a column of one of them, which is nan in the rows of the others."""
    _, study, closure = closed
    plan = joined({"cold": study.plan, "warm": study.plan}, {"cold": ["T_X"], "warm": ["T_X"]})
    read = {"ways": closure.after.ways, "angular": closure.after.angular}
    after = SimpleNamespace(measurement=SimpleNamespace(plan=plan), **read)

    def text_of(*names):
        what = Unexplained([*names], [0.5] * len(names), [], "Z", 12.0, 0.5, 1e-9, "a test")
        what = dataclasses.replace(what, joint=True)
        return own_effect(dataclasses.replace(closure, after=after, unexplained=what))

    assert text_of("cold:T_X", "warm:X") is None
    text = text_of("cold:T_X", "Y", "t")
    assert 'plan.x("Y")' in text and 'plan.covariate("t")' in text
    assert "nan" not in text and "cold" not in text and "both_Z" not in text
    assert "both_Z" in text_of("Y", "t")


def test_an_effect_of_ones_own_with_any_name_of_a_column(closed, tmp_path):
    """Names are text in Python, and so are words in a docstring."""
    _, study, closure = closed
    name = 'spindle "load" % \\N """ ü'
    load = np.linspace(0.0, 1.0, study.plan.rows)
    plan = dataclasses.replace(study.plan, covariates={**study.plan.covariates, name: load})
    read = {"ways": closure.after.ways, "angular": closure.after.angular}
    after = SimpleNamespace(measurement=SimpleNamespace(plan=plan), **read)
    what = Unexplained([name], [0.5], [], "Z", 12.0, 0.5, 1e-9, f"it depends on {name}")
    text = own_effect(dataclasses.replace(closure, after=after, unexplained=what))
    assert text is not None
    (tmp_path / "own_effect.py").write_text(text, encoding="utf-8")
    (cls,) = load_effects(tmp_path / "own_effect.py")
    assert f"it depends on {name}" in sys.modules[cls.__module__].__doc__
    (effect,) = cls.candidates(Setup(study.chain, study.model.layout, plan))
    assert effect.needs == (name,)
    slope = effect.response(plan, {})["tool.Z", "slope1_Z"]
    np.testing.assert_allclose(slope, 2.0 * load - 1.0, atol=1e-4)


@pytest.mark.campaign
def test_a_dent_becomes_an_effect_of_ones_own(tmp_path):
    """Unexplained at first; with the file that the report leaves it has a name."""
    dent = {"effect": "dent", "axis": "X", "component": "Z", "depth_um": 25, "at_mm": 240,
            "sigma_mm": 35}  # fmt: skip
    folder = tmp_path / "study"
    make_case("laser_tracker", seed=5, effects=[dent], plan={"shape": (12, 5, 4)}, n_check=60,
              folder=folder)  # fmt: skip
    study = load_study(folder)
    closure = close_loop(study.model, study.measurement, check=study.check, draws=200)
    assert closure.verdict == "unexplained" and not closure.effects
    assert closure.variance["description"] > 0.5 * (1.0 - closure.variance["noise"])
    page = write_report(closure, study, tmp_path / "report")
    assert "own_effect.py" in page.read_text()
    (own,) = load_effects(tmp_path / "report" / "own_effect.py")
    again = close_loop(
        study.model,
        study.measurement,
        check=study.check,
        effects=[*CATALOGUE.values(), own],
        draws=200,
    )
    assert again.verdict == "named" and [e.effect.name for e in again.effects] == ["own_effect"]
    assert again.errors["after"].check.value < closure.errors["after"].check.value


def test_rows_count_as_in_the_file_and_what_is_not_a_number_is_null(closed):
    _, study, closure = closed
    changed = dataclasses.replace(closure, suspected=[Outlier(0, 7.0, 1e-6)], noise_scale=math.nan)
    told = record(changed, study)
    assert told["suspected_readings"] == [{"row": 1, "distance": 7.0, "p_value": 1e-6}]
    assert told["noise_scale"] is None and told["seconds"] is None
    json.dumps(told, allow_nan=False)


def test_amplitude_and_phase_follow_from_sine_and_cosine():
    effect = CATALOGUE["encoder_eccentricity"](angle="azimuth", placement="azimuth")
    # In units of the prior's 10 urad.
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    fit = SimpleNamespace(
        model=SimpleNamespace(effects=(effect,)),
        theta=np.array([0.3, 0.4]),
        covariance=covariance,
        places_of=lambda place: (np.arange(2), np.array([], int)),
    )
    rows = [("sine", 3.0, "urad", 2.0), ("cosine", 4.0, "urad", 3.0)]
    found = SimpleNamespace(effect=effect, parameters=rows)
    listed = {row[0]: row[1:] for row in parameters(SimpleNamespace(after=fit), found)}  # type: ignore[arg-type]
    draws = np.random.default_rng(0).multivariate_normal([30, 40], covariance, 200_000)
    assert listed["amplitude"] == (
        pytest.approx(5.0),
        "urad",
        pytest.approx(10 * np.hypot(*draws.T).std(), rel=0.01),
    )
    assert listed["phase"][0] == pytest.approx(math.atan2(4.0, 3.0))
    # Far from the origin the phase is linear in both; there it scales with one over the amplitude.
    spread = np.arctan2(draws[:, 1], draws[:, 0]).std() * 100.0
    assert listed["phase"][2] == pytest.approx(spread, rel=0.01)


@pytest.mark.parametrize(
    ("inside", "axes", "column", "factor"),
    [
        ("X", ("X", "Y"), "x_mm", 1e3),
        ("dir_Y", ("X", "Y"), "dir_y", 1.0),
        ("T_X", ("X", "Y"), "T_x_degC", 1.0),
        ("T_air", ("X", "Y"), "T_air_degC", 1.0),
        ("T_gradient_z_K_per_m", ("X", "Y"), "T_gradient_z_K_per_m", 1.0),
        ("t", ("X", "Y"), "t_s", 1.0),
        ("range", ("X", "Y"), "range_mm", 1e3),
        ("J2", ("J1", "J2"), "q2_cmd_deg", math.degrees(1)),
        ("read_J2", ("J1", "J2"), "q2_read_deg", math.degrees(1)),
        ("order", ("J1", "J2"), "pose", 1.0),
        ("load_kg", ("X", "Y"), "load_kg", 1.0),
    ],
)
def test_columns_of_covariates(inside, axes, column, factor):
    assert file_column(inside, axes) == (column, pytest.approx(factor))


def test_joints_that_were_read_back_are_told_by_that_column():
    read, commanded = np.array([[0.1], [0.2]]), np.array([[0.11], [0.21]])
    covariates = {"read_J1": read[:, 0], "commanded_J1": commanded[:, 0]}
    assert plots.column_of("J1", Plan(("J1",), read, covariates))[0] == "q1_read_deg"
    assert plots.column_of("J1", Plan(("J1",), commanded, covariates))[0] == "q1_cmd_deg"


# --- the files ---------------------------------------------------------------------------------


def test_all_files_are_there_and_nothing_else(written):
    files = strict(written / "report.json")["files"]
    assert sorted(p.name for p in written.iterdir()) == sorted(files)
    assert {"index.html", "report.json", "compensation.csv", "effects.csv"} <= set(files)
    pictures = [name for name in files if name.endswith(".png")]
    assert len(pictures) >= 5
    for name in pictures:
        assert (written / name).read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in written.parent.iterdir()] == [written.name]


def test_page_is_self_contained_and_says_what_matters(written):
    page = (written / "index.html").read_text(encoding="utf-8")
    targets = re.findall(r"""(?:src|href)\s*=\s*["']([^"']*)""", page)
    beside = [t for t in targets if not t.startswith(("data:image/", "#"))]
    assert beside == ["report.json", "compensation.csv", "effects.csv", "machine.json"]
    assert set(beside) < set(strict(written / "report.json")["files"])
    plain = re.sub('data:image/[a-z+]*;base64,[^"]*', "", page).replace("http-equiv", "")
    # One scene as data, and the script that draws scenes: the policy of the page names its hash.
    kinds, scripts = zip(*re.findall(r"<script([^>]*)>(.*?)</script>", plain, re.S), strict=True)
    assert kinds == (' type="application/json"', "") and scripts[1] == script(SCENE)
    digest = base64.b64encode(hashlib.sha256(scripts[1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in plain
    assert len("".join(scripts)) < 100_000
    without = re.sub(r"<script.*?</script>", "", plain, flags=re.S)
    assert not any(word in without for word in ("<script", "http", "@import", "url("))
    assert not any(word in scripts[1] for word in ("http", "fetch", "import", "eval", "innerHTML"))
    for words in (
        "The declared model lacked backlash Y.",
        "U (k = 2)",
        "SHA-256",
        "vcal loop study",
    ):
        assert words in plain
    anchors = {t[1:] for t in targets if t.startswith("#")}
    assert anchors == set(re.findall(r'id="([^"]*)"', page))


def test_what_was_significant_is_added_or_told_why_not(closed):
    _, study, closure = closed
    first = closure.screenings[0]
    alpha = closure.settings["alpha"]
    beyond = {k.kind for k in first.kinds if first.corrected(k) <= alpha}
    others = beyond & set(SEARCHED) - {"backlash"}  # without descriptions: those are for comparison
    told = {r.effect: r.reason for r in (*closure.rejected, *closure.passed_over)}
    assert others and others <= told.keys()
    assert "no longer significant after another effect was added" in told.values()
    # The same search, had it ended with a description.
    dent = LocalBump(port="tool.Z", unit="um", placement="X")
    rival = SimpleNamespace(effect=dent)
    what = Unexplained([], [], [], "Z", 4.0, 0.5, 1e-4, "so", empirical=rival)  # type: ignore[arg-type]
    ended = dataclasses.replace(
        closure,
        verdict="unexplained",
        effects=[],
        unexplained=what,
        screenings=[dataclasses.replace(first, added=None)],
        rejected=[],
    )
    (backlash,) = (r for r in ended.passed_over if r.effect == "backlash")
    assert backlash.placement == "Y" and backlash.p_value <= alpha
    assert backlash.reason == "an empirical description (local error) describes the residual better"
    rows = record(ended, study)["rejected"]
    assert {row["effect"] for row in rows} == others | {"backlash"}
    assert not any(r.effect == "backlash" for r in closure.passed_over)


def by_round(closure, name):
    """P-values of a kind of effect in every round, as the page has them."""
    table = _by_round(closure, {})
    (row,) = (row for row in table.rows if row[0] == name)
    return row[4:]


def test_one_p_value_of_what_was_found(closed):
    closure = closed[2]
    first, *later = closure.screenings
    (found,) = closure.effects
    assert first.added.alike(found.effect) and first.refined_p == {"backlash": found.p_value}
    assert later[-1].added is None and later[-1].refined_p == {}
    p_value = 1.25e-33  # not that of the step of the scan that is next to it
    first = dataclasses.replace(first, refined_p={"backlash": p_value})
    p_values = by_round(dataclasses.replace(closure, screenings=[first, *later]), "backlash")
    assert p_values[0] == text.probability(p_value) != p_values[1]


def test_every_round_tells_what_was_added_in_it(closed):
    """Whether that stayed or not: the effects in the end need not be those of the first rounds."""
    closure = closed[2]
    first, last = closure.screenings[0], closure.screenings[-1]
    nothing = dataclasses.replace(first, added=None, refined_p={})
    begun_anew = [nothing, last, first, last]
    drawn = search(begun_anew, closure.settings["alpha"])
    limit = -math.log10(closure.settings["alpha"])
    for ax, screening in zip(drawn.axes, begun_anew, strict=True):
        names = [label.get_text() for label in drawn.axes[0].get_yticklabels()]
        for name, bar in zip(names, ax.patches, strict=True):
            added = screening.added is not None and name == screening.added.name
            colour = AFTER if added else BEFORE if bar.get_width() >= limit else DOTS
            assert bar.get_facecolor() == to_rgba(colour)
    p_values = by_round(dataclasses.replace(closure, screenings=begun_anew), "backlash")
    (kind,) = (k for k in first.kinds if k.kind == "backlash")
    assert p_values[0] == text.probability(first.corrected(kind))
    assert p_values[2] == text.probability(closure.effects[0].p_value)
    # What was significant beside it in the last round was not looked at, whatever else was found.
    for added, why in ((first.added, "less probable than"), (None, "its evidence is far below")):
        screenings = [*begun_anew[:2], dataclasses.replace(first, added=added)]
        ended = dataclasses.replace(closure, screenings=screenings, rejected=[])
        assert ended.passed_over and all(r.reason.startswith(why) for r in ended.passed_over)


@pytest.mark.campaign
def test_caption_of_the_search_tells_what_was_dropped(closed, monkeypatch):
    closure = closed[2]
    monkeypatch.setattr(plots, "cut", lambda figure: plots.Pieces(b"", (), 0.0, False))

    def caption(**changed):
        shown = pictures(dataclasses.replace(closure, **changed), [])
        (one,) = (picture for picture in shown if picture.name == "search")
        return one.caption

    assert "never added: changing, interaction, kink, local_bump" in caption()
    assert "dropped" not in caption() and "in the place of" not in caption()
    assert caption(effects=[]).endswith(" Added and dropped again: backlash Y.")
    bare = [dataclasses.replace(one, added=None) for one in closure.screenings]
    assert caption(screenings=bare).endswith("in no round of its own: backlash Y.")


def test_page_says_what_an_effect_of_ones_own_is(closed):
    """Whether the study knows it or not, and though it was never added."""
    _, study, closure = closed

    class Dent(LocalBump):
        name, summary = "dent", "a dent in the guideway"

    class Shaking(LocalBump):
        name, summary = "shaking", "the floor shakes"

    dent = Dent(port="tool.Z", unit="um", placement="X")
    first = closure.screenings[0]
    kind = dataclasses.replace(
        first.kinds[0],
        kind="dent",
        peaks=[dataclasses.replace(first.kinds[0].peaks[0], effect=dent)],
    )
    first = dataclasses.replace(first, kinds=[*first.kinds, kind])
    study = dataclasses.replace(study, catalogue={**study.catalogue, "shaking": Shaking})
    missed = Untestable("shaking", "", "no such column", (("shakes", ()),))
    rejected = [*closure.rejected, Rejected("dent", "X", 1e-4, "so")]
    changed = dataclasses.replace(
        closure, screenings=[first, *closure.screenings[1:]], rejected=rejected, untestable=[missed]
    )
    said = page(changed, study, [], [])
    assert said.count("<td>dent</td><td>a dent in the guideway</td>") == 1
    assert "<td>dent X</td><td>a dent in the guideway</td>" in said
    assert "<td>shaking</td><td>the floor shakes</td>" in said
    assert "<td>local_bump</td><td>empirical: local error (for comparison" in said


def test_what_could_not_be_tested_on_the_same_axis_stands_beside_a_name(closed):
    """What needs a column that nobody recorded has to look like something else."""
    _, study, closure = closed
    wanting = [
        Untestable(name, place, "so", ((column, ()),))
        for name, place, column in (
            ("stribeck_friction", "Y", "v_Y"),
            ("coulomb_friction", "Y", "v_Y"),
            ("payload_sag", "Y", "payload_kg"),
            ("payload_sag", "X", "payload_kg"),
            ("probe_lobing", "", "approach_rad"),
        )
    ]
    few = dataclasses.replace(closure, untestable=wanting)
    said = "stribeck_friction Y, coulomb_friction Y (no v_y_m_s); payload_sag Y (no payload_kg)"
    heading = "Not tested on the same axis because columns are missing"
    assert f"<td>{heading}</td><td>{said}. If one" in page(few, study, [], [])
    assert heading not in page(closure, study, [], [])
    (effect,) = record(few, study)["effects"]
    assert effect["untested"] == [
        {"effects": ["stribeck_friction Y", "coulomb_friction Y"], "missing": "v_y_m_s"},
        {"effects": ["payload_sag Y"], "missing": "payload_kg"},
    ]


def test_effects_that_were_searched_for(closed, written):
    """Without artefact nothing looks for its bending: it was asked for, no more."""
    content = strict(written / "report.json")
    assert content["settings"]["effects_asked_for"] == list(SEARCHED)
    searched = content["settings"]["effects"]
    assert set(searched) == {kind.kind for s in closed[2].screenings for kind in s.kinds} & set(
        SEARCHED
    )
    assert "backlash" in searched and "artefact_bending" not in searched
    page = (written / "index.html").read_text(encoding="utf-8")
    assert f"<td>effects searched for</td><td>{', '.join(searched)}</td>" in page


def test_what_is_said_of_the_noise_agrees_with_its_table(closed):
    _, study, closure = closed
    as_declared = dataclasses.replace(
        closure,
        noise_scale=1.0,
        noise_scales={"": 1.0},
        noise_components=(Component("range", 1.05, 0.03), Component("elevation", 1.102, 0.0314)),
    )
    said = page(as_declared, study, [], [])
    assert "All readings taken together, the scatter of the residuals agrees with" in said
    assert "more than three standard uncertainties: elevation 1.10 ± 0.031 (" in said
    quiet = dataclasses.replace(as_declared, noise_components=as_declared.noise_components[:1])
    said = page(quiet, study, [], [])
    assert "<p>The scatter of the residuals agrees with the declared noise" in said
    assert "three standard uncertainties" not in said


def test_compensation_table_is_right(closed, written):
    case, _, closure = closed
    lines = (written / "compensation.csv").read_text(encoding="utf-8").splitlines()
    header = "component,axis,position_mm,value,unit,standard_uncertainty,information_share"
    assert lines[0] == header
    rows = [line.split(",") for line in lines[1:]]
    motions = [row for row in rows if row[2]]
    assert len(motions) == 18 * 41
    assert [row[0] for row in rows if not row[2]] == ["EC0Y", "EB0Z", "EA0Z"]
    assert {row[4] for row in rows if row[0][1] in "XYZ"} == {"um"}
    assert {row[4] for row in rows if row[0][1] in "ABC"} == {"urad"}
    q = np.tile(np.array([float(r[2]) for r in motions if r[0] == "EYY"])[:, None] * 1e-3, 3)
    true = error_motions(case.machine, q)[0][:, 1, 1] * 1e6
    value, u, share = (np.array([float(r[k]) for r in motions if r[0] == "EYY"]) for k in (3, 5, 6))
    assert np.abs(value - true).max() < 4.0 * u.max()
    assert ((0 <= share) & (share <= 1)).all()
    assert share.max() > 0.9


def test_geometry_is_told_as_tests_of_it_would(closed, written):
    """Squareness of the tool point's paths in page and record, more certain than the parameter."""
    tests = geometric_tests(closed[2].after)
    told = strict(written / "report.json")["geometry"]
    assert [(t["name"], t["what"]) for t in told] == [(t.name, t.what) for t in tests]
    assert [t["value"] for t in told] == pytest.approx([t.value for t in tests], rel=1e-6)
    page = (written / "index.html").read_text(encoding="utf-8")
    table = page[page.index("<h3>Geometric deviations (ISO 230-1)") :].partition("</table>")[0]
    for t in tests:
        shown = text.rounded(t.value, t.u)[0] if t.information >= 0.05 else text.DASH
        assert f'<td>{t.name}</td><td>{t.what}</td><td class="n">{shown}</td>' in table
    lines = (written / "compensation.csv").read_text(encoding="utf-8").splitlines()
    (parameter,) = (line.split(",") for line in lines if line.startswith("EC0Y"))
    (square,) = (t for t in told if t["name"] == "EC(0X)Y")
    assert square["standard_uncertainty"] < 0.5 * float(parameter[5])


def test_effects_table_repeats_the_record(written):
    header, row = (written / "effects.csv").read_text(encoding="utf-8").splitlines()
    assert header == (
        "effect,placement,parameter,value,unit,standard_uncertainty,status,fitted_placement"
    )
    (size,) = strict(written / "report.json")["effects"][0]["parameters"]
    assert row.split(",")[:3] == ["backlash", "Y", "size"]
    assert float(row.split(",")[3]) == pytest.approx(size["value"])


def test_values_are_those_of_one_placement_of_several(closed, capsys):
    """At the other one, which the data do not tell from it, they may have the opposite sign."""
    _, study, closure = closed
    values = "Values for backlash Y; for another effect of this class"
    assert values not in page(closure, study, [], [])
    (found,) = closure.effects
    found = dataclasses.replace(found, placement="X|Y", equivalent=["backlash X"])
    either = dataclasses.replace(closure, effects=[found])
    (effect,) = record(either, study)["effects"]
    assert (effect["placement"], effect["fitted_placement"]) == ("X|Y", "Y")
    row = effects_csv(either).splitlines()[1].split(",")
    assert (row[1], row[-1]) == ("X|Y", "Y")
    said = page(either, study, [], [])
    assert values in said and "alike, up to size and sign" in said and "exactly" not in said
    show_closure(either)
    assert "backlash X|Y: if it is backlash Y, size = " in capsys.readouterr().out


@pytest.mark.campaign
def test_declared_effects_are_told_as_they_were_fitted(tmp_path):
    """A play that is declared to a third: without it the machine is another one."""
    play = {"effect": "backlash", "axis": "X", "size_um": 13.0}
    rows = [{"name": "backlash", "placement": "X", "size_um": 10.0, "size_um_sigma": 3.0},
            {"name": "scale_growth", "placement": "Y", "alpha_um_per_m_K": 0.5}]  # fmt: skip
    make_case("laser_tracker", seed=5, effects=[play], declared=rows, folder=tmp_path / "study")
    study = load_study(tmp_path / "study" / "setup.toml")
    closure = close_loop(study.model, study.measurement, check=study.check, effects=[])
    write_report(closure, study, tmp_path / "out")
    (size, alpha) = (
        one["parameters"][0] for one in strict(tmp_path / "out" / "report.json")["declared"]
    )
    assert abs(size["value"] - 13.0) < 4 * size["standard_uncertainty"] < 2.0
    assert (alpha["value"], alpha["standard_uncertainty"]) == (0.5, 0.0)
    lines = (tmp_path / "out" / "effects.csv").read_text(encoding="utf-8").splitlines()[1:]
    table = [line.split(",") for line in lines]
    assert [row[:3] + row[6:] for row in table] == [
        ["backlash", "X", "size", "declared", "X"], ["scale_growth", "Y", "alpha", "declared", "Y"]
    ]  # fmt: skip
    assert float(table[0][3]) == pytest.approx(size["value"])
    assert "Declared effects</h2>" in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")


ALL = "the readings scatter 2.8 times as declared"
X_ALONE = "X scatters 4.1 times as declared"
TWO = "X scatters 4.1 and Z 2 times as declared"
HALL = "hall scatters 1.6 times as declared"


@pytest.mark.parametrize(
    ("scale", "uneven", "factors", "sets", "told"),
    [
        (1.0, False, (1.0, 1.0), {}, ""),
        (1.4, False, (1.4, 1.4), {}, ""),
        (2.76, False, (2.7, 2.8), {}, ALL),
        (2.76, True, (4.14, 0.98), {}, X_ALONE),
        (2.76, True, (4.14, 2.04), {}, TWO),
        (1.2, True, (1.4, 0.9), {}, ""),
        (1.3, False, (), {"hall": 1.6, "yard": 1.1}, HALL),
    ],
)
def test_noise_far_beyond_what_was_declared_is_part_of_the_verdict(
    closed, scale, uneven, factors, sets, told
):
    _, study, closure = closed
    parts = tuple(Component(n, f, 0.2) for n, f in zip("XZ", factors, strict=False))
    found = dataclasses.replace(
        closure, verdict="nothing_missing", effects=[], noise_scale=scale, noise_uneven=uneven,
        noise_components=parts, noise_scales=sets,
    )  # fmt: skip
    unsure = [dataclasses.replace(part, u=1.0 + part.factor) for part in parts]
    assert record(found, study)["verdict"] == "nothing_missing"
    said = page(found, study, [], [])
    if told:
        assert found.sentence.startswith(f"No effect was found, but {told}: the noise is larger")
        assert '<span class="badge caution">Noise larger than declared</span>' in said
        assert dataclasses.replace(found, verdict="named").louder == {}
    else:
        assert found.sentence.endswith("nothing was found that it lacks.")
        assert '<span class="badge good">Nothing was found</span>' in said
    if uneven:
        assert not dataclasses.replace(found, noise_components=tuple(unsure)).louder


@pytest.mark.parametrize(
    ("scale", "uneven", "verdict", "said"),
    [
        (10.0, False, "nothing_missing", "The declared noise is 10 times too small: "),
        (0.1, False, "nothing_missing", "The declared noise is 10 times too large: "),
        (10.0, False, "named", "The declared noise is 10 times too small: "),
        (10.0, True, "nothing_missing", ""),
        (2.5, False, "nothing_missing", ""),
    ],
)
def test_a_noise_declared_wrong_by_one_factor_comes_first(closed, scale, uneven, verdict, said):
    """In the first sentence, with the factor; not where the kinds of reading differ."""
    parts = tuple(Component(name, scale, 0.1) for name in "XZ")
    found = dataclasses.replace(
        closed[2], verdict=verdict, unexplained=None, noise_scale=scale, noise_uneven=uneven,
        noise_components=parts, noise_scales={},
    )  # fmt: skip
    assert found.wrong_noise == (scale if said else None)
    assert found.sentence.startswith(said)
    assert ("The declared noise is" in found.sentence) == bool(said)
    if said and verdict == "named":
        assert "The declared model lacked" in found.sentence


def test_what_is_as_likely_chance_is_a_hint(closed):
    closure = closed[2]
    (own,) = closure.effects
    lucky = dataclasses.replace(own, placement="Z", chance=0.6, hint="why", status="ambiguous")
    assert lucky.perhaps_chance and not own.perhaps_chance
    beside = dataclasses.replace(closure, effects=[own, lucky], unexplained=None)
    assert beside.sentence.startswith(
        "The declared model lacked backlash Y; there is a hint of backlash Z."
    )
    alone = dataclasses.replace(beside, effects=[lucky], verdict="ambiguous")
    assert alone.sentence.startswith(
        "There is a hint of backlash Z, but it is as likely that the declared model lacks nothing."
    )


def test_many_declared_values_are_told_in_short(closed, monkeypatch, capsys):
    """In one line where commands print, and folded on the page."""
    _, study, closure = closed
    array = BallCalibration(balls=(0, 1, 2), sigma=0.5e-6)
    listed = [(p.name, 0.8 * (p.name == "2.X"), "um", 0.1) for p in array.parameters]
    play = closure.effects[0].effect
    told = [(array, listed), (play, [("size", 12.98, "um", 0.21)])]
    for module in ("vcal.cli.show", "vcal.report.loop.findings"):
        monkeypatch.setattr(f"{module}.declared", lambda _: told)
    short = "ball_calibration: 9 declared values; the fit moved 2.X most, by 1.60 of its sigma"
    show_closure(closure)
    shown = capsys.readouterr().out
    assert f"  {short}\n" in shown and "0.X = " not in shown
    assert "backlash Y: size = 12.98 ± 0.42 um (k = 2), declared" in shown
    said = page(closure, study, [], [])
    section = said[said.index("Declared effects</h2>") : said.index("Effects tested</h2>")]
    before, folded = section.split(f"<details><summary>{short}</summary>")
    assert "<td>backlash Y</td>" in before
    assert "ball_calibration" not in before and folded.count("<td>ball_calibration</td>") == 9
    flat = [(p.name, 0.3, p.unit, 0.1) for p in study.model.effects[-1].parameters]
    assert in_short(study.model.effects[-1], flat) == f"{len(flat)} declared values"


@pytest.mark.thorough
def test_report_without_check_points(closed, tmp_path):
    _, study, closure = closed
    errors = {
        name: dataclasses.replace(value, check=None, check_raw=None)
        for name, value in closure.errors.items()
    }
    bare = dataclasses.replace(closure, check=None, errors=errors, screenings=[], interrupted=True)
    page = write_report(bare, study, tmp_path / "report").read_text(encoding="utf-8")
    content = strict(tmp_path / "report" / "report.json")
    assert content["interrupted"] and "Interrupted" in page
    for values in content["errors"].values():
        assert values["check_rms_um"] is values["u_check_rms_um"] is None
    assert "check_points.png" not in content["files"]
    assert "error_field.png" in content["files"]


@pytest.mark.thorough
def test_report_of_circles_that_have_no_error_motions(tmp_path):
    """An R-test declares none: there is nothing to tabulate, and the rest is told."""
    spike = {"effect": "reversal_spike", "size_um": 4.0, "decay_mm": 0.06}
    make_case("r_test", seed=3, effects=[spike], folder=tmp_path / "study")
    study = load_study(tmp_path / "study")
    assert study.measurement is not None
    tried = [CATALOGUE["reversal_spike"], CATALOGUE["servo_lag"]]
    closure = close_loop(study.model, study.measurement, effects=tried, draws=50)
    write_report(closure, study, tmp_path / "report")
    content = strict(tmp_path / "report" / "report.json")
    assert [e["effect"] for e in content["effects"]] == ["reversal_spike"]
    assert len((tmp_path / "report" / "compensation.csv").read_text().splitlines()) == 1
    assert "error_motions.png" not in content["files"]


@pytest.mark.thorough
def test_report_of_an_arm(small_arm_study, tmp_path):
    study = load_study(small_arm_study)
    assert study.measurement is not None
    effects = [CATALOGUE["drift"], CATALOGUE["backlash"], CATALOGUE["thermal_offset"]]
    closure = close_loop(study.model, study.measurement, effects=effects, draws=50)
    # Nothing on the check points is gained, so the tables are withheld unless asked for.
    assert closure.no_gain
    write_report(closure, study, tmp_path / "withheld")
    assert not (tmp_path / "withheld" / "compensation.csv").exists()
    write_report(closure, study, tmp_path / "report", compensate_anyway=True)
    content = strict(tmp_path / "report" / "report.json")
    assert {"error_motions.png", "held_out.png"} <= set(content["files"])
    # Time is that of the numbers of the poses; temperatures are not.
    assert {u["effect"] for u in content["untestable"]} == {"thermal_offset"}
    assert {u["reason"] for u in content["untestable"]} == {
        f"the data have no T_j{i}_degC" for i in range(1, 4)
    }
    lines = (tmp_path / "report" / "compensation.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].split(",")[2] == "position_deg"
    assert len(lines) == 1 + 18 * 41


@pytest.mark.parametrize("rounds", [1, 2, 3, 4])
@pytest.mark.parametrize(
    "name",
    [
        "acceleration_crosstalk",
        "effect_of_ones_own_with_a_long_name",
        "guideway_dent_from_the_crash_of_2019_on_the_second_pallet",
    ],
)
def test_headings_of_the_search_have_room(rounds, name):
    kinds = [KindResult("kink", [], 3, 9.0, 3.0, 1e-3), KindResult(name, [], 3, 50.0, 3.0, 1e-20)]
    added = SimpleNamespace(name=name)
    screening = Screening(kinds, 1e-20, 3.0, 1.0, [], added)  # type: ignore[arg-type]
    drawn = search([screening] * rounds, 1e-3)
    headings = [
        title
        for ax in drawn.axes
        for title in ax.get_children()
        if isinstance(title, Text) and title.get_text().startswith("round")
    ]
    ends = [title.get_window_extent() for title in headings]
    assert len(ends) == rounds
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(ends))
    assert min(label.get_window_extent().x0 for label in drawn.axes[0].get_yticklabels()) > 0.0
    assert max(end.x1 for end in ends) < drawn.bbox.x1
    assert max(end.y1 for end in ends) < drawn.bbox.y1
    assert (name in headings[0].get_text()) == (rounds * len(name) <= 72)


@pytest.mark.parametrize(
    ("column", "label"),
    [
        ("a_set_m_s2", "a_set, m/s²"),
        ("a_x_m_s2", "acceleration of X, m/s²"),
        ("v_c_rad_s", "angular velocity of C, rad/s"),
        ("since_b_deg", "turn of B since its reversal, °"),
        ("a_deg", "a, °"),
        ("coolant_l_min", "coolant, l/min"),
        ("oil_pressure_bar", "oil_pressure, bar"),
        ("payload_kg", "payload, kg"),
        ("humidity_pct", "humidity, %"),
        ("speed_rpm", "speed, 1/min"),
        ("T_gradient_z_K_per_m", "T_gradient_z, K/m"),
        ("hall: flow_l_min", "hall: flow, l/min"),
        ("t_s", "time, s"),
        ("x_mm", "x, mm"),
        ("circle_angle_deg", "circle_angle, °"),
        ("T_air_degC", "temperature of air, °C"),
        ("probe_A", "probe_A"),
        ("kg", "kg"),
        ("m_s", "m, s"),
        ("level", "level"),
    ],
)
def test_columns_as_labels_have_their_unit(column, label):
    assert column_label(column) == label


@pytest.mark.parametrize(
    ("unit", "printed"),
    [
        ("um/(m K)", "µm/(m K)"),
        ("um s2/m", "µm s²/m"),
        ("um s4/m", "µm s⁴/m"),
        ("um/mm10", "µm/mm¹⁰"),
        ("m s-1", "m s⁻¹"),
        ("1/min", "1/min"),
        ("1", ""),
    ],
)
def test_units_as_they_are_printed(unit, printed):
    assert plots.pretty_unit(unit) == printed


def test_location_errors_alone_are_drawn():
    """Of a machine whose error motions are all declared to be zero."""
    one = np.ones(1)
    values = (np.zeros(0), "mm", 4.0 * one, one, 40.0 * one, 0.9 * one)
    names = ("EC0Y", "EB0Z")
    tables = [ErrorMotionTable(name, name[-1], "urad", *values) for name in names]
    (ax,) = plots.error_motions(tables).axes
    assert [label.get_text() for label in ax.get_yticklabels()] == ["EC0Y", "EB0Z"]


def test_files_of_pictures_have_names_that_can_be_files():
    """Whatever place a user gave an effect."""
    assert Picture("effect_1_sag X/Y column", "", "", b"").file == "effect_1_sag_X_Y_column.png"
    assert Picture("../<b>\n", "", "", b"").file == ".._b_.png"


@pytest.mark.parametrize("bounds", [(-500, 500), (-90, 90), (0, 360), (0, 12000), (-0.5, 0.5)])
@pytest.mark.thorough
def test_labels_of_ticks_do_not_touch(bounds):
    """On small multiples as narrow as those of five axes or of a robot."""
    for columns in (3, 5, 6):
        drawn = figure(9.6, 2.0)
        margins = {"left": 0.8, "right": 0.2, "top": 0.3, "bottom": 0.5, "wspace": 0.7}
        ax = grid(drawn, 1, columns, margins)[0, 0]
        ax.set_xlim(*bounds)
        ticks_apart(ax, 5)
        drawn.canvas.draw()
        labels = [t for t in ax.get_xticklabels() if bounds[0] <= t.get_position()[0] <= bounds[1]]
        inside = [label.get_window_extent() for label in labels]
        assert len(inside) >= 2
        assert all(a.x1 + 2.0 < b.x0 for a, b in itertools.pairwise(inside))


@pytest.mark.parametrize("half", [0.025, 0.5, 10.0])
@pytest.mark.parametrize("picture", ["field", "check_points"])
@pytest.mark.thorough
def test_labels_have_room_on_machines_of_any_size(half, picture):
    """From 50 mm to 20 m: within the picture, and none over another or over a panel."""
    rng = np.random.default_rng(0)
    if picture == "field":
        nodes = dict.fromkeys("XYZ", np.linspace(-half, half, 8))
        errors = rng.normal(size=(8, 8, 8, 3))
        drawn = plots.field(ErrorField(nodes, errors, errors, errors[..., 0] ** 2))
    else:
        points = SimpleNamespace(tool_point=rng.uniform(-half, half, (50, 3)))
        names = ("uncompensated", "before", "after")
        errors = {name: rng.normal(size=(50, 3)) for name in names}
        drawn = plots.check_points(errors, points)  # type: ignore[arg-type]
    drawn.canvas.draw()
    panels = [ax.get_window_extent() for ax in drawn.axes]
    boxes = []
    for ax in drawn.axes:
        for axis in (ax.xaxis, ax.yaxis):
            shown = [axis.label, *(tick.label1 for tick in axis.get_major_ticks())]
            low, high = sorted(axis.get_view_interval())
            at = [low, *axis.get_majorticklocs()]
            boxes += [
                label.get_window_extent()
                for place, label in zip(at, shown, strict=True)
                if label.get_text() and label.get_visible() and low <= place <= high
            ]
    assert len(boxes) > 30
    for box in boxes:
        assert box.x0 >= 0.0 and box.x1 <= drawn.bbox.x1
        assert not any(box.overlaps(panel) for panel in panels)
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))


@pytest.mark.parametrize("kind", ["scatter", "visible", "sides"])
def test_no_dot_is_behind_the_legend(kind):
    """Whatever corner the readings fill; and it overlaps nothing else."""
    rng = np.random.default_rng(0)
    x = rng.choice([-1.0, 1.0], 400) if kind == "sides" else rng.uniform(-1.0, 1.0, 400)
    y, part = rng.uniform(-9.0, 9.0, 400), 0.5 * x
    tone, label = (np.abs(x), "dots: temperature of column_front_of_the_second_machine, °C, 20.08 "
                   "(dark) to 24.31 (bright)") if kind == "visible" else (None, "")  # fmt: skip
    view = View(x, "x, mm", kind, "along Y", y, y - part, tone=tone, tone_label=label)
    drawn = before_after(view, "jump")
    drawn.draw_without_rendering()
    (legend,) = (one.get_window_extent() for one in drawn.legends)
    assert not any(ax.get_legend() for ax in drawn.axes)
    assert not any(legend.overlaps(ax.get_tightbbox()) for ax in drawn.axes)
    assert legend.x0 > 0.0 < legend.y0 and legend.x1 < drawn.bbox.x1


@pytest.mark.parametrize("rounds", [7, 8, 11, 17, 20])
@pytest.mark.parametrize("minus_log_p", [50.0, 700.0, 6000.0])
def test_texts_of_many_rounds_are_apart(rounds, minus_log_p):
    kinds = [KindResult("joint_compliance", [], 3, minus_log_p, 3.0, 0.0)]
    added = SimpleNamespace(name="joint_compliance")
    screening = Screening(kinds, 1e-20, 3.0, 1.0, [], added)  # type: ignore[arg-type]
    drawn = search([screening] * rounds, 1e-3)
    drawn.draw_without_rendering()
    texts = [t for ax in drawn.axes for t in ax.findobj(Text) if t.get_visible() and t.get_text()]
    numbers = [text.get_text() for text in texts]
    assert all(any(str(i + 1) in one.split() for one in numbers) for i in range(rounds))
    boxes = [text.get_window_extent() for text in texts]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    assert max(box.x1 for box in boxes) < drawn.bbox.x1


@pytest.mark.parametrize("name", ["jump", "encoder_eccentricity warm azimuth of a second tracker"])
def test_titles_of_before_and_after_are_apart(name):
    x = np.linspace(0.0, 1.0, 50)
    view = View(x, "x, mm", "scatter", "along Y", 1234.0 * np.sin(9.0 * x), 0.1 * np.cos(9.0 * x))
    drawn = before_after(view, name)
    drawn.draw_without_rendering()
    above = [t for ax in drawn.axes for t in ax.get_children() if isinstance(t, Text)]
    shown = [t for t in (*above, *drawn.texts) if t.get_text()]
    told = sorted(t.get_text().partition(" (rms")[0] for t in shown)
    assert told == sorted(["before", "after", name])
    boxes = [t.get_window_extent() for t in shown]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    assert max(box.x1 for box in boxes) < drawn.bbox.x1


@pytest.mark.parametrize("jitter", [0.0, 0.01])
def test_readings_of_one_temperature_have_one_mean(jitter):
    """A long plateau is one point of the line, not a stroke along the ordinate."""
    x = np.concatenate([np.linspace(0.0, 1.0, 100), 2.0 + jitter * np.linspace(-1.0, 1.0, 200)])
    y = np.concatenate([x[:100], np.linspace(-9.0, 11.0, 200)])
    centres, values = means(x, y, 30)
    assert (np.diff(centres) > 0.0).all()
    assert (centres[-1], values[-1]) == (pytest.approx(2.0), pytest.approx(1.0))
    assert len(centres) > 8
    np.testing.assert_allclose(centres[:-1], values[:-1])


def test_residual_without_the_effect_is_that_of_the_declared_model(closed):
    _, _, closure = closed
    place = plots.place_of(closure.after, closure.effects[0].effect)
    without = residual_without(closure.after, place)
    size = np.abs(closure.before.residual).max(0)
    assert (np.abs(without - closure.before.residual).max(0) < 1e-3 * size).all()


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("encoder_eccentricity:azimuth:sine_urad=20", "the effect seems to move it"),
        ("angular_reversal:X:size_ECX_urad=20", "the effect moves it"),
    ],
)
def test_direction_of_a_picture_is_in_the_words_of_a_reader(closed, spec, words):
    """No names of the ports inside."""
    _, study, _ = closed
    effect = parse_with(spec, CATALOGUE, study.model.setup(study.plan))
    free = dataclasses.replace(effect, given=())
    fit = identify(study.model.with_effects(free), study.measurement)
    assert effect_view(fit, fit.model.effects[-1]).along == f"in the direction in which {words}"


def test_places_of_parameters_beside_a_pitch_that_is_known(closed):
    """A shape that is declared has no place among what is fitted."""
    _, study, _ = closed
    setup = study.model.setup(study.plan)
    screw = parse_with("screw_cyclic:X:sine_um=3,pitch_mm=20", CATALOGUE, setup)
    free = next(iter(CATALOGUE["screw_cyclic"].candidates(setup)))
    free = dataclasses.replace(free, placement="Y")
    first = len(study.model.effects)
    shapes = {first: {"pitch": 0.02}, first + 1: {"pitch": 0.013}}
    fit = identify(study.model.with_effects(screw, free), study.measurement, shapes=shapes)
    assert len(fit.places_of(first)[1]) == 0
    amplitudes, (pitch,) = fit.places_of(first + 1)
    assert [fit.entries[i][1].name for i in amplitudes] == [p.name for p in free.amplitudes]
    assert fit.entries[pitch][1].name == "pitch" and pitch == len(fit.theta) - 1
    assert np.isfinite(residual_without(fit, first + 1)).all()


# --- whole or not at all -------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_failure_leaves_nothing_behind(closed, tmp_path, monkeypatch, error):
    _, study, closure = closed

    def fail(*_):
        raise error("no picture")

    monkeypatch.setattr(plots, "normal_plot", fail)
    with pytest.raises(error, match="no picture"):
        write_report(closure, study, tmp_path / "new" / "report")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def quick(monkeypatch):
    """Reports without pictures and smallest sizes, where only their files matter."""
    picture = Picture("one", "noise", "a picture", b"\x89PNG")
    monkeypatch.setattr(write, "pictures", lambda *_: [picture])
    monkeypatch.setattr(write, "machine_pictures", lambda *_: [])
    monkeypatch.setattr(write, "could_be_seen", lambda *_: None)


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def test_earlier_report_is_replaced_and_other_files_are_not(closed, quick, tmp_path, monkeypatch):
    _, study, closure = closed
    out = tmp_path / "report"
    with monkeypatch.context() as earlier:
        pictures = [Picture(name, "noise", "a picture", b"\x89PNG") for name in ("one", "stale")]
        earlier.setattr(write, "pictures", lambda *_: pictures)
        write_report(closure, study, out)
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    old = strict(out / "report.json")
    assert set(old["sha256"]) == set(old["files"])
    write_report(closure, study, out, command="again")
    assert set(contents(out)) == {*old["files"], "notes.txt"} - {"stale.png"}
    assert strict(out / "report.json")["command"] == "again"
    assert (out / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["report"]


@pytest.mark.parametrize("name", ["compensation.csv", "index.html", "report.json", "own_effect.py"])
def test_what_was_changed_since_is_not_replaced(closed, quick, tmp_path, name):
    _, study, closure = closed
    out = tmp_path / "report"
    write_report(closure, study, out)
    record = (out / "report.json").read_bytes()
    if name == "report.json":
        text = json.dumps(strict(out / name) | {"notes": ["mine"]})
    else:  # the report has no own_effect.py of its own here: that of a user is as dear
        text = "mine"
    (out / name).write_text(text, encoding="utf-8")
    before = contents(out)
    for refused in (lambda: check_folder(out), lambda: write_report(closure, study, out)):
        with pytest.raises(StudyError) as caught:
            refused()
        expected = f"found {name}, not as the earlier report left it, expected only files that"
        assert expected in str(caught.value) and str(caught.value).startswith(f"{out}, ")
    assert contents(out) == before
    (out / name).rename(out / "mine")
    if name == "report.json":  # without it, the folder holds no report
        (out / name).write_bytes(record)
    write_report(closure, study, out)
    assert (out / "mine").read_text(encoding="utf-8") == text


def test_what_is_changed_while_the_report_is_made(closed, quick, tmp_path, monkeypatch):
    _, study, closure = closed
    out = tmp_path / "report"
    write_report(closure, study, out)

    def meanwhile(*_):
        (out / "effects.csv").write_text("mine", encoding="utf-8")
        return []

    monkeypatch.setattr(write, "pictures", meanwhile)
    with pytest.raises(StudyError, match=r"found effects.csv, not as the earlier report left it"):
        write_report(closure, study, out)
    assert (out / "effects.csv").read_text(encoding="utf-8") == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["report"]


def test_a_record_without_sums(closed, quick, tmp_path):
    """Of an older vcal: only what nobody edits is known to be as it was left."""
    _, study, closure = closed
    out = tmp_path / "report"
    write_report(closure, study, out)
    record = strict(out / "report.json")
    del record["sha256"]
    (out / "report.json").write_text(json.dumps(record), encoding="utf-8")
    with pytest.raises(StudyError) as caught:
        write_report(closure, study, out)
    expected = "found compensation.csv, effects.csv, machine.json, which may have been changed "
    assert expected + "since the earlier report left them" in str(caught.value)
    for name in ("compensation.csv", "effects.csv", "machine.json"):
        (out / name).unlink()
    write_report(closure, study, out)
    assert set(strict(out / "report.json")["sha256"]) == set(record["files"])


@pytest.mark.parametrize("moves", [1, 2, 4])
def test_interrupted_move_restores_the_earlier_report(closed, quick, tmp_path, monkeypatch, moves):
    _, study, closure = closed
    out = tmp_path / "report"
    write_report(closure, study, out, command="first")
    before, left, replace = contents(out), moves, os.replace

    def interrupted(source, target):
        nonlocal left
        left -= 1
        if left == 0:
            raise KeyboardInterrupt
        replace(source, target)

    # Where folders cannot change places in one step, files are replaced one by one.
    monkeypatch.setattr("vcal.report.html.folder.exchange", lambda *folders: False)
    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_report(closure, study, out, command="second")
    monkeypatch.undo()
    assert contents(out) == before
    assert [p.name for p in tmp_path.iterdir()] == ["report"]


def test_foreign_places_are_refused(closed, tmp_path):
    _, study, closure = closed
    file = tmp_path / "file"
    file.write_text("mine", encoding="utf-8")
    with pytest.raises(StudyError, match="found a file, expected a folder"):
        write_report(closure, study, file)
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "report.json").write_text('{"schema": "other/1"}', encoding="utf-8")
    with pytest.raises(StudyError, match=r"other files \(report.json"):
        write_report(closure, study, folder)
    assert contents(folder) == {"report.json": b'{"schema": "other/1"}'}
    empty = tmp_path / "empty"
    empty.mkdir()
    check_folder(empty)
    check_folder(tmp_path / "none")


def test_earlier_record_reaches_no_file_outside_its_folder(closed, quick, tmp_path):
    _, study, closure = closed
    out = tmp_path / "report"
    out.mkdir()
    (tmp_path / "precious").write_text("mine", encoding="utf-8")
    tampered = {"schema": "vcal-report/1", "files": ["../precious"]}
    (out / "report.json").write_text(json.dumps(tampered), encoding="utf-8")
    write_report(closure, study, out)
    assert (tmp_path / "precious").read_text(encoding="utf-8") == "mine"


# --- output formats ------------------------------------------------------------------------------

LEAF = '''"""backlash.txt: sizes of reversal errors.

Source: the final fit. Sign: positive is a lead. Units: um.
"""

from vcal.report.formats.base import FORMATS, Format


@FORMATS.register
class BacklashTxt(Format):
    """Sizes of backlash."""

    file = "backlash.txt"
    summary = "sizes of reversal errors <um>"

    def text(self, results):
        sizes = [e.parameters[0][1] for e in results.closure.effects if e.effect.name == "backlash"]
        return "".join(f"{size:.3f}\\n" for size in sizes) or None
'''


def test_a_new_output_format_is_one_file(closed, quick, tmp_path, monkeypatch):
    """It is found, written into the report, and listed on the page and in the record."""
    _, study, closure = closed
    (tmp_path / "leaves").mkdir()
    (tmp_path / "leaves" / "backlash_txt.py").write_text(LEAF, encoding="utf-8")
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(tmp_path / "leaves")])
    name = f"{formats.__name__}.backlash_txt"
    with unchanged():
        try:
            formats.discover()
            page = write_report(closure, study, tmp_path / "report")
            without = write_report(dataclasses.replace(closure, effects=[]), study, tmp_path / "no")
        finally:
            sys.modules.pop(name, None)
    ((_, size, *_),) = closure.effects[0].parameters
    assert (tmp_path / "report" / "backlash.txt").read_text() == f"{size:.3f}\n"
    assert "backlash.txt" in strict(tmp_path / "report" / "report.json")["files"]
    link = (
        '<a href="backlash.txt">backlash.txt</a></td><td>sizes of reversal errors &lt;um&gt;</td>'
    )
    assert link in page.read_text(encoding="utf-8")
    # These results have no content for it.
    assert not (tmp_path / "no" / "backlash.txt").exists()
    assert "backlash.txt" not in without.read_text(encoding="utf-8")


def test_every_format_states_source_sign_and_units():
    assert {"compensation.csv", "effects.csv"} <= {*formats.FORMATS}
    for kind in formats.FORMATS.values():
        about = sys.modules[kind.__module__].__doc__ or ""
        assert about.startswith(f"{kind.file}: ")
        assert all(f"\n{word}: " in about for word in ("Source", "Sign", "Units")), kind.file


# --- numbers as text -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "u", "shown"),
    [
        (11.4496, 0.3451, ("11.45", "0.35")),
        (-0.00123456, 0.0000996, ("−0.00123", "0.00010")),
        (1234.5, 62.0, ("1234", "62")),
        (123456.0, 4321.0, ("123500", "4300")),
        (3.14159, math.nan, ("3.1416", "–")),
        (-0.0004, 0.021, ("0.000", "0.021")),
        (-0.4, 120.0, ("0", "120")),
        (-0.006, 0.021, ("−0.006", "0.021")),
    ],
)
def test_values_are_rounded_to_their_uncertainty(value, u, shown):
    assert text.rounded(value, u) == shown


def test_a_zero_has_no_sign():
    assert (text.percent(-0.0002), text.percent(-0.002)) == ("0.0 %", "−0.2 %")
    assert text.percent(-0.5) == "−50 %" and text.number(-0.05, 1) == "−0.05"


@pytest.mark.parametrize(("p", "said"), [(0.0, "p < 10⁻³⁰⁰, "), (1e-5, "p = 1.0 × 10⁻⁵, ")])
def test_a_probability_that_underflows_is_not_zero(closed, capsys, p, said):
    found = dataclasses.replace(closed[2].effects[0], p_value=p)
    show_closure(dataclasses.replace(closed[2], effects=[found]))
    assert said in capsys.readouterr().out


def test_small_probabilities_are_powers_of_ten():
    assert text.probability(1.07e-191) == "1.1 × 10⁻¹⁹¹"
    assert text.probability(0.0) == "< 10⁻³⁰⁰"
    assert text.probability(0.04321) == "0.043"
