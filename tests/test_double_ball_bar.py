"""Double ball bar: its motion and unknowns, the circular tests of ISO 230-4, and what it finds."""

import json

import numpy as np
import pytest

import vcal
from conftest import write_csv
from designing import run
from oracle import Smooth, make_case
from oracle.ball_bar import bar_plan
from oracle.kinematics import nominal_machine
from report_schema import validated
from vcal import load_study
from vcal.demo import STARTS
from vcal.errors import StudyError
from vcal.geometry.circular_deviations import (
    actual_path,
    circular_deviations,
    circular_hysteresis,
    least_squares_circle,
    minimum_zone_circles,
    sensitivities,
)
from vcal.geometry.circular_tests import circular_tests
from vcal.machine.circles import circle_through

R = 0.15
ANGLE = 2.0 * np.pi * (np.arange(360) + 0.5) / 360
FAMILY = Smooth(translation=3e-6, rotation=6e-6, squareness=15e-6)

MACHINE = """
[machine]
chain = "{chain}"
tool_offset_mm = [0, 0, -150]
[machine.travel_mm]
X = [0, 600]
Y = [0, 500]
Z = [0, 450]
{more}
[instrument]
kind = "double_ball_bar"
length_mm = 150
{length}
sigma_um = 0.3
[model.geometric]
family = "smooth"
translation_um = 4
rotation_urad = 10
squareness_urad = 20
[data]
data = "data.csv"
"""


def write(folder, columns, length="length_u_um = 0.5", chain="w X b Y Z t", more=""):
    folder.mkdir(parents=True, exist_ok=True)
    text = MACHINE.format(chain=chain, more=more, length=length)
    (folder / "setup.toml").write_text(text, encoding="utf-8")
    write_csv(folder / "data.csv", columns)
    return folder


def circle(radius=150.0, points=24, centre=(300.0, 250.0, 225.0), sense=1, run=0):
    angle = sense * 2.0 * np.pi * (np.arange(points) + 0.5) / points
    place = np.tile(centre, (points, 1))
    place[:, 0] += radius * np.cos(angle)
    place[:, 1] += radius * np.sin(angle)
    return {"run": np.full(points, run)} | {f"{c}_mm": place[:, i] for i, c in enumerate("xyz")}


def together(*tables):
    return {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}


@pytest.fixture
def rng():
    return np.random.default_rng(0)


# --- ISO 230-4 ------------------------------------------------------------------------------------


def um(values):
    return 1e6 * np.asarray(values)


def test_four_readings_by_hand():
    """f = 3, -1, 5, 1 um at 0, 90, 180, 270 degrees: mean 2, centre (-1, -1), residuals +-2 um."""
    path = actual_path(np.deg2rad([0, 90, 180, 270]), 1e-6 * np.array([3.0, -1.0, 5.0, 1.0]), R)
    found = circular_deviations(path, R)
    np.testing.assert_allclose(um(least_squares_circle(path).centre), [-1.0, -1.0], atol=1e-4)
    expected = [4.0, 4.0, 5.0, -1.0, 4.0, 0.0, 2.0, np.nan]
    np.testing.assert_allclose(um(found.values), expected, atol=1e-4)


def test_a_minimum_zone_by_hand():
    """The least-squares centre of five points is not that of their minimum zone.

    Of f = 4, 0, 0, 0, 0, 0, 0, 0 um every 45 degrees, regression leaves 4 - 0.5 - 1 and, opposite,
    -0.5 + 1; the zone may shift by a along the first point: 4 - a at 0, and -a cos t elsewhere, of
    which the largest is a at 180 degrees and the smallest -a/sqrt(2) at 45. The width
    max(4 - a, a) + a/sqrt(2) is least where 4 - a = a: 2 + sqrt(2).
    """
    angle = np.deg2rad(np.arange(0, 360, 45))
    path = actual_path(angle, 1e-6 * np.array([4.0, *[0.0] * 7]), R)
    assert um(least_squares_circle(path).width) == pytest.approx(
        2.5 + 0.5 + 1 / np.sqrt(2), abs=1e-4
    )
    assert um(minimum_zone_circles(path).width) == pytest.approx(2.0 + np.sqrt(2.0), abs=1e-4)


