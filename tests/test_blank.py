"""Readings that are blank: a beam that broke, a reflector or a ball that was not seen."""

import csv
from pathlib import Path

import numpy as np
import pytest

from conftest import write_csv
from joint import write_joint
from oracle import make_case, write_study
from test_own_instruments import DISC, circles, write_disc
from vcal import close_loop, identify, load_study
from vcal.cli.show import show_study
from vcal.errors import StudyError
from vcal.report.loop.record import record
from vcal.study.simulated import write_simulated

SHARE = 0.1
BLANKS = ("", "nan", "NaN", " ")
PLANS = {
    "laser_tracker": {"shape": (4, 4, 3)},
    "ball_array": {"repeats": 1},
    "laser_frame": {"runs": 2},
    "r_test": {"samples": 60, "levels": (1.5, 4.5)},
    "reflectors": {"n": 40},
}
WITHOUT_ORDER = tuple(kind for kind in PLANS if kind not in ("reflectors", "r_test"))
"""Of what nothing in a row follows from other rows."""


def read_in(header):
    """Columns of readings among these; positions where there are no others."""
    read = [c for c in header if c.endswith("_ext_mm") or c.startswith(("smr", "base"))]
    read += [c for c in header if c in ("u_um", "v_um", "range_mm", "azimuth_rad", "elevation_rad")]
    return read or ["x_mm", "y_mm", "z_mm"]


def blanked(folder, seed=0, rows=None, file="data.csv"):
    """Blank some or all readings of rows of a study, at random unless given; their numbers."""
    rng = np.random.default_rng(seed)
    with open(folder / file, encoding="utf-8", newline="") as text:
        header, *table = csv.reader(text)
    if rows is None:
        rows = 1 + np.flatnonzero(rng.random(len(table)) < SHARE)
    read = read_in(header)
    for row in rows:
        for column in rng.permutation(read)[: rng.integers(1, len(read) + 1)]:
            table[row - 1][header.index(column)] = rng.choice(BLANKS)
    write_rows(folder / file, [header, *table])
    return tuple(int(row) for row in rows)


def without(folder, rows):
    """Delete rows of a study, by number."""
    header, *table = (folder / "data.csv").read_text(encoding="utf-8").splitlines()
    kept = [line for i, line in enumerate(table, start=1) if i not in rows]
    (folder / "data.csv").write_text("\n".join([header, *kept]) + "\n", encoding="utf-8")


def write_rows(path, rows):
    with open(path, "w", encoding="utf-8", newline="") as text:
        csv.writer(text, lineterminator="\n").writerows(rows)


def pair(kind, folder, **options):
    """A study of the oracle with blank readings, the same with these rows deleted, whole, and the
    numbers of the rows.
    """
    case = make_case(kind, seed=3, plan=PLANS[kind], **options)
    studies = []
    for name in ("blank", "deleted", "whole"):
        study = write_study(folder / name, case)
        if name != "whole":
            rows = blanked(study)
        if name == "deleted":
            study = write_study(folder / "again", case)
            without(study, rows)
        studies.append(load_study(study))
    return *studies, rows


@pytest.mark.parametrize("kind", PLANS)
@pytest.mark.thorough
def test_the_others_are_as_if_these_were_not_there(kind, tmp_path):
    blank, deleted, whole, rows = pair(kind, tmp_path)
    assert blank.plan.rows == whole.plan.rows - len(rows)
    assert blank.measurement.blank == {"data.csv": rows}
    np.testing.assert_allclose(
        blank.measurement.readings, deleted.measurement.readings, rtol=0.0, atol=1e-12
    )
    kept = np.setdiff1d(np.arange(whole.plan.rows), np.array(rows) - 1)
    assert [blank.plan.row_name(i) for i in range(blank.plan.rows)] == [str(k + 1) for k in kept]
    for name in blank.plan.groups:
        assert (
            np.asarray(blank.plan.groups[name]) == np.asarray(whole.plan.groups[name])[kept]
        ).all()
    if kind in WITHOUT_ORDER:
        same = deleted.plan, np.arange(blank.plan.rows)
    else:
        same = whole.plan, kept
    for name in (*blank.plan.axes, *blank.plan.covariates):
        assert (blank.plan.values(name) == same[0].values(name)[same[1]]).all(), name


