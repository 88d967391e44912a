"""Every mistake in an input ends in one message: file, place, found, expected, what to do."""

import itertools
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from known_files import write_frame
from vcal import CATALOGUE, Measurement, close_loop, identify
from vcal.errors import StudyError
from vcal.loop.notes import _beyond_prior
from vcal.study import load_study
from vcal.study.simulated import parse_with

Change = Callable[[Path], None]
FORM = re.compile(r"^\S+( \(override .*\))?, .+: found .+, expected .+; .+", re.DOTALL)


# --- ways to spoil a folder ----------------------------------------------------------------------


def replace(old: str, new: str, file: str = "setup.toml") -> Change:
    def change(folder: Path) -> None:
        path = folder / file
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="utf-8")

    return change


def append(text: str, file: str = "setup.toml") -> Change:
    def change(folder: Path) -> None:
        path = folder / file
        path.write_text(path.read_text(encoding="utf-8") + text, encoding="utf-8")

    return change


def effect(text: str) -> Change:
    return append("\n[[model.effect]]\n" + text + "\n")


def remove(file: str) -> Change:
    return lambda folder: (folder / file).unlink()


def write(text: str, file: str) -> Change:
    return lambda folder: (folder / file).write_text(text, encoding="utf-8") and None


def lines(edit: Callable[[list[str]], list[str]], file: str = "data.csv") -> Change:
    def change(folder: Path) -> None:
        path = folder / file
        found = path.read_text(encoding="utf-8").splitlines()
        path.write_text("\n".join(edit(found)) + "\n", encoding="utf-8")

    return change


def on_a_line(found: list[str]) -> list[str]:
    """Points along X with errors of some micrometres across it."""
    kept = [line.split(",")[:-2] for line in found[1:]]
    moved = [[*cells, f"{0.01 * (i % 3)}", f"{100 + 0.02 * i}"] for i, cells in enumerate(kept)]
    return [found[0], *(",".join(cells) for cells in moved)]


def base_on_a_line(found: list[str]) -> list[str]:
    """Three reflectors of the base along X."""
    first = found[0].split(",").index("base1_x_mm")
    rows = [line.split(",")[:first] for line in found[1:]]
    places = [f"{c}" for k in range(3) for c in (500.0 * k, 100.0, -50.0)]
    return [found[0], *(",".join([*cells, *places]) for cells in rows)]


def cell(row: int, column: str, value: str, file: str = "data.csv") -> Change:
    """Put `value` into a cell; data rows count from 1."""

    def edit(found: list[str]) -> list[str]:
        place = found[0].split(",").index(column)
        cells = found[row].split(",")
        cells[place] = value
        found[row] = ",".join(cells)
        return found

    return lines(edit, file)


def drop_column(column: str, file: str = "data.csv") -> Change:
    def edit(found: list[str]) -> list[str]:
        place = found[0].split(",").index(column)
        return [",".join(c for i, c in enumerate(r.split(",")) if i != place) for r in found]

    return lines(edit, file)


def fill(column: str, value: str, file: str = "data.csv") -> Change:
    """The same value in every row of a column."""

    def edit(found: list[str]) -> list[str]:
        place = found[0].split(",").index(column)
        rows = [row.split(",") for row in found]
        return [rows[0], *(r[:place] + [value] + r[place + 1 :] for r in rows[1:])]

    return lines(lambda found: [",".join(row) for row in edit(found)], file)


def both(*changes: Change) -> Change:
    def change(folder: Path) -> None:
        for one in changes:
            one(folder)

    return change


def check(folder: Path, expected: tuple[str, ...], overrides=()) -> str:
    with pytest.raises(StudyError) as caught:
        load_study(folder / "setup.toml", overrides)
    message = str(caught.value)
    assert FORM.match(message), message
    for fragment in expected:
        assert fragment in message, f"{fragment!r} is not in: {message}"
    return message


# --- tables --------------------------------------------------------------------------------------


def in_metres(line: str, *columns: int) -> str:
    cells = line.split(",")
    for i in columns:
        cells[i] = f"{float(cells[i]) / 1000:.9g}"
    return ",".join(cells)


