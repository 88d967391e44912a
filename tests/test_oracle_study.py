"""Whole cases and their files, and the oracle's conventions against the practice data."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from oracle import (
    Tracker,
    as_study,
    lmmse,
    make_case,
    read_study,
    tool_point,
    tracker_points,
    with_errors,
)

UM = 1e-6
PRACTICE = Path(__file__).parents[2] / "shared" / "data" / "practice"
EFFECTS = [
    {"effect": "backlash", "axis": "X", "size_um": 9},
    {"effect": "thermal_tilt", "axis": "Y", "component": "A", "urad_per_K": 40},
    {"effect": "dent", "axis": "X", "component": "Z", "depth_um": 18, "at_mm": 900, "sigma_mm": 60},
]


def needs_practice(test):
    """Skip a test where the practice data do not lie beside the checkout."""
    lacking = pytest.mark.skipif(not PRACTICE.is_dir(), reason="no practice data beside it")
    return pytest.mark.practice(lacking(test))


# --- plans and files -----------------------------------------------------------------------------


def test_cases_are_quick_and_reproducible():
    for kind in ("laser_tracker", "ball_array"):
        make_case(kind)
        start = time.perf_counter()
        one = make_case(kind, seed=9, effects=EFFECTS)
        assert time.perf_counter() - start < 1.0
        two = make_case(kind, seed=9, effects=EFFECTS)
        for name, values in one.data.items():
            np.testing.assert_array_equal(values, two.data[name])


@pytest.mark.parametrize("kind", ["laser_tracker", "ball_array"])
def test_study_round_trip(kind, tmp_path):
    declared = [{"name": "backlash", "axis": "Z", "size_sigma_um": 5.0}]
    case = make_case(kind, seed=7, effects=EFFECTS, declared=declared, folder=tmp_path)
    study = read_study(tmp_path)
    assert study.setup["model"]["effect"] == declared
    assert study.nominal.chain == case.machine.chain
    assert study.nominal.table == case.machine.table
    np.testing.assert_allclose(study.nominal.travel, case.machine.travel, atol=1e-12)
    np.testing.assert_allclose(study.run.q, case.run.q, atol=1e-9)
    np.testing.assert_allclose(study.check_tcp, case.check_tcp, atol=1e-9)
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["undeclared"] == EFFECTS
    coefficients = {k: np.array(v) for k, v in truth["error_motions"].items()}
    scale = np.array([1e-6, 1e-6, 1, 1e-6, 1e-6, 1, 1e-6, 1e-6])
    again = with_errors(study.nominal, {k: v * scale for k, v in coefficients.items()})
    p = tool_point(again, study.check_run, truth["undeclared"])
    np.testing.assert_allclose(p, study.check_tcp, atol=2e-9)


def header(path: Path) -> str:
    with path.open(encoding="utf-8") as f:
        return f.readline().strip()


@needs_practice
@pytest.mark.parametrize(
    ("kind", "case"),
    [
        ("laser_tracker", PRACTICE / "01_tracker_clean"),
        ("ball_array", PRACTICE / "05_balls_clean"),
        ("reflectors", PRACTICE.parent / "real" / "irb120"),
    ],
)
def test_files_look_like_the_practice_cases(kind, case, tmp_path):
    make_case(kind, folder=tmp_path)
    names = {p.name for p in case.iterdir()} | {"truth.json"}
    assert {p.name for p in tmp_path.iterdir()} == names
    for path in case.glob("*.csv"):
        assert header(path) == header(tmp_path / path.name), path.name

    def keys(folder: Path) -> set[str]:
        lines = (folder / "setup.toml").read_text(encoding="utf-8").splitlines()
        return {x.split("=")[0].strip() for x in lines if x and not x.startswith("#")}

    assert keys(tmp_path) == keys(case)


# --- the conventions against data that something else made ----------------------------------------


@needs_practice
@pytest.mark.parametrize("name", ["01_tracker_clean", "03_tracker_screw", "05_balls_clean"])
def test_nominal_machine_against_practice(name):
    study = read_study(PRACTICE / name)
    off = tool_point(study.nominal, study.check_run) - study.check_tcp
    assert np.abs(off).max() < 200 * UM
    told = study.setup["instrument"]
    if told["kind"] == "laser_tracker":
        tracker = Tracker(1e-3 * np.array(told["station_mm"]), np.deg2rad(told["euler_xyz_deg"]))
        d = study.data
        y = np.stack([1e-3 * d["range_mm"], d["azimuth_rad"], d["elevation_rad"]], axis=1)
        p = tool_point(study.nominal, study.run)
        assert np.abs(tracker_points(tracker, y) - p).max() < 1e-3


GROWTH = {"effect": "scale_growth", "axis": "X"}
SCREW = {"effect": "screw_cyclic", "axis": "X", "pitch": 0.02}
TILT = {"effect": "thermal_tilt", "axis": "Y", "component": "A"}
DENT = {"effect": "dent", "axis": "X", "component": "Z", "at": 1.234, "sigma": 0.06}


@needs_practice
@pytest.mark.parametrize(
    ("name", "unknown", "true_um", "before_um", "after_um"),
    [
        ("01_tracker_clean", [], [], 19.6, 0.71),
        (
            "02_tracker_backlash",
            [({"effect": "backlash", "axis": "Y"}, "size", 2e-5)],
            [12],
            30.6,
            0.94,
        ),
        (
            "03_tracker_screw",
            [(SCREW, "amplitude", 1e-5), (SCREW | {"phase": np.pi / 2}, "amplitude", 1e-5)],
            None,
            31.8,
            1.18,
        ),
        ("04_balls_scale_growth", [(GROWTH, "coefficient", 2e-5)], [11], 22.3, 3.63),
        ("05_balls_clean", [], [], 17.9, 4.20),
        ("06_tracker_dent", [(DENT, "depth", 3e-5)], [18], 41.6, None),
        ("06_tracker_dent", [], [], 41.6, 5.2),
        (
            "07_balls_two_effects",
            [({"effect": "backlash", "axis": "X"}, "size", 2e-5), (TILT, "coefficient", 4e-5)],
            [9, 40],
            19.4,
            4.33,
        ),
    ],
)
@pytest.mark.slow
def test_published_bounds_are_reproduced(name, unknown, true_um, before_um, after_um):
    """The practice page prints the LMMSE of each case: one wrong sign or lever misses it."""
    got = lmmse(read_study(PRACTICE / name), unknown)
    assert got.check_rms_before / UM == pytest.approx(before_um, abs=0.06)
    if after_um is not None:
        assert got.check_rms / UM == pytest.approx(after_um, abs=0.03)
    assert 0.85 < got.chi2_dof < 1.15
    if true_um is None:  # sine and cosine of one screw
        assert np.hypot(*got.amplitudes) / UM == pytest.approx(6, abs=0.5)
    else:
        assert np.all(np.abs(got.amplitudes / UM - true_um) < 3.5 * got.sigmas / UM)


@pytest.mark.parametrize("kind", ["laser_tracker", "ball_array"])
@pytest.mark.thorough
def test_bound_on_own_cases(kind):
    case = make_case(kind, seed=11, effects=EFFECTS[:1])
    got = lmmse(as_study(case), [({"effect": "backlash", "axis": "X"}, "size", 2e-5)])
    assert got.amplitudes[0] == pytest.approx(9e-6, abs=4 * got.sigmas[0])
    assert 0.8 < got.chi2_dof < 1.2
    assert got.check_rms < 0.5 * got.check_rms_before
