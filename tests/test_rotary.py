"""Machines with rotary axes: a trunnion table, against kinematics written in plain numpy."""

import csv
import math
import re
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vcal
from vcal.effects import CATALOGUE, Setup
from vcal.errors import StudyError
from vcal.geometry.acceptance import geometric_tests
from vcal.machine.chain import chain_from_string
from vcal.machine.error_functions import Matern
from vcal.model.simulate import simulate
from vcal.plots import effect_view

CHAIN = "w C A b Y X Z t"
AXES = "XYZAC"
AT = {"A": (0.0, 0.0, -0.12), "C": (0.01, -0.02, -0.2)}
TOOL = (0.0, 0.0, -0.15)
BALLS = np.array([[0, 0, 0], [180, 0, 20], [0, 180, 40], [-150, -100, 60]]) * 1e-3 + [0, 0, -0.1]
SETUP = """
[machine]
chain = "w C A b Y X Z t"
tool_offset_mm = [0, 0, -150]
travel_mm = { X = [-300, 300], Y = [-300, 300], Z = [-250, 400] }
[machine.rotary]
A = { at_mm = [0, 0, -120], travel_deg = [-90, 90] }
C = { at_mm = [10, -20, -200], travel_deg = [0, 360] }
[instrument]
kind = "ball_array"
artefact = "artefact.csv"
probe_sigma_um = 0.8
[model.geometric]
family = "smooth"
translation_um = 4
rotation_urad = 6
squareness_urad = 20
location_um = 20
"""


def chain():
    return chain_from_string(CHAIN, {"C": (0.0, 2.0 * np.pi)}, TOOL, AT)


# --- the machine once more, in homogeneous matrices -------------------------------------------


def _moved(v) -> np.ndarray:
    t = np.eye(4)
    t[:3, 3] = v
    return t


def _turned(v) -> np.ndarray:
    t = np.eye(4)
    t[:3, :3] = Rotation.from_rotvec(v).as_matrix()
    return t


def frame(q: Sequence[float], twists: np.ndarray) -> np.ndarray:
    """Pose of the tool's frame in the workpiece frame (4, 4), from errors (5, 6)."""
    x = dict(zip(AXES, q, strict=True))
    e = dict(zip(AXES, twists, strict=True))
    error = lambda axis: _moved(e[axis][:3]) @ _turned(e[axis][3:])  # noqa: E731
    along = lambda axis: _moved(x[axis] * np.eye(3)["XYZ".index(axis)]) @ error(axis)  # noqa: E731

    def about(axis: str) -> np.ndarray:
        # The table turns against its command; its errors do not turn with it.
        turn = _turned(-x[axis] * np.eye(3)["ABC".index(axis)])
        return _moved(AT[axis]) @ error(axis) @ turn @ _moved(-np.array(AT[axis]))

    table = about("A") @ about("C")
    return np.linalg.inv(table) @ along("Y") @ along("X") @ along("Z")


def point(q: Sequence[float], twists: np.ndarray) -> np.ndarray:
    t = frame(q, twists)
    return t[:3, 3] + t[:3, :3] @ TOOL


def positions(ball: np.ndarray, a: float, c: float, errors) -> np.ndarray:
    """X, Y and Z at which the tool point is in the ball; `errors` gives twists from positions."""
    x = np.zeros(3)
    for _ in range(8):
        off = [point([*x, a, c], errors([*x, a, c])) - ball]
        for step in 1e-3 * np.eye(3):
            off.append(point([*x + step, a, c], errors([*x + step, a, c])) - ball)
        x -= np.linalg.solve((np.array(off[1:]) - off[0]).T / 1e-3, off[0])
    return x