SEMICOLONS = lines(lambda found: [line.replace(",", ";") for line in found])
TABLES = {
    "no data": (remove("data.csv"), ("data.csv, file", "no such file")),
    "no family": (remove("errors.csv"), ("errors.csv, file", "no such file")),
    "empty": (write("", "data.csv"), ("data.csv, file", "nothing in it", "a header line")),
    "header only": (
        lines(lambda found: found[:1]),
        ("data.csv, row 1", "no row below the header", "expected data"),
    ),
    "two rows": (
        lines(lambda found: found[:3]),
        ("data.csv, row 2 (line 3)", "after 2 rows", "at least 3 rows"),
    ),
    "not text": (
        lambda folder: (folder / "data.csv").write_bytes(b"\xff\xfe\x00x"),
        ("data.csv, file", "unreadable text", "UTF-8"),
    ),
    "truncated": (
        lines(lambda found: [*found[:20], found[20][:30]]),
        ("data.csv, row 20 (line 21), column", "cells (the last row", "15 as in the header"),
    ),
    "cell too many": (
        lines(lambda found: [*found[:4], found[4] + ",1", *found[5:]]),
        ("data.csv, row 4 (line 5), column after the last one", "found 16 cells", "expected 15"),
    ),
    "blank lines count": (
        both(lines(lambda found: [found[0], "", *found[1:]]), cell(3, "range_mm", "no")),
        ("data.csv, row 2 (line 4), column range_mm", "'no'"),
    ),
    "semicolons, a cell too many": (
        both(lines(lambda found: [*found[:4], found[4] + ",1", *found[5:]]), SEMICOLONS),
        ("data.csv, row 4 (line 5)", "found 16 cells", "15 as in the header, separated by semicol"),
    ),
    "thousands": (
        both(cell(5, "range_mm", "1.234|5"), SEMICOLONS, replace("|", ",", "data.csv")),
        ("data.csv, row 5 (line 6), column range_mm", "found '1.234,5'"),
    ),
    "thousands beside decimal points": (
        both(cell(5, "range_mm", "1|234"), SEMICOLONS, replace("|", ",", "data.csv")),
        ("data.csv, row 5 (line 6), column range_mm", "found '1,234'"),
    ),
    "decimal commas between commas": (
        replace(".", ",", "data.csv"),
        ("data.csv, row 1 (line 2)", "need semicolons between the columns"),
    ),
    "missing position": (
        drop_column("x_mm"),
        ("data.csv, column x_mm", "no such column", "expected a column of this name"),
    ),
    "missing reading": (
        drop_column("azimuth_rad"),
        ("data.csv, column azimuth_rad", "no such column"),
    ),
    "misspelled column": (
        replace("range_mm", "rnage_mm", "data.csv"),
        ("data.csv, column range_mm", "; add the column; if rnage_mm holds this quantity, give it"),
    ),
    "column twice": (
        replace("y_mm", "x_mm", "data.csv"),
        ("data.csv, header (line 1), column x_mm", "2 times (places 2, 3)", "every name once"),
    ),
    "text": (
        cell(5, "range_mm", "abc"),
        ("data.csv, row 5 (line 6), column range_mm", "found 'abc'", "a number from 1 to 200000"),
    ),
    "empty cell": (
        cell(5, "x_mm", ""),
        ("data.csv, row 5 (line 6), column x_mm", "found an empty cell", "expected a number"),
    ),
    "a time that was not recorded": (
        cell(5, "t_s", ""),
        ("row 5 (line 6), column t_s", "found an empty cell", "fill it in, or remove the row"),
    ),
    "a temperature that was not recorded": (
        cell(5, "T_y_degC", ""),
        ("row 5 (line 6), column T_y_degC", "found an empty cell", "the row, or the column"),
    ),
    "NaN": (
        cell(7, "y_mm", "nan"),
        ("data.csv, row 7 (line 8), column y_mm", "'nan'", "a number from -1000000"),
    ),
    "inf": (
        cell(7, "t_s", "inf"),
        ("data.csv, row 7 (line 8), column t_s", "'inf'", "expected a number"),
    ),
    "underscore": (cell(7, "t_s", "1_0"), ("row 7 (line 8), column t_s", "'1_0'")),
    "text in a further column of numbers": (
        both(
            lines(lambda found: [found[0] + ",load_kg"] + [f"{line},1" for line in found[1:]]),
            cell(2, "load_kg", "1O"),
        ),
        ("data.csv, row 2 (line 3), column load_kg", "'1O'", "expected a number"),
    ),
    "negative range": (
        cell(1, "range_mm", "-5"),
        ("data.csv, row 1 (line 2), column range_mm", "found -5", "from 1 to 200000"),
    ),
    "in degrees": (
        cell(1, "azimuth_rad", "45"),
        ("data.csv, row 1 (line 2), column azimuth_rad", "found 45", "from -6.283185 to 6.283185"),
    ),
    "in kelvin": (
        cell(3, "T_x_degC", "293.15"),
        ("data.csv, row 3 (line 4), column T_x_degC", "found 293.15", "from -50 to 150"),
    ),
    "no direction": (
        cell(3, "dir_x", "0"),
        ("data.csv, row 3 (line 4), column dir_x", "found 0", "expected +1 or -1"),
    ),
    "as many readings as unknowns, but for a row": (
        lines(lambda found: found[:4]),
        (
            "data.csv, row 3 (the last one)",
            "found 9 readings (3 rows of 3) for 6 parameters without a prior (station)",
            "more than 9 readings",
            "measure more rows",
        ),
    ),
    "points on one line": (
        both(
            *(cell(row, "y_mm", "300") for row in range(1, 49)),
            *(cell(row, "z_mm", "200") for row in range(1, 49)),
        ),
        (
            "data.csv, columns of positions and conditions",
            "found 48 rows that identify 5 of 6 parameters without a prior; station Y, "
            "station A are not identified",
            "positions that are not all on one straight line",
            "measure further positions, or give a prior (a *_sigma) to a parameter",
        ),
    ),
    "direction of an unknown axis": (
        replace("dir_z", "dir_w", "data.csv"),
        ("data.csv, header, column dir_w", "unknown axis 'W'", "one of dir_x, dir_y, dir_z"),
    ),
    "pasted below itself": (
        lines(lambda found: [*found, *found[1:]]),
        (
            "data.csv, row 49 (line 50)",
            "found the same as in row 1 (line 2), in every column, and 47 more rows",
            "every reading once",
            "remove the rows or, if the measurement was really repeated",
        ),
    ),
    "a row twice, written otherwise": (
        both(lines(lambda found: [*found, found[3]]), cell(3, "x_mm", "+100.0000")),
        (
            "data.csv, row 49 (line 50)",
            "found the same as in row 3 (line 4), in every column, expected",
        ),
    ),
    "fractional index": (
        cell(3, "point", "2.5"),
        ("data.csv, row 3 (line 4), column point", "found 2.5", "a whole number of at least 0"),
    ),
    "outside the travel": (
        cell(9, "y_mm", "1000.1"),
        (
            "data.csv, row 9 (line 10), column y_mm",
            "found 1000.1, outside the travel",
            "expected 0 to 1000 (machine.travel_mm.Y)",
        ),
    ),
    "check point outside the travel": (
        cell(2, "x_mm", "-3", "check.csv"),
        ("check.csv, row 2 (line 3), column x_mm", "found -3", "expected 0 to 2000"),
    ),
    "another separator": (
        lines(lambda found: [line.replace(",", "|") for line in found]),
        (
            "data.csv, header (line 1)",
            'found one name, "point|x_mm|',
            "separated by commas or semicolons or tabs",
        ),
    ),
    "blanks between the columns": (
        lines(lambda found: [line.replace(",", " ") for line in found]),
        ("data.csv, header (line 1)", "found one name", "save the table with one of these"),
    ),
    "an index without end": (
        cell(3, "point", "1e300"),
        ("data.csv, row 3 (line 4), column point", "found 1e300", "no more than 1e+09 in size"),
    ),
    "a time without end": (
        cell(3, "t_s", "1e300"),
        ("data.csv, row 3 (line 4), column t_s", "found 1e300", "-1e+10 to 1e+10", "300 years"),
    ),
    "a mistake below a preamble": (
        both(
            cell(2, "range_mm", "no"),
            lines(lambda found: ["sep=,", '# measured by "me', "", "# again", *found]),
        ),
        ("data.csv, row 2 (line 7), column range_mm", "'no'"),
    ),
    "no name of the data": (
        append('\n[data]\ndata = ""\n'),
        ("setup.toml, key data.data", 'found ""', "text that is not empty"),
    ),
    "no name of the check points": (
        append('\n[data]\ncheck = ""\n'),
        ("setup.toml, key data.check", 'found ""', "text that is not empty"),
    ),
    "a folder for check points": (
        append('\n[data]\ncheck = "."\n'),
        (".", "file", "found a folder", "a CSV table"),
    ),
    "one axis in metres": (
        lines(lambda found: [found[0], *(in_metres(line, 2) for line in found[1:])]),
        (
            "data.csv, column y_mm",
            "positions from 0.05 to 0.95, a thousandth of the travel of 0 to 1000",
            "correct the unit of the positions or of machine.travel_mm.Y",
        ),
    ),
    "travel of one axis in um": (
        replace("Y = [0, 1000]", "Y = [0, 1000000]"),
        ("setup.toml, key machine.travel_mm.Y.1", "found 1000000", "at most 200000"),
    ),
    "tool points in metres": (
        lines(
            lambda found: [
                found[0],
                *(in_metres(line, *range(-3, 0)) for line in found[1:]),
            ],
            "check.csv",
        ),
        ("check.csv, row ", "columns tcp_x_mm, tcp_y_mm, tcp_z_mm", "mm off", "in millimetres"),
    ),
    "tool points of another sign": (
        replace("tcp_x_mm,tcp_y_mm", "tcp_y_mm,tcp_x_mm", "check.csv"),
        ("check.csv, row ", "a tool point that is", "unit, sign and order"),
    ),
    "check without tool points": (
        drop_column("tcp_z_mm", "check.csv"),
        ("check.csv, column tcp_z_mm", "no such column among x_mm, y_mm"),
    ),
    "too few check points": (
        lines(lambda found: found[:3], "check.csv"),
        ("columns tcp_x_mm, tcp_y_mm, tcp_z_mm", "found 2 check points on a line", "at least 3"),
    ),
    "check points on a line": (
        lines(on_a_line, "check.csv"),
        (
            "check.csv, columns tcp_x_mm, tcp_y_mm, tcp_z_mm",
            "found 5 check points on a line",
            "at least 3 that are not",
            "add points off that line",
        ),
    ),
    "named check that is not there": (
        append('\n[data]\ncheck = "other.csv"\n'),
        ("other.csv, file", "no such file"),
    ),
}


