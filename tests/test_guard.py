"""Readings that do not follow the declared machine: every single change with which they would is
named, the likeliest first, and none as an order.
"""

import re
from pathlib import Path

import numpy as np
import pytest

import vcal
from oracle import make_case, write_study
from oracle.kinematics import rotation_matrix
from vcal.errors import StudyError
from vcal.instruments.arm_follow import arm_off, other_convention
from vcal.instruments.base import remarks_of
from vcal.instruments.follow import other_chains
from vcal.machine.chain import chain_from_dh, chain_from_string

BROKEN = Path(__file__).parents[2] / "shared" / "data" / "broken"
AT = np.array([300.0, 250.0, 0.0])
STATION = np.array([-1500.0, 400.0, -900.0])


def rotating_table(seed=0, count=80):
    """Positions of a machine with a rotary table on the workpiece side, and polar readings of a
    tracker on the table: plain numpy.
    """
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(size=(count, 3)) * [600.0, 500.0, 400.0]
    c = rng.uniform(0.0, 360.0, count)
    turns = rotation_matrix(np.deg2rad(c)[:, None] * [0.0, 0.0, 1.0])
    point = xyz + [0.0, 0.0, -150.0] - AT
    point = np.einsum("nij,nj->ni", turns, point) + AT
    v = point - STATION
    r = np.linalg.norm(v, axis=1)
    return {
        "x_mm": xyz[:, 0], "y_mm": xyz[:, 1], "z_mm": xyz[:, 2], "c_deg": c,
        "range_mm": r + 1e-3 * rng.standard_normal(count),
        "azimuth_rad": np.arctan2(v[:, 1], v[:, 0]),
        "elevation_rad": np.arcsin(v[:, 2] / r),
    }  # fmt: skip


def table_study(folder, chain="w C b X Y Z t", station=STATION, **changes):
    """A study of it, with changed columns; returns its folder."""
    data = rotating_table()
    data |= {name: change(data) for name, change in changes.items()}
    folder.mkdir(exist_ok=True)
    rows = zip(*(np.asarray(v) for v in data.values()), strict=True)
    lines = [",".join(data), *(",".join(f"{v:.10g}" for v in row) for row in rows)]
    (folder / "data.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "setup.toml").write_text(
        f"""[machine]
chain = "{chain}"
tool_offset_mm = [0, 0, -150]
[machine.travel_mm]
X = [-600, 1000]
Y = [-600, 1000]
Z = [-600, 1000]
[machine.rotary]
C = {{ at_mm = {AT.tolist()}, travel_deg = [-360, 360] }}
[instrument]
kind = "laser_tracker"
range_sigma_um = 1
angle_sigma_urad = 2
station_mm = {np.asarray(station).tolist()}
[model.geometric]
family = "smooth"
translation_um = 10
rotation_urad = 10
squareness_urad = 20
smoothness = 0.5
""",
        encoding="utf-8",
    )
    return folder


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"c_deg": lambda d: 360.0 - d["c_deg"]}, "the other sign in c_deg"),
        ({"x_mm": lambda d: -d["x_mm"]}, "the other sign in x_mm"),
        ({"x_mm": lambda d: d["x_mm"] / 25.4}, "inches turned into millimetres in x_mm"),
        ({"range_mm": lambda d: d["range_mm"] / 25.4},
         "inches turned into millimetres in range_mm"),
        ({"c_deg": lambda d: np.deg2rad(d["c_deg"])}, "radians turned into degrees in c_deg"),
        ({"x_mm": lambda d: d["y_mm"], "y_mm": lambda d: rotating_table()["x_mm"]},
         "x_mm and y_mm exchanged"),
        ({"elevation_rad": lambda d: 0.5 * np.pi - d["elevation_rad"]},
         "elevations instead of zenith angles in elevation_rad"),
        ({"azimuth_rad": lambda d: -d["azimuth_rad"]}, "the other sign in azimuth_rad"),
    ],
)  # fmt: skip
def test_one_wrong_column_is_named_first_and_never_ordered(tmp_path, changes, said):
    path = table_study(tmp_path / "study", **changes)
    with pytest.raises(StudyError) as error:
        vcal.load_study(path)
    message = str(error.value)
    # A mirror image may be that of an axis as well, which is the likelier one.
    first = "azimuth" not in said and "elevation" not in said
    assert (f"they do with {said}" if first else f"with {said}") in message
    assert "with the machine" in message and "correct that" not in message


def test_an_instrument_that_moved_is_left_to_the_loop(tmp_path):
    """No change of the declaration explains it. Where it is too far, the columns are asked for."""

    def moved(by):
        return {"range_mm": lambda d: d["range_mm"] + by * (np.arange(len(d["range_mm"])) >= 40)}

    study = vcal.load_study(table_study(tmp_path / "near", **moved(40.0)))
    assert study.measurement.rows == 80
    with pytest.raises(StudyError, match="compare signs, units and order of the columns"):
        vcal.load_study(table_study(tmp_path / "far", **moved(600.0)))


def test_a_rotary_sign_comes_before_a_mirrored_linear_axis(tmp_path):
    """Where both make the readings follow: a point on the mirror plane of a table."""
    data = rotating_table()
    path = table_study(
        tmp_path / "study", c_deg=lambda d: -d["c_deg"], y_mm=lambda d: np.full(80, AT[1])
    )
    with pytest.raises(StudyError) as error:
        vcal.load_study(path)
    signs = re.findall(r"the other sign in (\w+)", str(error.value))
    assert len(data) == 7
    assert not signs or signs[0] == "c_deg"


