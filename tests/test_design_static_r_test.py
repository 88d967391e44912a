"""Plans of a static R-test made better, against plain numpy matrices and what is known on paper."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vcal
from conftest import write_csv
from designing import design, run, slopes, strict, task_of
from test_rotary import AXES, point, positions
from test_static_r_test import HEAD, INSTRUMENT, seen, still
from vcal.design import covariance
from vcal.design.next_measurement import plan_next
from vcal.design.optimiser import Compiled, optimise
from vcal.instruments.follow import carried_apart, followed
from vcal.machine.chain import chain_from_string
from vcal.uncertainty import ErrorMotionErrors, ParameterErrors, linearised
from vcal.uncertainty.campaign import virtual_pair

pytestmark = pytest.mark.usefixtures("kept_programs")

SPHERES = np.array([[160.0, 0.0, -60.0], [-90.0, 130.0, 20.0]]) * 1e-3
LOCATIONS = ("EC0Y", "EB0Z", "EA0Z", "EY0A", "EZ0A", "EB0A", "EC0A", "EX0C", "EY0C", "EA0C", "EB0C")
SIZE = {"X": 15.0, "Y": 15.0, "Z": 15.0, "A": 20.0, "B": 20.0, "C": 20.0}
"""Half width of what is believed of a location error, um or urad."""
RUN = np.repeat([0, 1], 6)
SIGMA, ZERO = 0.4e-6, 2e-6
FOURIER = 'family = "fourier"\ntable = "errors.csv"\n'
ROOM = ("design.places=true", "design.place_low_mm=[-150,-150,-80]",
        "design.place_high_mm=[150,150,40]")  # fmt: skip


def plan_of(folder, rows, nest="spindle", head=HEAD, open_=LOCATIONS, travel=None):
    """A study of that machine without readings: rows of run, a and c in deg, and how far the tool
    point is away from the sphere, m. No errors but location errors are believed in.
    """
    folder.mkdir(exist_ok=True)
    text = head + INSTRUMENT.format(nest=nest) + FOURIER
    (folder / "setup.toml").write_text(text, encoding="utf-8")
    table = []
    for run_, a, c, off in rows:
        x = positions(SPHERES[run_] + off, math.radians(a), math.radians(c), still)
        table.append([run_, *1e3 * x, a, c])
    names = ("run", "x_mm", "y_mm", "z_mm", "a_deg", "c_deg")
    write_csv(folder / "data.csv", dict(zip(names, np.transpose(table), strict=True)))
    motions = [f"E{c}{axis}" for axis in AXES for c in "XYZABC"]
    components = [*motions, *LOCATIONS]
    zero = [0.0] * len(components)
    family = {"component": components, "a0": [SIZE[n[1]] * (n in open_) for n in components]}
    others = dict.fromkeys(("a1", "n1", "b1", "c1", "n2", "b2", "c2"), zero)
    write_csv(folder / "errors.csv", family | others)
    return folder


def few(seed=0, off=0.0):
    """Six rows for each of two spheres, at angles close together."""
    rng = np.random.default_rng(seed)
    for run_ in range(2):
        for a, c in rng.uniform([-30.0, 20.0], [30.0, 160.0], (6, 2)).round(3):
            yield run_, a, c, off * rng.uniform(-1.0, 1.0, 3)


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    return plan_of(tmp_path_factory.mktemp("turned") / "given", few())


# --- the axes follow ------------------------------------------------------------------------------


@pytest.mark.campaign
def test_the_plan_as_it_is_is_where_the_search_starts(tmp_path):
    study, task = task_of(plan_of(tmp_path, few(1, off=0.5e-3)))
    space = task.space
    start = space.placed(jnp.asarray(space.start))
    np.testing.assert_allclose(start.position, study.plan.position, atol=1e-12)
    assert float(space.excess(start)) == 0.0
    # Elsewhere, the tool point is as far from the sphere as it was.
    placed = space.placed(jnp.asarray(space.scattered(jax.random.key(2))))
    before, after = (np.asarray(p.position) for p in (start, placed))
    points = [np.array([point(q, np.zeros((5, 6))) for q in rows]) for rows in (before, after)]
    np.testing.assert_allclose(points[1], points[0], atol=1e-12)
    assert np.ptp(after[:, 3] - before[:, 3]) > 0.1
    assert (np.abs(after[:, 3]) <= np.pi / 2).all() and (after[:, 4] >= 0.0).all()


@pytest.mark.parametrize(
    ("text", "apart"),
    [
        ("w C A b Y X Z t", ""),
        ("w b X Y Z C A t", ""),
        ("w C X b Y Z B t", ""),
        ("w b C X Y Z t", ""),
        ("w C X A b Y Z t", "A"),
        ("w b X B Y Z t", "B"),
    ],
)
@pytest.mark.thorough
def test_linear_axes_of_any_machine_follow_a_point(text, apart):
    at = {axis: (0.01, -0.02, 0.1 * i) for i, axis in enumerate("ABC") if axis in text}
    it = chain_from_string(text, None, (0.02, 0.01, -0.15), at)
    assert carried_apart(it) == apart
    if apart:
        return
    q, to = np.random.default_rng(5).uniform(-1.0, 1.0, (2, 4, len(it.axes)))
    found = np.asarray(followed(it, q, to[:, :3]))
    np.testing.assert_allclose(it.tool_point(found), to[:, :3], atol=1e-14)
    turning = [axis in "ABC" for axis in it.axes]
    np.testing.assert_array_equal(found[:, turning], q[:, turning])


@pytest.mark.thorough
def test_spheres_move_and_the_axes_with_them(turned):
    _, task = task_of(turned, *ROOM)
    space = task.space
    assert len(space.start) == 12 * 2 + 2 * 3
    placed = space.placed(jnp.asarray(space.scattered(jax.random.key(3))))
    places = np.asarray(placed.station).reshape(2, 3)
    assert np.abs(places - SPHERES).max() > 0.01
    for q, run_ in zip(np.asarray(placed.position), RUN, strict=True):
        np.testing.assert_allclose(point(q, np.zeros((5, 6))), places[run_], atol=1e-12)
    # What stands out of the travel is told as such.
    far = placed._replace(position=placed.position.at[4, 0].set(0.3125))
    assert float(space.excess(far)) == pytest.approx(0.0125)
    assert float(space.penalty(far)) > 1.1 > float(space.penalty(space.nominal)) == 1.0


# --- what a plan tells ----------------------------------------------------------------------------


def twists_of(q, values):
    """Location errors as errors of the axes (5, 6): ISO 230-1, written once more."""
    e, x = np.zeros((5, 6)), dict(zip(AXES, q, strict=True))
    for name, value in values.items():
        axis, about = name[3], name[1]
        if axis in "AC":
            e[AXES.index(axis), "XYZABC".index(about)] += value
        else:
            tilted = np.cross(np.eye(3)["ABC".index(about)], np.eye(3)["XYZ".index(axis)])
            e[AXES.index(axis), :3] += value * x[axis] * tilted
    return e


def expected_covariance(position, run_, places, nest):
    """Of the location errors in units of their prior, by finite differences of the matrices."""
    sigma = np.array([SIZE[name[1]] * 1e-6 / np.sqrt(3.0) for name in LOCATIONS])

    def readings(values):
        errors = dict(zip(LOCATIONS, values[:11] * sigma, strict=True))
        moved, zero = places + 1e-6 * values[11:17].reshape(2, 3), values[17:] * ZERO
        return np.concatenate(
            [
                seen(q, twists_of(q, errors), moved[k], zero, nest)
                for q, k in zip(position, run_, strict=True)
            ]
        )

    unit = np.eye(20)
    J = np.stack([(readings(u) - readings(-u)) / 2.0 / SIGMA for u in unit], 1)
    prior = np.diag(np.r_[np.ones(11), np.zeros(6), np.ones(3)])
    return np.linalg.inv(J.T @ J + prior)[:11, :11]


@pytest.mark.parametrize("nest", ["spindle", pytest.param("table", marks=pytest.mark.campaign)])
@pytest.mark.thorough
def test_the_covariance_by_plain_numpy(tmp_path, nest):
    study, task = task_of(plan_of(tmp_path, few(2), nest), *ROOM)
    space = task.space
    assert [e.parameter.name for e in task.families[0].model.entries] == list(LOCATIONS)
    compiled = Compiled(task)
    for placed in (space.nominal, space.placed(jnp.asarray(space.scattered(jax.random.key(4))))):
        (found,) = compiled.covariances(placed, jnp.ones(len(space.groups)))
        position = np.asarray(placed.position)
        places = np.asarray(placed.station).reshape(2, 3)
        expected = expected_covariance(position, RUN, places, nest)
        scale = np.sqrt(np.diag(expected))
        size = np.outer(scale, scale)
        np.testing.assert_allclose(found / size, expected / size, atol=1e-5)


@pytest.mark.parametrize(
    "goal",
    [
        "volume",
        pytest.param("largest", marks=pytest.mark.campaign),
        pytest.param("determinant", marks=pytest.mark.campaign),
    ],
)
@pytest.mark.thorough
def test_gradient_against_finite_differences(turned, goal):
    _, task = task_of(turned, f"design.goal={goal}", *ROOM)
    space, compiled = task.space, Compiled(task)
    z = np.clip(space.scattered(jax.random.key(1)), 0.05, 0.95)
    way = np.random.default_rng(6).standard_normal(len(z)) * 0.05
    slope, found = slopes(compiled.smooth, z, way)
    assert slope == pytest.approx(found, rel=1e-6)


# --- what is best ---------------------------------------------------------------------------------


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("turn", "seen_rows"), [(90, 0.5), pytest.param(360, 1.0, marks=pytest.mark.campaign)]
)
def test_where_an_axis_is_by_as_many_rows_on_either_side(tmp_path, turn, seen_rows):
    """On paper. With u = exp(i c), a row at the angle c reads u s + e + noise, e = EX0C + i EY0C,
    the place s unknown: of n rows the information on e is (n - |sum u|^2 / n) / sigma^2. An axis
    that turns by 90 deg does best with half of the rows at either end, where it is n / 2; one that
    turns all the way round with angles whose u add up to nothing, where it is n.
    """
    rows = [(0, 0.0, c, 0.0) for c in (5, 12, 23, 35, 48, 60, 75, 82)]
    head = HEAD.replace("travel_deg = [0, 360]", f"travel_deg = [0, {turn}]")
    folder = plan_of(tmp_path, rows, head=head, open_=("EX0C", "EY0C"))
    _, task = task_of(folder, "design.goal=largest", "instrument.zero_u_um=0")
    done = optimise(task, starts=3, steps=100)
    prior = (15e-6 / np.sqrt(3.0)) ** -2
    expected = 2e6 / np.sqrt(prior + seen_rows * len(rows) / SIGMA**2)
    assert done.after.criterion == pytest.approx(expected, rel=2e-4)
    assert done.before.criterion > 1.02 * expected
    c = np.rad2deg(np.asarray(done.best.position)[:, 4])
    if turn == 90:
        np.testing.assert_allclose(np.sort(c), [0.0] * 4 + [90.0] * 4, atol=0.5)
    else:
        assert abs(np.exp(1j * np.deg2rad(c)).mean()) < 0.02


# --- the folder -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def designed(turned, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "out"
    sets = [part for text in (*ROOM, "design.seconds_per_metre=2") for part in ("--set", text)]
    return out, design(turned, out, *sets)


@pytest.mark.campaign
def test_the_folder_is_a_study(designed, turned):
    out, printed = designed
    found = strict(out / "result.json")
    assert found["sentence"] in printed.output and found["group"] == "point"
    assert {"setup.toml", "plan.csv", "places.png", "angles.png"} <= set(found["files"])
    assert found["designed"]["criterion"] < 0.9 * found["nominal"]["criterion"]
    assert "can be used" in run("check", out).output
    study = vcal.load_study(out)
    before = vcal.load_study(turned)
    np.testing.assert_array_equal(study.plan.groups["run"], before.plan.groups["run"])
    # Angles of the plan take no way.
    way = np.linalg.norm(np.diff(np.asarray(study.plan.position)[:, :3], axis=0), axis=1).sum()
    assert found["designed"]["measuring_seconds"] == pytest.approx(120.0 + 2.0 * way, rel=1e-6)


@pytest.mark.thorough
def test_the_uncertainty_foretold_is_that_of_the_plan_written(designed):
    """By the GUM through the identification, which knows nothing of spaces."""
    out, _ = designed
    found = strict(out / "result.json")["designed"]["largest_U"]
    study = vcal.load_study(out)
    pair = virtual_pair(study.model, study.model, study.plan)
    quantities = [ParameterErrors(), ErrorMotionErrors(nodes=6)]
    budget = linearised(pair, [q.measure(pair) for q in quantities]).budget
    u = dict(zip(budget.labels, budget.u, strict=True))
    for name in LOCATIONS:
        unit = "um" if name[1] in "XYZ" else "urad"
        assert found[name] == pytest.approx(2.0 * u[f"geometric: {name} [{unit}]"], rel=1e-5), name
    for name in ("EXY", "EYA", "EAC"):
        largest = max(value for label, value in u.items() if label.startswith(f"{name} at"))
        assert found[name] == pytest.approx(2.0 * largest, rel=1e-5), name


@pytest.mark.campaign
def test_further_points_add_to_the_data(turned):
    """As one plan of all rows tells it, by the matrices."""
    study, task = task_of(turned)
    done = plan_next(task, 3, starts=1, steps=5)
    further = done.task.space.plan(done.best.placed)
    assert further.rows == 3 and set(np.asarray(further.groups["run"])) == {1}
    position = np.concatenate([study.plan.position, further.position])
    for q in np.asarray(further.position):
        np.testing.assert_allclose(point(q, np.zeros((5, 6))), SPHERES[1], atol=1e-9)
    run_ = np.r_[RUN, [1] * 3]
    expected = expected_covariance(position, run_, SPHERES, "spindle")
    i = [m.name for m in task.families[0].motions].index("EB0C")
    sigma = SIZE["B"] / np.sqrt(3.0)
    told = 2.0 * sigma * np.sqrt(expected[LOCATIONS.index("EB0C"), LOCATIONS.index("EB0C")])
    assert done.best.value.largest[i] == pytest.approx(told, rel=1e-4)
    assert done.best.value.criterion < done.before.criterion


@pytest.mark.campaign
def test_machines_are_found_as_much_better_as_was_foretold(designed, turned):
    """Thirty machines of plain matrices, measured by the plan as it is and as designed."""
    rng = np.random.default_rng(7)
    truths = [{n: 1e-6 * SIZE[n[1]] * rng.uniform(-1.0, 1.0) for n in LOCATIONS} for _ in range(30)]
    size = np.array([SIZE[n[1]] / np.sqrt(3.0) for n in LOCATIONS]) * 1e-6
    found, foretold = [], []
    for folder in (turned, designed[0]):
        study = vcal.load_study(folder)
        expected = covariance(study.model, study.plan)[:11, :11]
        foretold.append(np.sqrt(np.trace(expected) / 11))
        off = []
        for truth in truths:
            zero, noise = ZERO * rng.standard_normal(3), SIGMA * rng.standard_normal((12, 3))
            places = study.instrument.places + 20e-6 * rng.standard_normal((2, 3))
            readings = [
                seen(q, twists_of(q, truth), places[run_], zero, "spindle")
                for q, run_ in zip(np.asarray(study.plan.position), RUN, strict=True)
            ]
            fit = vcal.identify(study.model, vcal.Measurement(study.plan, readings + noise, ""))
            off.append(np.asarray(fit.theta)[:11] - np.array([truth[n] for n in LOCATIONS]) / size)
        found.append(np.sqrt(np.mean(np.square(off))))
    assert found == pytest.approx(foretold, rel=0.15)
    assert foretold[1] < 0.8 * foretold[0]
    assert found[1] / found[0] == pytest.approx(foretold[1] / foretold[0], rel=0.15)


@pytest.mark.campaign
def test_the_loop_on_data_of_the_designed_plan(designed, tmp_path):
    run("uncertainty", designed[0], "--out", tmp_path / "judged", "--draws", "50")
    run("simulate", designed[0], "--out", tmp_path / "made")
    run("loop", tmp_path / "made", "--out", tmp_path / "report")
    assert strict(tmp_path / "report" / "report.json")["verdict"] == "nothing_missing"


# --- mistakes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["design.places=true"], ["key design", "place_low_mm and place_high_mm; add both"]),
        (
            [*ROOM[:2], "design.place_high_mm=[150,-200,40]"],
            ["place_high_mm -200 in y", "exchange or correct them"],
        ),
        (["design.station=true"], ["design.station", "unknown"]),
        (['design.errors=["EX0B"]'], ["key design.errors.0", "did you mean 'EX0C'"]),
        (["design.must_see={EX0B=0}"], ["key design.must_see.EX0B"]),
        (
            ["machine.chain='w C X A b Y Z t'", "instrument.range_mm=900"],
            ["key design.points: found the rotary axis A between linear axes"],
        ),
    ],
)
@pytest.mark.thorough
def test_what_cannot_be_designed_is_one_message(turned, tmp_path, options, said):
    sets = [part for text in options for part in ("--set", text)]
    message = design(turned, tmp_path / "out", *sets, code=2).stderr
    assert all(part in message for part in said), message
    assert "Traceback" not in message and not (tmp_path / "out").exists()


@pytest.mark.campaign
def test_spheres_that_the_linear_axes_do_not_reach(turned, tmp_path):
    far = ("design.places=true", "design.place_low_mm=[900,900,900]",
           "design.place_high_mm=[950,950,950]")  # fmt: skip
    sets = [part for text in far for part in ("--set", text)]
    message = design(turned, tmp_path / "out", *sets, code=2).stderr
    assert "found no points within the travel from 2 starts" in message
    assert "design.place_low_mm" in message and "artefact" not in message
