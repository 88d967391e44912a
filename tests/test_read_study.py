"""Studies whose tables come from other programs: mappings, sheets, and numbers that cannot be."""

import json
import time

import numpy as np
import pytest

from conftest import write_csv
from table_files import rows_of, text, tracker, xlsx
from vcal.cli.show import show_study
from vcal.errors import StudyError
from vcal.instruments.base import Column
from vcal.loop.residuals.implausible import implausible
from vcal.report.html.provenance import provenance_record, provenance_section
from vcal.study import load_study, read_table
from vcal.study.simulated import write_simulated

INCH = 25.4
KEYS = """
[data]
file = "run.xlsx"
sheet = "points"
check = "run.xlsx#check"
[data.columns]
x_mm = { from = "X pos", unit = "inch", sign = -1, offset = 2000 }
t_s = { from = "Time", format = "%d.%m.%Y %H:%M:%S" }
[tables."run.xlsx#check"]
columns = { x_mm = { from = "X pos", unit = "cm" } }
"""


def numbers(folder, file="data.csv"):
    table = read_table(folder / file, [])
    return {name: np.array(values) for name, values in table.items()}


def sheet(columns, units=()):
    rows = list(zip(*(list(c) for c in columns.values()), strict=True))
    return [list(columns), *([list(units)] if units else []), *rows]


@pytest.fixture
def exported(small_tracker_study):
    """The small tracker study with data and check points in one spreadsheet; and its true data."""
    pytest.importorskip("python_calamine", reason="needs python_calamine, of the extra tables")
    folder = small_tracker_study
    data, check = numbers(folder), numbers(folder, "check.csv")
    clock = np.datetime64("2025-03-01T08:00:00") + data["t_s"].astype("timedelta64[s]")
    made = {("X pos" if name == "x_mm" else name): values for name, values in data.items()}
    made["X pos"] = (2000.0 - data["x_mm"]) / INCH
    made = {("Time" if name == "t_s" else name): values for name, values in made.items()}
    made["Time"] = [t.item().strftime("%d.%m.%Y %H:%M:%S") for t in clock]
    points = {("X pos" if name == "x_mm" else name): values for name, values in check.items()}
    points["X pos"] = check["x_mm"] / 10.0
    xlsx(folder / "run.xlsx", {"points": sheet(made), "check": sheet(points), "more": [["a"]]})
    plain = load_study(folder)
    for name in ("data.csv", "check.csv"):
        (folder / name).unlink()
    with open(folder / "setup.toml", "a", encoding="utf-8") as file:
        file.write(KEYS)
    return folder, plain