def test_another_chain_is_named(tmp_path):
    path = table_study(tmp_path / "study", chain="w b X Y Z C t")
    with pytest.raises(StudyError, match=r'they do with the chain "w C b X Y Z t"'):
        vcal.load_study(path)


def test_a_station_on_the_other_side_is_said_and_found(tmp_path):
    far = STATION + [10_000.0, 0.0, 0.0]
    study = vcal.load_study(table_study(tmp_path / "study", station=far))
    (said,) = remarks_of(study.instrument)
    assert "10 m from instrument.station_mm" in said and "compare station_mm" in said
    assert np.abs(1e3 * study.instrument.station - STATION).max() < 1.0


def test_chains_that_differ_only_in_the_order_of_linear_axes_are_one():
    chain = chain_from_string("w C b X Y Z t", rotary_m={"C": [0.1, 0.2, 0.0]})
    others = [one.text for one in other_chains(chain)]
    assert "w C b X Z Y t" not in others and "w b X Y Z C t" in others
    assert len(others) == len(set(others))
    linear = chain_from_string("w X b Y Z t")
    assert list(other_chains(linear)) == []


# --- arms ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    write_study(folder, make_case("reflectors", seed=2, plan={"n": 60}))
    return folder


def edited(source, folder, change):
    """The arm's study with changed columns of commands."""
    folder.mkdir()
    (folder / "setup.toml").write_text((source / "setup.toml").read_text(), encoding="utf-8")
    header, *rows = (source / "data.csv").read_text(encoding="utf-8").splitlines()
    names = header.split(",")
    values = np.array([[float(v) for v in row.split(",")] for row in rows])
    table = {name: values[:, i] for i, name in enumerate(names)}
    table |= change(table)
    lines = [",".join(f"{v:.10g}" for v in row) for row in np.column_stack(list(table.values()))]
    (folder / "data.csv").write_text("\n".join([",".join(table), *lines]) + "\n", encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: {"q2_cmd_deg": -t["q2_cmd_deg"]}, "the other sign in q2_cmd_deg"),
        (lambda t: {"q3_cmd_deg": t["q3_cmd_deg"] + t["q2_cmd_deg"]},
         "joint 3 coupled to joint 2 (machine.coupling: its angle is q3_cmd_deg minus q2_cmd_deg)"),
        (lambda t: {"q2_cmd_deg": t["q3_cmd_deg"], "q3_cmd_deg": t["q2_cmd_deg"]},
         "q2_cmd_deg and q3_cmd_deg exchanged"),
        (lambda t: {"q3_cmd_deg": t["q3_cmd_deg"] - 90.0}, "90 deg more in machine.joint.2"),
        (lambda t: {n: v / 25.4 for n, v in t.items() if n.startswith("smr")},
         "inches turned into millimetres"),
        (lambda t: {n: -v for n, v in t.items() if n.endswith("_x_mm")},
         "the other sign in one coordinate of all reflectors"),
    ],
)  # fmt: skip
def test_a_wrong_column_of_an_arm_is_named(arm, tmp_path, change, said):
    with pytest.raises(StudyError) as error:
        vcal.load_study(edited(arm, tmp_path / "study", change))
    message = str(error.value)
    if "inches" in said and "rms about their mean" in message:
        return  # another check of the size says so first
    assert said in message and "with the machine" in message


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("machine.joint.1.a_mm=0.27", "metres turned into millimetres in machine.joint.1.a_mm"),
        ("machine.joint.2.a_mm=0.07", "metres turned into millimetres in machine.joint.2.a_mm"),
        ("machine.convention=modified", "standard DH rows"),
    ],
)
def test_a_wrong_number_of_an_arm_is_named(arm, override, said):
    with pytest.raises(StudyError, match=f"they do with {re.escape(said)}"):
        vcal.load_study(arm, [override])


def test_the_other_convention_of_the_other_convention_is_the_arm():
    rows = [
        {"type": "revolute", "a": 0.1, "d": 0.3, "alpha": -1.2, "theta": 0.4},
        {"type": "prismatic", "a": 0.2, "d": 0.1, "alpha": 0.7, "theta": -2.0},
        {"type": "revolute", "a": 0.0, "d": 0.2, "alpha": 0.5, "theta": 3.0},
    ]
    arms = {kind: chain_from_dh(rows, convention=kind) for kind in ("standard", "modified")}
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 3))
    for kind, other in (("standard", "modified"), ("modified", "standard")):
        found = other_convention(arms[kind])
        np.testing.assert_allclose(found.tool_point(q), arms[other].tool_point(q), atol=1e-12)
        assert f"{other} DH" in found.text


def test_an_arm_as_declared_follows(arm):
    study = vcal.load_study(arm)
    plan, seen = study.plan, study.measurement.readings.reshape(study.plan.rows, -1, 3)
    off = arm_off(study.chain, np.asarray(plan.position), seen)
    assert np.median(off) < 0.01


# --- inputs that were once taken for good --------------------------------------------------------


@pytest.mark.skipif(not BROKEN.exists(), reason="needs ../shared")
@pytest.mark.parametrize(
    ("name", "overrides", "said"),
    [
        ("arm_q1_sign", [], "they do with the other sign in q1_cmd_deg"),
        ("arm_link_in_metres", ["machine.joint.1.a_mm=0.27"], "in machine.joint.1.a_mm (0.27)"),
        ("rotary_axis_reversed", [], "they do with the other sign in c_deg, or with"),
    ],
)  # fmt: skip
def test_what_was_once_taken_for_good_is_refused(name, overrides, said):
    with pytest.raises(StudyError, match=re.escape(said)) as error:
        vcal.load_study(BROKEN / name, overrides)
    assert "correct that" not in str(error.value)
