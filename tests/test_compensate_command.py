"""`vcal compensate` and `vcal verify` as a user runs them, from a report and from a study."""

import copy
import json
import math
import re
from dataclasses import replace

import jax
import numpy as np
import pytest

import vcal
from test_cli import DEMO, refused, run
from vcal import StudyError
from vcal.compensation import FORMATS, Range
from vcal.compensation.base import conditions_inside
from vcal.compensation.nc import correct_program
from vcal.compensation.nc_displacement import nc_displacement
from vcal.compensation.stored import machine_from, machine_record
from vcal.model.simulate import simulate
from vcal.numerics.stored import Reader, Writer
from vcal.report.compensation.write import RECORD
from vcal.study.identified_machine import FILE, load_machine


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("VCAL_NO_CACHE", "1")


@pytest.fixture(scope="module")
def record():
    """What the report of a machine with backlash in Y holds of it."""
    study = vcal.load_study(DEMO / "setup.toml")
    setup = study.model.setup(study.plan)
    effect = next(e for e in vcal.CATALOGUE["backlash"].candidates(setup) if e.placement == "Y")
    true = simulate(study.model, study.plan, jax.random.key(4), effects=(effect,))
    fit = vcal.identify(true.model, true.measurement)
    return machine_record(vcal.IdentifiedMachine.of_fit(fit, name="mine", date="2026-01-31"))


@pytest.fixture
def report(record, tmp_path):
    folder = tmp_path / "report"
    folder.mkdir()
    (folder / FILE).write_text(json.dumps(record), encoding="utf-8")
    return folder


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_certificate_is_no_compensation(report, tmp_path):
    message = refused("compensate", report, "--to", "dcc", "--out", tmp_path / "c")
    assert "write a digital calibration certificate with vcal certificate" in message


def test_files_are_written_and_what_stays_is_said(report, tmp_path):
    out = tmp_path / "control"
    said = run(
        "compensate", report, "--to", "linuxcnc-screw", "--option", "points=5", "--out", out
    ).stdout
    record = json.loads((out / RECORD).read_text(encoding="utf-8"))
    assert {p.name for p in out.iterdir()} == set(record["files"])
    assert {"x.comp", "y.comp", "z.comp", "screw.ini"} < set(record["files"])
    assert len((out / "x.comp").read_text().splitlines()) == 5
    lines = said.splitlines()
    for key, words in (("carried", "carried:"), ("not_carried", "not carried:")):
        names = [one["name"] for one in record[key]]
        assert names
        for name in names:
            assert any(line.startswith(words) and f"{name}" in line for line in lines)
    assert "not identified: ECZ: the readings know nothing of it; zero in the files" in lines
    assert record["options"]["points"] == 5 and "--to linuxcnc-screw" in record["command"]

    # Again into the same folder, in another format: the earlier files are replaced.
    run("compensate", report / FILE, "--to", "csv", "--option", "points=3", "--out", out)
    assert {p.name for p in out.iterdir()} == {"corrections.csv", RECORD}


def test_nothing_is_half_written(report, tmp_path, monkeypatch):
    out = tmp_path / "control"

    def broken(self):
        raise vcal.StudyError("the disc is full of sand")

    monkeypatch.setattr("vcal.compensation.formats.grid_csv.CsvTables._text", broken)
    arguments = "compensate", report, "--to", "csv", "--option", "points=3", "--out", out
    assert "sand" in refused(*arguments)
    assert not out.exists()


def test_verify_has_a_line_for_every_format(report):
    said = run("verify", report, "--draws", 20).stdout
    lines = [line for line in said.splitlines() if line]
    first = [line.split()[0] for line in lines]
    assert first.index("without") < min(first.index(name) for name in FORMATS if name in first)
    assert {"csv", "linuxcnc", "linuxcnc-screw"} <= {*first}
    rms = {line.split()[0]: float(line.split()[1]) for line in lines[1:-1]}
    assert rms["csv"] < rms["linuxcnc-screw"] < rms["without"]