def test_a_spreadsheet_with_a_mapping_is_the_same_study(exported):
    folder, plain = exported
    study = load_study(folder)
    np.testing.assert_allclose(study.measurement.readings, plain.measurement.readings, rtol=1e-12)
    np.testing.assert_allclose(study.plan.position, plain.plan.position, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(study.plan.covariate("t"), plain.plan.covariate("t"))
    np.testing.assert_allclose(study.check.plan.position, plain.check.plan.position, rtol=1e-12)
    assert set(study.hashes) == {"setup.toml", "errors.csv", "run.xlsx"}


def test_the_mapping_is_shown_and_recorded(exported, capsys):
    study = load_study(exported[0])
    show_study(study)
    shown = " ".join(capsys.readouterr().out.split())
    assert "run.xlsx: spreadsheet, sheet 'points'" in shown
    assert "x_mm from 'X pos', inch to mm, sign -1, offset +2000" in shown
    assert "x_mm from 'X pos', cm to mm" in shown
    assert "0 is 2025-03-01T08:00:00" in shown
    record = json.loads(json.dumps(provenance_record(study, {}, "", 0.0)["tables_read"]))
    (data,) = (one for one in record if one["table"] == "run.xlsx")
    (x,) = (one for one in data["columns"] if one["column"] == "x_mm")
    assert x == {
        "column": "x_mm",
        "from": "X pos",
        "unit": "inch",
        "sign": -1,
        "offset": 2000.0,
        "format": None,
        "zero": None,
    }
    tables = provenance_section(study, {}, {}, "", 0.0).tables
    assert any("inch to mm" in cell for table in tables for row in table.rows for cell in row)


@pytest.mark.thorough
def test_a_simulated_copy_is_in_plain_columns(exported, tmp_path):
    study = load_study(exported[0])
    write_simulated(study, tmp_path / "made", seed=3)
    again = load_study(tmp_path / "made")
    assert again.files == {"": "run.csv"} and again.check_file == "run_check.csv"
    np.testing.assert_allclose(again.plan.position, study.plan.position, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again.plan.covariate("t"), study.plan.covariate("t"))


def test_a_family_table_from_a_spreadsheet(small_tracker_study):
    pytest.importorskip("python_calamine", reason="needs python_calamine, of the extra tables")
    plain = load_study(small_tracker_study)
    rows = [
        line.split(",")
        for line in (small_tracker_study / "errors.csv").read_text(encoding="utf-8").splitlines()
    ]
    cells = [rows[0], *([row[0], *map(float, row[1:])] for row in rows[1:])]
    xlsx(small_tracker_study / "errors.xlsx", {"S": cells})
    study = load_study(small_tracker_study, ["model.geometric.table=errors.xlsx"])
    assert [e.key for e in study.model.entries] == [e.key for e in plain.model.entries]


def test_check_points_are_read_by_what_they_look_like(small_tracker_study):
    plain = load_study(small_tracker_study)
    check = numbers(small_tracker_study, "check.csv")
    made = {name.replace("tcp_x_mm", "tcp_x_in"): values for name, values in check.items()}
    made["tcp_x_in"] = check["tcp_x_mm"] / INCH
    path = small_tracker_study / "check.csv"
    path.write_bytes(text(made, ";", decimal=",").encode("utf-16"))
    study = load_study(small_tracker_study)
    np.testing.assert_allclose(study.check.tool_point, plain.check.tool_point, rtol=1e-12)


def test_a_declared_table_that_is_not_read(small_tracker_study):
    with open(small_tracker_study / "setup.toml", "a", encoding="utf-8") as file:
        file.write('\n[tables."chekc.csv"]\ndecimal = ","\n')
    with pytest.raises(StudyError, match="does not read.*did you mean 'check.csv'"):
        load_study(small_tracker_study)


def test_times_with_a_date_share_one_clock(small_tracker_study):
    """Check points that were measured an hour later are an hour later."""
    data, check = numbers(small_tracker_study), numbers(small_tracker_study, "check.csv")
    start = np.datetime64("2025-03-01T08:00:00")
    for table, later, file in ((data, 0, "data.csv"), (check, 3600, "check.csv")):
        times = start + (table["t_s"] + later).astype("timedelta64[s]")
        write_csv(small_tracker_study / file, {**table, "t_s": [str(t) for t in times]})
    study = load_study(small_tracker_study)
    np.testing.assert_allclose(study.plan.covariate("t"), data["t_s"])
    np.testing.assert_allclose(study.check.plan.covariate("t"), check["t_s"] + 3600.0)


# --- numbers that cannot be ----------------------------------------------------------------------


def changed(folder, **columns):
    write_csv(folder / "data.csv", {**numbers(folder), **columns})
    return folder


def said(study) -> list[str]:
    readings = None if study.measurement is None else study.measurement.readings
    return implausible(study.chain, study.plan, study.instrument, readings)


def test_nothing_is_said_of_a_plausible_study(small_tracker_study):
    assert said(load_study(small_tracker_study)) == []


def test_all_temperatures_in_fahrenheit_are_refused(small_tracker_study):
    data = numbers(small_tracker_study)
    hot = {name: v * 1.8 + 32.0 for name, v in data.items() if name.startswith("T_")}
    with pytest.raises(StudyError) as caught:
        load_study(changed(small_tracker_study, **hot))
    message = str(caught.value)
    for part in ("between 68 and 68.9 degC", "20 to 20.5 degC", "T_x_degF", 'unit = "degC"'):
        assert part in message
    with open(small_tracker_study / "setup.toml", "a", encoding="utf-8") as file:
        file.write("\n[data.columns]\n")
        file.writelines(f'{name} = {{ from = "{name}", unit = "degF" }}\n' for name in hot)
    study = load_study(small_tracker_study)
    np.testing.assert_allclose(study.plan.covariate("T_X"), data["T_x_degC"], rtol=1e-9)


def test_one_hot_column_is_said(small_tracker_study):
    (one,) = said(load_study(changed(small_tracker_study, T_head_degC=np.linspace(66.0, 71.0, 48))))
    assert one.startswith("T_head_degC goes from 66 to 71 degC") and "in degF they would be" in one


def test_cold_is_said_without_fahrenheit(small_tracker_study):
    (one,) = said(load_study(changed(small_tracker_study, T_x_degC=np.linspace(-30, -25.0, 48))))
    assert "beyond -20 to 60 degC" in one and "degF" not in one


@pytest.mark.parametrize(("factor", "unit"), [(60.0, "min"), (3600.0, "h"), (86400.0, "days")])
def test_times_in_a_longer_unit_are_said(small_tracker_study, factor, unit):
    data = numbers(small_tracker_study)
    (one,) = said(load_study(changed(small_tracker_study, t_s=data["t_s"] / factor / 10.0)))
    assert "implies that the axes move at" in one and unit in one.partition("if they are in ")[2]
    assert "data.columns" in one


def test_times_in_milliseconds_are_said(small_tracker_study):
    data = numbers(small_tracker_study)
    (one,) = said(load_study(changed(small_tracker_study, t_s=data["t_s"] * 1e5)))
    assert "days from row to row; if they are in ms" in one


def test_little_travel_is_said(small_tracker_study):
    (one,) = said(load_study(small_tracker_study, ["machine.travel_mm.X=[0, 40000]"]))
    assert "cover only 4.5 % of X" in one and "inches" in one


def test_a_direction_that_never_changes_is_said(small_tracker_study):
    (one,) = said(load_study(changed(small_tracker_study, dir_z=np.ones(48))))
    assert one.startswith("the direction dir_z never changes") and "both ways" in one


def test_noise_of_an_atom_is_said(small_tracker_study):
    keys = ["instrument.range_sigma_um=0.0013", "instrument.range_sigma_um_per_m=0.0002"]
    (one,) = said(load_study(small_tracker_study, keys))
    assert "declared noise of range is" in one and "*_sigma" in one


def test_check_and_loop_say_the_same(small_tracker_study, capsys):
    from vcal.loop.notes import _NOTES, _implausible

    assert _implausible in _NOTES
    show_study(load_study(changed(small_tracker_study, dir_z=np.ones(48))))
    shown = " ".join(capsys.readouterr().out.split())
    assert "implausible the direction dir_z never changes" in shown


# --- large tables --------------------------------------------------------------------------------

LARGE = [Column(name=name) for name in tracker(2) if name not in ("point", "dir_x")]


def large(rows: int) -> dict[str, np.ndarray]:
    return {name: np.round(values, 6) for name, values in tracker(rows).items()}


def write_large(path, columns, mark=",", decimal="."):
    lines = [mark.join(columns)]
    cells = [[repr(value) for value in column.tolist()] for column in columns.values()]
    lines += [mark.join(row) for row in zip(*cells, strict=True)]
    content = "\n".join(lines) + "\n"
    path.write_text(content if decimal == "." else content.replace(".", decimal), encoding="utf-8")


@pytest.mark.parametrize(("mark", "decimal"), [(",", "."), (";", ","), ("\t", ".")])
def test_the_fast_path_reads_the_same(tmp_path, mark, decimal):
    """Above a million characters; with a column of text, and with a cell that is no number."""
    columns = large(12_000)
    write_large(tmp_path / "data.csv", columns, mark, decimal)
    path = tmp_path / "data.csv"
    content = path.read_text(encoding="utf-8")
    assert len(content) > 1_000_000
    table = read_table(path, LARGE)
    for name, values in columns.items():
        np.testing.assert_array_equal(table[name], values)
    assert table.lines[0] == 2 and table.lines[-1] == 12_001
    noted = content.replace("\n", f"{mark}ok\n").replace(f"{mark}ok\n", f"{mark}note\n", 1)
    path.write_text("# made\n" + noted, encoding="utf-8")
    table = read_table(path, LARGE, labels=["note"])
    np.testing.assert_array_equal(table["range_mm"], columns["range_mm"])
    assert set(table["note"]) == {"ok"} and table.lines[0] == 3
    lines = content.splitlines()
    lines[8000] = lines[8000].replace(lines[8000].split(mark)[1], "lost")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(StudyError, match=r"row 8000 \(line 8001\), column x_mm: found 'lost'"):
        read_table(path, LARGE)


@pytest.mark.thorough
def test_a_million_rows_take_seconds(tmp_path):
    """Four seconds of processor time where nothing else runs; on a busy computer all takes longer,
    so that the limit is a multiple of what numpy takes for the bare numbers.
    """
    path = tmp_path / "data.csv"
    write_large(path, large(1_000_000))
    start = time.process_time()
    assert read_table(path, LARGE).rows == 1_000_000
    ours = time.process_time() - start
    np.loadtxt(path, delimiter=",", skiprows=1)
    assert ours <= 3.5 * (time.process_time() - start - ours)


@pytest.mark.thorough
def test_a_spreadsheet_of_a_hundred_thousand_rows_takes_seconds(tmp_path):
    pytest.importorskip("python_calamine", reason="needs python_calamine, of the extra tables")
    xlsx(tmp_path / "data.xlsx", {"S": sheet(large(100_000))})
    start = time.process_time()
    assert read_table(tmp_path / "data.xlsx", LARGE).rows == 100_000
    assert time.process_time() - start <= 15.0


def test_rows_are_those_of_the_writer():
    """The writer of the tests prints every digit."""
    rows = rows_of({"a": [0.1, 1234567.25], "b": [-2.0, 1e-3]}, thousands=" ")
    assert rows == [["a", "b"], ["0.1", "-2"], ["1 234 567.25", "0.001"]]
