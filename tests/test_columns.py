"""Columns of conditions: what they are called in files and inside, and what is refused."""

import shutil

import numpy as np
import pytest

from vcal import StudyError
from vcal.cli.show import show_study
from vcal.cli.start_studies import STARTS, example
from vcal.effects.registry import CATALOGUE
from vcal.instruments import INSTRUMENTS
from vcal.instruments.ball_array import _DERIVED
from vcal.instruments.conditions import (
    GROUPS,
    file_column,
    file_name,
    inside_name,
    linear_plan,
    linear_plan_table,
)
from vcal.loop.screening.candidates import candidates
from vcal.machine.chain import chain_from_string
from vcal.study import load_study, read_header, read_table, write_table
from vcal.study.simulated import parse_with, write_simulated

LINEAR, ARM = ("X", "Y", "Z"), ("J1", "J2")
MOTION = [f"{kind}_{axis}" for kind in ("dir", "a", "v", "since") for axis in LINEAR]
CONDITIONS = [
    *((name, LINEAR) for name in (*MOTION, "t", "T_X", "T_air", "T_head", "payload_kg", "sense")),
    *((name, LINEAR) for name in ("speed_rpm", "approach_rad", "T_gradient_z_K_per_m", "path_mm")),
    *((f"{kind}_J2", ARM) for kind in ("commanded", "read", "move", "dir")),
    *((name, ARM) for name in ("t", "order", "T_air")),
]


def renamed(folder, names, file="data.csv"):
    table = read_table(folder / file, [])
    write_table(folder / file, {names.get(name, name): v for name, v in table.items()})
    return folder


def with_columns(folder, **columns):
    table = read_table(folder / "data.csv", [])
    write_table(folder / "data.csv", {**table, **columns})
    return folder


# --- names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "axes"), CONDITIONS)
def test_a_condition_has_one_column(name, axes):
    assert inside_name(file_name(name, axes), axes) == name


@pytest.mark.slow
def test_what_an_effect_needs_can_be_in_a_file():
    """But for what instruments derive, which no file holds, and positions."""
    derived = {n for kind in INSTRUMENTS.values() for n in kind.derived} | {*_DERIVED}
    examples = [one for one in map(example, CATALOGUE.values()) if one is not None]
    assert len(examples) > 30
    for instance, setup in examples:
        axes = setup.plan.axes
        for name in {*instance.needs} - derived - {*axes, *GROUPS}:
            assert inside_name(file_name(name, axes), axes) == name, instance.key


@pytest.mark.parametrize(
    ("column", "name"),
    [
        ("T_X_degC", "T_X"),
        ("dir_X", "dir_X"),
        ("since_X_mm", "since_X"),
        ("a_X_m_s2", "a_X"),
        ("since_x", "since_x"),
        ("a_x_m_s", "a_x_m_s"),
        ("a_set_m_s2", "a_set_m_s2"),
        ("range_mm", "range_mm"),
        ("dir_q1", "dir_q1"),
    ],
)
def test_a_column_of_another_name(column, name):
    """The axis may be in either case; another unit, or an axis that is not there, is another."""
    assert inside_name(column, LINEAR) == name


def test_conditions_are_in_si_inside_and_in_their_units_in_files():
    chain = chain_from_string("w X b Y Z t", {a: (0.0, 1.0) for a in LINEAR})
    plan = linear_plan(
        chain,
        {f"{a.lower()}_mm": np.zeros(3) for a in LINEAR}
        | {file_name(n, LINEAR): np.arange(3.0) for n in (*MOTION, "t", "T_X")},
    )
    for name in (*MOTION, "t", "T_X"):
        factor = file_column(name, LINEAR)[1]
        np.testing.assert_allclose(plan.covariate(name), np.arange(3.0) / factor)
    np.testing.assert_allclose(plan.covariate("since_X"), [0.0, 1e-3, 2e-3])
    for values in list(linear_plan_table(plan).values())[3:]:
        np.testing.assert_allclose(values, np.arange(3.0))


