"""The picture of the declared machine: its numbers against the kinematics, and what is drawn."""

import json
import math
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from arms import COLUMN, write_arm
from vcal import load_study
from vcal.cli.commands import app
from vcal.demo import STARTS
from vcal.geometry.declared_machine import Measured, declared_machine, nominal_frames
from vcal.instruments.marks import Mark
from vcal.machine.chain import chain_from_dh, chain_from_string
from vcal.machine.plan import Plan
from vcal.plots import machine_views, svg
from vcal.plots.declared_machine import TOOL, WORKPIECE
from vcal.report.machine.section import machine_pictures, of_study

AT = {"A": (0.0, 0.0, -0.12), "C": (0.01, -0.02, -0.2)}
ROWS = [
    {
        "type": row["type"],
        "a": 1e-3 * row.get("a_mm", 0.0),
        "d": 1e-3 * row.get("d_mm", 0.0),
        "alpha": math.radians(row.get("alpha_deg", 0.0)),
        "theta": math.radians(row.get("theta_deg", 0.0)),
    }
    for row in COLUMN
]
CHAINS = {
    "three axes": chain_from_string("w X b Y Z t", {"X": (0, 1)}, (0.0, 0.0, -0.15)),
    "quill": chain_from_string("w X b Y Z W t", {}, (0.0, 0.0, -0.2), up="+Y"),
    "trunnion": chain_from_string("w C A b Y X Z t", {}, (0.0, 0.0, -0.15), AT),
    "exchanged": chain_from_string("w A C b Y X Z t", {}, (0.0, 0.0, -0.15), AT),
    "head": chain_from_string(
        "w b X Y Z C B t", {}, (0.0, 0.0, -0.3), {"B": (0, 0, 0.1), "C": (0.2, 0, 0)}
    ),
    "mixed": chain_from_string(
        "w C b X Y Z B t", {}, (0.05, 0.0, -0.3), {"B": (0, 0, 0.1), "C": (0.2, 0.3, 0)}
    ),
    "arm on a column": chain_from_dh(ROWS, (0.03, 0.0, 0.1)),
    "modified rows": chain_from_dh(ROWS, (0.03, 0.0, 0.1), "-Z", "modified"),
}


@pytest.fixture(params=CHAINS, ids=lambda name: name.replace(" ", "_"))
def chain(request):
    return CHAINS[request.param]


# --- the numbers --------------------------------------------------------------------------------


def test_a_positive_command_moves_the_tool_as_the_arrow_says(chain):
    """Relative to the workpiece, along the arrow, or about the axis by the right-hand rule."""
    machine = declared_machine(chain, [])
    step = 1e-6
    zero = np.zeros((1, len(chain.axes)))
    tool = chain.tool_point(zero)[0]
    np.testing.assert_allclose(machine.tool_point, tool, atol=1e-12)
    assert {axis.name for axis in machine.axes} == {*chain.axes}
    for axis in machine.axes:
        there = zero + step * (np.array(chain.axes) == axis.name)
        back = zero - step * (np.array(chain.axes) == axis.name)
        moved = (chain.tool_point(there) - chain.tool_point(back))[0] / (2.0 * step)
        expected = axis.relative
        if axis.turns:
            expected = np.cross(axis.relative, tool - axis.place)
        np.testing.assert_allclose(moved, expected, atol=1e-9, err_msg=axis.name)


def test_frames_are_those_of_the_chain(chain):
    q = np.random.default_rng(0).uniform(-1.0, 1.0, len(chain.axes))
    found = nominal_frames(chain, q)
    turn, point = chain.tool_frame(q[None])
    np.testing.assert_allclose(found.tool_rotation, turn[0], atol=1e-12)
    end = found.tool_origin + found.tool_rotation @ np.asarray(chain.tool_offset)
    np.testing.assert_allclose(end, point[0], atol=1e-12)
    if chain.arm:  # the chain's own frames are those of the bed
        rotation, origin = chain.frames(q[None])
        np.testing.assert_allclose(found.rotation, rotation[0], atol=1e-12)
        np.testing.assert_allclose(found.origin, origin[0], atol=1e-12)