@pytest.mark.thorough
def test_what_was_measured_again_is_no_repeated_row(small_tracker_study):
    """In a plan, where something tells the rows apart, and where a coarse resolution makes some
    readings agree; not where none of them ever differs.
    """
    data = small_tracker_study / "data.csv"
    head, *rows = [line.split(",") for line in data.read_text(encoding="utf-8").splitlines()]
    told = [head.index(name) for name in ("point", "t_s") if name in head]
    readings = head.index("range_mm")

    def written(rows, drop=()):
        kept = [i for i in range(len(head)) if i not in drop]
        text = [",".join(row[i] for i in kept) for row in (head, *rows)]
        data.write_text("\n".join(text) + "\n", encoding="utf-8")
        return small_tracker_study

    again = [[*row] for row in rows]
    for i in told:
        for number, row in enumerate(again, start=1000):
            row[i] = str(number)
    assert load_study(written(rows + again)).plan.rows == 96
    assert load_study(written(rows * 2, range(readings, readings + 3))).plan.rows == 96
    coarse = [[*row] for row in rows]
    for row in coarse[::2]:
        row[readings] = f"{float(row[readings]) + 0.001:.9g}"
    for row in coarse[1:6:2]:
        row[readings] = f"{float(row[readings]) + 0.002:.9g}"
    assert load_study(written(rows + coarse, told)).plan.rows == 96
    written(rows * 2, told)
    check(small_tracker_study, ("data.csv, row 49 (line 50)", "and 47 more rows"))


@pytest.mark.parametrize("case", TABLES)
def test_tables(small_tracker_study, case):
    change, expected = TABLES[case]
    change(small_tracker_study)
    check(small_tracker_study, expected)


ERRORS = "errors.csv"
FAMILY = {
    "missing component": (
        lines(lambda f: [line for line in f if not line.startswith(("EBY", "EC0Y"))], ERRORS),
        ("column component", "found 19 rows without EBY, EC0Y", "all 21 error motions"),
    ),
    "unknown component": (
        replace("EAX", "EA1X", ERRORS),
        ("row 4 (line 5), column component", "'EA1X' (did you mean 'EAX'?)", "one of EXX, EYX"),
    ),
    "component of another axis": (
        replace("EXX", "EXU", ERRORS),
        ("row 1 (line 2), column component", "'EXU'", "the machine has no axis 'U'"),
    ),
    **{
        f"{column} = {value}": (
            cell(4, column, value, ERRORS),
            (f"row 4 (line 5), column {column}", f"found {value}", expected),
        )
        for column, value, expected in (
            *((name, "1e+09", "a number from 0 to 1000; correct") for name in ("n1", "n2")),
            *((name, "1e+09", "from 0 to 50000") for name in ("a0", "a1", "b1", "c1", "b2", "c2")),
            ("n1", "1e-09", "zero, or a number from 0.01 to 1000"),
            ("c2", "1e-09", "zero, or a number from 1e-06 to 50000"),
        )
    },
    "component twice": (
        replace("EYX", "EXX", ERRORS),
        ("row 2 (line 3), column component", "EXX again, first in row 1", "every component once"),
    ),
    "negative amplitude": (
        cell(4, "b1", "-15", ERRORS),
        ("row 4 (line 5), column b1", "found -15", "a number from 0 to 50000"),
    ),
    "no wave number": (
        cell(4, "n1", "0", ERRORS),
        ("row 4 (line 5), column n1", "0 with b1 = 15", "a wave number above 0"),
    ),
    "no column": (drop_column("c2", ERRORS), ("column c2", "no such column")),
    "no components": (drop_column("component", ERRORS), ("column component", "no such column")),
}


@pytest.mark.parametrize("case", FAMILY)
def test_family_tables(small_tracker_study, case):
    change, expected = FAMILY[case]
    change(small_tracker_study)
    check(small_tracker_study, ("errors.csv, ", *expected))


def on_the_line(ball: int) -> Change:
    """A ball of the artefact on a line along its x."""
    return both(*(cell(ball + 1, f"{c}_mm", "1.5", "artefact.csv") for c in "yz"))