def test_the_way_since_a_reversal_can_be_recorded(small_tracker_study):
    since = {f"since_{c}_mm": np.linspace(0.0, 4.0, 48) for c in "xyz"}
    study = load_study(with_columns(small_tracker_study, **since))
    found, missing = candidates(study.model, study.measurement, study.tried)
    assert "reversal_spike" in {effect.name for effect in found}
    assert "reversal_spike" not in {one.effect for one in missing}


# --- the same under other names ------------------------------------------------------------------


@pytest.mark.campaign
@pytest.mark.parametrize(
    "names",
    [{"dir_x": "dir_X"}, {"T_x_degC": "T_X_degC"}, {"T_x_degC": "T_X_degC", "dir_x": "dir_X"}],
)
def test_what_can_be_read_can_be_simulated(small_tracker_study, tmp_path, names):
    plain = load_study(small_tracker_study)
    study = load_study(renamed(small_tracker_study, names))
    place = study.model.setup(study.plan)
    text = "backlash:X:size_um=12", "scale_growth:X:alpha_um_per_m_K=3"
    effects = [parse_with(one, study.catalogue, place) for one in text]
    write_simulated(study, tmp_path / "made", effects=effects)
    again = load_study(tmp_path / "made")
    assert set(again.plan.covariates) == set(again.check.plan.covariates) | {
        "range",
        "azimuth",
        "elevation",
    }
    for name, values in plain.plan.covariates.items():
        if name not in study.instrument.derived:  # those are of other readings
            np.testing.assert_allclose(again.plan.covariate(name), values, rtol=1e-6)
    assert set(names.values()) <= set(read_header(tmp_path / "made" / "data.csv"))


# --- what is refused -----------------------------------------------------------------------------

