"""Arms with prismatic and revolute joints, against kinematics in plain numpy (`arms`)."""

import dataclasses
import math

import numpy as np
import pytest

from arms import COLUMN, REFLECTOR, STATION, about, flange, poses, write_arm
from vcal.effects.arm import gravity_moments
from vcal.errors import StudyError
from vcal.identification.identify import identify
from vcal.instruments.conditions import file_column, inside_name
from vcal.loop.weighing.cross_validation import fit_rms, folds_of, heldout_rms
from vcal.machine.chain import chain_from_dh
from vcal.machine.plan import Axes, Plan, slides
from vcal.study.study import load_study

MODIFIED = (
    {"type": "prismatic", "low_mm": 0, "high_mm": 3000, "alpha_deg": 90, "a_mm": 30},
    {"type": "revolute", "alpha_deg": -90, "d_mm": 400, "theta_deg": 20},
    {"type": "revolute", "alpha_deg": 90, "a_mm": 350},
    {"type": "revolute", "a_mm": 300, "alpha_deg": 30, "d_mm": 90},
)


def si(rows):
    """Rows for `chain_from_dh`."""
    return [
        {
            "type": row["type"],
            "a": 1e-3 * row.get("a_mm", 0.0),
            "d": 1e-3 * row.get("d_mm", 0.0),
            "alpha": math.radians(row.get("alpha_deg", 0.0)),
            "theta": math.radians(row.get("theta_deg", 0.0)),
        }
        for row in rows
    ]


@pytest.mark.parametrize("convention", ["standard", "modified"])
@pytest.mark.parametrize("rows", [COLUMN, MODIFIED, MODIFIED[1:]])
def test_kinematics_against_numpy(rows, convention):
    rng = np.random.default_rng(8)
    chain = chain_from_dh(si(rows), convention=convention)
    q = poses([{"low_mm": 0, "high_mm": 2000, **row} for row in rows], 5)
    twists = 1e-3 * rng.standard_normal((5, len(rows), 6))
    r, t = flange(rows, q, twists, convention == "modified")
    for i in range(5):
        turn, place = chain.pose_as_arrays(q[i], twists[i])
        np.testing.assert_allclose(turn, r[i], atol=1e-14)
        np.testing.assert_allclose(place, t[i], atol=1e-14)
    np.testing.assert_allclose(
        chain.tool_point(q), flange(rows, q, None, convention == "modified")[1], atol=1e-14
    )


def test_names_know_which_joints_slide():
    chain = chain_from_dh(si(COLUMN))
    assert chain.axes == ("J1", "J2", "J3", "J4", "J5", "J6", "J7") and chain.arm
    assert [slides(chain.axes, axis) for axis in chain.axes] == [True, *[False] * 6]
    assert chain.axes == Axes(chain.axes, {"J1"}) != Axes(chain.axes)
    assert file_column("J1", chain.axes) == ("q1_cmd_mm", 1e3)
    assert file_column("read_J2", chain.axes)[0] == "q2_read_deg"
    assert file_column("dir_J1", chain.axes) == ("dir_q1", 1.0)
    assert inside_name("q1_cmd_mm", chain.axes) == "commanded_J1"
    assert inside_name("q1_cmd_deg", chain.axes) == "q1_cmd_deg"
    # A plan keeps them, also through what is done with its rows.
    plan = Plan(chain.axes, np.zeros((4, 7))).take(np.arange(2))
    assert slides(plan.axes, "J1")


def test_an_arm_with_a_rail_alone_is_an_arm():
    assert chain_from_dh(si(COLUMN[:1])).arm


@pytest.fixture(scope="module")
def column(tmp_path_factory):
    """A column whose carriage tilts and shifts along the travel, and links with constant errors."""
    q = poses(COLUMN, 150)
    rng = np.random.default_rng(5)
    errors = np.tile(
        np.column_stack([3e-4 * rng.standard_normal((7, 3)), 5e-4 * rng.standard_normal((7, 3))]),
        (150, 1, 1),
    )
    u = q[:, 0] / 2.0
    errors[:, 0, 0] += 4e-4 * np.sin(2.0 * u)  # straightness
    errors[:, 0, 4] += 6e-4 * u**2  # pitch
    return write_arm(
        tmp_path_factory.mktemp("column") / "s", COLUMN, q, errors=errors, extra={
            "t_s": np.arange(150.0), "column_ax_m_s2": np.sin(np.arange(150.0))
        },
    )  # fmt: skip


