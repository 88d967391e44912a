"""Bases, columns and guideways that yield to the moment of what they carry, against plain numpy."""

import math

import numpy as np
import pytest

from oracle.kinematics import Arm, arm_frames, rotation_matrix
from vcal import CATALOGUE, close_loop, load_study
from vcal.effects.base import Setup
from vcal.effects.carried import carried
from vcal.instruments.recorded import response_column
from vcal.loop.outcome.confirmed import confirmations
from vcal.machine.chain import chain_from_dh, chain_from_string
from vcal.machine.plan import Plan
from vcal.machine.ports import PortLayout
from vcal.model.forward import tool_points

LIFT = Arm(
    a=np.array([0.0, 0.05, 0.6, 0.0]),
    alpha=np.array([0.0, -0.5 * np.pi, 0.0, 0.5 * np.pi]),
    d=np.array([0.2, 0.3, 0.1, 0.5]),
    theta=np.array([0.3, 0.0, -0.4, 0.2]),
    prismatic=np.array([True, False, False, False]),
)
"""A lifting column that carries an arm of three joints."""
TOOL = np.array([0.05, -0.03, 0.15])
DOWN = np.array([0.0, 0.0, -1.0])


def rows_of(arm):
    slides = np.zeros(arm.joints, bool) if arm.prismatic is None else arm.prismatic
    kind = {True: "prismatic", False: "revolute"}
    return [
        {"type": kind[bool(s)], "a": a, "alpha": al, "d": d, "theta": th}
        for s, a, al, d, th in zip(slides, arm.a, arm.alpha, arm.d, arm.theta, strict=True)
    ]


def lifted(rows=60, seed=1):
    """The arm on its column, with positions at five heights."""
    rng = np.random.default_rng(seed)
    q = np.column_stack(
        [rng.choice(np.linspace(0.8, 2.4, 5), rows), rng.uniform(-2.5, 2.5, (rows, 3))]
    )
    chain = chain_from_dh(rows_of(LIFT), TOOL)
    return chain, q


def setup_of(chain, q):
    return Setup(chain, PortLayout.of(chain.axes, ()), Plan(chain.axes, q))


def moved(chain, q, effect, sizes):
    """Tool points with the effect at `sizes` (urad or um)."""
    plan = Plan(chain.axes, q)
    layout = PortLayout.of(chain.axes, ())
    ports = np.zeros((len(q), len(layout)))
    response = effect.response(plan, {})
    for (port, name), values in response.items():
        ports[:, layout.index(port)] += 1e-6 * sizes[name] * np.asarray(values)
    return np.asarray(tool_points(chain, q, ports))


def weights_of(effect, sizes, name):
    """Compliance times weight at every place behind the joint, rad/m, from the parameters."""
    own = np.array([sizes[f"{name}{i + 1}"] for i in range(len(effect.patterns.shares))])
    return 1e-6 * effect.patterns.weights @ own


def moment(weights, points, tool, about):
    """Sum of (c - about) x g over the places, the last two weights being those of a tool 50 mm off
    the flange along its X and Y.
    """
    total = np.zeros((len(points), 3))
    for k in range(points.shape[1]):
        total += weights[k] * np.cross(points[:, k] - about, DOWN)
    for k in range(2):
        total += weights[points.shape[1] + k] * np.cross(0.05 * tool[:, :, k], DOWN)
    return total


def sizes_for(effect, seed=2):
    rng = np.random.default_rng(seed)
    return {p.name: p.sigma * rng.normal() for p in effect.amplitudes}


@pytest.mark.parametrize("stiffness", [0, 1])
def test_a_base_tilts_about_its_foot(stiffness):
    chain, q = lifted()
    effect = list(CATALOGUE["base_compliance"].candidates(setup_of(chain, q)))[stiffness]
    sizes = sizes_for(effect)
    frames, origins = arm_frames(LIFT, q)
    still = origins[:, -1] + frames[:, -1] @ TOOL
    names = ("about_x", "about_y") if stiffness else ("tilt", "tilt")
    tilt = np.zeros((len(q), 3))
    for axis, name in enumerate(names):
        weights = weights_of(effect, sizes, name)
        tilt[:, axis] = moment(weights, origins[:, 1:], frames[:, -1], origins[:, 0])[:, axis]
    assert 1e-5 < np.abs(tilt).max() < 3e-3
    expected = np.einsum("nij,nj->ni", rotation_matrix(tilt), still)
    found = moved(chain, q, effect, sizes)
    largest = np.linalg.norm(expected - still, axis=1).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * largest)
    # Both are of second order in the tilt.
    half = {name: 0.01 * size for name, size in sizes.items()}
    expected = np.einsum("nij,nj->ni", rotation_matrix(0.01 * tilt), still)
    found = moved(chain, q, effect, half)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-7 * largest)


