"""Plans of a touch probe made better, against plain numpy matrices."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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
from test_design_static_r_test import FOURIER, LOCATIONS, SIZE, twists_of
from test_rotary import AXES, frame, point, positions
from test_static_r_test import HEAD
from test_touch_probe import GAUGE, RING, SPHERE, columns_of, line, write
from vcal.design.next_measurement import plan_next
from vcal.design.optimiser import Compiled, optimise
from vcal.study.design.written_plan import plan_table

pytestmark = pytest.mark.usefixtures("kept_programs")

SPHERES = np.array([[160.0, 0.0, -60.0], [-90.0, 130.0, 20.0]]) * 1e-3
SIGMA, STYLUS_U, RADIUS_U, RADIUS, STYLUS = 0.5e-6, 1e-6, 0.2e-6, 12.5e-3, 3e-3
INSTRUMENT = """
[instrument]
kind = "touch_probe"
artefact = "sphere"
diameter_mm = 25
diameter_u_um = 0.4
stylus_radius_mm = 3
stylus_u_um = 1.0
probe_sigma_um = 0.5
[model.geometric]
"""
ROOM = ("design.places=true", "design.place_low_mm=[-170,-150,-80]",
        "design.place_high_mm=[170,150,40]")  # fmt: skip
still = lambda q: np.zeros((5, 6))  # noqa: E731


def plan_of(folder, settings=((0, 20), (40, 70), (-30, 200)), open_=LOCATIONS, sides=6):
    """A study of the trunnion table of test_rotary.py: two spheres, touched at every setting of A
    and C from the sides and from above. No errors but location errors are believed in.
    """
    folder.mkdir(exist_ok=True)
    (folder / "setup.toml").write_text(HEAD + INSTRUMENT + FOURIER, encoding="utf-8")
    rows = []
    for setup, sphere in enumerate(SPHERES):
        for k, (a, c) in enumerate(settings):
            angles = math.radians(a), math.radians(c)
            centre = positions(sphere, *angles, still)
            for side in range(sides):
                t = 2.0 * np.pi * side / (sides - 1) + 0.3 * k
                out = np.array([np.cos(t), np.sin(t), 0.0]) if side < sides - 1 else np.eye(3)[2]
                q = centre + (RADIUS + STYLUS) * out
                rows.append([setup, *1e3 * q, a, c, 1 if k % 2 else -1])
    names = ("setup", "x_mm", "y_mm", "z_mm", "a_deg", "c_deg", "dir_c")
    write_csv(folder / "data.csv", dict(zip(names, np.transpose(rows), strict=True)))
    components = [*(f"E{c}{axis}" for axis in AXES for c in "XYZABC"), *LOCATIONS]
    zero = [0.0] * len(components)
    family = {"component": components, "a0": [SIZE[n[1]] * (n in open_) for n in components]}
    others = dict.fromkeys(("a1", "n1", "b1", "c1", "n2", "b2", "c2"), zero)
    write_csv(folder / "errors.csv", family | others)
    return folder


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    return plan_of(tmp_path_factory.mktemp("probe") / "given")


def somewhere(space, seed=1):
    return jax.jit(space.placed)(space.scattered(jax.random.key(seed)))


# --- the plans ------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_plan_as_it_is_is_where_the_search_starts(turned):
    study, task = task_of(turned, *ROOM)
    space = task.space
    start = jax.jit(space.placed)(space.start)
    np.testing.assert_allclose(start.position, study.plan.position, atol=1e-8)
    assert float(space.excess(start)) == 0.0 and space.groups == (0, 1)
    for name, values in study.plan.covariates.items():
        if name != "approach_rad":
            np.testing.assert_allclose(start.covariates[name], values, atol=1e-9, err_msg=name)
    level = np.arange(study.plan.rows) % 6 < 5  # at the pole there is no azimuth
    found, expected = (
        np.exp(1j * np.asarray(p.covariates["approach_rad"])[level]) for p in (start, study.plan)
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_contacts_are_on_the_sphere_and_above_its_equator(turned):
    """By the matrices; settings and directions stay together."""
    _, task = task_of(turned, *ROOM, "design.lowest_deg=20")
    space = task.space
    placed = somewhere(space, 3)
    position, places = np.asarray(placed.position), np.asarray(placed.place)
    assert np.abs(places - SPHERES).max() > 0.01
    assert (np.abs(position[:, 3]) <= np.pi / 2).all() and (position[:, 4] >= 0.0).all()
    lowest = 1.0
    for row, q in enumerate(position):
        t = frame(q, np.zeros((5, 6)))
        arm = point(q, np.zeros((5, 6))) - places[row // 18]
        assert np.linalg.norm(arm) == pytest.approx(RADIUS + STYLUS, abs=1e-10)
        out = t[:3, :3].T @ arm / (RADIUS + STYLUS)
        lowest = min(lowest, out[2])
        approach = float(np.asarray(placed.covariates["approach_rad"])[row])
        if out[2] < 0.99:
            assert np.exp(1j * approach) == pytest.approx(
                -complex(out[0], out[1]) / np.hypot(out[0], out[1]), abs=1e-8
            )
        np.testing.assert_array_equal(position[row, 3:], position[row // 6 * 6, 3:])
        # X, Y and Z carry the tool: they move against what the tip touches.
        for i, axis in enumerate("XYZ"):
            if abs(out[i]) > 0.051:
                assert float(placed.covariates[f"dir_{axis}"][row]) == -np.sign(out[i])
    assert lowest == pytest.approx(np.sin(np.deg2rad(20.0)), abs=1e-9)
    # What stands out of the travel is told as such.
    far = placed._replace(position=placed.position.at[4, 0].set(0.3125))
    assert float(space.excess(far)) >= 0.0125 - 1e-12 and float(space.penalty(far)) > 1.1


def test_a_written_plan_is_read_as_it_was_judged(turned):
    study, task = task_of(turned, *ROOM)
    placed = somewhere(task.space, 5)
    table = plan_table(study, task.space, placed)
    np.testing.assert_array_equal(table["dir_c"], np.repeat([-1, 1, -1] * 2, 6))
    assert "dir_x" not in table  # it follows from the approach
    write_csv(turned / "again.csv", table)
    again = vcal.load_study(turned, ["data.data=again.csv"])
    np.testing.assert_allclose(again.instrument.places, placed.place, atol=1e-9)
    for name in ("dir_X", "dir_Y", "dir_Z", "dir_C"):
        np.testing.assert_array_equal(again.plan.covariates[name], placed.covariates[name])


def test_a_ring_is_touched_around_its_axis(tmp_path):
    """About an axis along Y: the height of the contacts stays, and so does the ring."""
    angle = 2.0 * np.pi * np.arange(8) / 8
    out = np.column_stack([np.cos(angle), 0.0 * angle, np.sin(angle)])
    points = np.array([300.0, 250.0, 100.0]) + 22.0 * out
    points[:, 1] += 2.0 * (np.arange(8) % 2)
    folder = write(tmp_path, columns_of(points), f'{RING}\nring_axis = "Y"')
    study, task = task_of(folder)
    assert [b.start.shape for b in task.space.blocks.values()] == [(8,)]
    placed = somewhere(task.space)
    arm = np.asarray(placed.position) + [0.0, 0.0, -0.15] - study.instrument.places[0]
    np.testing.assert_allclose(np.hypot(arm[:, 0], arm[:, 2]), 0.022, atol=1e-9)
    np.testing.assert_allclose(np.ptp(arm[::2, 1]), 0.0, atol=1e-9)
    np.testing.assert_allclose(arm[1, 1] - arm[0, 1], 2e-3, atol=1e-9)
    way = np.asarray(placed.covariates["dir_X"])
    clear = np.abs(arm[:, 0]) > 0.06 * 0.022
    np.testing.assert_array_equal(way[clear], np.sign(arm[clear, 0]))


@pytest.fixture(scope="module")
def gauge(tmp_path_factory):
    points, more = line((1, 0, 0))
    across, side = line((0, 1, 0), start=(400.0, 150.0, 120.0))
    first = columns_of(points, 0, **more)
    second = columns_of(across, 1, **side)
    columns = {name: np.concatenate([first[name], second[name]]) for name in first}
    folder = tmp_path_factory.mktemp("gauge") / "given"
    write(folder, columns, GAUGE, faces=10.0 * np.arange(10))
    text = (folder / "setup.toml").read_text().partition('family = "smooth"')[0]
    text += 'family = "fourier"\ntable = "errors.csv"\n[data]\ndata = "data.csv"\n'
    (folder / "setup.toml").write_text(text, encoding="utf-8")
    table = {name: np.zeros(len(TABLE)) for name in TABLE_COLUMNS}
    for i, name in enumerate(TABLE):
        table["n1"][i], table["n2"][i] = 0.5, 3.0
        if name in GAUGED:
            table[GAUGED[name][0]][i] = GAUGED[name][1]
    write_csv(folder / "errors.csv", {"component": list(TABLE), **table})
    return folder


GAUGED = {"EXX": ("a1", 20.0), "EYY": ("a1", 20.0), "EZZ": ("a1", 20.0), "EC0Y": ("a0", 30.0),
          "EB0Z": ("a0", 30.0), "EA0Z": ("a0", 30.0), "EBX": ("b1", 10.0)}  # fmt: skip


def test_a_gauge_moves_and_turns(gauge):
    study, task = task_of(gauge, "design.places=true", "design.directions=true")
    space = task.space
    assert len(space.start) == 2 * 3 + 2 * 2  # without rotary axes, bounds are those of the travel
    start = jax.jit(space.placed)(space.start)
    np.testing.assert_allclose(start.position, study.plan.position, atol=1e-9)
    placed = somewhere(space, 2)
    points = np.asarray(placed.position) + [0.0, 0.0, -0.15]
    face, way = np.arange(10), np.where(np.arange(10) % 2 == 0, 1.0, -1.0)
    for k in range(2):
        d = np.asarray(placed.direction)[k]
        assert np.linalg.norm(d) == pytest.approx(1.0) and abs(d[k]) < 0.999
        at = points[10 * k : 10 * k + 10]
        along = 1e-2 * face - way * 3e-3
        np.testing.assert_allclose(at - at[0], (along - along[0])[:, None] * d, atol=1e-9)
        for i, axis in enumerate("XYZ"):
            if abs(d[i]) > 0.06:
                rows = np.asarray(placed.covariates[f"dir_{axis}"])[10 * k : 10 * k + 10]
                np.testing.assert_array_equal(rows, way * np.sign(d[i]))


# --- what a plan tells ----------------------------------------------------------------------------


def expected_covariance(position, setup, places):
    """Of the location errors in units of their prior, by finite differences of the matrices."""
    sigma = np.array([SIZE[name[1]] * 1e-6 / np.sqrt(3.0) for name in LOCATIONS])
    count = len(places)

    def readings(values):
        errors = dict(zip(LOCATIONS, values[:11] * sigma, strict=True))
        moved = places + 1e-6 * values[11 : 11 + 3 * count].reshape(count, 3)
        size = STYLUS_U * values[-2] + RADIUS_U * values[-1]
        return np.array([
            np.linalg.norm(point(q, twists_of(q, errors)) - moved[k]) - size
            for q, k in zip(position, setup, strict=True)
        ])  # fmt: skip

    unit = np.eye(13 + 3 * count)
    J = np.stack([(readings(u) - readings(-u)) / 2.0 / SIGMA for u in unit], 1)
    prior = np.diag(np.r_[np.ones(11), np.zeros(3 * count), np.ones(2)])
    return np.linalg.inv(J.T @ J + prior)[:11, :11]


def assert_close(found, expected, atol=2e-5):
    scale = np.sqrt(np.diag(expected))
    size = np.outer(scale, scale)
    np.testing.assert_allclose(found / size, expected / size, atol=atol)


@pytest.mark.thorough
def test_the_covariance_by_plain_numpy(turned):
    _, task = task_of(turned, *ROOM)
    space, compiled = task.space, Compiled(task)
    assert [e.parameter.name for e in task.families[0].model.entries] == list(LOCATIONS)
    for placed in (space.nominal, somewhere(space, 4)):
        for weights in ([1.0, 1.0], [0.0, 1.0]):
            (found,) = compiled.covariances(placed, jnp.asarray(weights))
            rows = np.flatnonzero(np.array(weights)[space.setup])
            kept, setup = np.unique(space.setup[rows], return_inverse=True)
            position, places = np.asarray(placed.position)[rows], np.asarray(placed.place)[kept]
            expected = expected_covariance(position, setup, places)
            assert_close(np.asarray(found), expected)


@pytest.mark.thorough
def test_the_covariance_of_a_gauge_by_plain_numpy(gauge):
    _, task = task_of(gauge, "design.places=true", "design.directions=true")
    space, compiled = task.space, Compiled(task)
    machine = nominal_machine("w X b Y Z t", (0.6, 0.5, 0.45), (0.0, 0.0, -0.15))
    names = [e.parameter.name.split(".")[0] for e in task.families[0].model.entries]
    size = np.array([width * 1e-6 / np.sqrt(3.0) for _, width in GAUGED.values()])
    way, k = np.where(np.arange(20) % 2 == 0, 1.0, -1.0), len(GAUGED)
    for placed in (space.nominal, somewhere(space, 6)):
        q, d0, place = (np.asarray(v) for v in (placed.position, placed.direction, placed.place))

        def readings(values, q=q, d0=d0, place=place):
            rows = {}
            for (name, (column, _)), value in zip(GAUGED.items(), values[:k] * size, strict=True):
                row = np.zeros(8)
                row[[2, 5]] = 0.5, 3.0
                row[TABLE_COLUMNS.index(column)] = value
                rows[name] = row
            it = with_errors(machine, rows)
            own = values[k : k + 12].reshape(2, 6) * 1e-6
            d = Rotation.from_rotvec(own[:, 3:]).apply(np.array(d0))
            off = compose(it, q, *error_motions(it, q)) - np.repeat(place + own[:, :3], 10, 0)
            far = (off * np.repeat(d, 10, 0)).sum(1)
            faces = 0.3e-6 * values[k + 13 :]
            return -way * (far - np.tile(faces, 2)) - 1e-6 * values[k + 12]

        unit = np.eye(k + 13 + 10)
        J = np.stack([(readings(u) - readings(-u)) / 2.0 / SIGMA for u in unit], 1)
        H = J.T @ J + np.diag(np.r_[np.ones(k), np.zeros(12), np.ones(11)])
        # The gauge across its line and its roll are not seen, and no error needs them.
        rest = np.linalg.pinv(H[k:, k:], 1e-12)
        expected = np.linalg.inv(H[:k, :k] - H[:k, k:] @ rest @ H[k:, :k])
        (found,) = compiled.covariances(placed, jnp.ones(2))
        rows = [names.index(name) for name in GAUGED]
        assert_close(np.asarray(found)[np.ix_(rows, rows)], expected)


@pytest.mark.parametrize(
    "goal",
    [
        pytest.param("determinant", marks=pytest.mark.thorough),
        pytest.param("volume", marks=pytest.mark.campaign),
    ],
)
def test_gradient_against_finite_differences(turned, goal):
    _, task = task_of(turned, f"design.goal={goal}", *ROOM)
    space, compiled = task.space, Compiled(task)
    drawn, width = space.scattered(jax.random.key(1)), space.high - space.low
    z = np.clip(drawn, space.low + 0.05 * width, space.high - 0.05 * width)
    way = np.random.default_rng(6).standard_normal(len(z)) * 0.03 * width
    slope, found = slopes(compiled.smooth, z, way)
    assert slope == pytest.approx(found, rel=1e-6) and slope != 0.0


# --- what is best ---------------------------------------------------------------------------------


@pytest.mark.campaign
def test_where_a_turning_axis_is_by_settings_on_all_sides(tmp_path):
    """On paper. Contacts at one setting place the sphere with the information h in every direction
    across C. With u = exp(i c), m settings at the angles c hold (m - |sum u|^2 / m) h of EX0C and
    EY0C, the sphere unknown: most where the u add up to nothing.
    """
    folder = plan_of(tmp_path / "one", ((0, 5), (0, 20), (0, 45), (0, 80)), ("EX0C", "EY0C"))
    _, task = task_of(folder, "design.goal=largest", "design.contacts=false")
    done = optimise(task, starts=3, steps=60)
    c = np.asarray(done.best.position)[:, 4].reshape(2, 4, 6)[:, :, 0]
    assert np.abs(np.exp(1j * c).mean(1)).max() < 0.15
    # Five contacts around a sphere place its centre with 5 / 2 sigma^2 in either direction.
    prior = (15e-6 / np.sqrt(3.0)) ** -2
    expected = 2e6 / np.sqrt(prior + 2 * 4 * 2.5 / SIGMA**2)
    assert done.after.criterion == pytest.approx(expected, rel=2e-2)
    assert done.before.criterion > 1.3 * done.after.criterion


@pytest.mark.thorough
def test_a_design_is_no_worse_than_its_start(turned):
    _, task = task_of(turned, *ROOM)
    done = optimise(task, seed=0, starts=1, steps=4)
    assert done.after.criterion < 0.97 * done.before.criterion and all(done.fits)


@pytest.mark.thorough
def test_the_folder_is_a_study(turned, tmp_path):
    sets = ("--set", "design.seconds_per_setup=300", "--set", "design.seconds_per_contact=4")
    small = ("design.grid=[4,3,3]", "design.starts=1", "design.steps=3")
    printed = design(turned, tmp_path / "out", *sets, small=small)
    found = strict(tmp_path / "out" / "result.json")
    assert found["sentence"] in printed.output and found["group"] == "setup"
    assert {"plan.csv", "places.png", "angles.png"} <= set(found["files"])
    assert found["designed"]["criterion"] < found["nominal"]["criterion"]
    assert found["designed"]["measuring_seconds"] == pytest.approx(2 * 300 + 36 * 4)
    assert "can be used" in run("check", tmp_path / "out").output


@pytest.mark.campaign
def test_a_further_setup_adds_to_the_data(turned):
    study, task = task_of(turned, *ROOM)
    done = plan_next(task, 1, starts=1, steps=3)
    placed = done.best.placed
    further = done.task.space.plan(placed)
    assert set(np.asarray(further.groups["setup"])) == {2} and further.rows == 18
    position = np.concatenate([study.plan.position, further.position])
    setup = np.concatenate([np.repeat([0, 1], 18), np.full(18, 2)])
    places = np.concatenate([SPHERES, np.asarray(placed.place)])
    expected = expected_covariance(position, setup, places)
    i = [m.name for m in task.families[0].motions].index("EB0C")
    at = LOCATIONS.index("EB0C")
    told = 2.0 * SIZE["B"] / np.sqrt(3.0) * np.sqrt(expected[at, at])
    assert done.best.value.largest[i] == pytest.approx(told, rel=1e-4)
    assert done.best.value.criterion < done.before.criterion


# --- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["design.places=true"],
            ["key design.places", "place_low_mm and place_high_mm", "add both"],
        ),
        (["design.place_low_mm=[0,0,0]"], ["place_low_mm and place_high_mm; add both"]),
        (
            [*ROOM[:2], "design.place_high_mm=[150,-200,40]"],
            ["place_high_mm -200 in y", "exchange or correct them"],
        ),
        (["design.lowest_deg=95"], ["key design.lowest_deg"]),
        (
            ["design.contacts=false", "design.angles=false"],
            ["key design.places", "nothing may change"],
        ),
        (["design.points=true"], ["design.points", "unknown"]),
        (['design.errors=["EX0B"]'], ["key design.errors.0", "did you mean 'EX0C'"]),
    ],
)
def test_what_cannot_be_designed_is_one_message(turned, tmp_path, options, said):
    sets = [part for text in options for part in ("--set", text)]
    message = design(turned, tmp_path / "out", *sets, code=2).stderr
    assert all(part in message for part in said), message
    assert "Traceback" not in message and not (tmp_path / "out").exists()


def test_a_gauge_that_may_not_move_is_one_message(gauge, tmp_path):
    message = design(gauge, tmp_path / "out", code=2).stderr
    assert "key design.places: found a plan of which nothing may change" in message


def test_a_sphere_of_a_machine_without_rotary_axes(tmp_path):
    """Its contacts and its places may change, within the travel by default."""
    from test_touch_probe import around

    folder = write(tmp_path / "linear", columns_of(around()[0]), SPHERE)
    _, task = task_of(folder, "design.places=true")
    assert [*task.space.blocks] == ["places", "azimuths", "elevations"]
    assert task.space.room == pytest.approx(np.array([[0, 0.6], [0, 0.5], [-0.15, 0.3]]))