PROBED = "probe_sigma_um = 0.7\n"
BALLS = {
    "a single pose of three balls": (
        lines(lambda found: found[:4]),
        (
            "data.csv, row 3 (the last one)",
            "found 9 readings (3 rows of 3) for 6 parameters without a prior (artefact_pose)",
            "more than 9 readings",
            "measure more rows",
        ),
    ),
    "no artefact": (remove("artefact.csv"), ("artefact.csv, file", "no such file")),
    "no index": (drop_column("ball"), ("data.csv, column ball", "no such column")),
    "repeated index": (
        cell(2, "ball", "0"),
        (
            "data.csv, row 2 (line 3), column ball: found pose 0, ball 0 again",
            "mm from where",
            "row 1 has it, expected the same place within 2 mm",
            "correct the index",
        ),
    ),
    "unknown index": (
        cell(2, "ball", "9"),
        ("data.csv, row 2", "column ball", "found 9", "a ball of artefact.csv (0, 1, 2, 3, 4, 5)"),
    ),
    "fractional index": (
        cell(2, "ball", "0.5"),
        ("data.csv, row 2 (line 3), column ball", "found 0.5", "a whole number of at least 0"),
    ),
    "negative index": (cell(2, "pose", "-1"), ("data.csv, row 2 (line 3), column pose", "-1")),
    "too few balls in a pose": (
        lines(lambda found: found[:3] + found[7:]),
        ("data.csv, row 1", "column pose", "2 balls", "at least 3"),
    ),
    "ball calibrated twice": (
        cell(2, "ball", "0", "artefact.csv"),
        ("artefact.csv, row 2 (line 3), column ball", "ball 0 again", "every ball once"),
    ),
    "two balls at one place": (
        lines(lambda found: [*found[:4], f"3{found[1][1:]}", *found[5:]], "artefact.csv"),
        (
            "artefact.csv, columns x_mm, y_mm, z_mm: found balls 0 and 3 0 mm apart",
            "expected every ball at a place of its own",
        ),
    ),
    "an artefact that is a line": (
        both(*(on_the_line(ball) for ball in range(6))),
        (
            "data.csv, row 1 (line 2), column ball: found the balls 0, 1, 2, 3, 4, 5 of pose 0, "
            "all on one line of artefact.csv",
            "expected balls that span a plane",
            "measure a ball off the line",
        ),
    ),
    "three balls of a pose on a line": (
        both(
            *(on_the_line(ball) for ball in range(3)),
            lines(lambda found: found[:10] + found[13:]),
        ),
        ("data.csv, row 7 (line 8), column ball: found the balls 0, 1, 2 of pose 1, all on one",),
    ),
    "both supports at one place": (
        replace(PROBED, PROBED + "supports = [0.5, 0.5]\n"),
        (
            "setup.toml, key instrument: found supports = [0.5, 0.5]",
            "two shares of the artefact's length from 0 to 1, the lower first",
        ),
    ),
    "supports in percent": (
        replace(PROBED, PROBED + "supports = [22, 78]\n"),
        ("setup.toml, key instrument: found supports = [22, 78]", "such as [0.22, 0.78]"),
    ),
    "supports exchanged": (
        replace(PROBED, PROBED + "supports = [0.78, 0.22]\n"),
        ("setup.toml, key instrument: found supports", "the lower first"),
    ),
    "inf in a calibration": (
        cell(3, "y_mm", "inf", "artefact.csv"),
        ("artefact.csv, row 3 (line 4), column y_mm", "'inf'"),
    ),
}


@pytest.mark.parametrize("case", BALLS)
def test_ball_tables(small_ball_study, case):
    change, expected = BALLS[case]
    change(small_ball_study)
    check(small_ball_study, expected)


def other_unit(name: str, factor: float) -> Change:
    """Columns with that beginning of their names in another unit."""

    def edit(found: list[str]) -> list[str]:
        head, *rows = [line.split(",") for line in found]
        at = [i for i, column in enumerate(head) if column.startswith(name)]
        for row in rows:
            for i in at:
                row[i] = f"{float(row[i]) * factor:.12g}"
        return [",".join(row) for row in (head, *rows)]

    return lines(edit)


ARMS = {
    "reflectors in metres": (
        other_unit("smr", 1e-3),
        ("data.csv, row ", "columns smr1_x_mm", "while the arm moves its tool", "correct the unit"),
    ),
    "angles in radians": (
        other_unit("q", 0.017453292519943295),
        ("data.csv, row ", "columns of the joint angles", "convert the angles to degrees"),
    ),
    "more reflectors than anyone has": (
        replace("tool_reflectors = 3", "tool_reflectors = 100000000"),
        ("key instrument.tool_reflectors", "found 100000000", "a number of at most 100"),
    ),
    "repeated pose": (
        cell(3, "pose", "1"),
        (
            "data.csv, row 3 (line 4), column pose",
            "pose 1 again, first in row 2",
            "every pose once",
        ),
    ),
    "joint outside its bounds": (
        cell(3, "q1_cmd_deg", "171"),
        (
            "data.csv, row 3 (line 4), column q1_cmd_deg",
            "171, outside the travel",
            "expected -170 to 170 (machine.joint.0)",
        ),
    ),
    "missing joint": (drop_column("q2_cmd_deg"), ("data.csv, column q2_cmd_deg", "no such")),
    "missing base": (drop_column("base2_z_mm"), ("data.csv, column base2_z_mm", "no such column")),
    "base on a line": (
        lines(base_on_a_line),
        ("key instrument.base_reflectors", "3 reflectors on one line", "rotation about"),
    ),
    "joint out of order": (
        replace("low_deg = -170", "low_deg = 175"),
        ("setup.toml, key machine.joint.0", "low_deg 175 and high_deg 170", "low below high"),
    ),
    "bound of another kind": (
        replace("low_deg = -170", "low_mm = -170"),
        ("setup.toml, key machine.joint.0", "found low_mm", "expected low_deg and high_deg"),
    ),
    "unknown type of joint": (
        replace('type = "revolute"', 'type = "revolving"'),
        ("setup.toml, key machine.joint.0.type", "\"revolving\" (did you mean 'revolute'?)"),
    ),
    "unknown key of a joint": (
        replace("d_mm = 300", "d_um = 300"),
        ("setup.toml, key machine.joint.2.d_um", "did you mean 'd_mm'?", "expected one of type"),
    ),
    "family of linear axes": (
        replace("link_translation_um", 'family = "fourier"\nlink_translation_um'),
        ("setup.toml, key model.geometric.family", '"fourier"', "expected 'smooth'"),
    ),
    "negative size of links": (
        replace("link_rotation_urad = 2000", "link_rotation_urad = -1"),
        ("setup.toml, key model.geometric.link_rotation_urad", "found -1", "at least 1e-06"),
    ),
    "sliding joint": (
        both(
            replace('type = "revolute"\na', 'type = "prismatic"\na'),
            replace("low_deg = -170\nhigh_deg = 170\n", ""),
        ),
        ("data.csv, column q1_cmd_mm", "no such column"),
    ),
    "sliding joint without bounds": (
        both(
            replace('type = "revolute"\na', 'type = "prismatic"\na'),
            replace("low_deg = -170\nhigh_deg = 170\n", ""),
            replace("q1_cmd_deg", "q1_cmd_mm", "data.csv"),
        ),
        ("setup.toml, key machine.joint.0", "a prismatic joint without bounds", "low_mm and high"),
    ),
    "more parameters than readings": (
        # 3 rows of 3 readings against a base pose, a reflector, and six links without a prior.
        both(
            lines(lambda found: found[:4]),
            replace("tool_reflectors = 3", "tool_reflectors = 1"),
            append(
                "".join(
                    f'\n[[model.effect]]\nname = "gear_harmonic"\nplacement = "J1"\norder = {n}\n'
                    f"sine{n}_urad_sigma = inf\n"
                    for n in (1, 2)
                )
            ),
        ),
        (
            "data.csv, row 3",
            "found 9 readings",
            "for 11 parameters without a prior",
            "more than 14",
        ),
    ),
}


@pytest.mark.parametrize("case", ARMS)
def test_arm_studies(small_arm_study, case):
    change, expected = ARMS[case]
    change(small_arm_study)
    check(small_arm_study, expected)


# --- study file ----------------------------------------------------------------------------------

