"""Plans of a double ball bar made better, against plain numpy and what is known on paper."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vcal
from conftest import write_csv
from designing import design, run, slopes, strict, task_of
from oracle.kinematics import (
    TABLE,
    TABLE_COLUMNS,
    compose,
    error_motions,
    nominal_machine,
    with_errors,
)
from vcal.design.next_measurement import plan_next
from vcal.design.optimiser import Compiled, optimise
from vcal.study.design.written_plan import plan_table

pytestmark = pytest.mark.usefixtures("kept_programs")

CHAIN, TRAVEL, TOOL = "w X b Y Z t", (0.6, 0.5, 0.45), (0.0, 0.0, -0.15)
SIGMA, LENGTH_U = 0.3e-6, 0.5e-6
OPEN = {
    **{f"E{a}{a}": ("a1", 20.0) for a in "XYZ"},
    **{"EYX": ("b1", 10.0), "EBX": ("a1", 15.0), "EAY": ("a1", 15.0)},
    **{name: ("a0", 30.0) for name in ("EC0Y", "EB0Z", "EA0Z")},
}
"""Errors that are believed in: one coefficient each, half its width in um or urad."""
FREE = (
    'design.planes=["XY","YZ","ZX"]',
    "design.lengths_mm=[100,150]",
    "design.arcs=true",
    "design.senses=true",
)
SETUP = """
[machine]
chain = "w X b Y Z t"
tool_offset_mm = [0, 0, -150]
travel_mm = { X = [0, 600], Y = [0, 500], Z = [0, 450] }
[instrument]
kind = "double_ball_bar"
length_mm = 150
sigma_um = 0.3
length_u_um = 0.5
[model.geometric]
family = "fourier"
table = "errors.csv"
[data]
data = "data.csv"
"""
ARCS = (("XY", 0.0, 360.0), ("YZ", -20.0, 200.0), ("ZX", -110.0, 110.0))
CENTRES = ((300.0, 250.0, 225.0, 150.0), (420.0, 180.0, 150.0, 100.0))
"""Positions of the axes at the ball, and the length of the bar, mm."""


def points_of(plane, angles, centre, length):
    place = np.tile(centre, (len(angles), 1))
    place[:, "XYZ".index(plane[0])] += length * np.cos(angles)
    place[:, "XYZ".index(plane[1])] += length * np.sin(angles)
    return place


def plan_of(folder, arcs=ARCS, centres=CENTRES, open_=OPEN, points=12, senses=(1, -1), text=SETUP):
    """A study without readings: all arcs about every ball."""
    folder.mkdir(exist_ok=True)
    found: dict[str, list] = {n: [] for n in ("run", "setup", "length_mm", "feed_mm_min")}
    places, number = [], 0
    for setup, (*centre, length) in enumerate(centres):
        for plane, low, high in arcs:
            angles = np.deg2rad(low + (high - low) * (np.arange(points) + 0.5) / points)
            for sense in senses:
                places.append(points_of(plane, angles[::sense], centre, length))
                for name, value in zip(
                    found, (number, setup, length, 1000.0 + 3000.0 * setup), strict=True
                ):
                    found[name] += [value] * points
                number += 1
    columns = {name: np.array(values) for name, values in found.items()}
    position = np.concatenate(places)
    write_csv(
        folder / "data.csv", columns | {f"{c}_mm": position[:, i] for i, c in enumerate("xyz")}
    )
    table = {name: np.zeros(len(TABLE)) for name in TABLE_COLUMNS}
    for i, name in enumerate(TABLE):
        table["n1"][i], table["n2"][i] = 0.5, 3.0
        if name in open_:
            table[open_[name][0]][i] = open_[name][1]
    write_csv(folder / "errors.csv", {"component": list(TABLE), **table})
    (folder / "setup.toml").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    return plan_of(tmp_path_factory.mktemp("bar") / "given")


def somewhere(space, seed=1):
    return space.placed(jnp.asarray(space.scattered(jax.random.key(seed))))


# --- the plans ------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [pytest.param((), marks=pytest.mark.campaign), FREE])
def test_the_plan_as_it_is_is_where_the_search_starts(planned, options):
    study, task = task_of(planned, *options)
    space = task.space
    start = space.placed(jnp.asarray(space.start))
    np.testing.assert_allclose(start.position, study.plan.position, atol=1e-9)
    assert float(space.excess(start)) == 0.0
    for name, values in study.plan.covariates.items():
        np.testing.assert_allclose(start.covariates[name], values, atol=1e-9, err_msg=name)
    assert space.groups == (0, 1) and space.group == "setup"


def test_rows_are_on_circles_inside_the_travel(planned):
    study, task = task_of(planned, *FREE)
    planes, lengths = set(), set()
    at = jax.jit(task.space.placed)
    for seed in range(12):
        placed = at(task.space.scattered(jax.random.key(seed)))
        plan, device = task.space.plan(placed), task.space.instrument(placed)
        points = np.asarray(plan.position) + TOOL
        lengths |= set(np.asarray(plan.groups["bar"]).tolist())
        for number in range(12):
            mine = np.asarray(plan.groups["run"]) == number
            ball = device.centres[int(np.asarray(plan.groups["setup"])[mine][0])]
            length = 1e-3 * device.lengths_mm[int(np.asarray(plan.groups["bar"])[mine][0])]
            arm = points[mine] - ball
            np.testing.assert_allclose(np.linalg.norm(arm, axis=1), length, atol=1e-9)
            across = int(np.argmin(np.ptp(arm, axis=0)))
            assert np.abs(arm[:, across]).max() < 1e-9
            planes.add(across)
            # The whole arc lies inside, and not only its rows.
            first, second = [(1, 2), (2, 0), (0, 1)][across]
            angle = np.unwrap(np.arctan2(arm[:, second], arm[:, first]))
            low, high = np.rad2deg(np.sort(angle[[0, -1]]))
            limits = {2: (0, 360), 0: (-20, 200), 1: (-110, 110)}[across]
            turn = 360.0 * np.round((np.mean(limits) - 0.5 * (low + high)) / 360.0)
            assert limits[0] - 1e-9 <= low + turn and high + turn <= limits[1] + 1e-9
            assert high - low > 180.0 - 1e-9
            every = np.linspace(angle[0], angle[-1], 500)
            whole = np.zeros((500, 3)) + ball - TOOL
            whole[:, first] += length * np.cos(every)
            whole[:, second] += length * np.sin(every)
            assert whole.min() > -1e-9 and (whole < np.array(TRAVEL) + 1e-9).all()
    assert planes == {0, 1, 2} and lengths == {0, 1}


def test_a_written_plan_is_read_as_it_was_judged(planned, tmp_path):
    """Directions, distances since a reversal and velocities, from the table by the instrument."""
    study, task = task_of(planned, *FREE)
    for seed in range(3):
        placed = somewhere(task.space, seed)
        table = plan_table(study, task.space, placed)
        assert {"length_mm", "feed_mm_min", "setup"} <= set(table)
        write_csv(planned / "again.csv", table)
        again = vcal.load_study(planned, ["data.data=again.csv"])
        np.testing.assert_allclose(again.plan.position, placed.position, atol=1e-9)
        np.testing.assert_allclose(again.instrument.centres, placed.place, atol=1e-9)
        for name, values in again.plan.covariates.items():
            np.testing.assert_allclose(placed.covariates[name], values, atol=1e-7, err_msg=name)
            np.testing.assert_allclose(task.space.plan(placed).covariates[name], values, atol=1e-7)


@pytest.mark.campaign
def test_a_cone_keeps_its_latitude(tmp_path):
    """A circle smaller than the bar is long, about a ball that lies below it."""
    folder = plan_of(tmp_path / "cone", arcs=ARCS[:1], senses=(1,))
    table = {k: v.copy() for k, v in np.load(_columns(folder)).items()}
    up = np.deg2rad(20.0)
    for setup, (x, y, z, length) in enumerate(CENTRES):
        mine = table["setup"] == setup
        for i, (name, centre) in enumerate(zip(("x_mm", "y_mm", "z_mm"), (x, y, z), strict=True)):
            shift = length * np.sin(up) if i == 2 else 0.0
            table[name][mine] = centre + np.cos(up) * (table[name][mine] - centre) + shift
            table[f"ball_{name}"] = table.get(f"ball_{name}", np.zeros(len(mine)))
            table[f"ball_{name}"][mine] = centre + 1e3 * TOOL[i]
    write_csv(folder / "data.csv", table)
    study, task = task_of(folder, "design.lengths_mm=[100,150]")
    start = task.space.placed(jnp.asarray(task.space.start))
    np.testing.assert_allclose(start.position, study.plan.position, atol=1e-9)
    placed = somewhere(task.space, 4)
    arm = np.asarray(placed.position) + TOOL - np.asarray(placed.place)[task.space.setup]
    length = task.space.lengths[np.asarray(placed.bar)]
    np.testing.assert_allclose(arm[:, 2], length * np.sin(up), atol=1e-9)
    assert {"ball_x_mm", "ball_z_mm"} <= set(plan_table(study, task.space, placed))


def _columns(folder):
    path = folder / "columns.npz"
    header, *rows = (folder / "data.csv").read_text().splitlines()
    values = np.array([[float(v) for v in row.split(",")] for row in rows]).T
    np.savez(path, **dict(zip(header.split(","), values, strict=True)))
    return path


def test_directions_of_axes_at_rest_are_kept(planned):
    """They do not follow from the positions: `dir_z` of a circle in XY."""
    table = dict(np.load(_columns(planned)))
    way = np.where(table["run"] % 2 == 0, 1.0, -1.0)
    for axis in "xyz":
        here = np.array([np.ptp(table[f"{axis}_mm"][table["run"] == k]) > 0 for k in range(12)])
        table[f"dir_{axis}"] = np.where(here[table["run"].astype(int)], 0.0, way)
    moving = vcal.load_study(planned).plan
    for axis in "XYZ":
        column = table[f"dir_{axis.lower()}"]
        column += np.where(column == 0.0, np.asarray(moving.covariate(f"dir_{axis}")), 0.0)
    write_csv(planned / "rest.csv", table)
    study, task = task_of(planned, "data.data=rest.csv")
    space, placed = task.space, somewhere(task.space)
    for name in ("dir_X", "dir_Y", "dir_Z"):
        for values in (space.plan(placed).covariates[name], placed.covariates[name]):
            np.testing.assert_array_equal(values, study.plan.covariate(name))
    assert "dir_z" in plan_table(study, space, placed)


# --- what a plan tells ----------------------------------------------------------------------------


def expected_covariance(plan, centres, lengths, flat):
    """Of the errors in units of their prior, by finite differences of the oracle's kinematics."""
    machine = nominal_machine(CHAIN, TRAVEL, TOOL)
    q, setup = np.asarray(plan.position), np.asarray(plan.groups["setup"])
    bar, count = np.asarray(plan.groups["bar"]), len(centres)
    size = np.array([width * 1e-6 / np.sqrt(3.0) for _, width in OPEN.values()])

    def readings(values):
        rows = {}
        for (name, (column, _)), value in zip(
            OPEN.items(), values[: len(OPEN)] * size, strict=True
        ):
            row = np.zeros(8)
            row[[2, 5]] = 0.5, 3.0
            row[TABLE_COLUMNS.index(column)] = value
            rows[name] = row
        it = with_errors(machine, rows)
        rest = values[len(OPEN) :] * 1e-6
        ball = centres + rest[: 3 * count].reshape(count, 3)
        longer = rest[3 * count :]
        off = longer[setup] if flat else longer[bar] * LENGTH_U / 1e-6
        tool = compose(it, q, *error_motions(it, q))
        return np.linalg.norm(tool - ball[setup], axis=1) - off

    unknown = len(OPEN) + 3 * count + (count if flat else len(lengths))
    J = np.stack([(readings(u) - readings(-u)) / 2.0 / SIGMA for u in np.eye(unknown)], 1)
    prior = np.zeros(unknown)
    prior[: len(OPEN)] = 1.0
    if not flat:
        prior[len(OPEN) + 3 * count :] = 1.0
    # Rank-deficient where a set-up does not show a coordinate of the ball, which no error needs.
    H = J.T @ J + np.diag(prior)
    k = len(OPEN)
    return np.linalg.inv(H[:k, :k] - H[:k, k:] @ np.linalg.pinv(H[k:, k:], 1e-12) @ H[k:, :k])


