"""A probe of position and orientation on an arm, whose readings are those of plain numpy."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracle.kinematics import arm_frames, rotation_matrix
from oracle.plans import example_arm
from vcal import StudyError, identify, load_study, predict
from vcal.demo import STARTS
from vcal.instruments.orientation import between_frames, orientation_table, orientations
from vcal.model.declared_noise import declared_covariances
from vcal.model.simulate import prepare

ARM = example_arm()
PLACE = np.array([0.04, -0.02, 0.09])
PROBE = Rotation.from_euler("XYZ", [0.3, -0.8, 2.0]).as_matrix()
STATION = np.array([1.5, -0.7, 0.4])
ORIENTATION = Rotation.from_euler("XYZ", [0.1, 0.2, -2.3]).as_matrix()
SIGMA = np.repeat([20e-6, 50e-6], 3)
CORRELATION = np.eye(6)
CORRELATION[1, 5] = CORRELATION[5, 1] = 0.6
CORRELATION[2, 4] = CORRELATION[4, 2] = -0.4


def measured(q, arm, noise):
    """Positions (n, 3), m, and orientations (n, 3, 3) in the frame of the instrument."""
    frames, origins = arm_frames(arm, q)
    place = origins[:, -1] + frames[:, -1] @ PLACE
    seen = (place - STATION) @ ORIENTATION + noise[:, :3]
    turns = ORIENTATION.T @ frames[:, -1] @ PROBE
    return seen, rotation_matrix(noise[:, 3:]) @ turns


def write(folder, convention="quaternion", rows=60, seed=2, errors=1.0, noisy=1.0, **changed):
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (rows, ARM.joints))
    arm = dataclasses.replace(
        ARM,
        translation=errors * rng.normal(0.0, 100e-6, (ARM.joints, 3)),
        rotation=errors * rng.normal(0.0, 300e-6, (ARM.joints, 3)),
    )
    root = np.linalg.cholesky(CORRELATION) * SIGMA[:, None]
    places, turns = measured(q, arm, noisy * rng.normal(size=(rows, 6)) @ root.T)
    turns = changed.get("turns", lambda t: t)(turns)
    columns = {"pose": np.arange(rows)}
    columns |= {f"q{j + 1}_cmd_deg": np.rad2deg(q[:, j]) for j in range(ARM.joints)}
    columns |= {f"{c}_mm": 1e3 * places[:, i] for i, c in enumerate("xyz")}
    columns |= orientation_table(turns, changed.get("written", convention))
    folder.mkdir()
    header = ",".join(columns)
    np.savetxt(folder / "data.csv", np.column_stack([*columns.values()]), fmt="%.15g",
               delimiter=",", header=header, comments="")  # fmt: skip
    joints = "".join(
        f'[[machine.joint]]\ntype = "revolute"\na_mm = {1e3 * a!r}\n'
        f"alpha_deg = {math.degrees(al)!r}\n"
        f"d_mm = {1e3 * d!r}\ntheta_deg = {math.degrees(th)!r}\n"
        for a, al, d, th in zip(
            *(v.tolist() for v in (ARM.a, ARM.alpha, ARM.d, ARM.theta)), strict=True
        )
    )
    (folder / "setup.toml").write_text(
        f'name = "probe"\n[machine]\n{joints}[instrument]\nkind = "pose_probe"\n'
        "position_sigma_um = 20\norientation_sigma_urad = 50\n"
        f'orientation = "{convention}"\ncorrelation = {CORRELATION.tolist()}\n'
        "[model.geometric]\nlink_translation_um = 100\nlink_rotation_urad = 300\n"
    )
    return folder, q, arm


@pytest.mark.parametrize("convention", ["quaternion", "euler_xyz", "euler_zyx", "euler_zyz"])
def test_conventions_of_an_orientation(convention):
    """The product of elementary rotations that the convention names."""
    turns = Rotation.random(20, rng=3).as_matrix()
    table = orientation_table(turns, convention)
    np.testing.assert_allclose(orientations(table, convention), turns, atol=1e-12)
    if convention == "quaternion":
        w, x, y, z = (table[f"q{c}"] for c in "wxyz")
        np.testing.assert_allclose(turns[:, 0, 1], 2 * (x * y - w * z), atol=1e-12)
        negative = {name: -values for name, values in table.items()}
        np.testing.assert_allclose(orientations(negative, convention), turns, atol=1e-12)
        return
    values = [np.deg2rad(v) for v in table.values()]
    product = np.broadcast_to(np.eye(3), turns.shape)
    for letter, angle in zip(convention[-3:], values, strict=True):
        product = product @ rotation_matrix(angle[:, None] * np.eye(3)["xyz".index(letter)])
    np.testing.assert_allclose(product, turns, atol=1e-12)


def test_rotations_between_two_frames_in_closed_form():
    rng = np.random.default_rng(1)
    nominal = Rotation.random(12, rng=1).as_matrix()
    seen = ORIENTATION.T @ nominal @ PROBE
    s, t = between_frames(nominal, seen)
    np.testing.assert_allclose(s, ORIENTATION, atol=1e-12)
    np.testing.assert_allclose(t, PROBE, atol=1e-12)
    off = rotation_matrix(1e-3 * rng.normal(size=(12, 3))) @ seen
    s, t = between_frames(nominal, off)
    assert np.abs(s - ORIENTATION).max() < 2e-3 and np.abs(t - PROBE).max() < 2e-3


@pytest.mark.thorough
def test_a_nominal_arm_leaves_nothing(tmp_path):
    folder, *_ = write(tmp_path / "a", errors=0.0, noisy=0.0)
    study = load_study(folder)
    readings = study.measurement.readings
    np.testing.assert_allclose(readings[:, 3:], 0.0, atol=1e-10)
    theta = np.zeros(len(study.model.entries))
    found = predict(study.model, study.plan, theta)
    np.testing.assert_allclose(found, readings, rtol=0, atol=1e-10)
    np.testing.assert_allclose(study.instrument.station, STATION, atol=1e-9)
    np.testing.assert_allclose(study.instrument.point, PLACE, atol=1e-9)
    table = study.instrument.to_table(study.plan, readings)
    for name in ("x_mm", "qw", "qx", "qy", "qz", "q3_cmd_deg"):
        np.testing.assert_allclose(np.abs(table[name]), np.abs(study.one.table[name]), atol=1e-7)


@pytest.mark.parametrize("convention", ["quaternion", "euler_zyx"])
@pytest.mark.thorough
def test_an_arm_with_errors_is_identified(convention, tmp_path):
    """Poses of other positions, by the numpy arm, are predicted."""
    folder, _, arm = write(tmp_path / "a", convention, rows=80)
    study = load_study(folder)
    fit = identify(study.model, study.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.2)
    q = np.random.default_rng(9).uniform(-1.2, 1.2, (40, ARM.joints))
    places, turns = measured(q, arm, np.zeros((40, 6)))
    angles = {f"q{j + 1}_cmd_deg": np.rad2deg(q[:, j]) for j in range(ARM.joints)}
    plan = study.instrument.plan(study.chain, {"pose": np.arange(40), **angles})
    readings = np.asarray(predict(fit.model, plan, fit.theta, fit.shapes))
    table = study.instrument.to_table(plan, readings)
    found = orientations(table, convention)
    off = Rotation.from_matrix(found @ np.swapaxes(turns, 1, 2)).magnitude()
    assert np.sqrt(np.mean(off**2)) < 60e-6
    assert np.sqrt(np.mean((readings[:, :3] - places) ** 2)) < 30e-6


@pytest.mark.thorough
def test_the_declared_covariance_is_that_of_the_correlation(tmp_path):
    folder, *_ = write(tmp_path / "a")
    study = load_study(folder)
    parts = declared_covariances(study.model, study.measurement)
    total = np.sum([part for _, part in parts], axis=0)
    expected = SIGMA[:, None] * CORRELATION * SIGMA
    np.testing.assert_allclose(total, np.broadcast_to(expected, total.shape), rtol=1e-9, atol=1e-18)
    simulator = prepare(study.model, study.plan)
    assert simulator.scatter, "simulated noise is correlated too"


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"written": "euler_zyx"}, "they do as 'euler_zyx': correct instrument.orientation"),
        ({"turns": lambda t: np.swapaxes(t, 1, 2)}, "their inverse does"),
    ],
)
def test_a_wrong_convention_is_named(changed, says, tmp_path):
    folder, *_ = write(tmp_path / "a", "euler_xyz", **changed)
    with pytest.raises(StudyError, match=says):
        load_study(folder)


@pytest.mark.parametrize("value", [1.2, 0.9])
def test_a_correlation_that_is_none(value, tmp_path):
    folder, *_ = write(tmp_path / "a")
    text = (folder / "setup.toml").read_text()
    broken = CORRELATION.copy()
    broken[1, 5] = value
    (folder / "setup.toml").write_text(
        text.replace(str(CORRELATION.tolist()), str(broken.tolist()))
    )
    with pytest.raises(StudyError, match="correlation"):
        load_study(folder)


@pytest.mark.thorough
def test_the_study_to_start_from_lacks_nothing():
    from vcal import close_loop

    study = load_study(STARTS / "pose_probe")
    closure = close_loop(study.model, study.measurement, draws=100)
    assert closure.verdict == "nothing_missing"