SETUP = {
    "no study": (remove("setup.toml"), ("setup.toml, file", "no such file", "a study file")),
    "not TOML": (
        replace('kind = "laser_tracker"', "kind = laser_tracker"),
        ("setup.toml, line 12, column 8", "found what is not TOML", "correct the line"),
    ),
    "no instrument": (
        replace("[instrument]", "[instrument_x]"),
        ("setup.toml, key instrument_x", "did you mean 'instrument'?"),
    ),
    "unknown instrument": (
        replace('"laser_tracker"', '"laser_traker"'),
        (
            "setup.toml, key instrument.kind",
            "'laser_traker' (did you mean 'laser_tracker'?)",
            "expected one of",
        ),
    ),
    "unknown key": (
        replace("angle_sigma_urad", "angle_sigma_uard"),
        ("setup.toml, key instrument.angle_sigma_uard", "did you mean 'angle_sigma_urad'?"),
    ),
    "unknown table": (
        append("\n[lop]\nseed = 1\n"),
        ("setup.toml, key lop", "did you mean 'loop'?", "expected one of name, machine"),
    ),
    "unknown key of the loop": (
        append("\n[loop]\nalhpa = 0.05\n"),
        ("setup.toml, key loop.alhpa", "did you mean 'alpha'?", "correct or remove the key"),
    ),
    "missing key": (
        replace("angle_sigma_urad = 2.5", ""),
        ("setup.toml, key instrument.angle_sigma_urad", "found nothing", "; add it"),
    ),
    "text for a number": (
        replace("range_sigma_um = 1.3", 'range_sigma_um = "1.3"'),
        ("setup.toml, key instrument.range_sigma_um", 'found "1.3"', "expected a number"),
    ),
    "truth for a number": (
        replace("range_sigma_um = 1.3", "range_sigma_um = true"),
        ("setup.toml, key instrument.range_sigma_um", "found true", "expected a number"),
    ),
    "NaN": (
        replace("range_sigma_um = 1.3", "range_sigma_um = nan"),
        ("setup.toml, key instrument.range_sigma_um", "found nan", "expected a finite number"),
    ),
    "inf in a list": (
        replace("[-900.0", "[-inf"),
        ("setup.toml, key instrument.station_mm.0", "found -inf", "expected a finite number"),
    ),
    "negative noise": (
        replace("range_sigma_um = 1.3", "range_sigma_um = -1.3"),
        ("setup.toml, key instrument.range_sigma_um", "found -1.3", "a number of at least 1e-05"),
    ),
    "short list": (
        replace("300.0, 700.0]", "300.0]"),
        ("setup.toml, key instrument.station_mm", "found [-900.0, 300.0]", "at least 3 values"),
    ),
    "long list": (
        replace("700.0]", "700.0, 1.0]"),
        ("setup.toml, key instrument.station_mm", "expected 3 values"),
    ),
    "value for a table": (
        replace("[machine.travel_mm]\n", "[machine.travel_mm]\nX = 3\n[machine.travel]\n"),
        ("setup.toml, key machine.travel_mm.X", "found 3", "a list in square brackets"),
    ),
    "list for a table": (
        replace("[machine.travel_mm]\n", "travel_mm = [0, 3]\n[machine.travel]\n"),
        ("setup.toml, key machine.travel_mm", "found [0, 3]", "expected a table; correct"),
    ),
    "rows for a table": (
        append("\n[[loop]]\nalpha = 0.01\n"),
        ("setup.toml, key loop", "expected one table, below [loop]", "single brackets"),
    ),
    "alpha out of range": (
        append("\n[loop]\nalpha = 1.0\n"),
        ("setup.toml, key loop.alpha", "found 1.0", "a number less than 1"),
    ),
    "fractional seed": (
        append("\n[loop]\nseed = 1.5\n"),
        ("setup.toml, key loop.seed", "found 1.5", "a whole number"),
    ),
    "unknown effect of the loop": (
        append('\n[loop]\neffects = ["screw_cyclic", "backlsh"]\n'),
        ("setup.toml, key loop.effects.1", "'backlsh' (did you mean 'backlash'?)", "one of"),
    ),
    "impossible chain": (
        replace('"w X b Y Z t"', '"w X Y Z t"'),
        ("setup.toml, key machine.chain", "found an impossible chain 'w X Y Z t'", "'b'"),
    ),
    "axis twice": (
        replace('"w X b Y Z t"', '"w X b Y X t"'),
        ("setup.toml, key machine.chain", "axis 'X' appears twice", "expected 'w'"),
    ),
    "unknown axis of the chain": (
        replace('"w X b Y Z t"', '"w X b Y V t"'),
        (
            "setup.toml, key machine.chain",
            "axis 'V' is none of the linear axes X, Y, Z",
            "expected 'w'",
        ),
    ),
    "a rotary axis": (
        replace('"w X b Y Z t"', '"w C X b Y Z t"'),
        (
            "key machine.rotary.C",
            "found nothing",
            "the position of the rotary axis C",
            "add [machine.rotary.C]",
        ),
    ),
    "two axes": (
        both(replace('"w X b Y Z t"', '"w X b Z t"'), replace("Y = [0, 1000]\n", "")),
        ("setup.toml, key instrument.kind", "'w X b Z t'", "the axes X, Y and Z"),
    ),
    "unknown axis of the travel": (
        replace("Z = [0, 600]", "z = [0, 600]"),
        ("setup.toml, key machine.travel_mm.z", "'z' (did you mean 'Z'?)", "one of X, Y, Z"),
    ),
    "travel upside down": (
        replace("Z = [0, 600]", "Z = [600, 0]"),
        ("setup.toml, key machine.travel_mm.Z", "found [600, 0]", "the lowest below the highest"),
    ),
    "travel in nanometres": (
        replace("Z = [0, 600]", "Z = [0, 600e6]"),
        ("setup.toml, key machine.travel_mm.Z.1", "found 600000000.0", "at most 200000", "200 m"),
    ),
    "travel of nothing": (
        replace("Z = [0, 600]", "Z = [0, 0.05]"),
        ("setup.toml, key machine.travel_mm.Z", "found [0, 0.05]", "at least 0.1 mm"),
    ),
    "a tool in metres": (
        replace("tool_offset_mm = [0, 0, -150]", "tool_offset_mm = [0, 0, -0.15]"),
        (
            "setup.toml, key machine.tool_offset_mm",
            "found [0.0, 0.0, -0.15], less than a thousandth of the travel",
            "correct the unit, or write [0, 0, 0] if",
        ),
    ),
    "tool in um": (
        replace("tool_offset_mm = [0, 0, -150]", "tool_offset_mm = [0, 0, -150000]"),
        ("setup.toml, key machine.tool_offset_mm.2", "-150000", "at least -10000"),
    ),
    "huge": (
        replace("range_sigma_um = 1.3", "range_sigma_um = 1e308"),
        ("setup.toml, key instrument.range_sigma_um", "1e+308", "from 1e-15 to 1e+15 in size"),
    ),
    "noise of a metre": (
        replace("range_sigma_um = 1.3", "range_sigma_um = 1e6"),
        (
            "setup.toml, key instrument.range_sigma_um",
            "found 1000000.0",
            "at most 5000; correct the value or its unit: ",
        ),
    ),
    "a station in um": (
        replace("[-900.0", "[-900000.0"),
        ("setup.toml, key instrument.station_mm.0", "found -900000.0", "at least -200000"),
    ),
    "noise of a thousandth of an atom": (
        replace("range_sigma_um = 1.3", "range_sigma_um = 1e-12"),
        ("setup.toml, key instrument.range_sigma_um", "found 1e-12", "at least 1e-05"),
    ),
    "noise in metres": (
        replace("range_sigma_um = 1.3", "range_sigma_um = 1.3e-6"),
        ("setup.toml, key instrument.range_sigma_um", "found 1.3e-06", "at least 1e-05; correct"),
    ),
    "tiny": (
        replace("range_sigma_um = 1.3", "range_sigma_um = 1e-300"),
        ("setup.toml, key instrument.range_sigma_um", "1e-300", "from 1e-15 to 1e+15 in size"),
    ),
    "a huge whole number": (
        append(f"\n[loop]\nseed = 1{'0' * 400}\n"),
        ("setup.toml, key loop.seed", "at most 2^63 - 1"),
    ),
    "a number of thousands of digits": (
        append(f"\n[loop]\nseed = 1{'0' * 5000}\n"),
        ("setup.toml, file", "what is not TOML (Exceeds the limit", "correct the line"),
    ),
    "brackets without end": (
        append("\n[loop]\nseed = " + "[" * 5000),
        ("setup.toml, file", "what is not TOML (maximum recursion depth", "correct the line"),
    ),
    "pitch of nothing": (
        effect('name = "screw_cyclic"\nplacement = "Y"\npitch_mm = 0'),
        ("model.effect.0.pitch_mm (screw_cyclic)", "found 0", "a number greater than 0"),
    ),
    "negative pitch": (
        effect('name = "screw_cyclic"\nplacement = "Y"\npitch_mm = -5'),
        ("model.effect.0.pitch_mm (screw_cyclic)", "found -5", "a number greater than 0"),
    ),
    "missing travel": (
        replace("Z = [0, 600]\n", ""),
        ("setup.toml, key machine.travel_mm.Z", "found nothing", "add it, such as Z = [0, 1000]"),
    ),
    "no machine": (
        replace('chain = "w X b Y Z t"', ""),
        ("setup.toml, key machine", "neither a chain nor joint rows", "expected either"),
    ),
    "chain and joints": (
        append('\n[[machine.joint]]\ntype = "revolute"\n'),
        ("setup.toml, key machine", "both a chain and joint rows", "expected either"),
    ),
    "instrument of an arm": (
        lambda folder: (folder / "setup.toml").write_text(
            (folder / "setup.toml").read_text().split("[instrument]")[0]
            + '[instrument]\nkind = "reflectors"\ntool_reflectors = 1\nsigma_um = 10\n'
        ),
        ("setup.toml, key instrument.kind", "'reflectors' on a machine with 'w X b Y Z t'", "arm"),
    ),
    "unknown family": (
        replace('"fourier"', '"forier"'),
        ("setup.toml, key model.geometric.family", "did you mean 'fourier'?", "or 'smooth'"),
    ),
    "misspelled family": (
        replace("family =", "famly ="),
        ("setup.toml, key model.geometric.famly", "did you mean 'family'?"),
    ),
    "key of another family": (
        append("smoothness = 0.5\n"),
        ("setup.toml, key model.geometric.smoothness", "expected one of family, table"),
    ),
    "negative size": (
        replace(
            'family = "fourier"\ntable = "errors.csv"',
            'family = "smooth"\ntranslation_um = -1\nrotation_urad = 1\nsquareness_urad = 1',
        ),
        ("setup.toml, key model.geometric.translation_um", "found -1", "at least 1e-06"),
    ),
    "errors in metres": (
        replace(
            'family = "fourier"\ntable = "errors.csv"',
            'family = "smooth"\ntranslation_um = 8\nrotation_urad = 1e-12\nsquareness_urad = 2e6',
        ),
        (
            "setup.toml, key model.geometric.rotation_urad: found 1e-12, expected a number of at",
            "setup.toml, key model.geometric.squareness_urad: found 2000000.0, expected a number",
        ),
    ),
    "unknown effect": (
        effect('name = "scale_grwth"\nplacement = "X"'),
        ("setup.toml, key model.effect.0.name", "'scale_grwth' (did you mean 'scale_growth'?)"),
    ),
    "effect without a name": (
        effect('placement = "X"'),
        ("setup.toml, key model.effect.0.name", "found nothing", "add it to setup.toml"),
    ),
    "unknown placement": (
        effect('name = "backlash"\nplacement = "y"'),
        ("model.effect.0.placement (backlash)", "'y' (did you mean 'Y'?)", "one of X, Y, Z"),
    ),
    "no placement": (
        effect('name = "backlash"\nsize_um = 3'),
        ("model.effect.0.placement (backlash)", "found nothing", "one of X, Y, Z"),
    ),
    "unknown parameter": (
        effect('name = "backlash"\nplacement = "Y"\nsize_mm = 3'),
        ("model.effect.0.size_mm (backlash)", "did you mean 'size_um'?", "one of size_um"),
    ),
    "text for a parameter": (
        effect('name = "backlash"\nplacement = "Y"\nsize_um = "3"'),
        ("model.effect.0.size_um (backlash)", 'found "3"', "expected a number"),
    ),
    "list for a parameter": (
        effect('name = "backlash"\nplacement = "Y"\nsize_um = [1, 2]'),
        ("model.effect.0.size_um (backlash)", "found [1, 2]", "a 3 x 3 matrix"),
    ),
    "negative sigma": (
        effect('name = "backlash"\nplacement = "Y"\nsize_um = 3\nsize_um_sigma = -1'),
        ("model.effect.0.size_um_sigma (backlash)", "found -1", "a number of at least 0"),
    ),
    "sigma of a shape": (
        effect('name = "screw_cyclic"\nplacement = "Y"\npitch_mm_sigma = 1'),
        ("model.effect.0.pitch_mm_sigma (screw_cyclic)", "found 1", "expected no sigma"),
    ),
    "infinite parameter": (
        effect('name = "backlash"\nplacement = "Y"\nsize_um = inf'),
        ("setup.toml, key model.effect.0.size_um", "found inf", "a finite number"),
    ),
    "unknown component": (
        effect('name = "thermal_tilt"\nplacement = "Y"\ncomponent = "EAX"'),
        ("model.effect.0.component (thermal_tilt)", "'EAX' (did you mean", "one of EAY, EBY, ECY"),
    ),
    "no component": (
        effect('name = "thermal_tilt"\nplacement = "Y"'),
        ("model.effect.0.component (thermal_tilt)", "3 effects", "EAY, EBY, ECY"),
    ),
    "two components": (
        effect(
            'name = "thermal_tilt"\nplacement = "Y"\nk_EAY_urad_per_K = 1\nk_EBY_urad_per_K = 2'
        ),
        ("model.effect.0 (thermal_tilt)", "belong to different effects", "one [[model.effect]]"),
    ),
    "effect of another instrument": (
        effect('name = "artefact_expansion"\nalpha_um_per_m_K = 3'),
        ("model.effect.0.name (artefact_expansion)", "possible placement", "on this instrument"),
    ),
    "effect without its covariate": (
        both(
            effect('name = "scale_growth"\nplacement = "X"'),
            drop_column("T_x_degC"),
        ),
        ("data.csv, column T_x_degC", "'scale_growth X'", "T_x_degC, x_mm"),
    ),
    "no effects file": (
        append('\n[model]\neffects_file = "own.py"\n'),
        ("own.py, file", "no such file", "a Python file"),
    ),
}