@pytest.mark.parametrize("flat", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_the_covariance_by_plain_numpy(planned, flat):
    text = SETUP.replace("length_u_um = 0.5\n", "") if flat else SETUP
    (planned / "setup.toml").write_text(text, encoding="utf-8")
    _, task = task_of(planned, *FREE)
    space, compiled = task.space, Compiled(task)
    order = [m.name for m in task.families[0].motions]
    assert set(OPEN) <= set(order)
    for placed in (space.nominal, somewhere(space, 3)):
        plan = space.plan(placed)
        for weights in ([1.0, 1.0], [1.0, 0.0]):
            (found,) = compiled.covariances(placed, jnp.asarray(weights))
            kept = np.flatnonzero(np.array(weights)[np.asarray(plan.groups["setup"])])
            expected = expected_covariance(
                plan.take(kept), np.asarray(placed.place), space.lengths, flat
            )
            names = [e.parameter.name.split(".")[0] for e in task.families[0].model.entries]
            rows = [names.index(name) for name in OPEN]
            found = np.asarray(found)[np.ix_(rows, rows)]
            scale = np.sqrt(np.diag(expected))
            np.testing.assert_allclose(
                found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=2e-5
            )
    (planned / "setup.toml").write_text(SETUP, encoding="utf-8")


@pytest.mark.parametrize(
    "goal",
    [
        pytest.param("determinant", marks=pytest.mark.thorough),
        pytest.param("volume", marks=pytest.mark.campaign),
    ],
)
def test_gradient_against_finite_differences(planned, goal):
    _, task = task_of(planned, *FREE, f"design.goal={goal}")
    space, compiled = task.space, Compiled(task)
    smooth = space.levels == 0
    z = np.where(smooth, np.clip(space.scattered(jax.random.key(1)), 0.05, 0.95), space.start)
    way = np.random.default_rng(6).standard_normal(len(z)) * 0.05 * smooth
    slope, found = slopes(compiled.smooth, z, way)
    assert slope == pytest.approx(found, rel=1e-6) and slope != 0.0
    # Choices have no slope: they are exchanged.
    assert (np.asarray(jax.grad(compiled.smooth)(jnp.asarray(z)))[~smooth] == 0.0).all()


# --- what is best ---------------------------------------------------------------------------------


@pytest.mark.campaign
def test_the_plane_and_the_bar_that_show_a_squareness(tmp_path):
    """On paper: on whole circles in YZ the squareness e of Z to Y reads L e sin(2t) / 2, at right
    angles to the unknown centre and the length, so that n rows hold n L^2 / 8 sigma^2 of it;
    circles in other planes hold nothing.
    """
    folder = plan_of(
        tmp_path / "square", ARCS[:1], CENTRES[1:], {"EA0Z": ("a0", 30.0)}, senses=(1,)
    )
    _, task = task_of(folder, "design.goal=largest", *FREE[:2], "design.arcs_deg={ YZ = [0, 360] }")
    done = optimise(task, starts=1, steps=5)
    prior = (30e-6 / np.sqrt(3.0)) ** -2
    expected = 2e6 / np.sqrt(prior + 12 * 0.15**2 / (8.0 * SIGMA**2))
    assert done.after.criterion == pytest.approx(expected, rel=1e-6)
    assert done.before.criterion == pytest.approx(2e6 / np.sqrt(prior), rel=1e-6)
    assert np.ptp(np.asarray(done.best.position)[:, 0]) < 1e-12


@pytest.mark.thorough
def test_a_design_is_no_worse_than_its_start(planned):
    _, task = task_of(planned, *FREE)
    done = optimise(task, seed=0, starts=1, steps=3)
    assert done.after.criterion <= done.before.criterion and all(done.fits)


# --- the folder -----------------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_folder_is_a_study(planned, tmp_path):
    small = ("design.grid=[4,3,3]", "design.starts=1", "design.steps=2")
    sets = [part for text in FREE[:2] for part in ("--set", text)]
    printed = design(planned, tmp_path / "out", *sets, "--set", "design.seconds_per_setup=300",
                     small=small)  # fmt: skip
    found = strict(tmp_path / "out" / "result.json")
    assert found["sentence"] in printed.output and found["group"] == "setup"
    assert found["designed"]["criterion"] <= found["nominal"]["criterion"]
    assert found["designed"]["measuring_seconds"] == pytest.approx(2 * 300 + 12 * 60)
    assert "can be used" in run("check", tmp_path / "out").output


@pytest.mark.campaign
def test_a_further_setup_adds_to_the_data(planned):
    """As one plan of all rows tells it."""
    study, task = task_of(planned, *FREE)
    done = plan_next(task, 1, starts=1, steps=2)
    space, placed = done.task.space, done.best.placed
    further, before = space.plan(placed), task.space.plan(task.space.nominal)
    assert set(np.asarray(further.groups["setup"])) == {2} and space.group == "setup"
    assert set(np.asarray(further.groups["run"])) == set(range(12, 18))
    assert (np.asarray(further.covariate("feed_mm_min")) == 4000.0).all()
    both = vcal.Plan(
        before.axes,
        np.concatenate([before.position, further.position]),
        {},
        {n: np.concatenate([before.groups[n], further.groups[n]]) for n in ("setup", "bar")},
    )
    centres = np.concatenate([study.instrument.centres, np.asarray(placed.place)])
    expected = expected_covariance(both, centres, space.lengths, False)
    i = [m.name for m in task.families[0].motions].index("EA0Z")
    told = 2.0 * 30.0 / np.sqrt(3.0) * np.sqrt(expected[-1, -1])
    assert list(OPEN)[-1] == "EA0Z"
    assert done.best.value.largest[i] == pytest.approx(told, rel=1e-4)
    assert done.best.value.criterion < done.before.criterion


# --- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (['design.planes=["XY"]'], ["key design.planes", "XY, and run 2 in YZ", "add it"]),
        (["design.lengths_mm=[150]"], ["key design.lengths_mm", "with 100 mm"]),
        (["design.centre_low_mm=[0,0,0]"], ["centre_low_mm and centre_high_mm; add both"]),
        (
            ["design.arcs_deg={ YZ = [0, 90] }"],
            ["largest arc 0 to 90 deg in YZ", "shortest_arc_deg = 180"],
        ),
        (["design.places=true"], ["design.places", "unknown"]),
        (["design.planes=['YX']"], ["key design.planes.0"]),
    ],
)
def test_what_cannot_be_designed_is_one_message(planned, tmp_path, options, said):
    sets = [part for text in options for part in ("--set", text)]
    message = design(planned, tmp_path / "out", *sets, code=2).stderr
    assert all(part in message for part in said), message
    assert "Traceback" not in message and not (tmp_path / "out").exists()


def test_a_path_that_is_no_circle_is_one_message(tmp_path):
    folder = plan_of(tmp_path / "tilted", arcs=ARCS[:1], senses=(1,))
    table = dict(np.load(_columns(folder)))
    mine = table["run"] == 0
    y = table["y_mm"][mine] - 250.0
    table["y_mm"][mine], table["z_mm"][mine] = 250.0 + 0.8 * y, 225.0 + 0.6 * y
    write_csv(folder / "data.csv", table)
    message = design(folder, tmp_path / "out", code=2).stderr
    assert "key design.centres: found run 0, which is no arc" in message


@pytest.mark.campaign
def test_bars_that_do_not_fit(planned, tmp_path):
    sets = ["--set", "design.centre_low_mm=[0,0,-150]", "--set", "design.centre_high_mm=[50,50,0]"]
    message = design(planned, tmp_path / "out", *sets, code=2).stderr
    assert "found no setups within the travel" in message and "design.lengths_mm" in message