@pytest.mark.parametrize("stiffness", [0, 1])
def test_a_column_bends_as_a_cantilever(stiffness):
    """The curvature M / EI is integrated along the column, twice."""
    chain, q = lifted()
    effect = list(CATALOGUE["column_compliance"].candidates(setup_of(chain, q)))[stiffness]
    assert effect.key == "column_compliance J1"
    sizes = {name: 0.01 * size for name, size in sizes_for(effect).items()}
    frames, origins = arm_frames(LIFT, q)
    still = origins[:, -1] + frames[:, -1] @ TOOL
    names = ("about_x", "about_y") if stiffness else ("tilt", "tilt")
    curvature = np.zeros((len(q), 3))
    for axis, name in enumerate(names):
        weights = weights_of(effect, sizes, name)
        curvature[:, axis] = moment(weights, origins[:, 1:], frames[:, -1], origins[:, 1])[:, axis]
    expected = np.zeros_like(still)
    for n in range(len(q)):
        heights = np.linspace(0.0, LIFT.d[0] + q[n, 0], 4001)
        slope = curvature[n] * heights[:, None]
        # Every piece of the column is carried along by the slope below it.
        step = np.diff(heights)[:, None]
        off = np.sum(0.5 * (slope[1:] + slope[:-1]) * step, axis=0)
        top = origins[n, 1]
        shift = np.cross(off, -DOWN)
        expected[n] = top + shift + rotation_matrix(slope[-1]) @ (still[n] - top)
    found = moved(chain, q, effect, sizes)
    largest = np.linalg.norm(expected - still, axis=1).max()
    assert largest > 1e-6
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * largest)
    # Rotation and translation of the top are consistent: d = (w x up) h / 2.
    (tilts,) = (
        np.sum([1e-6 * sizes[k] * np.asarray(v) for k, v in effect.tilts(plan).items()], axis=0)
        for plan in [Plan(chain.axes, q)]
    )
    top = carried(chain, q, "J1").end
    np.testing.assert_allclose(top, origins[:, 1], atol=1e-12)
    height = (LIFT.d[0] + q[:, 0])[:, None]
    np.testing.assert_allclose(tilts, curvature * height, atol=1e-12)


def test_a_column_of_a_machine_tool_is_clamped_at_either_end():
    chain = chain_from_string("w X b Z Y t", {"X": (0, 1), "Y": (-0.3, 0.3), "Z": (-0.4, 0.1)})
    q = np.random.default_rng(3).uniform([0, -0.3, -0.4], [1, 0.3, 0.1], (40, 3))
    standing, hanging = CATALOGUE["column_compliance"].candidates(setup_of(chain, q))
    assert [p.name for p in standing.parameters] == ["tilt1"]
    assert [p.name for p in hanging.parameters] == ["hanging1"]
    y, z = q[:, 1], q[:, 2]
    for effect, height, way in ((standing, z + 0.4, 1.0), (hanging, 0.1 - z, -1.0)):
        (name,) = (p.name for p in effect.parameters)
        response = effect.response(Plan(chain.axes, q), {})
        # The weight of the ram acts at y: a moment about -X.
        shape = -height * y
        scale = (response["EAZ", name] @ shape) / (shape @ shape)
        np.testing.assert_allclose(response["EAZ", name], scale * shape, atol=1e-12)
        # A tilt about X moves the end of a standing column along -Y, that of a ram along +Y.
        bent = -way * 0.5 * height * response["EAZ", name]
        np.testing.assert_allclose(response["EYZ", name], bent, atol=1e-12)
        assert not np.any(response["EBZ", name]) and not np.any(response["EZZ", name])