@pytest.mark.parametrize("case", SETUP)
def test_study_file(small_tracker_study, case):
    change, expected = SETUP[case]
    change(small_tracker_study)
    check(small_tracker_study, expected)


def test_a_list_that_is_wrong_is_told_once(small_tracker_study):
    message = check(small_tracker_study, ("loop.effects.0", "found 3"), ["loop.effects=[3]"])
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize("end", [",", ",,,", ",17", ",1,2"])
def test_columns_without_a_name_are_left_out(small_tracker_study, end):
    plain = load_study(small_tracker_study).plan
    blank = "," * end.count(",")
    lines(lambda f: [f[0] + blank, *(line + end for line in f[1:])])(small_tracker_study)
    found = load_study(small_tracker_study).plan
    assert found.covariates.keys() == plain.covariates.keys() and found.rows == plain.rows


def test_what_stands_before_the_header_is_left_out(small_tracker_study):
    plain = load_study(small_tracker_study).measurement
    lines(lambda found: ["# a comment; of mine", *found])(small_tracker_study)
    SEMICOLONS(small_tracker_study)
    lines(lambda found: ["sep=;", *found])(small_tracker_study)
    assert (load_study(small_tracker_study).measurement.readings == plain.readings).all()


def test_all_mistakes_of_a_study_file_are_told_at_once(small_tracker_study):
    replace("range_sigma_um = 1.3", 'range_sigma_um = "1.3"')(small_tracker_study)
    replace("angle_sigma_urad = 2.5", "angle_sigma_uard = 2.5")(small_tracker_study)
    message = check(small_tracker_study, ("range_sigma_um", "angle_sigma_uard"))
    assert len(message.splitlines()) == 2