def errors_of(q: Sequence[float], dir_c: float, backlash: float, worm: float = 0.0) -> np.ndarray:
    """What this machine does wrong: nothing of it is a function of vcal's."""
    x, y, _, a, c = q
    e = np.zeros((5, 6))
    e[0, 1], e[0, 5] = 3e-6 * math.sin(4.0 * x), 5e-6 * math.cos(5.0 * x)
    e[1, 0] = 15e-6 * y  # squareness
    e[3, 2], e[3, 4] = 12e-6 + 2e-6 * math.sin(a), 10e-6
    e[4, 0], e[4, 1], e[4, 3] = -18e-6 + 2e-6 * math.cos(c), 14e-6 + 1e-6 * math.sin(2 * c), 12e-6
    e[4, 5] = 4e-6 * math.sin(c) + 0.5 * backlash * dir_c + worm * math.sin(180.0 * c + 0.7)
    return e


def write(
    folder,
    backlash: float,
    seed: int,
    balls: Sequence[int] = (0, 1, 2, 3),
    worm: float = 0.0,
    turned: bool = True,
) -> None:
    """A study of this machine: balls found while the table stands at angles, come to from both
    sides, and the true tool point at others. A `worm` of 180 teeth is seen at uneven angles; C
    stands still unless it is `turned`.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(exist_ok=True)
    (folder / "setup.toml").write_text(SETUP)
    up = [(a, c, 1) for a in (-60, -20, 20, 60) for c in range(0, 360, 60)]
    down = [(a, c, -1) for a in (-40, 0, 40) for c in range(330, -1, -60)]
    rows = []
    for a, even, way in up + down:
        c = turned * even + (round(rng.uniform(0.0, 29.0), 2) if worm else 0.0)
        for ball in balls:
            errors = partial(errors_of, dir_c=way, backlash=backlash, worm=worm)
            x = positions(BALLS[ball], math.radians(a), math.radians(c), errors)
            x = 1e3 * x + 0.8e-3 * rng.standard_normal(3)
            rows.append([20 * len(rows), 0, ball, *x, a, c, way])
    _save(folder / "data.csv", "t_s,pose,ball,x_mm,y_mm,z_mm,a_deg,c_deg,dir_c", rows)
    _save(
        folder / "artefact.csv", "ball,x_mm,y_mm,z_mm", [[i, *b] for i, b in enumerate(BALLS * 1e3)]
    )
    rows = []
    for x, y, z, a, c, side in rng.uniform(size=(60, 6)):
        at = [0.4 * x - 0.2, 0.4 * y - 0.2, 0.3 * z, 2.4 * a - 1.2, 6.2 * c]
        way = 1 if side > 0.5 else -1
        true = 1e3 * point(at, errors_of(at, way, backlash, worm))
        rows.append([*np.array(at[:3]) * 1e3, *np.degrees(at[3:]), way, *true])
    _save(folder / "check.csv", "x_mm,y_mm,z_mm,a_deg,c_deg,dir_c,tcp_x_mm,tcp_y_mm,tcp_z_mm", rows)


def _save(path, header: str, rows) -> None:
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([header.split(","), *rows])


# --- kinematics -------------------------------------------------------------------------------


@pytest.mark.thorough
def test_pose_and_its_derivatives_are_those_of_the_matrices():
    rng, it = np.random.default_rng(1), chain()
    assert it.axes == tuple(AXES)
    for _ in range(3):
        q = rng.uniform(-1.0, 1.0, 5)
        twists = 1e-2 * rng.standard_normal((5, 6))
        r, t = it.pose_as_arrays(jnp.asarray(q), jnp.asarray(twists))
        expected = frame(q, twists)
        np.testing.assert_allclose(np.asarray(r), expected[:3, :3], atol=1e-14)
        np.testing.assert_allclose(np.asarray(t), expected[:3, 3], atol=1e-14)
        r, t = it.pose(list(q), [list(row) for row in twists])
        np.testing.assert_allclose(np.asarray(r.array()), expected[:3, :3], atol=1e-14)
        _, found, moved, _ = it.jacobian(jnp.asarray(q), jnp.asarray(twists), jnp.asarray(TOOL))
        np.testing.assert_allclose(np.asarray(found), point(q, twists), atol=1e-14)
        for k in range(30):
            step = 1e-6 * (np.arange(30) == k).reshape(5, 6)
            slope = (point(q, twists + step) - point(q, twists - step)) / 2e-6
            np.testing.assert_allclose(np.asarray(moved)[:, k], slope, atol=1e-9)

        def along(x, errors=twists):
            r, t = it.pose([x[i] for i in range(5)], [list(row) for row in errors])
            return t.array() + r.array() @ jnp.asarray(TOOL)

        slopes = jax.jacfwd(along)(jnp.asarray(q))
        for k in range(5):
            step = 1e-6 * np.eye(5)[k]
            slope = (point(q + step, twists) - point(q - step, twists)) / 2e-6
            np.testing.assert_allclose(np.asarray(slopes)[:, k], slope, atol=1e-9)


def test_nominal_tool_point_and_the_turn_of_the_table():
    q = np.array([[0.1, -0.05, 0.2, 0.5, 4.0], [0.0, 0.1, 0.0, -1.0, 0.3]])
    still = np.zeros((5, 6))
    np.testing.assert_allclose(chain().tool_point(q), [point(row, still) for row in q], atol=1e-14)
    # No axis of the tool side turns: what turns the bed's frame is all there is.
    expected = [frame(row, still)[:3, :3] for row in q]
    np.testing.assert_allclose(chain().turn(q), expected, atol=1e-14)


def test_a_smooth_family_comes_round_with_a_whole_turn():
    basis = Matern((0.0, 2.0 * np.pi), 2.0, 0.5, around=True)
    x = np.array([0.0, 0.7, 2.0, 4.0, 6.2])
    functions = np.asarray(basis.functions(x))
    np.testing.assert_allclose(np.asarray(basis.functions(x + 2.0 * np.pi)), functions, atol=1e-9)
    # Matern-5/2 of the chord on a circle of radius 1, with a correlation length of 0.5 times 2.
    r = math.sqrt(5.0) * np.abs(2.0 * np.sin((x[:, None] - x) / 2.0))
    kernel = 4.0 * (1.0 + r + r**2 / 3.0) * np.exp(-r)
    np.testing.assert_allclose((functions * basis.sigma**2) @ functions.T, kernel, atol=2e-3)


# --- a study ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trunnion")
    write(folder, backlash=40e-6, seed=4)
    return vcal.load_study(folder)


@pytest.mark.thorough
def test_location_errors_of_rotary_axes_are_declared_by_their_names(studied):
    names = [entry.parameter.name for entry in studied.model.entries]
    located = [name for name in names if name[2:3] == "0" and "." not in name]
    assert set(located) >= {f"E{c}0A" for c in "YZBC"} | {f"E{c}0C" for c in "XYAB"}
    units = {e.parameter.name: e.parameter.unit for e in studied.model.entries}
    assert units["EX0C"] == "um" and units["EA0C"] == "urad"


@pytest.mark.thorough
def test_the_loop_names_the_backlash_of_a_rotary_axis_and_corrects_the_machine(studied):
    closure = vcal.close_loop(studied.model, studied.measurement, check=studied.check)
    assert [f.effect.key for f in closure.effects] == ["backlash C"]
    (_, value, unit, u), *_ = closure.effects[0].parameters
    assert unit == "urad" and abs(value - 40.0) < 3.0 * u < 6.0
    none, before, after = (
        closure.errors[k].check.value for k in ("uncompensated", "before", "after")
    )
    assert after < 0.6 * before and after < 0.12 * none
    assert closure.after.chi2 / closure.after.dof == pytest.approx(1.0, abs=0.15)
    tests = geometric_tests(closure.after)
    named = {t.name: t for t in tests if "average line" in t.what or "squareness" in t.what}
    assert set(named) == {
        *("EC(0X)Y", "EB(0X)Z", "EA(0Y)Z"),
        *(f"E{c}0A" for c in "YZBC"),
        *(f"E{c}0C" for c in "XYAB"),
    }
    true = {"EX0C": -18.0, "EY0C": 14.0, "EA0C": 12.0, "EB0C": 0.0, "EB0A": 10.0}
    # Of the lines, X is the only one that is not straight.
    x = np.linspace(-0.3, 0.3, 41)
    path = [point([v, 0, 0.075, 0, 0], errors_of([v, 0, 0.075, 0, 0], 0, 0.0)) for v in x]
    true["EC(0X)Y"] = -15.0 - 1e6 * np.polyfit(x, np.array(path)[:, 1], 1)[0]
    for name, value in true.items():
        assert abs(named[name].value - value) < 3.5 * named[name].u < 40.0, name


@pytest.mark.thorough
def test_the_loop_names_the_worm_of_a_rotary_axis(tmp_path):
    write(tmp_path, backlash=0.0, seed=7, worm=15e-6)
    study = vcal.load_study(tmp_path)
    closure = vcal.close_loop(study.model, study.measurement, check=study.check)
    (found,) = closure.effects
    assert found.effect.key == "screw_cyclic C"
    (_, sine, unit, u), (_, cosine, _, _), (_, pitch, degrees, u_pitch) = found.parameters
    assert (unit, degrees) == ("urad", "deg")
    assert abs(pitch - 2.0) < 3.0 * u_pitch < 0.01
    assert abs(math.hypot(sine, cosine) - 15.0) < 3.0 * u < 6.0
    assert closure.errors["after"].check.value < 0.6 * closure.errors["before"].check.value
    seen = effect_view(closure.after, found.effect)
    assert seen.x_label.startswith("C position modulo the pitch of ") and seen.x_label.endswith("°")
    assert 1.9 < seen.x.max() < 2.01


def test_pitches_of_a_worm_end_where_slow_harmonics_begin(studied):
    it = studied.model
    setup = Setup(it.chain, it.layout, studied.plan, it.effects)
    worms = {e.placement: e for e in CATALOGUE["screw_cyclic"].candidates(setup)}
    assert [*worms] == list(AXES)
    for axis, longest in (("A", 30.0), ("C", 80.0)):
        pitches = np.degrees(worms[axis].scan(studied.plan)["pitch"])
        assert pitches[0] == pytest.approx(longest) and pitches[-2] <= 1.0 < pitches[-3]
    assert worms["X"].parameters[0].unit == "um" and worms["X"].parameters[2].unit == "mm"


@pytest.mark.thorough
def test_nothing_is_missing_where_nothing_is(tmp_path):
    write(tmp_path, backlash=0.0, seed=5)
    study = vcal.load_study(tmp_path)
    assert vcal.close_loop(study.model, study.measurement).verdict == "nothing_missing"


@pytest.mark.campaign
def test_simulated_balls_are_where_the_matrices_find_them(studied):
    """The positions found are those at which the tool point is in the ball: the residual of the
    simulated data at the truth is the noise.
    """
    made = simulate(studied.model, studied.plan, jax.random.key(2), noise_factor=0.0)
    assert np.abs(made.ideal).max() < 1e-11
    moved = np.asarray(made.measurement.plan.position) - np.asarray(studied.plan.position)
    assert 5e-6 < np.abs(moved).max() < 1e-3
    assert np.abs(moved[:, 3:]).max() == 0.0


@pytest.mark.thorough
def test_one_ball_on_the_table_is_enough(tmp_path):
    write(tmp_path, backlash=0.0, seed=6, balls=(1,))
    header, *rows = (tmp_path / "artefact.csv").read_text().splitlines()
    (only,) = (row for row in rows if row.startswith("1,"))
    (tmp_path / "artefact.csv").write_text(f"{header}\n{only}\n", encoding="utf-8")
    study = vcal.load_study(tmp_path)
    pose = [e.parameter.name for e in study.model.entries if e.key == "artefact_pose"]
    assert pose == ["0.X", "0.Y", "0.Z"]
    fit = vcal.identify(study.model, study.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.3)
    # Nothing of it bends or expands, and nothing is divided by its length.
    assert study.one.instrument.artefact is None
    assert np.isfinite(study.plan.covariate("along_beam")).all()


def test_settings_stay_together_whatever_the_order_of_the_rows(studied):
    """What is held out has no reading of its setting among those that are fitted."""
    plan, instrument = studied.plan, studied.one.instrument
    folds, _ = instrument.folds(plan)
    mixed = np.random.default_rng(0).permutation(plan.rows)
    for rows in (np.arange(plan.rows), mixed):
        found, _ = instrument.folds(plan.take(rows))
        turning = np.asarray(plan.position)[rows][:, [plan.axes.index(a) for a in "AC"]]
        _, setting = np.unique(turning, axis=0, return_inverse=True)
        for k in np.unique(setting):
            assert len(np.unique(found[setting.ravel() == k])) == 1
    assert len(np.unique(folds)) == 5


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["machine.chain=w C B b Y X Z t"], "machine.rotary.B"),
        (["machine.chain=w A b Y X Z t"], "machine.rotary.C"),
        (["machine.rotary.C.travel_deg=[10, 10]"], "travel_deg"),
        (["machine.travel_mm.C=[0, 100]"], "machine.travel_mm.C"),
        (["machine.rotary.A.travel_deg=[-30, 30]"], "column a_deg"),
        (["machine.rotary.C.at_mm=[0.01, -0.02, -0.2]"], "at_mm of the rotary axes"),
        (["machine.rotary.C.at_m=[0, 0, 0]"], "(did you mean 'at_mm'?), expected one of at_mm"),
        (["machine.rotary.c.at_mm=[0, 0, 0]"], "the unknown key 'c' (did you mean 'C'?)"),
        (["data.must_see={EX0B = 0}"], "(did you mean 'EX0C'?), expected an error motion"),
        (["data.must_see={EC0C = 0}"], "the unknown error 'EC0C'"),
        (["instrument.kind=laser_frame"], "instrument"),
    ],
)
def test_what_does_not_fit_is_one_message(studied, overrides, said):
    with pytest.raises(StudyError, match=re.escape(said)) as caught:
        vcal.load_study(studied.path, overrides)
    assert "expected" in str(caught.value)


@pytest.mark.parametrize(
    ("factors", "said"),
    [
        ({"a_deg": -1.0}, "the other sign in a_deg"),
        ({"c_deg": math.pi / 180.0}, "radians turned into degrees in c_deg"),
        (dict.fromkeys(("a_deg", "c_deg"), math.pi / 180.0), "degrees in a_deg, c_deg"),
    ],
)
@pytest.mark.thorough
def test_angles_that_readings_do_not_follow_are_told(tmp_path, factors, said):
    write(tmp_path, backlash=0.0, seed=8)
    _change(tmp_path / "data.csv", factors)
    with pytest.raises(
        StudyError, match=rf"data\.csv, row \d+ .* they do with .*{said}.*: compare"
    ):
        vcal.load_study(tmp_path)


@pytest.mark.thorough
def test_readings_that_are_astray_are_no_wrong_angles(tmp_path):
    """A few gross errors are left out by the loop, as on any machine."""
    write(tmp_path, backlash=0.0, seed=8)
    _change(tmp_path / "data.csv", {"x_mm": 0.3}, rows=(5, 50))
    assert vcal.load_study(tmp_path).plan.rows == 168


def test_one_ball_that_nothing_turns_is_refused(tmp_path):
    write(tmp_path, backlash=0.0, seed=8, balls=(1,))
    _change(tmp_path / "data.csv", {"a_deg": 0.0, "c_deg": 0.0})
    with pytest.raises(StudyError, match=r"one ball in pose 0, at one setting .* expected several"):
        vcal.load_study(tmp_path)


@pytest.mark.campaign
def test_location_errors_of_rotary_axes_can_be_asked_for(studied, tmp_path):
    vcal.load_study(studied.path, ["data.must_see={EX0C = 0, EY0C = 0, EZC = 3, EC0A = 0}"])
    write(tmp_path, backlash=0.0, seed=8, turned=False)
    # While C stands, nothing tells where it is from where the artefact is.
    with pytest.raises(StudyError, match="EX0C.* not identified"):
        vcal.load_study(tmp_path, ["data.must_see={EX0C = 0, EZ0A = 0}"])


def _change(path, factors, rows: Sequence[int] | None = None) -> None:
    with open(path, newline="") as file:
        header, *table = csv.reader(file)
    for row in table if rows is None else [table[k] for k in rows]:
        for name, factor in factors.items():
            row[header.index(name)] = float(row[header.index(name)]) * factor
    _save(path, ",".join(header), table)