TWICE = "found two columns of one quantity, expected one, "
RESERVED = "found the internal name of the quantity in column "
REFUSED = {
    "directions": ({"dir_X": np.ones(48)}, f"columns dir_x and dir_X: {TWICE}dir_x; remove one"),
    "temperatures": (
        {"T_X_degC": np.full(48, 20.0)},
        f"columns T_x_degC and T_X_degC: {TWICE}T_x_degC; remove one",
    ),
    "positions": ({"X_mm": np.ones(48)}, f"columns x_mm and X_mm: {TWICE}x_mm; remove one"),
    "readings": (
        {"Range_mm": np.full(48, 900.0)},
        f"columns range_mm and Range_mm: {TWICE}range_mm; remove one",
    ),
    "an index": ({"Point": np.ones(48)}, f"columns point and Point: {TWICE}point; remove one"),
    "time in minutes": (
        {"t": np.arange(48.0)},
        f"column t: {RESERVED}t_s, expected t_s, or another name for another quantity; rename or",
    ),
    "temperature without a unit": (
        {"T_X": np.full(48, 300.0)},
        f"column T_X: {RESERVED}T_x_degC, expected",
    ),
    "air without a unit": ({"T_air": np.full(48, 300.0)}, f"column T_air: {RESERVED}T_air_degC"),
    "acceleration": ({"a_X": np.ones(48)}, f"column a_X: {RESERVED}a_x_m_s2, expected"),
    "range": ({"range": np.ones(48)}, f"column range: {RESERVED}range_mm, expected"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_two_columns_of_one_quantity(small_tracker_study, case):
    columns, expected = REFUSED[case]
    with pytest.raises(StudyError) as caught:
        load_study(with_columns(small_tracker_study, **columns))
    assert str(caught.value).startswith(f"data.csv, header, {expected}")


def test_check_points_have_the_same_names(small_tracker_study):
    renamed(small_tracker_study, {"t_s": "t"}, "check.csv")
    with pytest.raises(StudyError, match="check.csv, header, column t: found the internal name"):
        load_study(small_tracker_study)


@pytest.mark.parametrize("name", ["dir_J1", "dir_q1", "move_q1_deg"])
def test_moves_of_joints_are_computed(small_arm_study, name):
    with pytest.raises(StudyError) as caught:
        load_study(with_columns(small_arm_study, **{name: np.ones(16)}))
    assert f"header, column {name}: found a column of joint moves" in str(caught.value)


def test_the_order_of_poses_has_one_column(small_arm_study):
    with pytest.raises(
        StudyError, match="column order: found the internal name .* in column pose,"
    ):
        load_study(with_columns(small_arm_study, order=np.arange(16.0)[::-1]))


def test_a_renamed_column_is_told_to_be_constant(small_tracker_study, capsys):
    table = read_table(small_tracker_study / "data.csv", [])
    table["T_X_degC"] = np.full(48, 20.0)
    del table["T_x_degC"]
    write_table(small_tracker_study / "data.csv", table)
    show_study(load_study(small_tracker_study))
    shown = capsys.readouterr().out.splitlines()
    (line,) = (line for line in shown if line.strip().startswith("constant"))
    assert "T_X_degC" in line


def test_an_index_of_an_instrument_of_ones_own():
    """A group, by which nothing is multiplied, where the instrument says so; else a quantity."""
    chain = chain_from_string("w X b Y Z t")
    table = {f"{c}_mm": np.arange(3.0) for c in "xyz"} | {"station": np.array([0.0, 1.0, 1.0])}
    assert linear_plan(chain, table).covariate("station").tolist() == [0.0, 1.0, 1.0]
    plan = linear_plan(chain, table, groups=("station",))
    assert plan.groups["station"].tolist() == [0, 1, 1] and not plan.covariates
    assert linear_plan_table(plan)["station"].tolist() == [0, 1, 1]


# --- readings that are named otherwise -----------------------------------------------------------


def start_with(folder, kind, names, extra=()):
    """A starting study, its columns renamed (to none: left out), with further ones."""
    shutil.copytree(STARTS / kind, folder)
    (folder / "check.csv").unlink(missing_ok=True)
    table = read_table(folder / "data.csv", [], labels=("plane",) if kind == "r_test" else ())
    kept = {names.get(name, name): v for name, v in table.items() if names.get(name, name)}
    rows = 18.0 + np.arange(float(table.rows)) % 7.0
    write_table(folder / "data.csv", kept | dict.fromkeys(extra, rows))
    return folder


TRACKER = ("range_mm", "azimuth_rad", "elevation_rad")
FRAME = ("u_um", "v_um")
SPHERE = ("x_ext_mm", "y_ext_mm", "z_ext_mm")
POINTS = tuple(f"smr{k}_{c}_mm" for k in (1, 2, 3) for c in "xyz")
UNREAD = {
    "no unit": ("static_r_test", SPHERE, ("x_ext", "", ""), "x_ext", "x_ext_mm"),
    "a letter": ("laser_tracker", TRACKER, ("", "azimut_rad", ""), "azimut_rad", "azimuth_rad"),
    "letters": ("laser_tracker", TRACKER, ("rnage_mm", "", ""), "rnage_mm", "range_mm"),
}
READ = {
    "metres": ("laser_tracker", TRACKER, ("range_m", "", ""), "azimuth_rad"),
    "degrees": ("laser_tracker", TRACKER, ("", "azimuth_deg", ""), "range_mm"),
    "brackets": ("laser_tracker", TRACKER, ("Range [mm]", "", ""), "azimuth_rad"),
    "capitals": ("r_test", SPHERE, ("X_ext_mm", "", ""), "y_ext_mm"),
    "micro": ("laser_frame", FRAME, ("u_µm", ""), "v_um"),
    "reflectors": ("reflectors", POINTS, ("SMR1_X_mm", *8 * ("",)), "smr1_y_mm"),
}
"""A reading in another unit or spelling that is read, while others are missing."""


@pytest.mark.parametrize("case", UNREAD)
def test_readings_of_another_name_make_no_plan(tmp_path, case):
    kind, columns, names, column, meant = UNREAD[case]
    base = {n: "" for n in read_header(STARTS / kind / "data.csv") if n.startswith("base")}
    folder = start_with(tmp_path / kind, kind, base | dict(zip(columns, names, strict=True)))
    with pytest.raises(StudyError) as caught:
        load_study(folder)
    message = str(caught.value)
    assert message.startswith(f"data.csv, header, column {column}: found no column of readings")
    assert f"a name similar to {meant}, expected" in message


@pytest.mark.parametrize("case", READ)
def test_a_reading_in_another_unit_makes_no_plan(tmp_path, case):
    kind, columns, names, missing = READ[case]
    base = {n: "" for n in read_header(STARTS / kind / "data.csv") if n.startswith("base")}
    folder = start_with(tmp_path / kind, kind, base | dict(zip(columns, names, strict=True)))
    with pytest.raises(StudyError) as caught:
        load_study(folder)
    message = str(caught.value)
    assert message.startswith(f"data.csv, column {missing}: found no such column among")


def test_readings_in_another_unit_are_converted(tmp_path):
    folder = start_with(tmp_path / "made", "laser_frame", {})
    readings = load_study(folder).measurement.readings
    table = read_table(folder / "data.csv", [])
    made = {f"{name[0]}_mm": 1e-3 * table.pop(name) for name in FRAME}
    write_table(folder / "data.csv", {**table, **made})
    np.testing.assert_allclose(load_study(folder).measurement.readings, readings, rtol=1e-9)


@pytest.mark.parametrize("kind", ["r_test", "static_r_test"])
@pytest.mark.thorough
def test_readings_of_other_settings_make_no_plan(tmp_path, kind):
    probes = ["instrument.probes=[[0.8, 0.0, 0.6], [-0.4, 0.69, 0.6], [-0.4, -0.69, 0.6]]"]
    folder = start_with(tmp_path / kind, kind, {})
    with pytest.raises(StudyError) as caught:
        load_study(folder, probes)
    message = str(caught.value)
    assert message.startswith(
        "data.csv, header, columns x_ext_mm, y_ext_mm, z_ext_mm: found readings of"
    )
    assert "expected p1_mm, p2_mm, p3_mm; or no readings, in a plan; correct the set" in message
    bare = start_with(tmp_path / "plan", kind, dict.fromkeys(SPHERE, ""))
    assert load_study(bare, probes).measurement is None


EXTRA = ("humidity_percent", "T_cabinet_degC", "operator", "counter", "pressure_hPa", "v_m_s")
PLANS = {
    "laser_tracker": (TRACKER, ("distance_mm", "az_zone", "station_x_mm")),
    "laser_frame": (FRAME, ("u_V", "w_um", "path_mm")),
    "r_test": (SPHERE, ("x_set_mm", "x_exp_mm", "p1_kPa")),
    "static_r_test": (SPHERE, ("x_set_mm", "tool_number")),
}


@pytest.mark.parametrize("kind", PLANS)
def test_a_plan_may_have_further_columns(tmp_path, kind):
    readings, extra = PLANS[kind]
    old = read_header(STARTS / kind / "data.csv")
    added = [name for name in (*EXTRA, *extra) if name not in old]
    folder = start_with(tmp_path / kind, kind, dict.fromkeys(readings, ""), added)
    assert load_study(folder).measurement is None


def test_a_rotary_axis_has_one_column(tmp_path):
    folder = start_with(tmp_path / "turning", "static_r_test", {}, ("C_deg",))
    with pytest.raises(StudyError, match=f"header, columns c_deg and C_deg: {TWICE}c_deg; remove"):
        load_study(folder)


def test_check_points_have_every_column_once(small_tracker_study):
    table = read_table(small_tracker_study / "check.csv", [])
    write_table(small_tracker_study / "check.csv", {**table, "TCP_x_mm": table["tcp_x_mm"]})
    with pytest.raises(StudyError, match="check.csv, header, columns tcp_x_mm and TCP_x_mm: found"):
        load_study(small_tracker_study)