def squareness(t, sense):
    return -20e-6 * R * np.sin(2 * t) / 2


def scales(t, sense):
    return R * (20e-6 * np.cos(t) ** 2 - 10e-6 * np.sin(t) ** 2)


def backlash(t, sense):
    return -sense * 3e-6 * np.sign(np.sin(t)) * np.cos(t)


def lag(t, sense):
    return sense * 4e-6 * np.sin(2 * t) / 2


# G, G(b), D and F_max = -F_min - 2 D in um
CLOSED = {squareness: (3.0, 3.0, 0.0), scales: (4.5, 4.5, 0.75), backlash: (6.0, 6.0, 0.0),
          lag: (4.0, 4.0, 0.0)}  # fmt: skip


@pytest.mark.parametrize("error", CLOSED)
def test_closed_forms(error):
    one, both, mean = CLOSED[error]
    paths = [actual_path(ANGLE, error(ANGLE, sense), R) for sense in (1, -1)]
    for path in paths:
        found = circular_deviations(path, R)
        assert um(found.circular) == pytest.approx(one, abs=2e-3)
        assert um(found.circular_least_squares) == pytest.approx(one, abs=2e-3)
        assert um(found.mean_radial) == pytest.approx(mean, abs=1e-3)
        assert um(found.radial_max) == pytest.approx(mean + one / 2, abs=2e-3)
        assert um(found.radial_min) == pytest.approx(mean - one / 2, abs=2e-3)
    together = circular_deviations(np.concatenate(paths), R)
    assert um(together.circular) == pytest.approx(both, abs=2e-3)
    assert um(together.mean_radial) == pytest.approx(mean, abs=1e-3)


def test_eccentricity_is_no_deviation():
    """A circle about another centre is a circle, however far it is set up beside it."""
    path = (R + 1e-6) * np.column_stack([np.cos(ANGLE), np.sin(ANGLE)]) + [4e-4, -3e-4]
    found = circular_deviations(path, R)
    assert um(found.circular) < 1e-6 and um(found.circular_least_squares) < 1e-6
    assert um(found.mean_radial) == pytest.approx(1.0, abs=1e-6)
    assert found.radial_max == pytest.approx(5e-4, rel=0.01)


def test_derivatives_of_deviations(rng):
    f = backlash(ANGLE, 1) + rng.normal(0.0, 5e-7, 360)
    step = 1e-10 * rng.standard_normal(360)
    ends = [circular_deviations(actual_path(ANGLE, f + k * step, R), R).values for k in (1, -1)]
    found = sensitivities(actual_path(ANGLE, f, R)) @ step
    np.testing.assert_allclose(found, np.subtract(*ends)[:7] / 2, atol=1e-13)


def test_a_hysteresis_by_hand():
    """Readings of 3, -1, 5, 1 um and, in the other sense, 2, 0, 5, -2 um at four angles differ by
    1, -1, 0 and 3 um. Between its angles the other path is taken along straight lines: half of a
    step further on, it reads 0 between -2 and 2, and the circle closes.
    """
    angle = np.deg2rad([0.0, 90.0, 180.0, 270.0])
    one, other = 1e-6 * np.array([3.0, -1.0, 5.0, 1.0]), 1e-6 * np.array([2.0, 0.0, 5.0, -2.0])
    back = np.array([3, 2, 1, 0])
    width, slope = circular_hysteresis((angle, angle[back]), (one, other[back]))
    assert um(width) == pytest.approx(3.0)
    np.testing.assert_allclose(slope, [0, 0, 0, 1, -1, 0, 0, 0], atol=1e-12)
    shifted = angle + np.deg2rad(45.0)
    width, slope = circular_hysteresis((shifted, angle), (one, other))
    # 3 - 1, -1 - 2.5, 5 - 1.5 and 1 - 0: the largest is 3.5 um.
    assert um(width) == pytest.approx(3.5)
    width, _ = circular_hysteresis((shifted[3:], angle), (1e-6 * np.array([7.0]), other))
    assert um(width) == pytest.approx(7.0)