@pytest.mark.parametrize("kind", WITHOUT_ORDER)
def test_the_fit_is_that_of_the_others(kind, tmp_path):
    blank, deleted, _, _ = pair(kind, tmp_path)
    one, other = (identify(study.model, study.measurement) for study in (blank, deleted))
    assert one.converged and one.counted.sum() == other.counted.sum()
    np.testing.assert_allclose(one.theta, other.theta, rtol=0.0, atol=1e-9)
    assert one.chi2 == pytest.approx(other.chi2, rel=1e-9)
    assert one.dof == pytest.approx(other.dof, rel=1e-9)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A study of an arm with the backlash of a joint, of which every fourth pose was not seen; what
    the loop makes of it, and the numbers of these rows.
    """
    effect = {"effect": "backlash", "joint": 1, "size_urad": 300.0}
    case = make_case("reflectors", seed=5, plan={"n": 80}, effects=[effect])
    folder = write_study(tmp_path_factory.mktemp("blank") / "arm", case)
    rows = blanked(folder, rows=range(3, 81, 4))
    study = load_study(folder)
    options = {"draws": 100, "effects": ["backlash"]}
    return study, close_loop(study.model, study.measurement, **options), rows


@pytest.mark.thorough
def test_an_arm_came_from_where_it_was_not_seen(arm):
    """The direction in which a joint came says which way its backlash goes: without the pose before
    it is unknown.
    """
    study, closure, rows = arm
    (found,) = closure.effects
    assert found.effect.key == "backlash J2"
    ((_, size, _, u),) = found.parameters
    assert abs(size - 300.0) < 3.0 * u < 100.0
    assert closure.errors["after"].chi2_per_dof == pytest.approx(1.0, abs=0.25)
    # Of the first pose alone, where no pose before it is blank.
    unknown = np.asarray(study.plan.values("dir_J2")) == 0.0
    assert unknown.sum() == 1


@pytest.mark.thorough
def test_what_was_left_out_is_told(arm, capsys):
    study, closure, rows = arm
    said = "left out: 20 rows (3, 7, 11, 15, 19, ...) of data.csv, as a reading is blank"
    assert said in closure.notes
    assert record(closure, study)["blank_readings"] == [{"file": "data.csv", "rows": [*rows]}]
    assert (
        study.observations
        == "60 observations of 9 readings (20 more with a blank reading left out)"
    )
    show_study(study)
    shown = " ".join(capsys.readouterr().out.split())
    assert "data 60 rows of 9 readings" in shown
    assert "left out 20 rows (3, 7, 11, 15, 19, ...): a reading is blank" in shown


@pytest.mark.thorough
def test_of_one_data_set(tmp_path):
    cases = {
        name: make_case("laser_tracker", seed=3, plan=PLANS["laser_tracker"], noise_seed=k)
        for k, name in enumerate(("cold", "warm"))
    }
    folder = write_joint(tmp_path / "joint", cases)
    whole = load_study(folder)
    blanked(folder, rows=(2, 5), file="warm.csv")
    study = load_study(folder)
    assert study.measurement.blank == {"warm.csv": (2, 5)}
    n = whole.plan.rows // 2
    kept = np.setdiff1d(np.arange(2 * n), [n + 1, n + 4])
    assert (study.measurement.readings == whole.measurement.readings[kept]).all()
    names = [study.plan.row_name(row) for row in (0, n - 1, n, n + 1, n + 2, n + 3)]
    assert names == ["1 of cold", f"{n} of cold", *(f"{k} of warm" for k in (1, 3, 4, 6))]
    fit = identify(study.model, study.measurement)
    assert fit.converged and fit.counted.sum() == 3 * (2 * n - 2)


@pytest.mark.thorough
def test_simulated_again(small_arm_study, tmp_path):
    """What was not read is not read in data that are made up for the same plan either."""
    rows = blanked(small_arm_study)
    study = load_study(small_arm_study)
    write_simulated(study, tmp_path / "made", seed=1)
    made = load_study(tmp_path / "made")
    assert made.measurement.blank == {"data.csv": rows}
    for name in ("move_J2", "dir_J2", "commanded_J1"):
        np.testing.assert_allclose(made.plan.values(name), study.plan.values(name), atol=1e-9)


@pytest.mark.thorough
def test_a_ball_that_was_not_found_in_simulated_data(small_ball_study, tmp_path):
    blanked(small_ball_study, rows=(4, 9))
    study = load_study(small_ball_study)
    write_simulated(study, tmp_path / "made", seed=1)
    assert load_study(tmp_path / "made").measurement.blank == {"data.csv": (4, 9)}


@pytest.mark.thorough
def test_a_pose_that_was_not_seen_at_all(small_ball_study):
    """Its six unknowns are none then."""
    before = load_study(small_ball_study)
    blanked(small_ball_study, rows=range(7, 13))
    study = load_study(small_ball_study)
    assert len(study.model.entries) == len(before.model.entries) - 6


@pytest.mark.thorough
def test_the_ends_of_a_circle(tmp_path):
    case = make_case("r_test", seed=3, plan={"samples": 60, "levels": (4.5,)})
    folder = write_study(tmp_path / "circles", case)
    blanked(folder, rows=(1, 2, 59, 60))
    assert load_study(folder).plan.rows == 6 * 60 - 4
    before = load_study(folder)
    blanked(folder, rows=range(3, 9))
    study = load_study(folder)
    # Where the axes were is known all the same, and the circle that they travelled.
    rows = np.isin(before.plan.numbers, study.plan.numbers)
    assert rows.sum() == 6 * 60 - 10
    np.testing.assert_array_equal(study.plan.position, before.plan.position[rows])


REMEMBERS = """        steps = np.diff(table["z_mm"], prepend=0.0)
        plan = linear_plan(chain, table, readings=("deviation_um",))
        return vcal.Plan(plan.axes, plan.position, {**plan.covariates, "step": steps}, plan.groups)