def fitted(study):
    _, apart = folds_of(study.model, study.measurement)
    return identify(study.model, study.measurement, keep=~apart)


@pytest.mark.thorough
def test_a_column_with_an_arm_is_fitted(column):
    study = load_study(column)
    names = [entry.parameter.name for entry in study.model.entries]
    assert "EXJ1.0" in names and "EBJ1.k0" in names and "ECJ7.0" in names
    assert "EXJ2.k0" not in names
    assert "column_ax_m_s2" in study.plan.covariates
    fit = fitted(study)
    # 20 um per coordinate are 35 um per point.
    assert fit_rms(fit).value < 45.0 and heldout_rms(fit).value < 60.0
    # Without error motions along the travel, the constant errors of links do not suffice.
    less = {
        "model.geometric.slide_translation_um": 1e-3,
        "model.geometric.slide_rotation_urad": 1e-3,
    }
    assert heldout_rms(fitted(load_study(column, less))).value > 100.0


def test_nothing_is_lost_on_the_way_to_a_table(column):
    study = load_study(column)
    table = study.one.instrument.to_table(study.plan, study.measurement.readings)
    for name in ("q1_cmd_mm", "q2_cmd_deg", "smr1_x_mm"):
        np.testing.assert_allclose(table[name], study.one.table[name], rtol=1e-12, atol=1e-9)


COUPLED = np.eye(7)
COUPLED[3, 2] = -1.0  # joint 4 is counted from the horizontal


@pytest.mark.thorough
def test_a_coupled_readout(tmp_path):
    q = poses(COLUMN, 60)
    commands = q @ np.linalg.inv(COUPLED).T
    machine = f"coupling = {COUPLED.tolist()}"
    folder = write_arm(tmp_path / "s", COLUMN, q, commands=commands, machine=machine)
    study = load_study(folder)
    np.testing.assert_allclose(study.plan.position, q, atol=1e-12)
    assert fit_rms(fitted(study)).value < 40.0
    table = study.one.instrument.to_table(study.plan, study.measurement.readings)
    np.testing.assert_allclose(table["q4_cmd_deg"], np.rad2deg(commands[:, 3]), atol=1e-9)
    assert "coupled" in study.chain.text


@pytest.mark.thorough
def test_a_coupling_between_a_slide_and_an_angle_is_in_the_units_of_the_columns(tmp_path):
    q = poses(COLUMN, 20)
    coupling = np.eye(7)
    coupling[0, 1] = 0.5  # mm per degree
    commands = q.copy()
    commands[:, 0] -= 0.5e-3 * np.rad2deg(q[:, 1])
    machine = f"coupling = {coupling.tolist()}"
    study = load_study(write_arm(tmp_path / "s", COLUMN, q, commands=commands, machine=machine))
    np.testing.assert_allclose(study.plan.position, q, atol=1e-12)


@pytest.mark.thorough
def test_modified_rows_in_a_study(tmp_path):
    q = poses(MODIFIED, 50)
    folder = write_arm(
        tmp_path / "s", MODIFIED, q, modified=True, machine='convention = "modified"'
    )
    study = load_study(folder)
    assert study.chain.text == "4 joints, modified DH"
    assert fit_rms(fitted(study)).value < 40.0
    with pytest.raises(StudyError, match="they do with modified DH rows: compare it"):
        load_study(folder, {"machine.convention": "standard"})


@pytest.mark.thorough
def test_moments_of_gravity_for_any_direction():
    up = np.array([0.3, -0.4, 1.2])
    chain = chain_from_dh(si(COLUMN), up=up)
    np.testing.assert_allclose(chain.up, up / np.linalg.norm(up))
    q = poses(COLUMN, 4)
    got = gravity_moments(chain, q, "J3")
    before = flange(COLUMN[:2], q[:, :2])
    turned = before[0] @ about("z", math.radians(-90.0) + q[:, 2])
    # The last place before the tool's is the flange.
    arm = flange(COLUMN, q)[1] - before[1]
    moment = np.cross(arm, -up / np.linalg.norm(up))
    # In the frame of the joint, before its angle theta and its variable.
    local = np.einsum("nji,nj->ni", turned, moment)
    np.testing.assert_allclose(got[:, -3], local, atol=1e-12)