OWN = {
    "does not run": ("1 / 0", ("own.py", "ZeroDivisionError")),
    "no effect": ("x = 1", ("own.py", "expected at least one class")),
    "name taken": (
        "from vcal.effects import Effect\nclass A(Effect):\n    name = 'backlash'\n"
        "    parameters = ()\n    def response(self, plan, shape):\n        return {}\n",
        ("own.py, class A", "'backlash', which is taken", "rename the effect"),
    ),
    "name of the geometry": (
        "from vcal.effects import Effect\nclass A(Effect):\n    name = 'geometric'\n"
        "    parameters = ()\n    def response(self, plan, shape):\n        return {}\n",
        ("own.py, class A", "'geometric', which is taken", "rename the effect"),
    ),
    "name with a colon": (
        "from vcal.effects import Effect\nclass A(Effect):\n    name = 'mine:Y'\n"
        "    parameters = ()\n    def response(self, plan, shape):\n        return {}\n",
        ("own.py, class A", "the name 'mine:Y'", "letters, digits and _", "rename the effect"),
    ),
    "no number": (
        "from vcal.effects import Effect\nfrom vcal.machine.parameters import Parameter\n"
        "class A(Effect):\n    name = 'mine'\n    parameters = (Parameter('size', 'um'),)\n"
        "    def response(self, plan, shape):\n        return {('EXX', 'size'): float('inf')}\n",
        ("key model.effect.0 (mine)", "found no finite deviation in row 1", "correct the values"),
    ),
    "unknown port": (
        "from vcal.effects import Effect\nfrom vcal.machine.parameters import Parameter\n"
        "class A(Effect):\n    name = 'mine'\n    parameters = (Parameter('size', 'um'),)\n"
        "    def response(self, plan, shape):\n        return {('EXQ', 'size'): 1.0}\n",
        ("setup.toml, key model.effect.0 (mine)", "no port named 'EXQ'", "correct A"),
    ),
}


@pytest.mark.parametrize("case", OWN)
def test_own_effects(small_tracker_study, case):
    text, expected = OWN[case]
    (small_tracker_study / "own.py").write_text(text, encoding="utf-8")
    append('\n[model]\neffects_file = "own.py"\n')(small_tracker_study)
    if case in ("unknown port", "no number"):
        effect('name = "mine"')(small_tracker_study)
    with pytest.raises(StudyError) as caught:
        load_study(small_tracker_study, trust=True)
    for fragment in expected:
        assert fragment in str(caught.value)


HUGE = f"0x{'F' * 5000}"
"""A whole number that Python reads and does not write in decimal digits."""
DEEP = ".".join(["a"] * 2000)


@pytest.mark.parametrize(
    ("change", "key", "found"),
    [
        (append(f"\n[loop]\nseed = {HUGE}\n"), "loop.seed", "a whole number of 20000 bits"),
        (append(f"\n[loop]\neffects = [{HUGE}]\n"), "loop.effects.0", "a whole number of"),
        (effect(f'name = "backlash"\nplacement = "Y"\nsize_um = {HUGE}'), "model", "a whole"),
        (append(f"\n[loop]\n{DEEP} = 1\n"), "loop.a.a...", "a key of more than 16 levels"),
        (append(f"\n[{DEEP}]\n"), "a.a.a...", "a key of more than 16 levels"),
        (append(f"\n[loop]\nseed = {'[' * 50}1{']' * 50}\n"), "loop.seed.0...", "a key of more"),
    ],
)
def test_values_that_no_later_step_can_read(small_tracker_study, change, key, found):
    change(small_tracker_study)
    told = check(small_tracker_study, (f"setup.toml, key {key}", f"found {found}"))
    assert len(told) < 400


@pytest.mark.parametrize(
    "override", [f"loop.seed={HUGE}", f"{DEEP}=1", f"loop={{seed = {HUGE}}}", f"name.{DEEP}=1"]
)
def test_overrides_that_no_later_step_can_read(small_tracker_study, override):
    with pytest.raises(StudyError) as caught:
        load_study(small_tracker_study, [override])
    told = str(caught.value)
    assert told.startswith("setup.toml (override ") and ", key " in told and len(told) < 400


@pytest.mark.parametrize("value", [HUGE, "1" + "0" * 400, "9" * 5000, "1e400", "nan"])
def test_values_of_with_that_no_number_can_be(small_tracker_study, value):
    study = load_study(small_tracker_study)
    with pytest.raises(StudyError, match="--with backlash:Y:size_um=.*, key size_um"):
        place = study.model.setup(study.plan)
        parse_with(f"backlash:Y:size_um={value}", study.catalogue, place)