def test_list_names_options_and_sources():
    said = run("compensate", "--list").stdout
    for name, kind in FORMATS.items():
        assert f"{name}: {kind.summary}" in said and kind.source in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--to", "csv"), "--out: found none, expected one"),
        (("--out", "x"), "--to: found none"),
        (("--to", "cvs", "--out", "x"), "unknown compensation format 'cvs' (did you mean 'csv'?)"),
        (("--to", "csv", "--out", "x", "--option", "points"), "found 'points', expected KEY=VALUE"),
        (("--to", "csv", "--out", "x", "--at", "T_Y=warm"), "found T_Y='warm', expected a number"),
        (("--to", "csv", "--out", "x", "--set", "a=1"), "found an override of a study"),
        (("--to", "csv", "--out", "x", "--option", "points=1"), "option points: found '1'"),
        (("--to", "csv", "--out", "x", "--at", "T_Y=20"), "option at: found 'T_Y'"),
    ],
)
def test_mistakes(report, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert said in refused("compensate", report, *arguments)
    assert not (tmp_path / "x").exists()


def test_other_files_in_the_folder_are_safe(report, tmp_path):
    out = tmp_path / "control"
    out.mkdir()
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    assert "other files (notes.txt" in refused("compensate", report, "--to", "csv", "--out", out)
    assert "the folder that is read" in refused(
        "compensate", report, "--to", "csv", "--out", report
    )
    assert contents(out) == {"notes.txt": b"mine"}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: {**r, "schema": "vcal-machine/7"}, 'key schema: found "vcal-machine/7"'),
        (lambda r: {**r, "schema": "vcal-report/1"}, 'found "vcal-report/1"'),
        (lambda r: [], "found no table"),
        (lambda r: {**r, "no_gain": "It makes things worse."}, "It makes things worse."),
    ],
)
def test_reports_that_cannot_be_used(report, tmp_path, change, said):
    record = json.loads((report / FILE).read_text(encoding="utf-8"))
    (report / FILE).write_text(json.dumps(change(record)), encoding="utf-8")
    message = refused("compensate", report, "--to", "csv", "--out", tmp_path / "x")
    assert said in message and message.count("\n") == 1


def test_the_page_of_a_report_names_its_machine(report):
    by_page, by_folder = load_machine(report / "index.html"), load_machine(report)
    assert np.array_equal(by_page.theta, by_folder.theta)


def test_a_page_is_no_study(tmp_path):
    page = tmp_path / "page.html"
    page.write_text("<!DOCTYPE html>", encoding="utf-8")
    message = refused("verify", page)
    assert "what is not TOML" in message and "name a study file (setup.toml)" in message


def test_a_folder_without_a_machine(tmp_path):
    (tmp_path / "report.json").write_text('{"schema": "vcal-report/1"}', encoding="utf-8")
    for source in (tmp_path, tmp_path / "report.json"):
        message = refused("compensate", source, "--to", "csv", "--out", tmp_path / "x")
        assert f"found no {FILE}, expected {FILE} of a report written by vcal loop" in message


def test_an_effect_of_the_user_is_refused_by_name(report, tmp_path):
    record = json.loads((report / FILE).read_text(encoding="utf-8"))
    one = record["objects"]["effects"][-1]
    one |= {"key": "sag Z", "object": None, "because": "Sag, a class outside vcal"}
    (report / FILE).write_text(json.dumps(record), encoding="utf-8")
    message = refused("verify", report)
    assert "found the effect 'sag Z', which is one of the user's own" in message


def test_stored_values():
    """Every kind of value comes back to the last bit, and what is equal is written once."""
    import numpy as np

    value = {
        "number": float("nan"),
        "far": float("inf"),
        "array": np.array([[1.0, 1e-300], [np.pi, -0.0]]),
        "same": np.array([[1.0, 1e-300], [np.pi, -0.0]]),
        "whole": np.arange(3),
        "list": [1, (2, "x"), None, True],
        "set": frozenset({"a", "b"}),
    }
    writer = Writer()
    plain = json.loads(json.dumps(writer.plain(value), allow_nan=False))
    assert len(writer.arrays) == 2
    found = Reader(writer.records, writer.arrays).value(plain)
    assert np.isnan(found.pop("number")) and np.isnan(value.pop("number"))
    for name in ("array", "same", "whole"):
        ours, theirs = found.pop(name), value.pop(name)
        assert ours.dtype == theirs.dtype and (ours == theirs).all()
    assert found == value


@pytest.mark.slow
def test_a_study_and_its_report_give_the_same_files(tmp_path):
    setup = DEMO / "setup.toml"
    quick = ("--set", "loop.draws=100", "--set", 'loop.effects=["thermal_tilt"]')
    run("loop", setup, "--out", tmp_path / "report", *quick)
    wanted = "--to", "csv", "--option", "points=3"
    run("compensate", tmp_path / "report", *wanted, "--out", tmp_path / "a")
    run("compensate", setup, *quick, *wanted, "--out", tmp_path / "b")
    one, other = (contents(tmp_path / name)["corrections.csv"].decode() for name in "ab")
    undated = [[r for r in t.splitlines() if "# date" not in r] for t in (one, other)]
    assert undated[0] == undated[1] and "thermal_tilt" not in one