@pytest.mark.thorough
def test_up_is_a_vector_or_an_axis(column):
    lying = load_study(column, {"machine.up": [0, 0, -2.0]})
    assert lying.chain.up == (0.0, 0.0, -1.0) and lying.chain.text.endswith("-Z up")
    assert load_study(column, {"machine.up": [1.0, 0, 1.0]}).chain.text.endswith(
        "(0.7071, 0, 0.7071) up"
    )


LINK = '[[model.geometric.link]]\njoint = "{}"\n{}\n'


def test_links_that_are_fixed_bounded_or_shared(column, tmp_path):
    text = (column / "setup.toml").read_text()
    rows = LINK.format("J3", 'components = "ZC"\nfixed = true')
    rows += LINK.format("J4", "translation_um = 60\nrotation_urad = 90\nbounded = true")
    rows += LINK.format("J6", 'components = "A"\ntie = "J5"')
    (column / "tied.toml").write_text(text + rows)
    study = load_study(column / "tied.toml")
    entries = {e.parameter.name: e.parameter for e in study.model.entries}
    assert not {"EZJ3.0", "ECJ3.0", "EAJ6.0"} & {*entries} and "EXJ3.0" in entries
    assert entries["EXJ4.0"].sigma == pytest.approx(60.0 / math.sqrt(3.0))
    assert entries["EXJ4.0"].law is not None and entries["EXJ5.0"].law is None
    # One parameter moves both joints.
    geometric = next(e for e in study.model.effects if e.name == "geometric")
    ports = [port for port, name in geometric.response(study.plan, {}) if name == "EAJ5.0"]
    assert ports == ["EAJ5", "EAJ6"]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (LINK.format("J9", "fixed = true"), ("model.geometric.link.0.joint", "'J9'")),
        (LINK.format("J2", ""), ("none of them", "fixed = true")),
        (LINK.format("J2", 'tie = "J2"'), ("link.0.tie", "tied to itself")),
        (LINK.format("J2", 'tie = "J1"'), ("varies along a travel",)),
        (LINK.format("J2", "bounded = true\nfixed = true"), ("bounded without a size",)),
        (LINK.format("J2", "fixed = true") * 2, ("EXJ2 again", "link.0")),
    ],
)
def test_wrong_link_rows(column, row, words):
    file = column / "wrong.toml"
    file.write_text((column / "setup.toml").read_text() + row)
    with pytest.raises(StudyError) as refused:
        load_study(file)
    assert all(word in str(refused.value) for word in words), str(refused.value)


@pytest.mark.thorough
def test_a_station_and_reflectors_that_are_known(column):
    base = {
        "instrument.station_mm": [float(v) for v in 1e3 * STATION],
        "instrument.euler_xyz_deg": [0.0, 0.0, 91.0],
    }
    tool = {"instrument.reflectors_mm": [[float(v) for v in 1e3 * REFLECTOR]]}
    keys = lambda study: [e.key for e in study.model.effects]  # noqa: E731
    assert keys(load_study(column)) == ["geometric", "station", "tool_points"]
    known = load_study(column, base | tool)
    assert keys(known) == ["geometric"]
    assert fit_rms(fitted(known)).value < 45.0
    near = load_study(column, base | {"instrument.station_sigma_um": 50.0})
    assert keys(near) == ["geometric", "station", "tool_points"]
    sigma = {e.parameter.name: e.parameter.sigma for e in near.model.entries if e.key == "station"}
    assert sigma["X"] == pytest.approx(50.0) and sigma["A"] == 0.0
    np.testing.assert_allclose(near.one.instrument.points[0], REFLECTOR, atol=5e-3)
    with_tool = load_study(column, tool | {"instrument.reflectors_sigma_um": 100.0})
    fit = fitted(with_tool)
    assert fit_rms(fit).value < 45.0


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"instrument.station_mm": [0, 0, 0]}, ("without euler_xyz_deg",)),
        ({"instrument.station_sigma_um": 1.0}, ("without station_mm",)),
        ({"instrument.reflectors_mm": [[0, 0, 0], [1, 1, 1]]}, ("2 reflectors, expected 1",)),
        ({"machine.coupling": [[1.0, 0.0]]}, ("key machine.coupling", "7 rows of 7 numbers")),
        (
            {"machine.coupling": np.zeros((7, 7)).tolist()},
            ("key machine.coupling", "not invertible"),
        ),
        ({"machine.up": [0, 0, 0]}, ("up = [0, 0, 0]",)),
        ({"machine.convention": "craig"}, ("machine.convention", "standard")),
    ],
)
def test_wrong_keys_of_an_arm(column, keys, words):
    with pytest.raises(StudyError) as refused:
        load_study(column, keys)
    assert all(word in str(refused.value) for word in words), str(refused.value)