@pytest.mark.parametrize(
    ("text", "carrier", "lever", "about"),
    [
        ("w b X Y Z t", "X", 1, "A"),
        ("w X Y b Z t", "Y", 0, "B"),
        ("w b Y X Z t", "Y", 0, "B"),
    ],
)
@pytest.mark.thorough
def test_a_guideway_yields_to_the_position_of_the_slide_that_it_carries(
    text, carrier, lever, about
):
    travel = {"X": (0, 1), "Y": (0, 0.6), "Z": (0, 0.5)}
    chain = chain_from_string(text, travel, (0.0, 0.0, -0.2))
    q = np.random.default_rng(4).uniform(0, 0.5, (40, 3))
    (effect,) = CATALOGUE["guideway_compliance"].candidates(setup_of(chain, q))
    assert effect.placement == carrier
    assert [p.name for p in effect.parameters] == ["tilt1", "sag"]
    response = effect.response(Plan(chain.axes, q), {})
    x = q[:, lever]
    tilt, sag = response[f"E{about}{carrier}", "tilt1"], response[f"EZ{carrier}", "sag"]
    for values in (tilt, sag):
        assert abs(np.corrcoef(values, x)[0, 1]) == pytest.approx(1.0, abs=1e-12)
        assert np.std(values) == pytest.approx(1.0)
    # The tool point moves by w x (p - o): here with the exact rotation of the carriage.
    sizes = {"tilt1": 20.0, "sag": 0.0}
    found = moved(chain, q, effect, sizes)
    nominal = chain.tool_point(q)
    origin = carried(chain, q, carrier).origin
    w = 20e-6 * np.outer(tilt, np.eye(3)["ABC".index(about)])
    tool_side = chain.axes.index(carrier) in chain.tool_side
    bed_tool = q * np.array([chain.axes.index(a) in chain.tool_side for a in "XYZ"])
    bed_tool = bed_tool + [0.0, 0.0, -0.2]
    if tool_side:
        expected = origin + np.einsum("nij,nj->ni", rotation_matrix(w), bed_tool - origin)
    else:
        # The table tilts beneath the tool: about its carriage, which moves against the command.
        place = np.zeros_like(q)
        place[:, 0] = -q[:, 0]
        seen = np.einsum("nji,nj->ni", rotation_matrix(w), bed_tool - origin)
        expected = seen - place
    np.testing.assert_allclose(found - nominal, expected - nominal, rtol=0, atol=1e-12)


def test_weights_of_moments_are_independent_of_the_plan():
    """What an effect amounts to predicts the tilt at other positions."""
    chain, q = lifted()
    effect = next(iter(CATALOGUE["base_compliance"].candidates(setup_of(chain, q))))
    sizes = sizes_for(effect)
    amounts = {
        name: sum(w * sizes[n] for n, w in row.items()) for name, _, row in effect.amounts_to
    }
    assert [*amounts] == [
        "tilt_J2",
        "tilt_J3",
        "tilt_J4",
        "tilt_flange",
        "tilt_off_x",
        "tilt_off_y",
    ]
    other = lifted(seed=9)[1]
    frames, origins = arm_frames(LIFT, other)
    values = 1e-6 * np.array([*amounts.values()])
    expected = moment(values, origins[:, 1:], frames[:, -1], origins[:, 0])
    tilts = effect.tilts(Plan(chain.axes, other))
    found = np.sum([1e-6 * sizes[name] * np.asarray(v) for name, v in tilts.items()], axis=0)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-15)
    assert not found[:, 2].any()


def test_machines_without_a_lever_have_no_candidates():
    chain = chain_from_string("w X b Y Z t", {"X": (0, 1), "Y": (0, 0.6), "Z": (0, 0.5)})
    q = np.random.default_rng(4).uniform(0, 0.5, (40, 3))
    for name in ("base_compliance", "column_compliance", "guideway_compliance"):
        assert not list(CATALOGUE[name].candidates(setup_of(chain, q)))


# --- recorded responses --------------------------------------------------------------------------


def test_names_of_recorded_responses():
    """An accelerometer that tilts reads a part of gravity; an axis's acceleration is a cause."""
    up = (0.0, 0.0, 1.0)
    tilt = np.array([[1e-3, 2e-3, 0.0]])
    for name, expected in (
        ("base_ax_m_s2", -9.80665 * 2e-3),
        ("col_ay_m_s2", 9.80665 * 1e-3),
        ("base_az_m_s2", 0.0),
        ("column_rx_urad", 1e3),
        ("table_ry_urad", 2e3),
    ):
        sensor = response_column(name)
        assert sensor is not None
        turned = rotation_matrix(tilt[0]).T @ [0.0, 0.0, 9.80665]
        found = sensor.reading(tilt, up)[0]
        assert found == pytest.approx(expected, abs=1e-9)
        if sensor.accelerates:
            change = turned - [0.0, 0.0, 9.80665]
            assert found == pytest.approx(change @ np.array(sensor.along), abs=3e-5)
    for name in ("a_x_m_s2", "a_X", "v_x_m_s", "T_x_degC", "psd_u_mm", "ax_m_s2"):
        assert response_column(name) is None


