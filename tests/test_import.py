"""`vcal import`: exports of an independent writer keep their numbers and pass the check."""

import csv
import re
import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from arms import COLUMN, flange
from exports import (
    ANGLE,
    LENGTH,
    OFFSET,
    coordinates,
    lines_of,
    polar,
    sphere_contacts,
    text_of,
    tracker_case,
    write,
)
from test_urdf import URDF, tip
from vcal import StudyError
from vcal.cli import app
from vcal.importers import FORMATS, Options, import_study
from vcal.instruments import INSTRUMENTS
from vcal.study import load_study

CHAIN = "w X b Y Z t"
FORM = re.compile(r"^.+: found .+, expected .+; .+", re.DOTALL)
MACHINE = {"machine": CHAIN, "tool_offset": "0,0,-150"}
TRAVEL = [f"machine.travel_mm.{a}=[0,{n}]" for a, n in (("X", 1000), ("Y", 600), ("Z", 500))]
TRACKER = [*TRAVEL, "instrument.range_sigma_um=1.5", "instrument.angle_sigma_urad=2.5"]


def table(folder, name="data.csv"):
    """Columns of a written table: arrays, or texts."""
    with open(folder / name, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found = {}
    for column in rows[0]:
        cells = [row[column] for row in rows]
        try:
            found[column] = np.array([float(cell) for cell in cells])
        except ValueError:
            found[column] = cells
    return found


def setup(folder):
    return tomllib.loads((folder / "setup.toml").read_text(encoding="utf-8"))


def same(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


# --- point lists of trackers ---------------------------------------------------------------------

POINTS = {
    "cartesian, header": ("cartesian", "mm", "deg", ",", ".", "header", "utf-8"),
    "inches, decimal commas": ("cartesian", "inch", "deg", "\t", ",", "header", "utf-8-sig"),
    "metres, UTF-16": ("cartesian", "m", "deg", ";", ",", "header", "utf-16"),
    "units in a row": ("spherical", "m", "gon", ";", ",", "row", "cp1252"),
    "units in comments": ("spherical", "inch", "deg", ",", ".", "comment", "utf-8"),
    "units in options": ("spherical", "mm", "rad", " ", ".", "option", "utf-8"),
    "zenith distance": ("zenith", "mm", "gon", "\t", ".", "header", "utf-8"),
    "cylindrical": ("cylindrical", "mm", "deg", ",", ".", "header", "utf-8"),
    "cylindrical, commas and blanks": ("cylindrical", "m", "rad", "  ", ",", "comment", "utf-8"),
}


def write_points(path, seen, system, length, angle, separator, decimal, where, encoding):
    """A point list with names; the file is out of order by nothing but its writer's habits."""
    columns, names, is_angle = coordinates(seen, system)
    units = [angle if a else length for a in is_angle]
    factors = [ANGLE[angle] if a else LENGTH[length] for a in is_angle]
    cells = [[v * f for v in c] for c, f in zip(columns, factors, strict=True)]
    head = [
        "Name",
        *(f"{n} [{u}]" if where == "header" else n for n, u in zip(names, units, strict=True)),
    ]
    comments = ["// Laser tracker, frame of the instrument", "// version 1.0"]
    if where == "comment":
        comments.append(f"// Units: {length}, {angle}")
    rows = [[f"P{i}", *row] for i, row in enumerate(zip(*cells, strict=True))]
    lines = [*comments, separator.join(head)]
    if where == "row":
        lines.append(separator.join(["-", *units]))
    return write(path, [*lines, *lines_of(rows, separator, decimal)], encoding)


def write_positions(path, positions, order=None):
    rows = [[f"P{i}", *row] for i, row in enumerate(positions)]
    rows = rows if order is None else [rows[i] for i in order]
    return write(path, ["name,x_mm,y_mm,z_mm", *lines_of(rows)])


@pytest.mark.parametrize("case", POINTS)
def test_a_point_list_keeps_its_numbers(case, tmp_path):
    positions, seen = tracker_case()
    system, length, angle, _, _, where, _ = POINTS[case]
    export = write_points(tmp_path / "points.txt", seen, *POINTS[case])
    # By the names of the points, in whatever order the positions are.
    order = np.random.default_rng(1).permutation(len(seen))
    options = Options(positions=write_positions(tmp_path / "nominal.csv", positions, order))
    if where == "option":
        options = Options(positions=options.positions, unit=length, angle_unit=angle)
    out = tmp_path / "study"
    import_study([export], out, options=options, overrides=TRACKER, checked=False, **MACHINE)
    found = table(out)
    for name, expected in zip("xyz", positions.T, strict=True):
        assert np.array_equal(found[f"{name}_mm"], expected)
    for name, expected in zip(
        ("range_mm", "azimuth_rad", "elevation_rad"), polar(seen), strict=True
    ):
        same(found[name], expected)
    assert np.array_equal(found["point"], np.arange(len(seen)))


def test_an_imported_point_list_passes_the_check_and_knows_its_station(tmp_path):
    positions, seen = tracker_case()
    export = write_points(tmp_path / "points.txt", seen, *POINTS["inches, decimal commas"])
    out = tmp_path / "study"
    options = Options(positions=write_positions(tmp_path / "nominal.csv", positions))
    done = import_study([export], out, options=options, overrides=TRACKER, **MACHINE)
    assert done.formats == ["laser_tracker"] and done.rows == {"data.csv": 40}
    study = load_study(out)
    assert study.measurement.rows == 40
    assert study.chain.text == CHAIN
    np.testing.assert_allclose(setup(out)["instrument"]["station_mm"], [-900, 350, 420], atol=0.02)
    np.testing.assert_allclose(setup(out)["instrument"]["euler_xyz_deg"], [3, -2, 25], atol=1e-3)
    # The same study with a note on where it came from.
    head = (out / "setup.toml").read_text(encoding="utf-8")
    assert re.search(r"^#   points.txt \(laser_tracker\), SHA-256 [0-9a-f]{64}$", head, re.M)


def test_nominal_columns_times_and_uncertainties(tmp_path):
    positions, seen = tracker_case()
    head = "Target Name,Nom X (mm),Nom Y (mm),Nom Z (mm),Act X (m),Act Y (m),Act Z (m),"
    head += "Ux (mm),Uy (mm),Uz (mm),Timestamp,RMS"
    rows = [
        [f"P {i}", *p, *(v * 1e-3), 0.01, 0.01, 0.02, f"2024-03-05 10:{i:02d}:00.500", 0.003]
        for i, (p, v) in enumerate(zip(positions, seen, strict=True))
    ]
    export = write(tmp_path / "points.csv", [head, *lines_of(rows)])
    out = tmp_path / "study"
    done = import_study([export], out, overrides=TRACKER, checked=False, **MACHINE)
    found = table(out)
    assert np.array_equal(found["x_mm"], positions[:, 0])
    same(found["range_mm"], polar(seen)[0])
    assert np.array_equal(found["t_s"], 60.0 * np.arange(40))
    assert any("left out: RMS" in note for note in done.notes)
    assert any("rms 14.1 um" in note for note in done.notes)


@pytest.mark.parametrize(
    ("stamps", "given", "message"),
    [
        (["03/04/2024 10:00:00", "04/04/2024 10:00:00"], None, "--time-format"),
        (["03/04/2024 10:00:00", "04/04/2024 10:00:00"], "%d/%m/%Y %H:%M:%S", None),
        (["03/14/2024 01:00:00 PM", "03/15/2024 01:00:00 PM"], None, None),
        (["14.03.2024 13:00:00", "15.03.2024 13:00:00"], None, None),
        (["2024-03-14T13:00:00+01:00", "2024-03-15T13:00:00+01:00"], None, None),
    ],
)
def test_a_date_is_not_guessed(stamps, given, message, tmp_path):
    """Day and month in front give other intervals for some dates, and the same for others."""
    positions, seen = tracker_case(2)
    rows = [[*p, *v, s] for p, v, s in zip(positions, seen, stamps, strict=True)]
    head = "nom x mm;nom y mm;nom z mm;x mm;y mm;z mm;time"
    export = write(tmp_path / "points.csv", [head, *lines_of(rows, ";")])
    overrides = [*TRACKER, "instrument.station_mm=[0,0,0]", "instrument.euler_xyz_deg=[0,0,0]"]

    def run():
        import_study(
            [export],
            tmp_path / "study",
            options=Options(time_format=given),
            overrides=overrides,
            checked=False,
            **MACHINE,
        )

    if message:
        with pytest.raises(StudyError, match=message):
            run()
    else:
        with pytest.raises(StudyError, match="points on a line"):
            run()  # two points determine no station: the times were read before that


def test_theta_and_phi_are_not_guessed(tmp_path):
    positions, seen = tracker_case()
    r, azimuth, elevation = polar(seen)
    rows = [
        [*p, *row]
        for p, row in zip(positions, np.c_[r, np.pi / 2 - elevation, azimuth], strict=True)
    ]
    head = "nom x mm,nom y mm,nom z mm,R [mm],Theta [rad],Phi [rad]"
    export = write(tmp_path / "points.csv", [head, *lines_of(rows)])
    with pytest.raises(StudyError, match="--angles"):
        import_study([export], tmp_path / "study", overrides=TRACKER, **MACHINE)
    import_study(
        [export],
        tmp_path / "study",
        options=Options(angles="zenith,azimuth"),
        overrides=TRACKER,
        checked=False,
        **MACHINE,
    )
    same(table(tmp_path / "study")["azimuth_rad"], azimuth)
    same(table(tmp_path / "study")["elevation_rad"], elevation)


def test_a_list_without_a_header(tmp_path):
    positions, seen = tracker_case()
    rows = [["job", "main", str(i), *v] for i, v in enumerate(seen)]
    export = write(tmp_path / "points.txt", ["// Cartesian, units mm", *lines_of(rows, " ")])
    nominal = write(
        tmp_path / "nominal.txt",
        ["no x y z", *lines_of([[str(i), *p] for i, p in enumerate(positions)], " ")],
    )
    options = Options(positions=nominal, unit="mm")
    import_study(
        [export], tmp_path / "study", options=options, overrides=TRACKER, checked=False, **MACHINE
    )
    same(table(tmp_path / "study")["range_mm"], polar(seen)[0])


@pytest.mark.thorough
def test_several_lists_are_several_data_sets(tmp_path):
    positions, seen = tracker_case()
    other = seen @ Rotation.from_euler("z", 70, degrees=True).as_matrix() + [500.0, 0.0, 20.0]
    exports = []
    for name, points in (("first day", seen), ("2nd", other)):
        rows = [[*p, *v] for p, v in zip(positions, points, strict=True)]
        head = "nom x mm,nom y mm,nom z mm,meas x mm,meas y mm,meas z mm"
        exports.append(write(tmp_path / f"{name}.csv", [head, *lines_of(rows)]))
    out = tmp_path / "study"
    import_study(exports, out, overrides=TRACKER, **MACHINE)
    rows = setup(out)["data"]
    assert [row["name"] for row in rows] == ["first_day", "2nd"]
    assert all(row["instrument"]["angle_sigma_urad"] == 2.5 for row in rows)
    same(table(out, "2nd.csv")["range_mm"], polar(other)[0])


# --- arms ----------------------------------------------------------------------------------------


def arm_case(rows=40, seed=2):
    """Joint positions of a column with a six-axis arm (m, rad), and two points in a tracker's frame
    (mm).
    """
    rng = np.random.default_rng(seed)
    q = rng.uniform([0.2] + 6 * [-1.2], [1.8] + 6 * [1.2], (rows, 7))
    r, t = flange(COLUMN, q)
    turn = Rotation.from_euler("z", 91, degrees=True).as_matrix()
    points = [
        (t + r @ np.array(p) - [3.0, -2.0, 0.4]) @ turn for p in ((0.05, 0, 0.1), (0, 0.1, 0))
    ]
    noise = 2e-5 * rng.standard_normal((2, rows, 3))
    return q, 1e3 * (np.array(points) + noise)


def write_machine(path):
    rows = ""
    for row in COLUMN:
        rows += "[[machine.joint]]\n"
        for key, value in row.items():
            rows += f'{key} = "{value}"\n' if isinstance(value, str) else f"{key} = {value}\n"
    path.write_text(rows, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("angle", ["deg", "rad"])
def test_robot_poses_keep_their_numbers(angle, tmp_path):
    q, points = arm_case()
    scale = np.r_[LENGTH["m"] * 1e3, 6 * [ANGLE[angle]]]
    head = ["Pose", "Joint 1 [m]", *(f"Joint {j} [{angle}]" for j in range(2, 8))]
    head += [f"{c}{k} [m]" for k in (1, 2) for c in "xyz"]
    rows = [
        [str(i), *(q[i] * scale), *(points[0, i] * 1e-3), *(points[1, i] * 1e-3)]
        for i in range(len(q))
    ]
    export = write(tmp_path / "poses.csv", ["# arm", ";".join(head), *lines_of(rows, ";", ",")])
    out = tmp_path / "study"
    machine = write_machine(tmp_path / "arm.toml")
    import_study(
        [export],
        out,
        machine=machine,
        overrides=["instrument.sigma_um=20"],
        checked=angle == "deg",
    )
    found = table(out)
    same(found["q1_cmd_mm"], q[:, 0] * 1e3)
    for j in range(1, 7):
        same(found[f"q{j + 1}_cmd_deg"], np.rad2deg(q[:, j]))
    for k in (0, 1):
        for c, values in zip("xyz", points[k].T, strict=True):
            same(found[f"smr{k + 1}_{c}_mm"], values)
    assert setup(out)["instrument"]["tool_reflectors"] == 2


def test_commanded_and_read_back_joints(tmp_path):
    q, points = arm_case()
    degrees = np.rad2deg(q)
    degrees[:, 0] = 1e3 * q[:, 0]
    units = ["mm", *6 * ["deg"]]
    head = [f"q{j + 1}_{kind}_{u}" for kind in ("cmd", "read") for j, u in enumerate(units)]
    rows = [[*d, *(d + 1e-3), *p] for d, p in zip(degrees, points[0], strict=True)]
    export = write(
        tmp_path / "poses.csv", [",".join([*head, "x_mm", "y_mm", "z_mm"]), *lines_of(rows)]
    )
    out = tmp_path / "study"
    import_study(
        [export],
        out,
        machine=write_machine(tmp_path / "arm.toml"),
        overrides=["instrument.sigma_um=20"],
        checked=False,
    )
    assert setup(out)["instrument"]["joints"] == "read"
    assert np.array_equal(table(out)["q3_cmd_deg"], degrees[:, 2])
    assert np.array_equal(table(out)["q3_read_deg"], degrees[:, 2] + 1e-3)


@pytest.mark.thorough
def test_a_urdf_file_is_the_machine_of_a_table(tmp_path):
    rng = np.random.default_rng(3)
    q = rng.uniform([-1, -2, -2, -2], [2, 2, 2, 2], (40, 4))
    points = np.array([(tip(row) @ [0.05, -0.02, 0.1, 1.0])[:3] for row in q]) * 1e3
    rows = [[*row, *p] for row, p in zip(q, points, strict=True)]
    head = ["q1 [m]", "q2 [rad]", "q3 [rad]", "q4 [rad]", "x [mm]", "y [mm]", "z [mm]"]
    export = write(tmp_path / "poses.csv", [",".join(head), *lines_of(rows)])
    urdf = write(tmp_path / "cell.urdf", [URDF])
    out = tmp_path / "study"
    overrides = ["machine.tip_link=flange", "instrument.sigma_um=20"]
    with pytest.raises(StudyError, match="tip_link"):
        import_study([export, urdf], out, overrides=overrides[1:])
    assert not out.exists()
    done = import_study([export, urdf], out, overrides=overrides)
    assert done.formats == ["robot_poses", "urdf"]
    study = load_study(out)
    assert np.allclose(study.chain.tool_point(q), [tip(row)[:3, 3] for row in q], atol=1e-12)
    assert (out / "cell.urdf").read_bytes() == urdf.read_bytes()


@pytest.mark.thorough
def test_a_urdf_file_alone_becomes_a_plan(tmp_path):
    urdf = write(tmp_path / "cell.urdf", [URDF])
    out = tmp_path / "study"
    overrides = ["machine.tip_link=flange", "instrument.sigma_um=20"]
    import_study([urdf], out, overrides=overrides)
    study = load_study(out)
    assert study.measurement is None and study.plan.rows == 60
    found = table(out)
    assert -1000 <= found["q1_cmd_mm"].min() < -800 and 1700 < found["q1_cmd_mm"].max() <= 2000
    assert np.ptp(found["q3_cmd_deg"]) > 330  # continuous: a turn


# --- probe logs ----------------------------------------------------------------------------------


def probe_case(seed=4):
    """Calibrated balls and, for two poses of the artefact, contacts with each of them, mm."""
    rng = np.random.default_rng(seed)
    balls = np.column_stack([np.linspace(-200, 200, 6), 40 * (-1.0) ** np.arange(6), np.zeros(6)])
    centres, contacts = [], []
    for turn, place in ((15.0, [500.0, 300.0, 200.0]), (80.0, [450.0, 310.0, 330.0])):
        r = Rotation.from_euler("ZX", [turn, 20], degrees=True).as_matrix()
        for ball in balls:
            # The tool point is at the position plus the offset of the tool.
            centre = r @ ball + place - OFFSET
            centres.append(centre)
            contacts.append(sphere_contacts(centre, 14.5, 5, rng))
    return balls, np.array(centres), np.array(contacts)


def write_log(path, kind, contacts, unit):
    rows = contacts.reshape(-1, 3) * LENGTH[unit]
    if kind == "linuxcnc":
        return write(path, lines_of([[*row, 0, 0, 0, 0, 0, 0] for row in rows], " "))
    if kind == "grbl":
        hits = [f"[PRB:{','.join(map(text_of, row))}:1]" for row in rows]
        return write(path, ["ok", "[PRB:0.000,0.000,0.000:0]", *hits, "ok"], newline="\r\n")
    if kind == "words":
        said = [" ".join(f"{c}{v:.15f}" for c, v in zip("XYZ", row, strict=True)) for row in rows]
        return write(path, said)
    return write(
        path, ["# probe", f"X [{unit}]\tY [{unit}]\tZ [{unit}]", *lines_of(rows, "\t", ",")]
    )


@pytest.mark.parametrize(
    ("kind", "unit"), [("linuxcnc", "mm"), ("grbl", "inch"), ("words", "mm"), ("table", "m")]
)
def test_probe_logs_become_centres_of_balls(kind, unit, tmp_path):
    balls, centres, contacts = probe_case()
    log = write_log(tmp_path / "probe.txt", kind, contacts, unit)
    artefact = write(
        tmp_path / "balls.csv",
        ["ball,x [mm],y [mm],z [mm]", *lines_of([[str(i), *ball] for i, ball in enumerate(balls)])],
    )
    out = tmp_path / "study"
    options = Options(unit=unit, artefact=artefact, contacts=5)
    overrides = [*TRAVEL, "machine.travel_mm.Z=[0,700]", "instrument.probe_sigma_um=1"]
    done = import_study(
        [log],
        out,
        options=options,
        overrides=overrides[:2] + overrides[3:],
        checked=False,
        **MACHINE,
    )
    assert done.formats == ["probe_log"]
    found = table(out)
    # A fit of centres is as exact as the condition of the contacts allows.
    np.testing.assert_allclose(
        np.column_stack([found[f"{c}_mm"] for c in "xyz"]), centres, rtol=0, atol=1e-9
    )
    assert found["pose"].tolist() == [0.0] * 6 + [1.0] * 6
    assert found["ball"].tolist() == [*range(6)] * 2
    same(table(out, "artefact.csv")["x_mm"], balls[:, 0])
    assert any("radius of 14.5000 mm" in note for note in done.notes)
    if kind == "linuxcnc":
        assert load_study(out).measurement.rows == 12


@pytest.mark.thorough
def test_every_contact_with_a_sphere_counts(tmp_path):
    """Without a table of balls, the contacts themselves are the readings."""
    rng = np.random.default_rng(8)
    centres = rng.uniform([300, 200, 300], [700, 400, 500], (6, 3))
    contacts = np.array([sphere_contacts(c, 15.0, 9, rng) for c in centres])
    contacts += rng.normal(0, 3e-4, contacts.shape)
    log = write_log(tmp_path / "probe.txt", "linuxcnc", contacts, "inch")
    with pytest.raises(StudyError, match="instrument.diameter_mm.*instrument.stylus_radius_mm"):
        import_study([log], tmp_path / "study", **MACHINE)
    out = tmp_path / "study"
    sizes = {"artefact": "sphere", "diameter_mm": 25, "stylus_radius_mm": 2.5, "probe_sigma_um": 1}
    import_study(
        [log],
        out,
        options=Options(unit="inch", contacts=9),
        overrides=[*TRAVEL[:2], "machine.travel_mm.Z=[0,700]"]
        + [f"instrument.{key}={value}" for key, value in sizes.items()],
        checked="touch_probe" in INSTRUMENTS,
        **MACHINE,
    )
    found = table(out)
    same(np.column_stack([found[f"{c}_mm"] for c in "xyz"]), contacts.reshape(-1, 3))
    assert found["setup"].tolist() == [k for k in range(6) for _ in range(9)]
    assert setup(out)["instrument"] == {"kind": "touch_probe", **sizes}


def test_contacts_with_a_step_gauge(tmp_path):
    faces = np.arange(8) * 50.0 + np.array([0, 1, -2, 0, 3, 1, 0, 2]) * 1e-3
    gauge = write(
        tmp_path / "g.csv",
        ["face,position [mm]", *lines_of([[str(k), place] for k, place in enumerate(faces)])],
    )
    rows = []
    for place in ([250.0, 300.0, 300.0], [250.0, 150.0, 420.0]):
        for k, along in enumerate(faces):
            way = 1 if k % 2 == 0 else -1
            position = [place[0] + along - 2.5 * way, place[1], place[2]]
            rows.append([*position, str(k), str(way), str(int(place[1] == 150.0))])
    head = "X [mm],Y [mm],Z [mm],face,approach,setup"
    log = write(tmp_path / "log.csv", ["# probe", head, *lines_of(rows)])
    out = tmp_path / "study"
    sizes = ["instrument.stylus_radius_mm=2.5", "instrument.probe_sigma_um=1"]
    import_study(
        [log],
        out,
        options=Options(artefact=gauge),
        overrides=[*TRAVEL, *sizes],
        checked=False,
        **MACHINE,
    )
    same(table(out, "gauge.csv")["position_mm"], faces)
    found = table(out)
    assert found["face"].tolist() == [*range(8)] * 2
    assert found["setup"].tolist() == 8 * [0.0] + 8 * [1.0]
    same(found["x_mm"], [row[0] for row in rows])


def test_centres_need_contacts_off_a_plane(tmp_path):
    balls, _, contacts = probe_case()
    flat = contacts.copy()
    flat[:, :, 2] = 100.0
    log = write_log(tmp_path / "probe.txt", "linuxcnc", flat, "mm")
    artefact = write(tmp_path / "balls.csv", ["x mm,y mm,z mm", *lines_of(balls)])
    options = Options(unit="mm", artefact=artefact, contacts=5)
    with pytest.raises(StudyError, match="contacts 1 to 5.*in one plane"):
        import_study([log], tmp_path / "study", options=options, overrides=TRAVEL, **MACHINE)


# --- interferometer and ball bar -----------------------------------------------------------------


def runs_case(seed=5):
    """Targets in mm, and deviations in um of three runs in both directions."""
    rng = np.random.default_rng(seed)
    targets = np.round(np.linspace(20, 980, 13) + rng.uniform(-9, 9, 13), 3)
    deviations = 6 * np.sin(targets / 200) + rng.normal(0, 0.3, (3, 2, 13))
    return targets, deviations + np.array([0.0, 2.5])[:, None]


def in_time(targets, deviations):
    """Deviations, directions and targets in the order in which they are measured."""
    up = [(t, d, 1) for t, d in zip(targets, deviations[0], strict=True)]
    down = [(t, d, -1) for t, d in zip(targets, deviations[1], strict=True)]
    return [*up, *down[::-1]]


def write_runs(path, layout, targets, deviations, unit="um"):
    factor = LENGTH[unit] * 1e-3
    pairs = [(j, w) for j in range(3) for w in (0, 1)]
    body = [
        [str(i + 1), t, *(deviations[j, w, i] * factor for j, w in pairs)]
        for i, t in enumerate(targets)
    ]
    means = ["Mean", "", *(deviations[j, w].mean() for j, w in pairs)]
    comment = ["Positioning test ISO 230-2", "Axis: X", f"Deviations in {unit}"]
    if layout == "arrows":
        head = ["i", "Target [mm]", *(f"{j + 1} {'↑↓'[w]}" for j, w in pairs)]
        return write(path, [*comment, ";".join(head), *lines_of([*body, means], ";", ",")])
    if layout == "two rows":
        heads = ["i,Position (mm)," + ",".join(f"Run {j + 1}" for j, _ in pairs)]
        heads.append(",," + ",".join("+-"[w] for _, w in pairs))
        return write(path, [*(f"# {c}" for c in comment), *heads, *lines_of(body)])
    if layout == "named":
        head = [
            "No",
            "Target [inch]",
            *(f"Run {j + 1} {('forward', 'reverse')[w]}" for j, w in pairs),
        ]
        body = [[row[0], row[1] / 25.4, *row[2:]] for row in body]
        return write(
            path, [*(f"# {c}" for c in comment), "\t".join(head), *lines_of(body, "\t", ",")]
        )
    rows = [
        [t, str(j + 1), ("up", "down")[way < 0], d * factor]
        for j in range(3)
        for t, d, way in in_time(targets, deviations[j])
    ]
    head = f"target [mm],run,direction,deviation [{unit}]"
    return write(path, [*(f"# {c}" for c in comment[:2]), head, *lines_of(rows)])


@pytest.mark.parametrize(
    ("layout", "unit"),
    [("arrows", "um"), ("two rows", "um"), ("named", "inch"), ("one per row", "mm")],
)
def test_runs_of_an_interferometer_keep_their_numbers(layout, unit, tmp_path):
    targets, deviations = runs_case()
    export = write_runs(tmp_path / "x.txt", layout, targets, deviations, unit)
    out = tmp_path / "study"
    done = import_study(
        [export],
        out,
        options=Options(at_mm={"Y": 300.0, "Z": 250.0}),
        overrides=TRAVEL,
        checked="interferometer" in INSTRUMENTS,
        **MACHINE,
    )
    assert done.formats == ["interferometer"]
    found = table(out)
    expected = [one for run in deviations for one in in_time(targets, run)]
    same(found["x_mm"], [t for t, _, _ in expected])
    np.testing.assert_allclose(found["meas_position_um"], [d for _, d, _ in expected], rtol=1e-12)
    assert found["dir_x"].tolist() == [way for _, _, way in expected]
    assert found["run"].tolist() == [j for j in (1, 2, 3) for _ in range(26)]
    assert set(found["y_mm"]) == {300.0} and set(found["line"]) == {0.0}


def test_measured_positions_and_several_lines(tmp_path):
    """Cells may be positions instead of deviations; angles need the error motion by its name."""
    targets, deviations = runs_case()
    rows = [[t, t + 1e-3 * deviations[0, 0, i]] for i, t in enumerate(targets)]
    first = write(tmp_path / "x.csv", ["# Axis: X", "target [mm],run 1 + [mm]", *lines_of(rows)])
    rows = [[t, 2 * deviations[0, 0, i]] for i, t in enumerate(targets)]
    second = write(
        tmp_path / "pitch.csv", ["# EBX, pitch", "target [mm],run 1 + [arcsec]", *lines_of(rows)]
    )
    out = tmp_path / "study"
    import_study(
        [first, second],
        out,
        options=Options(at_mm={"Y": 300.0, "Z": 250.0}),
        overrides=TRAVEL,
        checked="interferometer" in INSTRUMENTS,
        **MACHINE,
    )
    found = table(out)
    assert found["line"].tolist() == [0.0] * 13 + [1.0] * 13
    # The difference of two numbers of 1000 mm keeps 1e-10 um of its digits.
    np.testing.assert_allclose(found["meas_position_um"][:13], deviations[0, 0], atol=1e-9)
    expected = 2 * deviations[0, 0] * np.pi / 648e3 * 1e6
    np.testing.assert_allclose(found["meas_angle_b_urad"][13:], expected, rtol=1e-12)
    assert np.isnan(found["meas_angle_b_urad"][:13]).all()


def bar_case(seed=6):
    rng = np.random.default_rng(seed)
    angle = np.arange(0.0, 360.0, 3.0)
    shape = 3 * np.cos(2 * np.radians(angle))
    return angle, np.array([shape, shape + 0.8]) + rng.normal(0, 0.2, (2, len(angle)))


def write_bar(path, layout, angle, deviations):
    head = ["# Plane: XY", "# Nominal radius: 150 mm", "# Feed: 1000 mm/min"]
    if layout == "two columns":
        rows = np.column_stack([angle, *deviations])
        names = "Angle [deg]\tCCW [um]\tCW [um]"
        return write(path, [*head, names, *lines_of(rows, "\t", ",")])
    if layout == "radius":
        turn = np.r_[angle, angle[::-1]] * np.pi / 180
        radius = 150.0 + 1e-3 * np.r_[deviations[0], deviations[1][::-1]]
        names = "angle [rad],radius [inch]"
        return write(path, [*head, names, *lines_of(np.c_[turn, radius / 25.4])])
    rows = [[a, "CCW", d] for a, d in zip(angle, deviations[0], strict=True)]
    rows += [[a, "CW", d] for a, d in zip(angle[::-1], deviations[1][::-1], strict=True)]
    return write(path, [*head, "angle [deg];direction;deviation [um]", *lines_of(rows, ";")])


@pytest.mark.parametrize("layout", ["two columns", "radius", "direction"])
def test_ball_bar_records_keep_their_numbers(layout, tmp_path):
    angle, deviations = bar_case()
    export = write_bar(tmp_path / "bar.txt", layout, angle, deviations)
    out = tmp_path / "study"
    done = import_study(
        [export],
        out,
        options=Options(at_mm={"X": 400.0, "Y": 300.0, "Z": 250.0}),
        overrides=[*TRAVEL, "instrument.sigma_um=0.3"],
        checked="double_ball_bar" in INSTRUMENTS,
        **MACHINE,
    )
    assert done.formats == ["ball_bar"]
    found = table(out)
    turn = np.radians(np.r_[angle, angle[::-1]])
    same(found["x_mm"], 400.0 + 150.0 * np.cos(turn))
    same(found["y_mm"], 300.0 + 150.0 * np.sin(turn))
    expected = np.r_[deviations[0], deviations[1][::-1]]
    # A radius of 150 mm has 1e-11 um of digits of its deviation.
    np.testing.assert_allclose(found["deviation_um"], expected, rtol=1e-12, atol=1e-9)
    assert found["run"].tolist() == [0.0] * 120 + [1.0] * 120
    assert set(found["feed_mm_min"]) == {1000.0}
    assert setup(out)["instrument"]["length_mm"] == 150.0


# --- formats and mistakes ------------------------------------------------------------------------


def test_every_format_says_what_it_needs_and_where_it_comes_from():
    for kind in FORMATS.values():
        for text in (kind.summary, kind.needs, kind.source, kind.undocumented, kind.__doc__):
            assert text and len(text) > 20
    listed = CliRunner().invoke(app, ["import", "--list"])
    assert listed.exit_code == 0
    assert all(f"{name}: " in listed.output for name in FORMATS)


def test_one_message_names_all_that_is_lacking(tmp_path):
    _, seen = tracker_case()
    export = write(tmp_path / "points.csv", ["name,x,y,z", *lines_of([["a", *v] for v in seen])])
    with pytest.raises(StudyError) as told:
        import_study([export], tmp_path / "study")
    message = str(told.value)
    for option in (
        *("--machine", "--positions", "--tool-offset", "--unit"),
        *("instrument.range_sigma_um", "instrument.angle_sigma_urad"),
    ):
        assert message.count(option) == 1, option
    assert FORM.match(message)


def test_several_candidates_are_listed(tmp_path):
    _, seen = tracker_case()
    export = write(tmp_path / "points.csv", ["x [mm],y [mm],z [mm]", *lines_of(seen)])
    with pytest.raises(StudyError, match="laser_tracker .*probe_log .*--format"):
        import_study([export], tmp_path / "study")
    with pytest.raises(StudyError, match="--positions"):
        import_study([export], tmp_path / "study", format_name="laser_tracker", machine=CHAIN)


GOOD = [
    "name,nom x mm,nom y mm,nom z mm,x mm,y mm,z mm",
    *(f"p{i},{i},2,3,4,5,{i}" for i in range(9)),
]
BAD = {
    "no such file": (None, {}, "no such file"),
    "empty": ([], {}, "0 bytes|no row of numbers"),
    "binary": (b"\x00\x01\x02" * 100, {}, "binary file"),
    "a cell of text": ([*GOOD[:3], "p,1,2,3,4,x,5", *GOOD[3:]], {}, "line 4, column y mm.*'x'"),
    "cut off": ([*GOOD, "p,1,2"], {}, "cut off"),
    "a missing cell": ([*GOOD[:3], "p,1,2,3,4,5", *GOOD[3:]], {}, "line 4: found 6 cells"),
    "two decimal marks": (
        ["x mm;y mm;z mm", "1,5;2,5;3,5", "1.5;2.5;3.5"],
        {"format_name": "laser_tracker"},
        "decimal points and others with decimal commas",
    ),
    "prose": (["This is a letter.", "It has no table."], {}, "no row of numbers"),
    "another table": (["a;b", "1;2", "3;4"], {}, "no format recognises"),
    "unknown format": (GOOD, {"format_name": "laser"}, "did you mean 'laser_tracker'"),
    "no header": (["1 2 3 4 5 6", "2 3 4 5 6 7"], {"format_name": "laser_tracker"}, "no header"),
    "wrong chain": (GOOD, {"machine": "w X Y Z t"}, "impossible"),
    "wrong offset": (GOOD, {"machine": CHAIN, "tool_offset": "1,2"}, "three numbers X,Y,Z"),
    "wrong key": (
        GOOD,
        {"machine": CHAIN, "overrides": ["machine.travl=1"]},
        "unknown key 'travl' .did you mean 'travel_mm'",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_ends_in_one_message_and_writes_nothing(case, tmp_path):
    content, options, message = BAD[case]
    export = tmp_path / "export.csv"
    if isinstance(content, bytes):
        export.write_bytes(content)
    elif content is not None:
        write(export, content)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(StudyError, match=message) as told:
        import_study([export], tmp_path / "study", **options)
    assert FORM.match(str(told.value)) and "\n" not in str(told.value)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("ending", ["b5r", "rtl", "xlsx", "xit64"])
def test_files_without_a_public_description_point_to_a_mapping(ending, tmp_path):
    export = tmp_path / f"record.{ending}"
    export.write_bytes(b"PK\x03\x04\x00\x00" * 50)
    with pytest.raises(StudyError, match=r"\[data.columns\]"):
        import_study([export], tmp_path / "study")


def test_a_xacro_file_has_to_be_converted(tmp_path):
    text = URDF.replace('<robot name="cell">', '<robot name="c" xmlns:xacro="x"><xacro:arg/>')
    with pytest.raises(StudyError, match="xacro robot.xacro > robot.urdf"):
        import_study([write(tmp_path / "robot.xacro", [text])], tmp_path / "study")


def test_a_study_that_fails_its_check_is_not_written(tmp_path):
    """A machine whose X counts the other way: the readings do not follow the axes."""
    positions, seen = tracker_case()
    rows = [[*p, *v] for p, v in zip(positions * [-1, 1, 1] + [1000, 0, 0], seen, strict=True)]
    head = "nom x mm,nom y mm,nom z mm,meas x mm,meas y mm,meas z mm"
    export = write(tmp_path / "points.csv", [head, *lines_of(rows)])
    with pytest.raises(StudyError, match="does not pass its check"):
        import_study([export], tmp_path / "study", overrides=TRACKER, **MACHINE)
    assert [path.name for path in tmp_path.iterdir()] == ["points.csv"]
    import_study([export], tmp_path / "study", overrides=TRACKER, checked=False, **MACHINE)
    assert (tmp_path / "study" / "setup.toml").is_file()


def test_the_command_line(tmp_path, monkeypatch):
    monkeypatch.setenv("VCAL_NO_CACHE", "1")
    positions, seen = tracker_case()
    rows = [[*p, *v] for p, v in zip(positions, seen, strict=True)]
    head = "nom x,nom y,nom z,meas x,meas y,meas z"
    export = write(tmp_path / "points.csv", [head, *lines_of(rows)])
    out = tmp_path / "study"
    command = ["import", str(export), "--out", str(out), "--machine", CHAIN]
    command += ["--tool-offset", "0,0,-150", "--unit", "millimeters"]
    missing = CliRunner().invoke(app, command)
    assert missing.exit_code == 2 and not out.exists()
    for text in TRACKER:
        command += ["--set", text]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert "data.csv (40 rows)" in done.output
    assert CliRunner().invoke(app, ["check", str(out)]).exit_code == 0
    again = CliRunner().invoke(app, command)
    assert again.exit_code == 2 and "not empty" in again.output
    for arguments in (
        ["import"],
        ["import", "x.csv"],
        ["import", "x.csv", "--out", "y", "--at", "Y"],
    ):
        assert CliRunner().invoke(app, arguments).exit_code == 2


def test_a_rotary_axis_needs_a_point_on_it(tmp_path):
    """A table that turns: angles in radians, and the place of the axis from the user."""
    rng = np.random.default_rng(7)
    positions = rng.uniform([0, 0, 0, -3], [1000, 600, 500, 3], (40, 4))
    centre = np.array([500.0, 300.0, 0.0])
    # The tool point in the frame of the table, which turns against its command (ISO 10791-6).
    back = Rotation.from_euler("z", positions[:, 3:])
    seen = back.apply(positions[:, :3] + OFFSET - centre) + centre
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    seen = (seen - [2000.0, 100.0, 300.0]) @ turn
    rows = np.c_[positions, seen]
    head = "nom x mm,nom y mm,nom z mm,nom c rad,meas x mm,meas y mm,meas z mm"
    export = write(tmp_path / "points.csv", [head, *lines_of(rows)])
    out = tmp_path / "study"
    machine = {"machine": "w C X b Y Z t", "tool_offset": "0,0,-150"}
    with pytest.raises(StudyError, match=r"machine.rotary.C.at_mm=\[X,Y,Z\]"):
        import_study([export], out, overrides=TRACKER, **machine)
    overrides = [*TRACKER, "machine.rotary.C.at_mm=[500,300,0]"]
    import_study([export], out, overrides=overrides, **machine)
    same(table(out)["c_deg"], np.rad2deg(positions[:, 3]))
    station = setup(out)["instrument"]["station_mm"]
    np.testing.assert_allclose(station, [2000.0, 100.0, 300.0], atol=1e-3)
