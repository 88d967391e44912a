"""A sphere that stays with the table while rotary axes turn, against plain numpy matrices."""

import csv
import dataclasses
import math
from functools import partial

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vcal
from test_rotary import BALLS, SETUP, TOOL, errors_of, frame, point, positions
from vcal.errors import StudyError
from vcal.identification.batch import identify_alone, identify_one, prepare_batch
from vcal.instruments.follow import cause, followed
from vcal.machine.chain import chain_from_string
from vcal.model.forward import Model
from vcal.model.simulate import simulate
from vcal.numerics.rigid import Vector

PROBES = np.array([[0.8, 0.0, 0.6], [-0.4, 0.69, 0.6], [-0.4, -0.69, 0.6]])
INSTRUMENT = """
[instrument]
kind = "static_r_test"
nest = "{nest}"
external_sigma_um = 0.4
zero_u_um = 2
[model.geometric]
"""
HEAD = SETUP.partition("[instrument]")[0]
FAMILY = SETUP.partition("[model.geometric]")[2]
AS_READ = ("p1_mm", "p2_mm", "p3_mm")
AS_PROBES = ["instrument.probes=[[0.8, 0.0, 0.6], [-0.4, 0.69, 0.6], [-0.4, -0.69, 0.6]]"]
COORDINATES = ("x_ext_mm", "y_ext_mm", "z_ext_mm")
still = lambda q: np.zeros((5, 6))  # noqa: E731


def seen(q, twists, sphere, zero, nest):
    """Where the nest sees the sphere; `sphere` in the workpiece frame, or the nest where it is on
    the table, `zero` what is in the spindle beside the tool point.
    """
    t = frame(q, twists)
    above = t[:3, 3] + t[:3, :3] @ (np.array(TOOL) + zero)
    return t[:3, :3].T @ (sphere - above) if nest == "spindle" else above - sphere


def poses(runs):
    """Angles of the table, come to from both sides, and the run."""
    for run in range(runs):
        for a in (-60, -20, 20, 60):
            yield from ((run, a, c, 1) for c in range(0, 360, 30))
            yield from ((run, a, c, -1) for c in range(345, -1, -30))


