"""Arms from URDF files, against homogeneous transformations in plain numpy."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arms import COLUMN, REFLECTOR, STATION, write_arm
from vcal.errors import StudyError
from vcal.study.study import load_study

URDF = """<?xml version="1.0"?>
<!-- a rail, an arm and a flange -->
<robot name="cell">
  <link name="world"/><link name="carriage"/><link name="shoulder"/><link name="upper"/>
  <link name="fore"/><link name="wrist"/><link name="flange"/><link name="camera"/>
  <joint name="rail" type="prismatic">
    <parent link="world"/><child link="carriage"/>
    <origin xyz="0.1 0 0.3" rpy="0 0 0.2"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="2" effort="1" velocity="1"/>
  </joint>
  <joint name="pan" type="revolute">
    <parent link="carriage"/><child link="shoulder"/>
    <origin xyz="0 0 0.4" rpy="0 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="lift" type="continuous">
    <parent link="shoulder"/><child link="upper"/>
    <origin xyz="0.05 0.1 0.1" rpy="0 1.5707963267948966 0"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="plate" type="fixed">
    <parent link="upper"/><child link="fore"/><origin xyz="0 0 0.5" rpy="0.1 -0.2 0.3"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="fore"/><child link="wrist"/>
    <origin xyz="0 -0.1 0.02"/><axis xyz="0.3 -2 0.5"/>
    <limit lower="-2" upper="2.5" effort="1" velocity="1"/>
  </joint>
  <joint name="tool" type="fixed">
    <parent link="wrist"/><child link="flange"/><origin xyz="0 0 0.35" rpy="0 0 1"/>
  </joint>
  <joint name="mount" type="fixed">
    <parent link="wrist"/><child link="camera"/><origin xyz="0 0.1 0"/>
  </joint>
</robot>
"""
CHAIN = (
    ((0.1, 0, 0.3), (0, 0, 0.2), "slide", (1, 0, 0)),
    ((0, 0, 0.4), (0, 0, 0), "turn", (0, 0, 1)),
    ((0.05, 0.1, 0.1), (0, math.pi / 2, 0), "turn", (0, 1, 0)),
    ((0, 0, 0.5), (0.1, -0.2, 0.3), "", ()),
    ((0, -0.1, 0.02), (0, 0, 0), "turn", (0.3, -2, 0.5)),
    ((0, 0, 0.35), (0, 0, 1), "", ()),
)


def tip(q):
    """Pose of the flange, joint after joint."""
    frame, variables = np.eye(4), iter(q)
    for xyz, rpy, kind, axis in CHAIN:
        step = np.eye(4)
        step[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()  # about fixed axes
        step[:3, 3] = xyz
        frame = frame @ step
        move = np.eye(4)
        if kind:
            n = np.array(axis) / np.linalg.norm(axis)
            value = next(variables)
            if kind == "slide":
                move[:3, 3] = n * value
            else:
                move[:3, :3] = Rotation.from_rotvec(n * value).as_matrix()
        frame = frame @ move
    return frame


@pytest.fixture
def cell(tmp_path):
    """A study of the cell with a URDF file, of 60 random poses."""
    rng = np.random.default_rng(3)
    q = rng.uniform([-1, -2, -2, -2], [2, 2, 2, 2], (60, 4))
    rows = [{**COLUMN[0]}, *COLUMN[1:4]]
    folder = write_arm(tmp_path / "s", rows, q)
    (folder / "arm.urdf").write_text(URDF)
    setup = (folder / "setup.toml").read_text()
    rest = setup[setup.index("[instrument]") :]
    machine = '[machine]\nurdf = "arm.urdf"\ntip_link = "flange"\n'
    (folder / "setup.toml").write_text(machine + rest)
    turn = Rotation.from_euler("z", 91.0, degrees=True).as_matrix()
    points = np.array([(tip(row) @ [*REFLECTOR, 1.0])[:3] for row in q])
    seen = 1e3 * (points - STATION) @ turn + 0.01 * rng.standard_normal((60, 3))
    lines = (folder / "data.csv").read_text().splitlines()
    kept = [",".join(line.split(",")[:5]) for line in lines[1:]]
    text = [",".join([a, *map(str, b)]) for a, b in zip(kept, seen, strict=True)]
    (folder / "data.csv").write_text("\n".join([lines[0], *text]) + "\n")
    return folder


@pytest.mark.thorough
def test_against_numpy(cell):
    study = load_study(cell)
    chain = study.chain
    assert chain.text == "4 joints, arm.urdf (rail, pan, lift, elbow)"
    assert [joint.kind for joint in chain.joints] == ["prismatic", *["revolute"] * 3]
    np.testing.assert_allclose(
        chain.travel, [[-1, 2], [-3, 3], [-np.inf, np.inf], [-2, 2.5]], atol=1e-15
    )
    q = np.asarray(study.plan.position)
    for i in range(5):
        r, t = chain.pose_as_arrays(q[i], np.zeros((4, 6)))
        frame = tip(q[i])
        np.testing.assert_allclose(r, frame[:3, :3], atol=1e-14)
        np.testing.assert_allclose(t, frame[:3, 3], atol=1e-14)
    # The pose of the tracker and the reflector are found from the readings.
    np.testing.assert_allclose(study.one.instrument.points[0], REFLECTOR, atol=1e-3)
    names = {entry.parameter.name for entry in study.model.entries}
    assert {"EXJ1.k0", "ECJ4.0"} <= names


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<robot", "<robt", ("line 34", "not XML")),
        ('<?xml version="1.0"?>', '<!DOCTYPE x [<!ENTITY a "b">]>', ("document type", "line 1")),
        ("-2 0.5", "-2", ("joint elbow", "axis xyz", "three numbers")),
        ('lower="-3"', 'lower="low"', ("joint pan", "limit lower", "'low'")),
        ('type="continuous"', 'type="floating"', ("joint lift", "'floating'", "prismatic")),
        ('axis xyz="0 1 0"', 'axis xyz="0 0 0"', ("joint lift", "axis of length zero")),
        ('<parent link="upper"/>', "", ("joint plate", "no <parent")),
        (
            '<axis xyz="0 0 1"/>',
            '<mimic joint="rail"/>',
            ("joint pan", "follows 'rail'", "a command of its own"),
        ),
    ],
)
def test_wrong_files(cell, old, new, words):
    path = cell / "arm.urdf"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(StudyError) as refused:
        load_study(cell)
    message = str(refused.value)
    assert message.startswith("arm.urdf, ") and all(word in message for word in words), message


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"machine.tip_link": "flang"}, ("machine.tip_link", "did you mean 'flange'")),
        ({"machine.base_link": "flange"}, ("machine.urdf", "no joint that moves")),
        ({"machine.base_link": "camera"}, ("machine.tip_link", "no joints connect")),
        ({"machine.urdf": "none.urdf"}, ("none.urdf", "no such file")),
        ({"machine.convention": "modified"}, ("convention together with a urdf",)),
        ({"machine.chain": "w b X Y Z t"}, ("both a chain and a urdf",)),
        ({"machine.coupling": [[1.0]]}, ("key machine.coupling", "4 rows of 4")),
    ],
)
def test_wrong_keys(cell, keys, words):
    with pytest.raises(StudyError) as refused:
        load_study(cell, keys)
    assert all(word in str(refused.value) for word in words), str(refused.value)


def test_the_tip_must_be_named_where_there_are_several(cell):
    setup = cell / "setup.toml"
    setup.write_text(setup.read_text().replace('tip_link = "flange"\n', ""))
    with pytest.raises(StudyError, match=r"machine\.tip_link.*flange, camera"):
        load_study(cell)