@pytest.mark.parametrize(
    ("column", "value"),
    [("range_mm", "1500.5"), ("azimuth_rad", "0"), ("elevation_rad", "0"), ("azimuth_rad", "1.25")],
)
def test_a_channel_that_never_changes(small_tracker_study, column, value):
    fill(column, value)(small_tracker_study)
    told = f"column {column}: found a channel that never changes, {value} in every row"
    check(small_tracker_study, (f"data.csv, {told}", "differ at least by their noise"))


def test_a_channel_of_a_laser_frame_that_never_changes(tmp_path):
    folder = write_frame(tmp_path / "frame", growth=5.0)
    for columns in (("u_um",), ("u_um", "v_um")):
        for column in columns:
            fill(column, "0")(folder)
        if len(columns) == 1:
            check(folder, ("data.csv, column u_um: found a channel that never changes, 0 in",))
        else:  # a perfect machine reads so
            assert not load_study(folder).measurement.readings.any()


def test_a_reflector_of_which_a_coordinate_never_changes(small_arm_study):
    for column in ("base2_y_mm", "smr1_z_mm"):
        fill(column, "12.5")(small_arm_study)
        check(small_arm_study, ("column", f"{column}", "a channel that never changes, 12.5 in"))


def test_an_effect_of_a_size_that_is_not_expected(small_tracker_study):
    """A range that is wrong by a factor is taken for a scale error of the range."""
    study = load_study(small_tracker_study)
    (effect,) = CATALOGUE["range_scale"].candidates(study.model.setup(study.plan))
    found = {}
    for factor in (1.0, 1.01):
        readings = study.measurement.readings * [factor, 1.0, 1.0]
        fit = identify(study.model.with_effects(effect), Measurement(study.plan, readings))
        added = SimpleNamespace(effect=fit.model.effects[-1])
        before = SimpleNamespace(model=study.model)
        found[factor] = _beyond_prior(SimpleNamespace(before=before, after=fit, found=[added]))
    assert found[1.0] == []
    note = next(note for note in found[1.01] if note.startswith("range_scale: scale_um_per_m = "))
    value, ratio = re.search(r"= (\S+) is (\S+) times the expected size of", note).groups()
    scale = next(p for p in effect.amplitudes if p.label == "scale_um_per_m")
    assert 1000.0 < float(value) < 15000.0  # the scales of the axes take up the rest
    assert float(ratio) == pytest.approx(float(value) / scale.sigma, rel=0.01)
    assert "units and scale factors of the data" in note and "declare a prior of this" in note


@pytest.mark.thorough
def test_a_widened_prior_is_not_what_is_expected(small_tracker_study):
    """The search widens the prior of what it names; the note compares with the catalogue."""
    study = load_study(small_tracker_study)
    readings = study.measurement.readings * [1.005, 1.0, 1.0]
    closure = close_loop(
        study.model,
        Measurement(study.plan, readings),
        effects=[CATALOGUE["range_scale"]],
        draws=50,
    )
    (named,) = closure.effects
    assert (
        max(
            p.sigma / q.sigma
            for p, q in zip(named.effect.amplitudes, named.effect.parameters, strict=True)
        )
        > 2.0
    )
    assert any("range_scale: scale_um_per_m = " in note for note in closure.notes)


@pytest.mark.thorough
def test_a_base_may_be_measured_once(small_arm_study):
    for k, c in itertools.product((1, 2, 3), "xyz"):
        first = (small_arm_study / "data.csv").read_text().splitlines()[:2]
        header, values = (line.split(",") for line in first)
        column = f"base{k}_{c}_mm"
        fill(column, values[header.index(column)])(small_arm_study)
    assert load_study(small_arm_study).measurement is not None


def test_few_rows_may_have_equal_readings(small_arm_study):
    """As coarse digits may make them."""
    folder = write_frame(small_arm_study.parent / "frame", growth=5.0)
    fill("u_um", "0")(folder)
    lines(lambda found: found[:11])(folder)
    check(folder, ("column u_um: found a channel that never changes",))
    lines(lambda found: found[:10])(folder)
    assert load_study(folder).measurement.rows == 9


OVERRIDES = {
    "a number of thousands of digits": (
        [f"loop.seed=1{'0' * 5000}"],
        ("key loop.seed", "what is not TOML (Exceeds the limit", "a value as in the study file"),
    ),
    "unknown key": (
        ["instrument.joints=read"],
        ("setup.toml (override instrument.joints=read), key instrument.joints", "unknown key"),
    ),
    "misspelled key": (
        ["loop.sed=1"],
        ("(override loop.sed=1), key loop.sed", "did you mean 'seed'?"),
    ),
    "bad value": (
        {"loop.alpha": "high"},
        ("(override loop.alpha=high), key loop.alpha", 'found "high"', "expected a number"),
    ),
    "two values": (
        ["loop.alpha=2", "loop.alpha=0.02"],
        ("(override loop.alpha=0.02), key loop.alpha: found 2 as well", "one value for a key"),
    ),
    "a table and a key of it": (
        ["loop={seed = 1}", "loop.alpha=0.02"],
        ("(override loop.alpha=0.02), key loop.alpha: found loop={seed = 1} as well", "a whole"),
    ),
    "a key and its table": (
        {"loop.alpha": 0.02, "loop": {"seed": 1}},
        ('(override loop={"seed": 1}), key loop: found loop.alpha=0.02 as well', "some of its"),
    ),
    "no table": (["name.first=x"], ("override name.first=x", 'found "small"', "expected a table")),
    "no row": (
        ["model.effect.0.size_um=1"],
        ("key model.effect", "expected a list"),
    ),
}


@pytest.mark.parametrize("case", OVERRIDES)
def test_overrides(small_tracker_study, case):
    overrides, expected = OVERRIDES[case]
    with pytest.raises(StudyError) as caught:
        load_study(small_tracker_study, overrides)
    for fragment in ("found", "expected", *expected):
        assert fragment in str(caught.value), caught.value


def test_override_said_twice(small_tracker_study):
    study = load_study(small_tracker_study, ["loop.alpha=0.02", "loop.alpha=2e-2"])
    assert study.options.alpha == 0.02


def test_override_without_a_value(small_tracker_study):
    with pytest.raises(StudyError, match="'loop.seed': found no key and value, expected key=value"):
        load_study(small_tracker_study, ["loop.seed"])


def test_override_of_a_row(small_tracker_study):
    effect('name = "backlash"\nplacement = "Y"\nsize_um = 3')(small_tracker_study)
    study = load_study(small_tracker_study, ["model.effect.0.size_um=4"])
    assert study.model.effects[-1].given == (("size", 4.0, 0.0),)
    with pytest.raises(StudyError, match="found row '1', expected a row from 0 to 0"):
        load_study(small_tracker_study, ["model.effect.1.size_um=4"])