def write_lift(folder, bent, rows=150, seed=4):
    """A study of the arm on its column, whose tool points are those of plain numpy; `bent` is the
    tilt of the top per moment and height, rad/m^2, of a unit weight at the flange.
    """
    rng = np.random.default_rng(seed)
    _, q = lifted(rows, seed)
    frames, origins = arm_frames(LIFT, q)
    points = origins[:, -1] + frames[:, -1] @ TOOL
    height = (LIFT.d[0] + q[:, 0])[:, None]
    turn = bent * height * np.cross(origins[:, -1] - origins[:, 1], DOWN)
    top = origins[:, 1]
    points = (
        top
        + 0.5 * height * np.cross(turn, -DOWN)
        + np.einsum("nij,nj->ni", rotation_matrix(turn), points - top)
    )
    station = rotation_matrix([0.0, 0.0, 0.4])
    seen = points @ station + [2.0, -1.0, 0.3] + rng.normal(0.0, 20e-6, points.shape)
    names = ["q1_cmd_mm", "q2_cmd_deg", "q3_cmd_deg", "q4_cmd_deg"]
    commands = np.column_stack([1e3 * q[:, 0], np.rad2deg(q[:, 1:])])
    ax = -9.80665 * turn[:, 1] + rng.normal(0.0, 1e-3, rows)
    ay = 9.80665 * turn[:, 0] + rng.normal(0.0, 1e-3, rows)
    other = rng.normal(0.0, 100.0, rows)
    header = ["pose", *names, "smr1_x_mm", "smr1_y_mm", "smr1_z_mm"]
    header += ["top_ax_m_s2", "top_ay_m_s2", "floor_rx_urad"]
    table = np.column_stack([np.arange(rows), commands, 1e3 * seen, ax, ay, other])
    folder.mkdir()
    np.savetxt(folder / "data.csv", table, fmt="%.12g", delimiter=",", header=",".join(header),
               comments="")  # fmt: skip
    rows_toml = "".join(
        f'[[machine.joint]]\ntype = "{"prismatic" if s else "revolute"}"\na_mm = {1e3 * a}\n'
        f"alpha_deg = {math.degrees(al)}\nd_mm = {1e3 * d}\ntheta_deg = {math.degrees(th)}\n"
        + ("low_mm = 500\nhigh_mm = 2600\n" if s else "")
        for s, a, al, d, th in zip(
            LIFT.prismatic, LIFT.a, LIFT.alpha, LIFT.d, LIFT.theta, strict=True
        )
    )
    (folder / "setup.toml").write_text(
        'name = "lift"\n[machine]\ntool_offset_mm = [50, -30, 150]\n' + rows_toml + "[instrument]\n"
        'kind = "reflectors"\ntool_reflectors = 1\nsigma_um = 20\n[model.geometric]\n'
        "link_translation_um = 200\nlink_rotation_urad = 200\nslide_translation_um = 20\n"
        "slide_rotation_urad = 20\n"
    )
    return folder, turn


@pytest.mark.slow
def test_a_column_that_bends_is_named_and_confirmed(tmp_path):
    folder, turn = write_lift(tmp_path / "lift", 1.5e-4)
    study = load_study(folder)
    closure = close_loop(study.model, study.measurement, draws=100)
    first = closure.effects[0]
    assert first.effect.key == "column_compliance J1"
    assert closure.errors["after"].chi2_per_dof == pytest.approx(1.0, abs=0.15)
    assert closure.errors["before"].chi2_per_dof > 2.0
    found = {(c.column, c.effect): c for c in confirmations(closure)}
    for column in ("top_ax_m_s2", "top_ay_m_s2"):
        one = found[column, "column_compliance J1"]
        assert abs(one.coefficient - 1.0) < 2.0 * one.expanded < 0.3
        assert abs(one.across) < 2.0 * one.across_expanded
        assert one.p_value < 1e-6 and one.share > 0.3
    other = found["floor_rx_urad", "column_compliance J1"]
    assert other.p_value > 1e-3 and other.share < 0.1
    # A response explains no residual: it is no covariate.
    described = closure.unexplained.depends_on if closure.unexplained else []
    assert not {"top_ax_m_s2", "top_ay_m_s2", "floor_rx_urad"} & {*described}
    assert np.abs(turn).max() > 1e-4