def test_axes_of_a_trunnion_table():
    """C is next to the workpiece: seen from there it stands still, and A turns with it."""
    machine = declared_machine(CHAINS["trunnion"], [])
    assert (machine.workpiece_side, machine.tool_side) == (("C", "A"), ("Y", "X", "Z"))
    c, a, y, x, z = machine.axes
    assert [axis.name for axis in (c, a, y, x, z)] == ["C", "A", "Y", "X", "Z"]
    # A table turns and moves against its command (ISO 841).
    assert c.moves == a.moves == "workpiece" and x.moves == "tool"
    np.testing.assert_allclose(c.direction, [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(a.direction, [-1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(c.place, AT["C"], atol=1e-15)
    np.testing.assert_allclose(x.direction, [1, 0, 0], atol=1e-15)
    for name, order in (("trunnion", "CA"), ("exchanged", "AC")):
        q = np.zeros(5)
        q[3:] = 0.4, 0.7  # A, C
        frames = nominal_frames(CHAINS[name], q)
        outer, inner = (CHAINS[name].axes.index(axis) for axis in order)
        about = {3: [1, 0, 0], 4: [0, 0, 1]}
        # The outer axis stands still; the inner one is turned by the command of the outer one.
        np.testing.assert_allclose(
            frames.rotation[outer].T @ about[outer], about[outer], atol=1e-12
        )
        turned = Rotation.from_rotvec(q[outer] * np.array(about[outer])).apply(about[inner])
        np.testing.assert_allclose(frames.rotation[inner] @ about[inner], turned, atol=1e-12)


def test_travel_is_that_of_the_tool_point():
    chain = chain_from_string(
        "w X b Y Z W t", {"X": (0, 1), "Y": (-0.2, 0.3), "Z": (0, 0.5), "W": (0, 0.1)},
        (0.0, 0.0, -0.15),
    )  # fmt: skip
    machine = declared_machine(chain, [])
    np.testing.assert_allclose(machine.travel, [[0, -0.2, -0.15], [1, 0.3, 0.45]], atol=1e-15)
    assert declared_machine(CHAINS["quill"], []).travel is None


def test_links_of_an_arm():
    """By Denavit-Hartenberg rows: d along the axis of the joint, then a across it."""
    rows = [
        {"type": "revolute", "d": 0.4, "a": 0.1, "alpha": -np.pi / 2},
        {"type": "revolute", "a": 0.5, "theta": -np.pi / 2},
        {"type": "prismatic", "d": 0.2},
    ]
    machine = declared_machine(chain_from_dh(rows, (0.0, 0.0, 0.05)), [])
    (zero,) = machine.poses
    # The second joint turns about +Y, and its link stands up.
    expected = [[0, 0, 0], [0, 0, 0.4], [0.1, 0, 0.4], [0.1, 0, 0.9], [0.1, 0.2, 0.9]]
    np.testing.assert_allclose(zero.links, expected, atol=1e-12)
    np.testing.assert_allclose(zero.tool, [0.1, 0.25, 0.9], atol=1e-12)
    directions = [axis.direction for axis in machine.axes]
    np.testing.assert_allclose(directions, [[0, 0, 1], [0, 1, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(machine.axes[0].place, [0, 0, 0.2], atol=1e-12)


# --- instruments --------------------------------------------------------------------------------


def tracker(folder, station, sign=1.0, chain="w X b Y Z t"):
    """A study of a tracker that stands at (-0.9, 0.3, 0.5) m, azimuth zero along +Y."""
    rng = np.random.default_rng(3)
    q = rng.uniform([0, 0, 0], [0.8, 0.5, 0.4], (60, 3))
    turn = Rotation.from_euler("z", 90, degrees=True)
    v = turn.inv().apply(q + [0, 0, -0.2] - np.array([-0.9, 0.3, 0.5]))
    r = np.linalg.norm(v, axis=1)
    columns = {"x_mm": 1e3 * sign * q[:, 0], "y_mm": 1e3 * q[:, 1], "z_mm": 1e3 * q[:, 2]}
    columns |= {"range_mm": 1e3 * r, "azimuth_rad": np.arctan2(v[:, 1], v[:, 0])}
    columns |= {"elevation_rad": np.arcsin(v[:, 2] / r)}
    lines = (",".join(repr(float(x)) for x in row) for row in zip(*columns.values(), strict=True))
    folder.mkdir(exist_ok=True)
    (folder / "data.csv").write_text("\n".join([",".join(columns), *lines]) + "\n")
    low = -800 if sign < 0 else 0
    (folder / "setup.toml").write_text(
        f'[machine]\nchain = "{chain}"\ntool_offset_mm = [0, 0, -200]\n'
        f"travel_mm = {{ X = [{low}, {low + 800}], Y = [0, 500], Z = [0, 400] }}\n"
        '[instrument]\nkind = "laser_tracker"\nrange_sigma_um = 1\nangle_sigma_urad = 1\n'
        f"station_mm = {[*station]}\neuler_xyz_deg = [0, 0, 90]\n"
        "[model.geometric]\nfamily = 'smooth'\ntranslation_um = 10\nrotation_urad = 20\n"
        "squareness_urad = 50\n"
    )
    return folder


def test_station_as_declared(tmp_path):
    (seen,) = of_study(load_study(tracker(tmp_path, (-900, 300, 500)))).seen
    (station,) = seen.marks
    assert station.azimuth and station.name == "station"
    np.testing.assert_allclose(station.frame[:, 0], [0, 1, 0], atol=1e-12)
    assert seen.station is None and seen.moved is None and seen.follows
    assert seen.rms < 1e-9


def test_station_on_the_other_side(tmp_path):
    """The readings place it in closed form, wherever it is declared."""
    machine = of_study(load_study(tracker(tmp_path, (1500, 300, 500))))
    (seen,) = machine.seen
    np.testing.assert_allclose(seen.station.places, [[-0.9, 0.3, 0.5]], atol=1e-9)
    np.testing.assert_allclose(seen.station.frame[:, 0], [0, 1, 0], atol=1e-9)
    assert seen.moved == pytest.approx(2.4) and seen.follows
    alt = machine_pictures(machine)[0].alt
    assert "place the station at (−900, 300, 500) mm, 2400 mm from where it is declared" in alt
    assert "The declared machine, XZ, seen from −Y. Chain: workpiece → X → bed → Y → Z" in alt


@pytest.mark.thorough
def test_two_data_sets_have_their_own_stations(tmp_path):
    """Each with its own tool, by their names."""
    tracker(tmp_path, (-900, 300, 500))
    text = (tmp_path / "setup.toml").read_text()
    machine, _, rest = text.partition("[instrument]")
    instrument, _, model = rest.partition("[model.geometric]")
    more = instrument.replace("-900", "-1300")
    lines = (tmp_path / "data.csv").read_text().splitlines()
    for name, part in (("hall", lines[1:31]), ("yard", lines[31:])):
        (tmp_path / f"{name}.csv").write_text("\n".join([lines[0], *part]) + "\n")
    (tmp_path / "setup.toml").write_text(
        f"{machine}[[data]]\nname = 'hall'\nfile = 'hall.csv'\n[data.instrument]{instrument}"
        f"[[data]]\nname = 'yard'\nfile = 'yard.csv'\ntool_offset_mm = [0, 0, -300]\n"
        f"[data.instrument]{more}[model.geometric]{model}"
    )
    machine = of_study(load_study(tmp_path))
    hall, yard = machine.seen
    assert hall.station is None and hall.name == "hall"
    # The tool of the other data set is 100 mm longer, and so is its station lower.
    np.testing.assert_allclose(yard.station.places, [[-0.9, 0.3, 0.4]], atol=1e-9)
    words = [t.get_text() for t in machine_views(machine)["xz"].axes[0].texts]
    assert {"hall: station", "yard: station", "yard: station by the readings"} <= {*words}


@pytest.mark.parametrize("kind", sorted(path.name for path in STARTS.iterdir() if path.is_dir()))
@pytest.mark.thorough
def test_every_instrument_has_its_marks(kind):
    study = load_study(STARTS / kind)
    (seen,) = of_study(study).seen
    marks = study.sets[0].instrument.marks(study.chain, study.plan)
    assert marks and all(mark.places.shape[1] == 3 for mark in marks)
    # The marks are in the middle of what was measured, but for a station.
    places = [m.places for m in marks if m.on == "workpiece" and m.frame is None]
    if places:
        low, high = seen.nominal.min(0) - 0.01, seen.nominal.max(0) + 0.01
        inside = (np.concatenate(places) >= low) & (np.concatenate(places) <= high)
        assert inside.mean() > 0.7
    if seen.measured is not None:
        assert seen.follows and seen.rms < 3e-3
    else:
        assert kind in {
            "ball_array", "double_ball_bar", "interferometer", "laser_frame", "r_test",
            "static_r_test", "touch_probe",
        }  # fmt: skip


@pytest.mark.thorough
def test_arm_on_a_column(tmp_path):
    """The tracker is free: it is shown where the readings place it."""
    q = np.random.default_rng(0).uniform([0, *[-1] * 6], [2, *[1] * 6], (40, 7))
    write_arm(tmp_path, COLUMN, q)
    machine = of_study(load_study(tmp_path))
    assert [pose.name for pose in machine.poses][0] == "zero pose" and len(machine.poses) == 4
    assert all(re.fullmatch(r"row \d+", pose.name) for pose in machine.poses[1:])
    (seen,) = machine.seen
    np.testing.assert_allclose(seen.station.places, [[3.0, -2.0, 0.4]], atol=2e-3)
    assert seen.moved is None
    row = int(machine.poses[1].name.split()[1]) - 1
    chain = load_study(tmp_path).chain
    np.testing.assert_allclose(machine.poses[1].tool, chain.tool_point(q[[row]])[0], atol=1e-9)


# --- the drawing --------------------------------------------------------------------------------


def _turning(drawn, colour):
    """Signed area of the thick arcs of this colour: positive where they run anticlockwise."""
    areas = []
    for line in drawn.axes[0].lines:
        x, y = np.asarray(line.get_data(), float)
        if line.get_color() == colour and len(x) > 20:
            x, y = x - x.mean(), y - y.mean()
            areas.append(float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])))
    return areas


@pytest.mark.parametrize(
    "text, colour, anticlockwise", [("w C b X Y Z t", WORKPIECE, 0), ("w b X Y Z C t", TOOL, 1)]
)
def test_sense_of_a_rotation_on_the_page(text, colour, anticlockwise):
    """Seen from +Z, a head C turns anticlockwise, and a table C clockwise."""
    chain = chain_from_string(text, {}, (0.0, 0.0, -0.1), {"C": (0.0, 0.0, 0.0)})
    views = machine_views(declared_machine(chain, []))
    (area,) = _turning(views["xy"], colour)
    assert (area > 0.0) == anticlockwise
    # From the side, the near side moves along axis x viewer: for C from -Y, towards +X.
    words = [t.get_text() for t in views["xz"].axes[0].texts]
    assert ("+C′" in words) == (colour == WORKPIECE) and ("+C" in words) == (colour == TOOL)


def test_arrows_of_linear_axes_on_the_page():
    """A table X moves to the left for +X, in the colour of the workpiece; Y goes away from a viewer
    at -Y.
    """
    views = machine_views(declared_machine(CHAINS["three axes"], []))
    ax = views["xz"].axes[0]
    arrows = {
        tuple(np.sign(np.round(np.subtract(t.xy, t.xyann), 6)))
        for t in ax.texts
        if getattr(t, "arrow_patch", None) is not None
    }
    assert {(-1.0, 0.0), (0.0, 1.0)} <= arrows
    words = [t.get_text() for t in ax.texts]
    assert {"+X′", "+Y", "+Z", "zero", "tool", "travel"} <= {*words}
    assert sum(line.get_marker() == "x" for line in ax.lines) == 1  # Y
    gravity = {key: next(t for t in v.axes[0].texts if "gravity" in t.get_text()).get_text()
               for key, v in views.items()}  # fmt: skip
    assert gravity["xz"] == gravity["space"] == "gravity ↓" and "⊗" in gravity["xy"]


def test_pictures_are_to_scale(chain):
    for key, drawn in machine_views(declared_machine(chain, [])).items():
        ax = drawn.axes[0]
        size = drawn.get_size_inches() * [ax.get_position().width, ax.get_position().height]
        across = np.ptp(ax.get_xlim()) / size[0], np.ptp(ax.get_ylim()) / size[1]
        assert across[0] == pytest.approx(across[1], rel=1e-9)
        if key != "space":
            assert ax.get_xlabel().endswith(", mm") and ax.get_ylabel().endswith(", mm")


def test_far_station_is_pointed_at(tmp_path):
    study = load_study(tracker(tmp_path, (-900, 300, 500)))
    one = study.sets[0]
    machine = of_study(study)
    (seen,) = machine.seen
    far = Mark("station", np.array([[-50.0, 0.3, 0.5]]), frame=np.eye(3), azimuth=True)
    object.__setattr__(seen, "marks", (far,))
    ax = machine_views(machine)["xy"].axes[0]
    assert any(re.fullmatch(r"station, 50\.\d m away", t.get_text()) for t in ax.texts)
    assert np.ptp(ax.get_xlim()) < 5e3 and one.name == ""


@pytest.mark.slow
def test_drawing_is_the_same_every_time():
    machine = of_study(load_study(STARTS / "static_r_test"))
    first, second = (
        {name: svg(drawn) for name, drawn in machine_views(machine).items()} for _ in range(2)
    )
    assert first == second and [*first] == ["xz", "yz", "xy", "space"]
    for data in first.values():
        assert data.startswith(b"<?xml") and b"<dc:date>" not in data and len(data) < 300_000


def test_many_points_are_thinned(tmp_path):
    chain = CHAINS["three axes"]
    study = load_study(STARTS / "laser_tracker")
    one = study.sets[0]
    rows = np.arange(100_000) % one.plan.rows
    plan = Plan(one.plan.axes, np.asarray(one.plan.position)[rows])
    machine = declared_machine(
        chain, [Measured("", "tracker", chain, one.instrument, one.instrument, plan, None)]
    )
    data = svg(machine_views(machine)["xy"])
    assert len(machine.seen[0].nominal) == 100_000 and len(data) < 200_000


# --- the pages ----------------------------------------------------------------------------------


@pytest.mark.thorough
def test_check_writes_a_page(tmp_path):
    folder, out = tracker(tmp_path / "study", (-900, 300, 500)), tmp_path / "out"
    done = CliRunner().invoke(app, ["check", str(folder), "--out", str(out)])
    assert done.exit_code == 0 and f"Page: {out / 'index.html'}" in done.output
    record = json.loads((out / "check.json").read_text(encoding="utf-8"))
    assert sorted(p.name for p in out.iterdir()) == sorted(record["files"])
    assert {f"machine_{key}.svg" for key in ("xz", "yz", "xy", "space")} < {*record["files"]}
    assert record["refused"] is None
    x, y, z = record["machine"]["axes"]
    assert (x["name"], x["moves"], x["direction"]) == ("X", "workpiece", [-1, 0, 0])
    assert y["travel_mm"] == [0, 500] and z["direction"] == [0, 0, 1]
    page = (out / "index.html").read_text(encoding="utf-8")
    assert page.count("data:image/svg+xml;base64,") == 4 and "<script" not in page
    assert page.count('<figure class="half">') == 4 and "<figcaption>" not in page
    for words in ("<td>X′</td><td>the workpiece</td><td>moves it along −X</td>", "to be tested"):
        assert words in page
    again = CliRunner().invoke(app, ["check", str(folder), "--out", str(out)])
    assert again.exit_code == 0


def test_refused_study_still_shows_its_machine(tmp_path):
    """A column with the other sign: the readings do not follow, and the picture shows both."""
    folder, out = tracker(tmp_path / "study", (-900, 300, 500), sign=-1.0), tmp_path / "out"
    done = CliRunner().invoke(app, ["check", str(folder), "--out", str(out)])
    assert done.exit_code == 2 and "tool point at the axis positions" in done.output
    page = (out / "index.html").read_text(encoding="utf-8")
    assert "Refused" in page and "They do not follow it" in page
    record = json.loads((out / "check.json").read_text(encoding="utf-8"))
    assert record["refused"] in re.sub(r"\s+", " ", done.output)
    (seen,) = record["machine"]["data_sets"]
    assert seen["rms_from_declared_mm"] > 50.0 and seen["station_by_readings_mm"] is None


@pytest.mark.thorough
def test_refused_study_file_has_no_page(tmp_path):
    folder, out = tracker(tmp_path / "study", (-900, 300, 500), chain="w X b Q t"), tmp_path / "out"
    done = CliRunner().invoke(app, ["check", str(folder), "--out", str(out)])
    assert done.exit_code == 2 and "machine.chain" in done.output and not out.exists()