PROGRAM = """%
(a pocket)
G21 G90 G17 G94
G54
G1 X100 Y50 Z-20 F500
X300.
Y250
M30
%
"""


def test_a_program_is_corrected(report, record, tmp_path):
    """The tool of the identified machine is where the program wants it, at the end of every block
    that it drives, with the backlash of the direction from which it comes.
    """
    program, out = tmp_path / "part.ngc", tmp_path / "corrected.ngc"
    program.write_text(PROGRAM)
    offset = ("--work-offset", "G54=50,40,-100")
    said = run("compensate", report, "--nc", program, "--out", out, "--tolerance", "1", *offset)
    assert f"Wrote {out}." in said.stdout
    machine = load_machine(report)
    ends, at = [], [np.nan] * 3
    for line in out.read_text().splitlines():
        words = dict(re.findall(r"([XYZ])(-?[\d.]+)", line.partition("(")[0]))
        at = [float(words.get(axis, old)) for axis, old in zip("XYZ", at, strict=True)]
        ends += [at] if words else []
    zero = np.array([50.0, 40.0, -100.0])
    commands = 1e-3 * (np.array(ends) + zero)
    # The first move has no direction that is known; the last one comes in +X, +Y.
    moved = machine.displacement(machine.plan(commands[-1:], np.array([[1.0, 1.0, 0.0]])))
    reached = 1e3 * (commands[-1] + moved[0]) - zero
    assert np.abs(reached - [300.0, 250.0, -20.0]).max() < 2e-4
    assert np.abs(np.array(ends)[-1] - [300.0, 250.0, -20.0]).max() > 5e-4


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--to", "csv"), "found it together with --to, expected one of them"),
        (("--work-offset", "G54=1,b"), "expected NAME=X,Y,Z in mm"),
        (("--tolerance", "0"), "found 0.0, expected a number above zero"),
    ],
)
def test_a_program_that_is_asked_for_wrongly(options, said, report, tmp_path):
    program = tmp_path / "part.ngc"
    program.write_text(PROGRAM)
    out = tmp_path / "corrected.ngc"
    assert said in refused("compensate", report, "--nc", program, "--out", out, *options)
    assert not out.exists()


def test_options_of_a_program_without_one(report, tmp_path):
    said = refused("compensate", report, "--to", "csv", "--out", tmp_path / "c", "--tolerance", 1)
    assert "--tolerance: found it without --nc, expected an NC program" in said


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: r["working_volume"].pop(), "no two ends for each of 3 axes"),
        (lambda r: r["shapes"].pop(), "shapes of"),
        (
            lambda r: r["conditions"].update(T_Y={"low": 1, "mean": math.inf, "high": 2}),
            "no finite",
        ),
    ],
)
def test_a_record_whose_parts_do_not_belong_together_is_refused(record, report, change, said):
    broken = copy.deepcopy(record)
    change(broken)
    (report / FILE).write_text(json.dumps(broken), encoding="utf-8")
    message = refused("compensate", report, "--to", "csv", "--out", report.parent / "out")
    assert said in " ".join(message.split()) and not (report.parent / "out").exists()


def test_conditions_have_values_near_the_measured_ones(record):
    machine = machine_from(record)
    ranges = {"T_Y": Range(20.0, 22.0, 24.0), "load": Range(0.0, 1.0, 2.0)}
    machine = replace(machine, ranges=ranges, temperature_offset_K=0.5)
    assert conditions_inside(machine, {"T_Y": 23.0, "load": 500.0}) == {"T_Y": 22.5, "load": 500.0}
    for name, value in (("T_Y", math.nan), ("T_Y", 75.0), ("load", math.inf), ("T_Q", 20.0)):
        with pytest.raises(StudyError, match=f"option at: found '?{name}"):
            conditions_inside(machine, {name: value})
    program = b"G21 G90\nG0 X1. Y2. Z3.\nG1 X100. F500\n"
    with pytest.raises(StudyError, match="option at"):
        correct_program(program, nc_displacement(machine, {"T_Q": 20.0}))