@pytest.mark.parametrize(
    ("error", "expected"), [(squareness, 0.0), (scales, 0.0), (backlash, 6.0), (lag, 4.0)]
)
@pytest.mark.parametrize("full", [True, False])
def test_hysteresis_in_closed_form(error, expected, full):
    angle = ANGLE if full else np.deg2rad(np.arange(-20.0, 200.25, 0.5))
    back = angle[::-1] + np.deg2rad(0.2) * (1 if full else 0)
    width, slope = circular_hysteresis((angle, back), (error(angle, 1), error(back, -1)), full=full)
    assert um(width) == pytest.approx(expected, abs=0.05)
    assert slope.sum() == pytest.approx(0.0, abs=1e-12)


def test_an_arc_has_no_mean_radius():
    found = circular_deviations(actual_path(ANGLE[:200], 0 * ANGLE[:200], R), R, full=False)
    assert np.isnan(found.mean_radial) and np.isnan(found.radial_max_centred)
    assert um(found.circular) < 1e-6


# --- motion ---------------------------------------------------------------------------------------


def test_motion_follows_from_positions(tmp_path, rng):
    """Directions, distances since reversals, speeds and accelerations as the generator has them."""
    machine = nominal_machine("w X b Y Z t", (0.6, 0.5, 0.45), (0.0, 0.0, -0.15))
    plan = bar_plan(machine, rng)
    columns = {"run": plan.number, "length_mm": 1e3 * plan.length, "feed_mm_min": 6e4 * plan.feed}
    columns |= {f"{c}_mm": 1e3 * plan.run.q[:, i] for i, c in enumerate("xyz")}
    found = load_study(write(tmp_path, columns)).plan
    for i, axis in enumerate("XYZ"):
        moves = np.abs(plan.motion.velocity[:, i]) > 0.0
        way = np.asarray(found.covariate(f"dir_{axis}"))
        assert (way[moves] == plan.motion.way[moves, i]).all() and not way[~moves].any()
        since = np.asarray(found.covariate(f"since_{axis}"))
        np.testing.assert_allclose(since[moves], plan.motion.since[moves, i], atol=1e-8)
        for kind, true in (("v", plan.motion.velocity), ("a", plan.motion.acceleration)):
            got = np.asarray(found.covariate(f"{kind}_{axis}"))
            np.testing.assert_allclose(got, true[:, i], atol=1e-8)


def test_a_row_at_a_reversal_has_the_direction_of_its_approach(tmp_path):
    columns = circle()
    angle = 2.0 * np.pi * np.arange(24) / 24  # the first and the 13th row are at the ends of X
    columns["x_mm"], columns["y_mm"] = 300 + 150 * np.cos(angle), 250 + 150 * np.sin(angle)
    way = np.asarray(load_study(write(tmp_path, columns)).plan.covariate("dir_X"))
    assert way.tolist() == [1.0] + [-1.0] * 12 + [1.0] * 11


def test_accelerations_need_two_of_them(tmp_path):
    one = circle() | {"feed_mm_min": np.full(24, 1000.0)}
    plan = load_study(write(tmp_path / "one", one)).plan
    assert plan.has("v_X", "since_X") and not plan.has("a_X")
    fast = circle(run=1) | {"feed_mm_min": np.full(24, 3000.0)}
    assert load_study(write(tmp_path / "two", together(one, fast))).plan.has("a_X")
    assert not load_study(write(tmp_path / "none", circle())).plan.has("v_X")


def test_no_circle_through_a_line_or_back_and_forth():
    line = np.linspace(0, 1, 9)[:, None] * [1.0, 2.0, 0.0]
    turn = np.deg2rad([0, 10, 20, 30, 20, 10])
    back = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    assert circle_through(line) is None and circle_through(back) is None
    ellipse = np.column_stack([np.cos(ANGLE), 1.1 * np.sin(ANGLE), 0 * ANGLE])
    assert circle_through(ellipse) is None