"""


@pytest.mark.parametrize("remembers", [True, False])
@pytest.mark.thorough
def test_an_instrument_of_ones_own(remembers, tmp_path):
    """Whether it gets these rows is for it to say."""
    plain = 'return linear_plan(chain, table, readings=("deviation_um",))'
    text = DISC.replace(f"        {plain}\n", REMEMBERS)
    text = text.replace("    dimension = 1", f"    remembers = {remembers}\n    dimension = 1")
    columns = circles(points=12)
    columns["deviation_um"] = np.random.default_rng(1).normal(0.0, 0.3, len(columns["run"]))
    folder = write_disc(tmp_path / "disc", columns, text)
    whole = load_study(folder, trust=True)
    columns["deviation_um"][[29, 30]] = np.nan
    write_csv(folder / "data.csv", columns)
    study = load_study(folder, trust=True)
    kept = np.setdiff1d(np.arange(whole.plan.rows), [29, 30])
    same = study.plan.values("step") == whole.plan.values("step")[kept]
    assert same.sum() == len(kept) - (not remembers)


def columns_blank(*columns):
    def change(table, header):
        for row in table:
            for column in columns:
                row[header.index(column)] = ""

    return change


def in_turn(table, header):
    for i, row in enumerate(table):
        row[header.index(("range_mm", "azimuth_rad")[i % 2])] = "nan"


def but_two(table, header):
    for row in table[2:]:
        row[header.index("range_mm")] = ""


def but_three(table, header):
    for row in table[3:]:
        row[header.index("range_mm")] = ""


def beside(column, value):
    def change(table, header):
        table[1][header.index("range_mm")] = ""
        table[4][header.index(column)] = value

    return change


REFUSED = {
    "a whole column": (
        columns_blank("azimuth_rad"),
        r"data.csv, row 1 \(line 2\) to row 48 \(line 49\), column azimuth_rad: found an empty "
        r"cell in every row, expected a reading .*; fill them in, or remove all columns",
    ),
    "every row": (in_turn, r"row 48 .*after 0 rows without a blank reading, expected at"),
    "all but two": (but_two, r"row 48 .*after 2 rows without a blank reading"),
    "too few to tell the station": (
        but_three,
        r"row 3 \(the last one\): found 9 readings \(3 rows of 3\) for 6 parameters",
    ),
    "a position": (beside("x_mm", ""), r"row 5 \(line 6\), column x_mm: found an empty cell"),
    "a time": (beside("t_s", "nan"), r"row 5 \(line 6\), column t_s: found 'nan'"),
    "an index": (beside("point", ""), r"row 5 \(line 6\), column point: found an empty cell"),
    "a temperature": (beside("T_x_degC", ""), r"row 5 \(line 6\), column T_x_degC: found an"),
    "another reading": (beside("range_mm", "n/a"), r"row 5 \(line 6\), column range_mm: .*'n/a'"),
    "no number": (beside("range_mm", "inf"), r"row 5 \(line 6\), column range_mm: found 'inf'"),
    "a direction": (beside("dir_x", "0"), r"row 5 \(line 6\), column dir_x: found 0"),
    "beyond the range": (beside("range_mm", "-4"), r"row 5 \(line 6\), column range_mm: found -4"),
}


@pytest.mark.parametrize(("change", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_still_refused(change, message, small_tracker_study):
    path: Path = small_tracker_study / "data.csv"
    with open(path, encoding="utf-8", newline="") as text:
        header, *table = csv.reader(text)
    change(table, header)
    write_rows(path, [header, *table])
    with pytest.raises(StudyError, match=message):
        load_study(small_tracker_study)


def test_rows_are_named_as_in_the_file(small_ball_study):
    """By an instrument too, which does not see those that are blank."""
    blanked(small_ball_study, rows=(1, 2))
    with open(small_ball_study / "data.csv", encoding="utf-8", newline="") as text:
        header, *table = csv.reader(text)
    table[4][header.index("ball")] = "77"
    write_rows(small_ball_study / "data.csv", [header, *table])
    with pytest.raises(StudyError, match=r"row 5 \(line 6\), column ball"):
        load_study(small_ball_study)


def test_a_plan_says_nothing_of_it(small_tracker_study, capsys):
    study = load_study(small_tracker_study)
    assert study.measurement.blank == {} and study.plan.numbers is None
    show_study(study)
    assert "left out" not in capsys.readouterr().out
