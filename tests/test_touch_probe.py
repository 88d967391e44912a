"""Touch probe: contacts on a sphere, in a ring and on a step gauge, and what they show."""

import jax
import numpy as np
import pytest

import vcal
from conftest import write_csv
from designing import run
from oracle import Smooth, make_case
from oracle.kinematics import nominal_machine
from oracle.rotary import FiveAxis
from oracle.touch_probe import GaugeProbe, gauge_plan, measure_gauge, positions_of
from vcal import load_study
from vcal.demo import STARTS
from vcal.errors import StudyError
from vcal.model.simulate import simulate

FAMILY = Smooth(translation=3e-6, rotation=6e-6, squareness=15e-6)
CENTRE, OFFSET = np.array([300.0, 250.0, 100.0]), np.array([0.0, 0.0, -150.0])
SETUP = """
[machine]
chain = "{chain}"
tool_offset_mm = [0, 0, -150]
[machine.travel_mm]
X = [0, 600]
Y = [0, 500]
Z = [0, 450]
{more}
[instrument]
kind = "touch_probe"
{artefact}
stylus_radius_mm = 3
{stylus}
probe_sigma_um = 0.5
[model.geometric]
family = "smooth"
translation_um = 4
rotation_urad = 10
squareness_urad = 20
[data]
data = "data.csv"
"""
SPHERE = 'artefact = "sphere"\ndiameter_mm = 25\ndiameter_u_um = 0.4'
RING = 'artefact = "ring"\ndiameter_mm = 50\ndiameter_u_um = 0.4'
GAUGE = 'artefact = "step_gauge"\ngauge = "gauge.csv"\nface_u_um = 0.3'
KNOWN = "stylus_u_um = 1.0"


def write(folder, columns, artefact=SPHERE, stylus=KNOWN, chain="w X b Y Z t", more="", faces=None):
    folder.mkdir(parents=True, exist_ok=True)
    text = SETUP.format(artefact=artefact, stylus=stylus, chain=chain, more=more)
    (folder / "setup.toml").write_text(text, encoding="utf-8")
    write_csv(folder / "data.csv", columns)
    if faces is not None:
        write_csv(folder / "gauge.csv", {"face": np.arange(len(faces)), "position_mm": faces})
    return folder


def columns_of(points, setup=0, **more):
    """The table of contacts with the tip at points (n, 3) of the workpiece frame, mm."""
    place = points - OFFSET
    found = {"setup": np.full(len(points), setup)}
    return found | {f"{c}_mm": place[:, i] for i, c in enumerate("xyz")} | more


