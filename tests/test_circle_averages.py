"""Long recordings of R-tests, averaged by the angle of the circle."""

import numpy as np
import pytest

from test_cli import refused, run
from test_r_test import E, circles, fitted, write
from vcal import close_loop, load_study
from vcal.errors import StudyError
from vcal.identification.identify import identify
from vcal.instruments.base import averaged_of
from vcal.instruments.circle_averages import automatic
from vcal.instruments.several import DataSet, several
from vcal.loop.empirical.covariates import distinct_covariates

FEW = {"planes": ("XY", "YZ"), "levels": (1.0, 3.0)}
"""Eight runs."""
AVERAGED = "averages_per_turn = 36\n"


def recording(tmp_path, more=AVERAGED, **given):
    """A study of eight runs of ten turns of 72 samples each."""
    table = circles(**(FEW | {"samples": 720, "turns": 10.0} | given))
    return load_study(write(tmp_path / "study", table, more)), table


def test_means_of_repeated_turns(tmp_path):
    study, table = recording(tmp_path, noise=0.0)
    plan, readings = study.plan, study.measurement.readings
    assert plan.rows == 8 * 36 and set(plan.covariates["samples"]) == {20.0}
    # An oracle without a fit: without noise, the angle of a sample is that of its position.
    apart = np.column_stack([table[f"{c}_ext_mm"] - table[f"{c}_int_mm"] for c in "xyz"]) * 1e-3
    run_of, plane = table["run"], table["plane"]
    angle = np.zeros(len(run_of))
    for name in FEW["planes"]:
        first, second = (f"{c.lower()}_int_mm" for c in name)
        mine = plane == name
        angle[mine] = np.arctan2(table[second][mine], table[first][mine])
    part = np.floor(np.mod(angle, 2 * np.pi) / (2 * np.pi) * 36).astype(int)
    at = np.floor(np.asarray(plan.covariates["circle_angle"]) / (2 * np.pi) * 36).astype(int)
    nominal = np.asarray(plan.position)
    for row in range(0, plan.rows, 7):
        mine = (run_of == plan.groups["run"][row]) & (part == at[row])
        assert mine.sum() == 20
        expected = apart[mine].mean(0) + nominal[row]
        np.testing.assert_allclose(readings[row], expected, atol=2e-12)
        assert plan.numbers[row] == np.flatnonzero(mine)[0] + 1


def test_the_noise_of_a_mean_and_what_is_identified(tmp_path):
    study, _ = recording(tmp_path, seed=3)
    whole, _ = recording(tmp_path / "whole", "averages_per_turn = 0\n", seed=3)
    assert whole.plan.rows == 8 * 720 and not whole.instrument.averaged
    catalogue = study.catalogue
    found = []
    for one in (study, whole):
        (effect,) = catalogue["acceleration_crosstalk"].candidates(one.model.setup(one.plan))
        fit = fitted(one, effect)
        found.append((fit.theta[-9:], np.sqrt(np.diag(fit.covariance))[-9:]))
        assert 0.8 < fit.chi2 / fit.dof < 1.2
    (theta, u), (theta_whole, u_whole) = found
    # Every mean is one of two angles that are 5 deg apart.
    arc = np.cos(np.radians(2.5))
    np.testing.assert_allclose(theta, arc * theta_whole, rtol=0, atol=0.1 * u_whole.min())
    np.testing.assert_allclose(u, u_whole, rtol=0.02)


def test_what_is_averaged_is_told(tmp_path):
    study, _ = recording(tmp_path)
    told = run("check", tmp_path / "study").stdout
    words = " ".join(told.split())
    assert "5760 samples are averaged to 288 rows: 36 angles of the circle" in words
    assert "what repeats within 349 um of the path" in words
    assert study.instrument.averaged in words
    assert "samples" not in distinct_covariates(study.plan)


def test_only_long_recordings_are_averaged_without_being_asked():
    assert automatic(50_000, 30) == 0
    assert automatic(1_000_000, 30) == 664
    assert automatic(1_000_000, 1_000) == 60


def test_a_long_table_is_averaged_and_its_mistakes_have_their_rows(tmp_path):
    table = circles(**FEW, samples=6_300, turns=10.0)
    folder = write(tmp_path / "study", table)
    study = load_study(folder)
    assert study.plan.rows == 8 * 624 or study.plan.rows < 20_000
    assert "averaged" in study.instrument.averaged
    table["sense"][40_000:] = 0
    write(folder, table)
    with pytest.raises(StudyError, match=r"data.csv, row 40001 .line 40002., run 6, column sense"):
        load_study(folder)


def test_means_that_were_made_elsewhere(tmp_path):
    study, _ = recording(tmp_path)
    run("simulate", tmp_path / "study", "--out", tmp_path / "made", "--seed", 4)
    made = load_study(tmp_path / "made")
    assert set(made.plan.covariates["samples"]) == {20.0} and made.plan.rows == study.plan.rows
    fit = identify(made.model, made.measurement)
    assert 0.8 < fit.chi2 / fit.dof < 1.2
    text = (tmp_path / "made" / "data.csv").read_text().splitlines()
    column = text[0].split(",").index("samples")
    cells = text[5].split(",")
    text[5] = ",".join([*cells[:column], "0.5", *cells[column + 1 :]])
    (tmp_path / "made" / "data.csv").write_text("\n".join(text) + "\n")
    told = refused("check", tmp_path / "made")
    assert "row 5 (line 6), column samples: found 0.5, expected the number of samples" in told


def test_a_recording_beside_another_data_set(tmp_path):
    one, _ = recording(tmp_path)
    sets = {name: DataSet(one.instrument, one.plan, (0.0, 0.0, 0.0)) for name in ("a", "b")}
    joint, plan = several(sets)
    assert plan.rows == 2 * one.plan.rows
    assert [*averaged_of(joint)] == [f"{name}: {one.instrument.averaged}" for name in "ab"]


@pytest.mark.slow
def test_the_verdict_of_a_thinned_copy(tmp_path):
    given = {**FEW, "planes": ("XY", "YZ", "ZX"), "matrix": 0 * E, "seed": 6}
    given["others"] = [{"effect": "servo_lag", "axis": "X", "T_ms": 0.03}]
    table = circles(**given, samples=2_160, turns=6.0)
    thinned = {name: values[::30] for name, values in table.items()}
    found = []
    for name, rows, more in (("long", table, "averages_per_turn = 60\n"), ("thin", thinned, "")):
        study = load_study(write(tmp_path / name, rows, more))
        closure = close_loop(study.model, study.measurement, seed=1)
        assert [e.effect.key for e in closure.effects] == ["servo_lag X"]
        found.append((closure.verdict, closure.effects[0].status))
        (value,) = (v for v in closure.after.values_of(len(closure.after.model.effects) - 1))
        assert abs(value[2] - 0.03) < 3 * value[3]
    assert found[0] == found[1]