# --- unknowns -------------------------------------------------------------------------------------


def keys(study):
    return [f"{e.key} {e.parameter.name}" for e in study.model.entries if "geometric" not in e.key]


@pytest.mark.thorough
def test_coordinates_that_a_circle_shows(tmp_path):
    study = load_study(write(tmp_path / "one", circle()))
    assert keys(study) == ["bar_centre 0.X", "bar_centre 0.Y", "bar_length error"]
    table = circle()
    upright = circle(run=1) | {"y_mm": np.full(24, 250.0), "z_mm": table["y_mm"] - 25.0}
    three = together(table, upright) | {"setup": np.full(48, 7)}
    found = keys(load_study(write(tmp_path / "three", three)))
    assert found == ["bar_centre 7.X", "bar_centre 7.Y", "bar_centre 7.Z", "bar_length error"]
    found = keys(load_study(write(tmp_path / "unknown", circle(), length="")))
    assert found == ["bar_centre 0.X", "bar_centre 0.Y", "setup_length 0.length"]
    exact = load_study(write(tmp_path / "exact", circle(), length="length_u_um = 0"))
    assert keys(exact) == ["bar_centre 0.X", "bar_centre 0.Y"]


def test_a_cone_needs_the_place_of_the_ball(tmp_path):
    """The circle of a cone is smaller than the bar is long; its axis coordinate changes all
    readings alike, as the length does.
    """
    small = circle(radius=120.0)
    with pytest.raises(StudyError, match="120 mm from the ball .* for a cone, or a tool at rest"):
        load_study(write(tmp_path / "lost", small))
    ball = {"ball_x_mm": 300.0, "ball_y_mm": 250.0, "ball_z_mm": 225.0 - 150.0 - 90.0}
    cone = small | {name: np.full(24, value) for name, value in ball.items()}
    study = load_study(write(tmp_path / "cone", cone))
    assert keys(study)[:3] == ["bar_centre 0.X", "bar_centre 0.Y", "bar_centre 0.Z"]
    study = load_study(write(tmp_path / "unknown", cone, length=""))
    assert keys(study) == ["bar_centre 0.X", "bar_centre 0.Y", "setup_length 0.length"]
    back = study.instrument.to_table(study.plan, np.zeros((24, 1)))
    for name, value in ball.items():
        np.testing.assert_allclose(back[name], value, atol=1e-9)


def test_what_was_set_is_found(tmp_path):
    study = load_study(write(tmp_path, together(circle(), circle(sense=-1, run=1))))
    model = study.model
    names = [f"{e.key} {e.parameter.name}" for e in model.entries]
    steps = np.array([e.parameter.step for e in model.entries])
    truth = np.zeros(len(names))
    for key, value in {"bar_centre 0.X": 30e-6, "bar_centre 1.Y": -20e-6}.items():
        truth[names.index(key)] = value / steps[names.index(key)]
    readings = np.asarray(vcal.predict(model, study.plan, truth))
    mine = study.plan.values("run") == 0
    across = (np.asarray(study.plan.x("X")) - 0.3) / R
    assert np.allclose(readings[mine, 0], -30e-6 * across[mine], atol=1e-8)
    fit = vcal.identify(model, vcal.Measurement(study.plan, readings, ""))
    assert np.allclose(fit.theta * steps, truth * steps, atol=1e-9)


TURNING = "[machine.rotary]\nC = { at_mm = [300, 250, 0], travel_deg = [0, 360] }"


def cylinder(points=24):
    """The ball in the spindle follows a point of the turning table, so that the bar keeps its
    direction in the frame of the table: a radial test of C.
    """
    c = 2.0 * np.pi * np.arange(points) / points
    # C carries the workpiece: a point p of it stands at at + R(-C) (p - at) in the bed.
    place = np.column_stack([300 + 100 * np.cos(c), 250 - 100 * np.sin(c), np.full(points, 300.0)])
    columns = {"run": np.zeros(points), "c_deg": np.degrees(c)}
    columns |= {f"{k}_mm": place[:, i] for i, k in enumerate("xyz")}
    ball = {"ball_x_mm": 250.0, "ball_y_mm": 250.0, "ball_z_mm": 150.0}
    return columns | {name: np.full(points, value) for name, value in ball.items()}