def test_a_slide_without_a_travel(tmp_path):
    rows = [{k: v for k, v in COLUMN[0].items() if k[-3:] != "_mm" or k == "d_mm"}, *COLUMN[1:]]
    folder = write_arm(tmp_path / "s", rows, poses(COLUMN, 40))
    with pytest.raises(StudyError, match=r"machine\.joint\.0.*low_mm and high_mm"):
        load_study(folder)


def test_positions_of_a_slide_beyond_its_travel(column, tmp_path):
    q = poses(COLUMN, 30)
    q[7, 0] = 2.5
    folder = write_arm(tmp_path / "s", COLUMN, q)
    with pytest.raises(StudyError, match=r"row 8 .*q1_cmd_mm.*2500"):
        load_study(folder)
    # Of coupled joints, the position counts, not the command.
    machine = "coupling = " + str((0.5 * np.eye(7)).tolist())
    with pytest.raises(StudyError, match="machine.coupling"):
        load_study(write_arm(tmp_path / "c", COLUMN, q, commands=2.0 * q, machine=machine))


def test_records_of_an_axes_survive_pickling():
    import pickle

    axes = Axes(("J1", "J2"), {"J1"})
    assert pickle.loads(pickle.dumps(axes)) == axes
    assert dataclasses.replace(Plan(axes, np.zeros((1, 2)))).axes.sliding == {"J1"}


@pytest.fixture(scope="module")
def twice(tmp_path_factory):
    """An arm that was measured from two places with one tool: upright in the first data set, turned
    in the second.
    """
    folder = tmp_path_factory.mktemp("twice")
    arm = COLUMN[1:]
    q = poses(arm, 120, seed=7)
    q[:60, 3] = 0.0
    q[:60, 4] = math.pi / 2.0 - q[:60, 1] - q[:60, 2]
    reflector = np.array([0.01, 0.0, 0.12])
    for name, rows in (("one", slice(0, 60)), ("two", slice(60, 120))):
        write_arm(folder / name, arm, q[rows], reflector=reflector, seed=len(name) + rows.start)
    setup = (folder / "one" / "setup.toml").read_text()
    machine, rest = setup.split("[instrument]")
    instrument, geometric = rest.split("[model.geometric]")
    data = "".join(
        f'[[data]]\nname = "{name}"\nfile = "{name}.csv"\ntool = "probe"\n'
        f"[data.instrument]{instrument}"
        for name in ("one", "two")
    )
    (folder / "setup.toml").write_text(f"{machine}{data}[model.geometric]{geometric}")
    for name in ("one", "two"):
        (folder / f"{name}.csv").write_text((folder / name / "data.csv").read_text())
    return folder


@pytest.mark.thorough
def test_one_tool_in_two_data_sets(twice):
    study = load_study(twice)
    keys = [effect.key for effect in study.model.effects]
    assert keys == ["geometric", "station one", "station two", "tool_points probe"]
    first, second = (one.instrument for one in study.sets)
    np.testing.assert_array_equal(first.points, second.points)
    fit = fitted(study)
    assert fit_rms(fit).value < 45.0
    place = keys.index("tool_points probe")
    values = {p.name: (value * 1e-6, u * 1e-6) for _, p, value, u in fit.values_of(place)}
    found = first.points[0] + [values[f"1.{c}"][0] for c in "XYZ"]
    assert np.linalg.norm(found - [0.01, 0.0, 0.12]) < 5e-3
    # Alone, the first data set does not determine the height of the reflector.
    apart = (twice / "setup.toml").read_text().replace('tool = "probe"\n', "", 1)
    (twice / "apart.toml").write_text(apart)
    with pytest.raises(StudyError, match="station one Z, tool_points one 1.Z are not identified"):
        load_study(twice / "apart.toml")


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"data.1.instrument.reflectors_mm": [[1, 2, 3]]}, ("data.1.tool", "other reflectors_mm")),
        ({"data.1.tool_offset_mm": [0, 0, 50]}, ("data.1.tool", "another tool_offset_mm")),
    ],
)
def test_tools_of_one_name_that_differ(twice, keys, words):
    with pytest.raises(StudyError) as refused:
        load_study(twice, keys)
    assert all(word in str(refused.value) for word in words), str(refused.value)