def around(count=12, radius=15.5, centre=CENTRE, pole=True):
    angle = 2.0 * np.pi * (np.arange(count) + 0.3) / count
    out = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    if pole:
        out = np.vstack([out, [0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    return centre + radius * out, out


def line(direction, faces=10, start=(100.0, 100.0, 50.0)):
    """Contacts with both sides of every step of a gauge, mm, with their faces and senses."""
    d = np.array(direction, float) / np.linalg.norm(direction)
    face = np.arange(faces)
    way = np.where(face % 2 == 0, 1.0, -1.0)
    points = np.array(start) + (10.0 * face - way * 3.0)[:, None] * d
    return points, {"face": face, "approach": way}


def keys(study):
    return [f"{e.key} {e.parameter.name}" for e in study.model.entries if "geometric" not in e.key]


# --- what the contacts show -----------------------------------------------------------------------


@pytest.mark.slow
def test_a_sphere(tmp_path):
    points, out = around()
    study = load_study(write(tmp_path / "sphere", columns_of(points)))
    assert keys(study) == [
        "artefact_place 0.X", "artefact_place 0.Y", "artefact_place 0.Z", "stylus_radius error",
        "artefact_radius error",
    ]  # fmt: skip
    np.testing.assert_allclose(study.instrument.places, 1e-3 * CENTRE[None], atol=1e-9)
    azimuth = np.asarray(study.plan.covariate("approach_rad"))[:12]
    np.testing.assert_allclose(np.cos(azimuth), -out[:12, 0], atol=1e-6)
    way = np.asarray(study.plan.covariate("dir_X"))
    moves = np.abs(out[:, 0]) > 0.06
    assert (way[moves] == -np.sign(out[moves, 0])).all() and way[12] == 0.0
    unknown = load_study(write(tmp_path / "unknown", columns_of(points), stylus=""))
    assert "stylus_radius_unknown error" in keys(unknown)


@pytest.mark.thorough
def test_a_sphere_touched_at_its_equator_only(tmp_path):
    """Its height is not seen, and is no unknown."""
    study = load_study(write(tmp_path, columns_of(around(pole=False)[0])))
    assert keys(study)[:3] == ["artefact_place 0.X", "artefact_place 0.Y", "stylus_radius error"]


@pytest.mark.thorough
def test_a_ring(tmp_path):
    points, out = around(radius=22.0, pole=False)
    study = load_study(write(tmp_path, columns_of(points), RING))
    assert keys(study)[:2] == ["artefact_place 0.X", "artefact_place 0.Y"]
    way = np.asarray(study.plan.covariate("dir_Y"))  # outwards, from inside
    assert (way == np.sign(out[:, 1])).all()
    moved = shifted(study, {"artefact_place 0.X": 5e-6, "artefact_radius error": 2e-6})
    # Where the ring lies further out, the tip has further to go.
    np.testing.assert_allclose(moved, 5e-6 * out[:, 0] + 2e-6, atol=1e-9)


def shifted(study, values):
    """Readings (n,), m, where some parameters have values, SI."""
    names = [f"{e.key} {e.parameter.name}" for e in study.model.entries]
    truth = np.zeros(len(names))
    for key, value in values.items():
        place = names.index(key)
        truth[place] = value / study.model.entries[place].parameter.step
    return np.asarray(vcal.predict(study.model, study.plan, truth))[:, 0]


@pytest.mark.thorough
def test_readings_of_a_sphere(tmp_path):
    points, out = around()
    study = load_study(write(tmp_path, columns_of(points)))
    moved = shifted(study, {"artefact_place 0.Y": 4e-6, "stylus_radius error": 1e-6})
    np.testing.assert_allclose(moved, -4e-6 * out[:, 1] - 1e-6, atol=2e-9)


@pytest.mark.thorough
def test_a_step_gauge(tmp_path):
    """Along an axis its tilt is not seen; contacts beside its line show it."""
    points, more = line((1, 0, 0))
    folder = write(tmp_path / "x", columns_of(points, **more), GAUGE, faces=10.0 * np.arange(10))
    study = load_study(folder)
    found = keys(study)
    assert found[:2] == ["artefact_place 0.X", "stylus_radius error"]
    assert found[2:] == [f"face_calibration {k}" for k in range(10)]
    way = np.asarray(study.plan.covariate("dir_X"))
    assert (way == more["approach"]).all() and not study.plan.has("dir_Y")
    moved = shifted(study, {"artefact_place 0.X": 3e-6, "face_calibration 4": 1e-6})
    # The gap ahead of the tip grows where the face lies further along the approach.
    np.testing.assert_allclose(moved, more["approach"] * (3e-6 + 1e-6 * (np.arange(10) == 4)),
                               atol=1e-9)  # fmt: skip
    wide = points + 5.0 * (np.arange(10) % 3)[:, None] * [0.0, 1.0, 0.0]
    folder = write(tmp_path / "w", columns_of(wide, **more), GAUGE, faces=10.0 * np.arange(10))
    assert "artefact_place 0.C" in keys(load_study(folder))


REFUSED = {
    "positions": (lambda t: t | {"x_mm": 1.3 * t["x_mm"]}, SPHERE, "from the surface of the artef"),
    "a sphere for a ring": (lambda t: t, RING, "from the surface of the artefact"),
    "another setup": (lambda t: t | {"setup": np.arange(14) // 2}, SPHERE, "2 contacts in set-up"),
    "no size": (lambda t: t, 'artefact = "sphere"', "artefact = 'sphere' without diameter_mm"),
    "no gauge": (lambda t: t, 'artefact = "step_gauge"', "'step_gauge' without gauge"),
    "a thick tip": (lambda t: t, 'artefact = "ring"\ndiameter_mm = 6', "in a ring of the diameter"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_table_that_cannot_be_right(tmp_path, case):
    change, artefact, expected = REFUSED[case]
    with pytest.raises(StudyError, match=expected):
        load_study(write(tmp_path, change(columns_of(around()[0])), artefact))


OF_GAUGE = {
    "face": ({"face": np.arange(10) + 1}, "column face: found 10, expected a face of gauge.csv"),
    "approach": ({"approach": np.zeros(10)}, "column approach: found 0"),
    "the other way": ({"approach": np.where(np.arange(10) % 2, 1.0, -1.0)}, "from the surface of"),
}


@pytest.mark.parametrize("case", OF_GAUGE)
def test_a_gauge_that_cannot_be_right(tmp_path, case):
    change, expected = OF_GAUGE[case]
    points, more = line((1, 0, 0))
    folder = write(tmp_path, columns_of(points, **(more | change)), GAUGE,
                   faces=10.0 * np.arange(10))  # fmt: skip
    with pytest.raises(StudyError, match=expected):
        load_study(folder)


@pytest.mark.parametrize("artefact", ["sphere", "gauge"])
@pytest.mark.thorough
def test_simulated_contacts_are_contacts(tmp_path, artefact):
    """What is simulated without noise is at the surface of the machine with errors."""
    if artefact == "sphere":
        folder = write(tmp_path, columns_of(around()[0]))
    else:
        points, more = line((1, 2, 1))
        folder = write(tmp_path, columns_of(points, **more), GAUGE, faces=10.0 * np.arange(10))
    study = load_study(folder)
    drawn = simulate(study.model, study.plan, jax.random.key(2), noise_factor=0.0)
    found = drawn.measurement.plan
    assert not np.asarray(drawn.measurement.readings).any()
    apart = np.asarray(found.position) - np.asarray(study.plan.position)
    assert 1e-7 < np.abs(apart).max() < 1e-4
    gaps = np.asarray(vcal.predict(study.model, found, drawn.truth.theta))
    assert np.abs(gaps).max() < 1e-11


# --- with rotary axes -----------------------------------------------------------------------------

TURNING = "[machine.rotary]\nC = { at_mm = [300, 250, 0], travel_deg = [0, 360] }"


@pytest.mark.thorough
def test_a_sphere_on_a_turning_table_shows_the_axis(tmp_path):
    """The contacts of an independent machine whose axis C is off and tilted: its average line."""
    machine = FiveAxis("w C b X Y Z t", {"C": [0.3, 0.25, 0.0]}, [0.0, 0.0, -0.15])
    off, tilt = np.array([8e-6, -5e-6, 0.0]), np.array([20e-6, -30e-6, 0.0])
    columns = []
    for setup, ball in enumerate(([0.4, 0.25, 0.05], [0.3, 0.4, 0.15], [0.2, 0.2, 0.1])):
        for angle in np.deg2rad(np.arange(0, 360, 30)):
            out = np.vstack([np.eye(3), -np.eye(3)[:2], [[0.6, 0.64, 0.48]]])
            n = len(out)
            q = np.zeros((n, 4))
            q[:, 3] = angle
            twists = np.zeros((n, 4, 6))
            twists[:, 3] = np.concatenate([off, tilt])
            # Where the tip touches, seen from the table: along the approach in the turned frame.
            frame = machine.frame(q, 0 * twists)[:, :3, :3]
            target = np.array(ball) + 0.0155 * np.einsum("nij,nj->ni", frame, out)
            q = machine.follow(target, q, lambda q, t=twists: t)
            columns.append(
                np.column_stack([np.full(n, setup), 1e3 * q[:, :3], np.degrees(q[:, 3])])
            )
    table = np.concatenate(columns)
    names = ("setup", "x_mm", "y_mm", "z_mm", "c_deg")
    data = {name: table[:, i] for i, name in enumerate(names)}
    folder = write(tmp_path, data, chain="w C b X Y Z t", more=TURNING)
    study = load_study(folder)
    fit = vcal.identify(study.model, study.measurement)
    found = {p.name: (value, u) for _, p, value, u in fit.parameter_values()}
    for name, true in {"EX0C": 8.0, "EY0C": -5.0, "EA0C": 20.0, "EB0C": -30.0}.items():
        value, u = found[name]
        assert abs(value - true) < 3.0 * u + 0.3, (name, value, u)


@pytest.mark.thorough
def test_the_bundled_study(tmp_path):
    study = load_study(STARTS / "touch_probe")
    assert study.plan.has("approach_rad", "dir_X", "dir_Z", "dir_C")
    folds, apart = study.instrument.folds(study.plan)
    assert apart is False and (np.bincount(folds) > 60).all()
    fit = vcal.identify(study.model, study.measurement)
    assert fit.converged and 0.8 < fit.chi2 / fit.dof < 1.2


# --- what it finds --------------------------------------------------------------------------------


def test_the_generator_touches(tmp_path):
    """Contacts of a machine without errors lie at the faces, less the radius of the tip."""
    machine = nominal_machine("w X b Y Z t", (0.5, 0.4, 0.35), (0.0, 0.0, -0.15))
    plan = gauge_plan(machine, np.random.default_rng(0), repeats=1)
    exact = GaugeProbe(sigma=0.0, face_u=0.0, stylus_u=0.0, scatter=0.0)
    found, certificate = measure_gauge(machine, plan, exact, np.random.default_rng(1))
    tip = found + machine.tool_offset
    along = np.einsum("ni,ni->n", tip - plan.origin, plan.direction)
    np.testing.assert_allclose(along + 3e-3 * plan.way, certificate[plan.face], atol=1e-12)
    np.testing.assert_allclose(certificate, positions_of(np.arange(26)))
    back = {"effect": "backlash", "axis": "X", "size_um": 4}
    moved, _ = measure_gauge(machine, plan, exact, np.random.default_rng(1), [back])
    first = plan.setup == 0  # along X, which carries the workpiece against its command
    np.testing.assert_allclose((moved - found)[first, 0], 2e-6 * plan.way[first], atol=1e-12)


def case(folder, effects=(), seed=1, noise_factor=1.0):
    make_case("touch_probe", seed=seed, effects=effects, family=FAMILY, folder=folder,
              noise_factor=noise_factor)  # fmt: skip
    return load_study(folder)


@pytest.mark.parametrize(("noise", "low", "high"), [(1.0, 0.85, 1.15), (0.0, 0.0, 0.02)])
@pytest.mark.thorough
def test_a_clean_case_is_noise(tmp_path, noise, low, high):
    study = case(tmp_path, noise_factor=noise)
    fit = vcal.identify(study.model, study.measurement)
    assert fit.converged and low <= fit.chi2 / fit.dof < high


FOUND = {
    "backlash X": {"effect": "backlash", "axis": "X", "size_um": 3},
    "screw_cyclic Y": {"effect": "screw_cyclic", "axis": "Y", "pitch_mm": 12, "amplitude_um": 1},
}


@pytest.mark.thorough
@pytest.mark.parametrize("key", FOUND)
def test_what_is_missing_is_named(tmp_path, key):
    study = case(tmp_path, [FOUND[key]])
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, draws=100)
    assert closure.verdict == "named", closure.sentence
    assert [e.effect.key for e in closure.effects] == [key]


@pytest.mark.thorough
@pytest.mark.parametrize("effect", ["probe_lobing", "probe_two_lobes"])
def test_lobes_are_named(tmp_path, effect):
    given = {"probe_lobing": "sine3_um=1", "probe_two_lobes": "sine2_um=1"}[effect]
    run("simulate", STARTS / "touch_probe", "--out", tmp_path / "data", "--with",
        f"{effect}:{given}", "--seed", 5)  # fmt: skip
    study = load_study(tmp_path / "data")
    closure = vcal.close_loop(study.model, study.measurement, draws=100)
    assert [e.effect.name for e in closure.effects] == [effect], closure.sentence


@pytest.mark.campaign
def test_uncertainty_before_measuring(tmp_path):
    told = run("uncertainty", STARTS / "touch_probe", "--out", tmp_path / "out",
               "--draws", 200).stdout  # fmt: skip
    assert "the rms volumetric error" in told