@pytest.mark.thorough
def test_a_cylinder_of_a_rotary_axis(tmp_path):
    columns = cylinder()
    folder = write(tmp_path / "turning", columns, chain="w C b X Y Z t", more=TURNING)
    study = load_study(folder)
    assert study.plan.has("dir_C") and not study.plan.has("since_X")
    # The bar has one direction: one coordinate of the ball, along it, is seen beside the length.
    assert keys(study) == ["bar_centre 0.X", "bar_length error"]
    names = [f"{e.key} {e.parameter.name}" for e in study.model.entries]
    truth = np.zeros(len(names))
    entry = study.model.entries[names.index("geometric EX0C")]
    truth[names.index("geometric EX0C")] = 10e-6 / entry.parameter.step
    read = np.asarray(vcal.predict(study.model, study.plan, truth))[:, 0]
    c = np.deg2rad(columns["c_deg"])
    # The axis 10 um along X: the tool is off by -10 um X in the bed, which turns with the table.
    expected = -10e-6 * np.cos(c)
    np.testing.assert_allclose(read - read.mean(), expected - expected.mean(), atol=1e-9)
    lost = {k: v for k, v in columns.items() if not k.startswith("ball_")}
    with pytest.raises(StudyError, match="add the ball's position"):
        load_study(write(tmp_path / "lost", lost, chain="w C b X Y Z t", more=TURNING))


# --- tables ---------------------------------------------------------------------------------------

