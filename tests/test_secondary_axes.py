"""Machine tools with a quill or another secondary axis U, V, W, against plain numpy."""

import csv
import math

import numpy as np
import pytest

from vcal.effects.base import along
from vcal.errors import StudyError
from vcal.geometry.acceptance import geometric_tests
from vcal.identification.identify import identify
from vcal.loop.weighing.cross_validation import fit_rms
from vcal.machine.chain import chain_from_string
from vcal.study.study import load_study

SETUP = """
[machine]
chain = "w X b Y Z W t"
tool_offset_mm = [0, 0, -200]
travel_mm = { X = [0, 800], Y = [0, 500], Z = [0, 400], W = [0, 300] }
[instrument]
kind = "laser_tracker"
range_sigma_um = 1
angle_sigma_urad = 1
station_mm = [-900, 300, 500]
[model.geometric]
family = "smooth"
translation_um = 10
rotation_urad = 20
squareness_urad = 50
"""
AXES = "XYZW"
TRAVEL = np.array([0.8, 0.5, 0.4, 0.3])


def tool_point(q, tilt=0.0, bow=0.0):
    """Tool point in the workpiece frame: W along Z, tilted by EB0W about Y, with a bow EXW."""
    x, y, z, w = q.T
    quill = np.column_stack([tilt * w + bow * np.sin(math.pi * w / 0.3), 0 * w, w])
    # The table carries the workpiece against the command of X.
    return np.column_stack([x, y, z - 0.2]) + quill


@pytest.fixture
def quill(tmp_path):
    """A tracker that follows random positions of a machine whose quill is tilted."""
    rng = np.random.default_rng(0)
    q = rng.uniform(0, TRAVEL, (150, 4))
    v = tool_point(q, tilt=60e-6, bow=8e-6) - [-0.9, 0.3, 0.5]
    r = np.linalg.norm(v, axis=1)
    data = {f"{a.lower()}_mm": 1e3 * q[:, i] for i, a in enumerate(AXES)}
    data["range_mm"] = 1e3 * (r + 1e-6 * rng.standard_normal(150))
    data["azimuth_rad"] = np.arctan2(v[:, 1], v[:, 0]) + 1e-6 * rng.standard_normal(150)
    data["elevation_rad"] = np.arcsin(v[:, 2] / r) + 1e-6 * rng.standard_normal(150)
    (tmp_path / "setup.toml").write_text(SETUP)
    with (tmp_path / "data.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(data)
        out.writerows(zip(*(map(repr, map(float, c)) for c in data.values()), strict=True))
    return tmp_path


def test_the_nominal_chain():
    chain = chain_from_string("w X b Y Z W t", tool_offset_m=(0, 0, -0.2))
    q = np.random.default_rng(1).uniform(0, 1, (5, 4))
    order = [chain.axes.index(axis) for axis in AXES]
    mine = np.empty_like(q)
    mine[:, order] = q
    np.testing.assert_allclose(chain.tool_point(mine), tool_point(q), atol=1e-15)
    assert along(chain, "W") == ("EZW", "um")
    assert chain_from_string("w U X b Y V Z t").axes == ("U", "V", "X", "Y", "Z")


@pytest.mark.thorough
def test_a_quill_is_identified(quill):
    study = load_study(quill)
    names = {entry.parameter.name for entry in study.model.entries}
    assert {"EXW.k0", "ECW.k0", "EA0W", "EB0W", "EC0Y"} <= names and "EC0W" not in names
    fit = identify(study.model, study.measurement)
    assert fit_rms(fit).value < 3.0
    table = study.one.instrument.to_table(study.plan, study.measurement.readings)
    np.testing.assert_allclose(table["w_mm"], study.one.table["w_mm"])
    # The squareness of the quill to X, about Y: its tilt, less that of nothing else.
    tests = {one.name: one for one in geometric_tests(fit)}
    found = tests["EB(0X)W"]
    assert found.value == pytest.approx(60.0, abs=3.0 * found.u + 1.0)
    assert not any(name.startswith(("EC(0W)", "EC(0Z)")) for name in tests)


def test_an_instrument_that_reads_the_main_axes_refuses_them(small_ball_study):
    with pytest.raises(StudyError, match="axes X, Y and Z.* for this instrument"):
        load_study(small_ball_study, {"machine.chain": "w X b Y Z W t"})