def write(
    folder,
    seed,
    errors,
    nest="spindle",
    runs=2,
    read=np.copy,
    names=COORDINATES,
    off=20e-6,
    slip=lambda t: 0.0,
):
    """A study of that machine: readings where the axes follow spheres as commanded. Its errors are
    `errors` of a pose and the way that C went.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(exist_ok=True)
    (folder / "setup.toml").write_text(HEAD + INSTRUMENT.format(nest=nest) + FAMILY)
    places = [BALLS[1 + k] + rng.normal(0.0, off, 3) for k in range(runs)]
    zero, rows = rng.normal(0.0, 2e-6, 3), []
    for run, a, c, way in poses(runs):
        angles = math.radians(a), math.radians(c)
        q = np.round([*positions(BALLS[1 + run], *angles, still), *angles], 9)
        place = places[run] + slip(20 * len(rows))
        p = seen(q, errors(q, way), place, zero, nest) + 0.4e-6 * rng.standard_normal(3)
        rows.append([20 * len(rows), run, *1e3 * q[:3], a, c, way, *1e3 * read(p)])
    save(folder / "data.csv", ["t_s", "run", *POSITIONS, *names], rows)
    rows = []
    for x, y, z, a, c, side in rng.uniform(size=(60, 6)):
        at = [0.2 * x - 0.1, 0.2 * y - 0.1, 0.2 * z, 2.0 * a - 1.0, 6.2 * c]
        way = 1 if side > 0.5 else -1
        true = 1e3 * point(at, errors(at, way))
        rows.append([*np.array(at[:3]) * 1e3, *np.degrees(at[3:]), way, *true])
    save(folder / "check.csv", [*POSITIONS, *(f"tcp_{k}_mm" for k in "xyz")], rows)
    return folder


POSITIONS = ("x_mm", "y_mm", "z_mm", "a_deg", "c_deg", "dir_c")


def save(path, header, rows):
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def machine(backlash):
    return lambda q, way: errors_of(q, way, backlash)


# --- the readings -----------------------------------------------------------------------------


@pytest.mark.parametrize("nest", ["spindle", "table"])
@pytest.mark.thorough
def test_readings_are_those_of_the_matrices(tmp_path, nest):
    study = vcal.load_study(write(tmp_path, 1, machine(0.0), nest, runs=1))
    instrument, rng = study.instrument, np.random.default_rng(2)
    plan = study.plan
    assert plan.axes == tuple("XYZAC")
    ports = rng.normal(0.0, 1e-3, (len(plan.axes) + 3, 6))
    it, sphere = study.model.chain, instrument.places[0]
    for row in (0, 17, 60):
        q, twists = np.asarray(plan.position)[row], ports[:5]
        rotation, t = it.pose(list(q), [list(e) for e in twists])
        tool = t + rotation @ Vector.of(it.tool_offset)
        place, zero, matrix = ports[5, :3], ports[6, :3], rng.normal(0.0, 1e-2, 9)
        own = {"place": list(place), "zero": list(zero), "matrix": list(matrix)}
        found = [float(v) for v in instrument.observe(sphere, rotation, tool, own)]
        expected = seen(q, twists, sphere + place, zero, nest)
        expected = (np.eye(3) + matrix.reshape(3, 3)) @ expected
        np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.thorough
def test_probes_of_their_own_tell_the_same(tmp_path):
    unit = PROBES / np.linalg.norm(PROBES, axis=1, keepdims=True)
    one = vcal.load_study(write(tmp_path / "one", 1, machine(0.0), runs=1))
    folder = write(tmp_path / "two", 1, machine(0.0), runs=1, read=unit.dot, names=AS_READ)
    two = vcal.load_study(folder, AS_PROBES)
    assert two.instrument.readings == ("p1", "p2", "p3")
    theta = np.random.default_rng(3).standard_normal(len(one.model.entries))
    expected, found = (np.asarray(vcal.predict(s.model, s.plan, theta)) for s in (one, two))
    np.testing.assert_allclose(found, expected @ unit.T, atol=1e-14)
    round_tips = vcal.load_study(folder, [*AS_PROBES, "instrument.tip_radius_mm=2"])
    found = np.asarray(vcal.predict(round_tips.model, round_tips.plan, theta))
    # The tip moves along the probe until the centres are the sum of the radii apart.
    for p, reading, along in zip(expected, found, expected @ unit.T, strict=True):
        for n, value, first in zip(unit, reading, along, strict=True):
            assert np.linalg.norm(p - (13e-3 + value) * n) == pytest.approx(13e-3, abs=1e-12)
            assert abs(value - first) < 1e-6


# --- what it finds ----------------------------------------------------------------------------


@pytest.fixture(
    scope="module", params=["spindle", pytest.param("table", marks=pytest.mark.campaign)]
)
def studied(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sphere")
    return vcal.load_study(write(folder, 3, machine(40e-6), request.param))


@pytest.mark.campaign
def test_the_loop_names_the_backlash_of_a_rotary_axis(studied):
    closure = vcal.close_loop(studied.model, studied.measurement, check=studied.check)
    assert [f.effect.key for f in closure.effects] == ["backlash C"]
    (_, value, unit, u), *_ = closure.effects[0].parameters
    assert unit == "urad" and abs(value - 40.0) < 3.0 * u < 6.0
    none, before, after = (
        closure.errors[k].check.value for k in ("uncompensated", "before", "after")
    )
    assert after < 0.95 * before and after < 0.3 * none
    assert closure.after.chi2 / closure.after.dof == pytest.approx(1.0, abs=0.15)


@pytest.mark.thorough
def test_nothing_is_missing_where_nothing_is(tmp_path):
    study = vcal.load_study(write(tmp_path, 5, machine(0.0)))
    assert vcal.close_loop(study.model, study.measurement).verdict == "nothing_missing"


@pytest.mark.slow
def test_location_errors_are_found(tmp_path):
    """Of axes that are off and square to nothing, without any other error."""
    truth = {"EY0A": 20.0, "EB0A": 15.0, "EX0C": -18.0, "EY0C": 11.0, "EA0C": 25.0}

    def errors(q, way):
        e = np.zeros((5, 6))
        for name, value in truth.items():
            e["XYZAC".index(name[3]), "XYZABC".index(name[1])] = value * 1e-6
        return e

    small = ["model.geometric.translation_um=0.5", "model.geometric.rotation_urad=1"]
    study = vcal.load_study(write(tmp_path, 6, errors), small)
    fit = vcal.identify(study.model, study.measurement)
    assert located(fit, truth) == pytest.approx(truth, abs=5.0)


def located(fit, truth):
    """Location errors found, in um and urad, and that they are within 3 u of the truth."""
    steps = np.array([entry.parameter.step for entry in fit.model.entries])
    values, u = fit.theta * steps, np.sqrt(np.diag(fit.covariance)) * steps
    names = [entry.parameter.name for entry in fit.model.entries]
    at = {name: names.index(name) for name in truth}
    for name, value in truth.items():
        assert abs(values[at[name]] * 1e6 - value) < 3e6 * u[at[name]], name
    return {name: values[i] * 1e6 for name, i in at.items()}


@pytest.mark.thorough
def test_simulated_readings_are_where_they_are_read(studied):
    made = simulate(studied.model, studied.plan, jax.random.key(2), noise_factor=0.0)
    values = studied.instrument.to_table(made.measurement.plan, made.measurement.readings)
    np.testing.assert_allclose(
        studied.instrument.measured(values), np.asarray(made.ideal), atol=1e-15
    )
    assert 1e-6 < np.abs(np.asarray(made.ideal)).max() < 1e-3


@pytest.mark.campaign
def test_errors_of_the_probes_are_told_where_they_are_far_from_zero(tmp_path):
    matrix = np.random.default_rng(10).normal(0.0, 1e-3, (3, 3))
    read = (np.eye(3) + matrix).dot
    folder = write(tmp_path, 9, machine(0.0), read=read, off=0.5e-3)
    study = vcal.load_study(folder, ["instrument.external_u_um=3"])
    fit = vcal.identify(study.model, study.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.15)
    elements = [i for i, e in enumerate(fit.model.entries) if e.key == "nest_matrix"]
    u = np.sqrt(np.diag(fit.covariance))[elements]
    steps = np.array([fit.model.entries[i].parameter.step for i in elements])
    assert steps == pytest.approx(3e-6 / 3e-3)
    assert np.abs((fit.theta[elements] - matrix.ravel() / steps) / u).max() < 3.5 and u.max() < 0.9


@pytest.mark.campaign
def test_the_place_of_a_sphere_that_no_reading_saw(studied):
    first = studied.plan.values("run") == 0
    readings = np.asarray(studied.measurement.readings)[first]
    fit = vcal.identify(studied.model, vcal.Measurement(studied.plan.take(first), readings, ""))
    with pytest.raises(np.linalg.LinAlgError, match=r"table_place 1\.X, table_place 1\.Y, .* 1\.Z"):
        assert fit.covariance is None


@pytest.mark.campaign
@pytest.mark.parametrize(
    "nest",
    [
        pytest.param("spindle", marks=pytest.mark.thorough),
        pytest.param("table", marks=pytest.mark.campaign),
    ],
)
def test_a_sphere_that_slips_on_the_table(tmp_path, nest):
    def slip(t):
        return np.array([4e-6, -3e-6, 0.0]) * (900 < t < 1920)

    study = vcal.load_study(write(tmp_path, 11, machine(0.0), nest, slip=slip))
    closure = vcal.close_loop(study.model, study.measurement)
    assert [f.effect.key for f in closure.effects] == ["jump place"]
    for (_, value, _, u), true in zip(closure.effects[0].parameters, (4, -3, 0, 910), strict=True):
        assert abs(value - true) < 3.0 * u


@pytest.mark.campaign
def test_curvature_that_differs_in_few_directions(tmp_path):
    """Errors of the probes are seen where the machine is off: of the linearised nominal problem
    they are not. A search that shares its curvature says where it has not arrived.
    """
    study = vcal.load_study(write(tmp_path, 12, machine(0.0)), ["instrument.external_u_um=3"])
    batch = prepare_batch(study.model, study.plan)
    assert not batch.shared
    made = [simulate(study.model, study.plan, jax.random.key(k)).measurement for k in range(4)]
    readings = np.stack([np.asarray(m.readings) for m in made])
    found, shared = (
        jax.jit(partial(jax.lax.map, partial(way, batch)))(readings)
        for way in (identify_alone, identify_one)
    )
    assert found.converged.all() and found.steps.max() < 5
    for k, measurement in enumerate(made):
        fit = vcal.identify(study.model, measurement, whitener=np.asarray(batch.whitener))

        def away(theta, fit=fit):
            return np.linalg.norm(np.triu(fit.factor[0]) @ (np.asarray(theta) - fit.theta))

        assert not fit.factor[1]
        assert away(found.theta[k]) < 1e-3
        assert not shared.converged[k] or away(shared.theta[k]) < 2e-3


# --- what cannot be used ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return write(tmp_path_factory.mktemp("small"), 7, machine(0.0), runs=1)


def test_folds_are_blocks_in_time_of_every_run(small):
    """Whatever the order of the rows; in theirs without a time."""
    it = vcal.load_study(small)
    fold, apart = it.instrument.folds(it.plan)
    assert not apart and (np.diff(fold[np.argsort(it.plan.values("t"))]) >= 0).all()
    order = np.random.default_rng(0).permutation(it.plan.rows)
    np.testing.assert_array_equal(it.instrument.folds(it.plan.take(order))[0], fold[order])
    timeless = dataclasses.replace(it.plan.take(order), covariates={})
    assert (np.diff(it.instrument.folds(timeless)[0]) >= 0).all()


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["machine.rotary.C.at_mm=[10, -20, 200]"], None),
        (["machine.rotary.C.at_mm=[14, -20, -200]"], "a tool point .* mm from the mean of run 0"),
        (["instrument.nest=bed"], "instrument.nest"),
        (["instrument.zero_u_um=-1"], "instrument.zero_u_um"),
        (["instrument.range_mm=0.001"], "column x_ext_mm"),
        (["instrument.probes=[[1, 0, 0], [0, 1, 0], [1, 1, 0]]"], "do not lie in one plane"),
    ],
)
def test_what_does_not_fit_is_one_message(small, overrides, said):
    if said is None:  # along C, its place makes no difference
        vcal.load_study(small, overrides)
        return
    with pytest.raises(StudyError, match=said) as caught:
        vcal.load_study(small, overrides)
    assert "expected" in str(caught.value)


@pytest.mark.thorough
def test_every_sign_that_fits_is_named():
    """Of a circle on a rotary table any of three; c_deg first, which is most often wrong."""
    chain = chain_from_string("w C b X Y Z t", rotary_m={"C": (0.0, 0.0, 0.0)})
    columns = {axis: i for i, axis in enumerate(chain.axes)}
    position = np.zeros((20, 4))
    position[:, columns["C"]] = np.linspace(0.0, 6.0, 20)
    place = np.tile([0.2, 0.0, 0.1], (20, 1))
    position = np.asarray(followed(chain, position, place))

    def off(points):
        return np.linalg.norm(points - points.mean(0), axis=1)

    assert np.max(off(chain.tool_point(position))) < 1e-12
    for axis in "CXY":
        wrong = position.copy()
        wrong[:, columns[axis]] *= -1.0
        assert np.median(off(chain.tool_point(wrong))) > 1e-3
        assert cause(chain, chain.axes, wrong, off, 1e-6) == (
            "they do with the other sign in c_deg, or with the other sign in x_mm, or with the "
            "other sign in y_mm, or with x_mm and y_mm exchanged: compare these, the likeliest "
            "first, with the machine"
        )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda row: {"c_deg": str(-float(row["c_deg"]) + 360.0)},
            "with the other sign in c_deg: compare it with the machine",
        ),
        (lambda row: dict.fromkeys(POSITIONS[:5], "20"), "the same in all rows"),
        (lambda row: {"run": str(int(row["t_s"]) // 40)}, r"rows? of run 0"),
        (
            lambda row: {c: str(1e-3 * float(row[c])) for c in row if c.endswith("_ext_mm")},
            r"^data.csv, columns x_ext_mm, y_ext_mm, z_ext_mm: found readings with a standard "
            "deviation of .* the declared noise .*; correct the unit of the readings, or",
        ),
    ],
)
def test_rows_that_do_not_fit(small, tmp_path, change, said):
    with open(small / "data.csv", newline="") as file:
        rows = [row | change(row) for row in csv.DictReader(file)]
    (tmp_path / "setup.toml").write_text((small / "setup.toml").read_text())
    save(tmp_path / "data.csv", list(rows[0]), [list(row.values()) for row in rows])
    with pytest.raises(StudyError, match=said):
        vcal.load_study(tmp_path)


@pytest.mark.thorough
def test_a_machine_without_rotary_axes(tmp_path):
    rows = [[0, 10.0 * k, 20.0, 30.0, 0.0, 0.0, 0.0] for k in range(9)]
    save(tmp_path / "data.csv", ["run", *POSITIONS[:3], *COORDINATES], rows)
    head = HEAD.partition("[machine.rotary]")[0].replace("w C A b", "w b")
    (tmp_path / "setup.toml").write_text(head + INSTRUMENT.format(nest="table") + FAMILY)
    with pytest.raises(StudyError, match="key machine.chain: found .* without a rotary axis"):
        vcal.load_study(tmp_path)


@pytest.mark.thorough
def test_probes_turn_with_a_head(tmp_path):
    """Where C and A carry the spindle, and A is off the axis of C."""
    rng = np.random.default_rng(8)
    about_c, about_a = np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 0.1])
    turn = lambda v: Rotation.from_rotvec(np.radians(v)).as_matrix()  # noqa: E731
    sphere, rows = np.array([0.2, 0.1, -0.3]), []

    def tip(a, c, off):
        carried = about_a + off - about_c + turn([a, 0, 0]) @ (np.array(TOOL) - about_a)
        return about_c + turn([0, 0, c]) @ carried

    for c in range(0, 360, 30):
        for a in (-40, -10, 20, 50):
            x = sphere - tip(a, c, np.zeros(3))
            p = sphere - (x + tip(a, c, np.array([0.0, 9e-6, -6e-6])))
            p = (turn([0, 0, c]) @ turn([a, 0, 0])).T @ p + 0.4e-6 * rng.standard_normal(3)
            rows.append([0, *1e3 * x, a, c, *1e3 * p])
    names = [*POSITIONS[:5], *COORDINATES]
    save(tmp_path / "data.csv", ["run", *names], rows)
    head = HEAD.replace("w C A b Y X Z t", "w b X Y Z C A t").replace("[-300, 300]", "[-700, 700]")
    head = head.replace("[0, 0, -120]", "[0, 0, 100]").replace("[10, -20, -200]", "[0, 0, 300]")
    head = head.replace("[-250, 400]", "[-700, 700]") + INSTRUMENT.format(nest="spindle") + FAMILY
    (tmp_path / "setup.toml").write_text(head)
    study = vcal.load_study(tmp_path)
    fit = vcal.identify(study.model, study.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.3)
    truth = {"EY0A": 9.0, "EZ0A": -6.0}
    assert located(fit, truth) == pytest.approx(truth, abs=8.0)


@pytest.mark.thorough
def test_a_spindle_in_a_head_that_warms_up_turns_with_it(studied):
    """No error motion of an axis does; where no head turns it, the last axis has the same."""
    warm = vcal.CATALOGUE["warm_up"]
    head = chain_from_string("w C b X Y Z B t", None, TOOL, {"B": (0, 0, 0.1), "C": (0, 0, -0.2)})
    for it, expected in ((head, {"tool.X", "tool.Y", "tool.Z"}), (studied.model.chain, set())):
        setup = Model(it, studied.instrument).setup(studied.plan)
        found = {e.port for e in warm.candidates(setup) if e.placement == "tool"}
        assert found == expected
    effect = warm(port="tool.Z", unit="um", placement="tool")
    assert [p.name for p in effect.parameters] == ["size_tool_Z", "tau"]
    response = effect.response(studied.plan, {"tau": 600.0})
    t = np.asarray(studied.plan.covariate("t"))
    np.testing.assert_allclose(response["tool.Z", "size_tool_Z"], 1.0 - np.exp(-t / 600.0))