REFUSED = {
    "radius": (lambda t: t | {"x_mm": 1.02 * t["x_mm"]}, "from the ball of set-up 0"),
    "setup": (lambda t: t | {"setup": np.arange(24.0)}, "set-ups .* in run 0"),
    "half a setup": (lambda t: t | {"setup": np.full(24, 0.5)}, "column setup: found 0.5"),
    "length": (lambda t: t | {"length_mm": np.full(24, -1.0)}, "column length_mm: found -1"),
    "feed": (lambda t: t | {"feed_mm_min": np.full(24, -1.0)}, "a negative feed"),
    "moved ball": (
        lambda t: t | {"ball_x_mm": np.linspace(0, 1, 24), "ball_y_mm": 0 * t["x_mm"],
                       "ball_z_mm": 0 * t["x_mm"]},
        "the ball 1 mm from where set-up 0 begins",
    ),
    "directions": (
        lambda t: t | {"dir_x": np.where(t["y_mm"] > 250, 1, -1)},
        "column dir_x: found directions against the order of the positions",
    ),
    "few rows": (lambda t: {k: v[:3] for k, v in t.items()} | {"run": np.arange(3)}, "1 row of"),
    "reading": (lambda t: t | {"deviation_um": np.full(24, 2000.0)}, "column deviation_um: found"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_table_that_cannot_be_right(tmp_path, case):
    change, expected = REFUSED[case]
    with pytest.raises(StudyError, match=expected):
        load_study(write(tmp_path, change(circle())))


def test_a_table_is_written_as_it_was_read(tmp_path):
    study = load_study(STARTS / "double_ball_bar")
    back = study.instrument.to_table(study.plan, study.sets[0].readings)
    table = study.sets[0].table
    assert {*back} == {*table}
    for name, values in back.items():
        np.testing.assert_allclose(values, table[name], atol=1e-8)


def test_directions_of_the_table_have_precedence(tmp_path):
    """An axis at rest has none of its own; the table may know from where it came."""
    plan = load_study(write(tmp_path / "plain", circle())).plan
    assert not plan.has("dir_Z")
    plan = load_study(write(tmp_path / "told", circle() | {"dir_z": -np.ones(24)})).plan
    assert (np.asarray(plan.covariate("dir_Z")) == -1.0).all() and plan.has("dir_X")


# --- what it finds --------------------------------------------------------------------------------


def case(folder, effects=(), seed=1, noise_factor=1.0):
    make_case("double_ball_bar", seed=seed, effects=effects, family=FAMILY, folder=folder,
              noise_factor=noise_factor)  # fmt: skip
    return load_study(folder)


@pytest.mark.parametrize(("noise", "low", "high"), [(1.0, 0.85, 1.15), (0.0, 0.0, 0.02)])
def test_a_clean_case_is_noise(tmp_path, noise, low, high):
    study = case(tmp_path, noise_factor=noise)
    fit = vcal.identify(study.model, study.measurement)
    assert fit.converged and low <= fit.chi2 / fit.dof < high


FOUND = {
    "backlash X": {"effect": "backlash", "axis": "X", "size_um": 3},
    "lateral_reversal Y": {"effect": "lateral_reversal", "axis": "Y", "component": "X",
                           "size_um": 3},
    "servo_lag X": {"effect": "servo_lag", "axis": "X", "T_ms": 0.05},
    "screw_cyclic Z": {"effect": "screw_cyclic", "axis": "Z", "pitch_mm": 10, "amplitude_um": 1},
    "reversal_spike": {"effect": "reversal_spike", "size_um": 3, "decay_mm": 2},
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("key", FOUND)
def test_what_is_missing_is_named(tmp_path, key):
    study = case(tmp_path, [FOUND[key]])
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, draws=100)
    assert closure.verdict == "named", closure.sentence
    assert [e.effect.key for e in closure.effects] == [key]


@pytest.mark.thorough
def test_nothing_is_missing_from_a_clean_case(tmp_path):
    study = case(tmp_path, seed=2)
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, draws=100)
    assert closure.verdict == "nothing_missing"


def test_circular_tests_of_a_fit(tmp_path):
    """The identified machine has the circular deviations of the true one, within 4 u."""
    noisy, exact = (case(tmp_path / f"{k}", seed=3, noise_factor=k) for k in (1.0, 0.0))
    found = []
    for study in (noisy, exact):
        fit = vcal.identify(study.model, study.measurement)
        rows = np.arange(study.plan.rows)
        found.append(circular_tests(fit, study.sets[0].instrument, study.plan, rows))
    assert [t.sense for t in found[0][:2]] == ["counter-clockwise", "clockwise"]
    assert [t.plane for t in found[0][:6:2]] == ["XY", "YZ", "ZX"]
    pairs = [t for t in found[0] if t.sense == "both"]
    assert len(pairs) == 6 and pairs[0].runs == (0, 1)
    # Without noise the readings have the deviations G of the machine.
    for test, true in zip(*found, strict=True):
        off = test.machine.circular - true.measured.circular
        assert abs(off) < 4.0 * test.u.circular + 2e-8
        assert test.measured.circular > true.measured.circular - 1e-7
        if np.isfinite(test.u.mean_radial):
            assert 1e-8 < test.u.mean_radial < 1e-6
        if test.sense == "both":
            # The machine has no hysteresis: what is read of it is noise.
            assert test.machine.hysteresis < 1e-9 < 1e-7 < test.measured.hysteresis


@pytest.mark.thorough
def test_report(tmp_path):
    case(tmp_path / "study", [FOUND["backlash X"]])
    run("loop", tmp_path / "study", "--out", tmp_path / "report", "--set", "loop.draws=100")
    record = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    validated(record)
    assert len(record["circular_tests"]) == 18
    page = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    assert "Circular tests (ISO 230-4)" in page and "G(b)" in page
    pairs = [t for t in record["circular_tests"] if t["sense"] == "both" and t["plane"] == "XY"]
    size = FOUND["backlash X"]["size_um"]
    for test in pairs:
        u = test["standard_uncertainty"]["hysteresis_um"]
        assert abs(test["machine"]["hysteresis_um"] - size) < 4.0 * u + 0.02 * size


@pytest.mark.campaign
def test_uncertainty_before_measuring(tmp_path):
    told = run("uncertainty", STARTS / "double_ball_bar", "--out", tmp_path / "out",
               "--draws", 200).stdout  # fmt: skip
    assert "the rms volumetric error" in told
