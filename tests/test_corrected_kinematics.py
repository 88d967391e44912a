"""Corrected kinematics of an arm against an independent forward kinematics in numpy."""

import csv
import io
import math
from types import SimpleNamespace

import numpy as np
import pytest

from known import Known
from oracle.kinematics import Arm, arm_frames
from oracle.plans import example_arm
from vcal.geometry.kinematics import corrected_kinematics, kinematics
from vcal.identification.identify import identify
from vcal.machine.chain import chain_from_dh
from vcal.report.formats.kinematics_csv import KinematicsCsv

LIFT = Arm(
    a=np.array([0.0, 0.05, 0.6, 0.0]),
    alpha=np.array([0.0, -0.5 * np.pi, 0.0, 0.5 * np.pi]),
    d=np.array([0.2, 0.3, 0.1, 0.5]),
    theta=np.array([0.3, 0.0, -0.4, 0.2]),
    prismatic=np.array([True, False, False, False]),
)
TOOL = np.array([0.05, -0.03, 0.15])


def turn(axis, angle):
    """A rotation (4, 4) about x, y or z."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = [k for k in range(3) if k != axis]
    found = np.eye(4)
    way = -1.0 if axis == 1 else 1.0
    found[i, i] = found[j, j] = c
    found[i, j], found[j, i] = -way * s, way * s
    return found


def shift(axis, distance):
    found = np.eye(4)
    found[axis, 3] = distance
    return found


def forward(rows, slides, q, base, tool, modified=False):
    """Frames of the tool from a table: the product of its elementary transformations."""
    found = []
    for position in q:
        frame = base
        for row, slide, x in zip(rows, slides, position, strict=True):
            theta, d, a, alpha, beta = row
            theta, d = (theta, d + x) if slide else (theta + x, d)
            joint = turn(2, theta) @ shift(2, d)
            link = shift(0, a) @ turn(0, alpha) @ turn(1, beta)
            frame = frame @ (link @ joint if modified else joint @ link)
        found.append(frame @ tool)
    return np.array(found)


def chain_of(arm, convention="standard"):
    slides = np.zeros(arm.joints, bool) if arm.prismatic is None else arm.prismatic
    rows = [
        {"type": "prismatic" if s else "revolute", "a": a, "alpha": al, "d": d, "theta": th}
        for s, a, al, d, th in zip(slides, arm.a, arm.alpha, arm.d, arm.theta, strict=True)
    ]
    return chain_from_dh(rows, TOOL, convention=convention), slides


@pytest.mark.parametrize("arm", [example_arm(), LIFT], ids=["six joints", "on a column"])
@pytest.mark.parametrize("size", [0.0, 1e-3, 0.05])
def test_a_table_has_the_tool_points_of_link_errors(arm, size):
    """Exactly, however large: parallel axes with the angle of Hayati, others without."""
    rng = np.random.default_rng(5)
    chain, slides = chain_of(arm)
    q = rng.uniform(-2.0, 2.0, (30, arm.joints))
    twists = size * rng.normal(size=(arm.joints, 6))
    if slides.any():
        twists[slides] = 0.0  # those of the oracle act before the motion of a slide
    found = kinematics(chain, twists)
    frames, origins = arm_frames(arm, q, twists[:, :3], twists[:, 3:])
    expected = origins[:, -1] + frames[:, -1] @ TOOL
    got = forward(found.rows, slides, q, found.base, found.tool)
    np.testing.assert_allclose(got[:, :3, 3], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(got[:, :3, :3], frames[:, -1], rtol=0, atol=1e-12)
    other = found.modified()
    again = forward(other.rows, slides, q, other.base, other.tool, modified=True)
    np.testing.assert_allclose(again, got, rtol=0, atol=1e-12)
    parallel = np.abs(np.sin(arm.alpha[:-1])) < 0.01
    assert not found.rows[:-1, 4][~parallel].any() and found.rows[-1, 4] == 0.0
    # What conventions fix keeps its value.
    np.testing.assert_allclose(found.rows[0, :2], [arm.theta[0], arm.d[0]], atol=1e-12)
    np.testing.assert_allclose(found.rows[-1, 2:4], [arm.a[-1], arm.alpha[-1]], atol=1e-12)
    if size == 0.0:
        declared = np.column_stack([arm.theta, arm.d, arm.a, arm.alpha, np.zeros(arm.joints)])
        off = found.rows - declared
        off[:, [0, 3]] = (off[:, [0, 3]] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(off, 0.0, atol=1e-12)
        np.testing.assert_allclose(found.base, np.eye(4), atol=1e-12)
        np.testing.assert_allclose(found.tool[:3, 3], TOOL, atol=1e-12)
    else:
        assert found.rows[:-1, 4][parallel & ~slides[:-1]].all()


def test_modified_rows_are_those_that_were_declared():
    arm = example_arm()
    chain, slides = chain_of(arm, "modified")
    found = kinematics(chain).modified()
    declared = np.column_stack([arm.theta, arm.d, arm.a, arm.alpha])
    off = found.rows[:, :4] - declared
    off[:, [0, 3]] = (off[:, [0, 3]] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(off, 0.0, atol=1e-12)
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (20, arm.joints))
    got = forward(found.rows, slides, q, found.base, found.tool, modified=True)
    np.testing.assert_allclose(got[:, :3, 3], chain.tool_point(q), rtol=0, atol=1e-12)


def test_only_arms_have_a_table():
    from vcal.machine.chain import chain_from_string

    with pytest.raises(ValueError, match="expected an arm"):
        kinematics(chain_from_string("w X b Y Z t"))


@pytest.mark.slow
def test_the_file_reproduces_the_readings_of_the_identified_arm(tmp_path):
    it = Known("reflectors", tmp_path, noise_factor=1.0)
    measurement = it.study.measurement
    fit = identify(it.study.model, measurement)
    found = corrected_kinematics(fit)
    chain, plan = fit.model.chain, measurement.plan
    closure = SimpleNamespace(after=fit, no_gain="")
    text = KinematicsCsv().text(SimpleNamespace(closure=closure))
    table = list(csv.DictReader(io.StringIO(text)))
    si = {"mm": 1e-3, "deg": math.radians(1.0)}
    q = np.asarray(plan.position)
    from vcal.model.forward import predict

    readings = np.asarray(predict(fit.model, plan, fit.theta, fit.shapes))
    for convention in ("standard", "modified"):
        value = {
            (row["place"], row["name"]): float(row["corrected"]) * si[row["unit"]]
            for row in table
            if row["convention"] == convention
        }
        rows = [
            [value[axis, name] for name in ("theta", "d", "a", "alpha", "beta")]
            for axis in chain.axes
        ]
        base = turn(0, value["base", "rx"]) @ turn(1, value["base", "ry"])
        base = base @ turn(2, value["base", "rz"])
        base[:3, 3] = [value["base", c] for c in "xyz"]
        slides = [False] * len(rows)
        flange = forward(rows, slides, q, base, np.eye(4), convention == "modified")
        for k in range(3):
            place = np.array([value[f"point{k + 1}", c] for c in "xyz"])
            got = flange[:, :3, 3] + flange[:, :3, :3] @ place
            # Eight digits in the file.
            np.testing.assert_allclose(got, readings[:, 3 * k : 3 * k + 3], rtol=0, atol=2e-7)
    # Nothing varies in this model; beta of the parallel axes is what four numbers cannot hold.
    assert found.varying_max < 1e-12
    assert 0.0 < found.lost_rms <= found.lost_max
    true = kinematics(chain, np.hstack([it.case.arm.translation, it.case.arm.rotation])).rows
    off = true - found.corrected.rows
    u = np.array([n.u for n in found.numbers if n.place in chain.axes]).reshape(-1, 5)
    kept = u > 0.0
    assert kept.sum() >= 18 and not u[0, :2].any() and not u[-1].any()
    assert np.mean((off[kept] / u[kept]) ** 2) < 3.0
