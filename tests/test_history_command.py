"""`vcal history` as a user runs it, on small reports that were made by hand."""

import json
from pathlib import Path

import jsonschema
import pytest

import vcal
from histories import DATES, records, write_report, write_reports
from test_cli import refused, run

(FILE,) = Path(vcal.__file__).parent.rglob("history.schema.json")
SCHEMA = json.loads(FILE.read_text(encoding="utf-8"))
SQUARENESS = "EC(0X)Y: squareness of Y to X"


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr("vcal.report.history.write.pictures", lambda history: [])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("machine")
    write_reports(folder / "reports")
    said = run("history", folder / "reports", "--out", folder / "history").stdout
    return folder, said


def test_the_answer_is_printed_and_written(written):
    folder, said = written
    out = folder / "history"
    content = json.loads((out / "history.json").read_text(encoding="utf-8"))
    jsonschema.validate(content, SCHEMA)
    assert {p.name for p in out.iterdir()} == set(content["files"])
    first, *rest = said.splitlines()
    assert first == content["sentence"]
    assert first == (
        f"1 of 8 series of 5 reports from {DATES[0]} to {DATES[-1]} has changed significantly: "
        f"{SQUARENESS}. backlash Y appeared."
    )
    step, appeared, last = rest
    assert step.startswith(f"  {SQUARENESS}: step of ")
    assert f"µrad between {DATES[2]} and {DATES[3]}, p = " in step
    assert appeared.endswith("while the other report would have named it from 1.50 µm on")
    assert last == f"Report: {out / 'index.html'}"
    assert [line.strip() for line in (step, appeared)] == content["changes"]
    (series,) = (one for one in content["series"] if one["name"] == SQUARENESS)
    ((change,),) = (one["changes"] for one in content["series"] if one["changes"])
    assert change in series["changes"] and change["kind"] == "step"
    assert content["command"].startswith("vcal history") and content["alpha"] == 0.05


def test_the_page_shows_every_series_with_its_changes(written):
    out = written[0] / "history"
    content = json.loads((out / "history.json").read_text(encoding="utf-8"))
    page = (out / "index.html").read_text(encoding="utf-8")
    for one in content["series"]:
        assert one["name"] in page
    for text in (content["sentence"], *DATES, "serial number A 17", "Effective number of tests"):
        assert text in page
    assert "not named; would have been from size 1.50 µm on" in page
    groups = {one["group"].replace(" ", "_") for one in content["series"]}
    assert {p.stem for p in out.glob("*.png")} == {f"history_{group}" for group in groups}
    assert page.count("<img") >= len(groups)


def test_a_later_history_replaces_an_earlier_one_and_nothing_else(written, no_pictures):
    folder, _ = written
    reports = folder / "reports"
    again = run("history", reports, "--out", folder / "history", "--alpha", "0.01", "--seed", 3)
    assert again.stdout.startswith("1 of 8 series")
    assert "the folder that is read" in refused("history", reports, "--out", reports)
    report = reports / "measurement 1"
    assert "other files" in refused("history", reports, "--out", report)


def test_reports_without_a_date(tmp_path, no_pictures):
    for i, name in enumerate("ab"):
        write_report(tmp_path / "reports" / name, *records(i))
    arguments = ("history", tmp_path / "reports", "--out", tmp_path / "out")
    told = refused(*arguments)
    assert told.startswith("vcal: a, b, date of the measurement: found none, expected one")
    assert told.count("\n") == 1 and not (tmp_path / "out").exists()
    table = tmp_path / "dates.csv"
    table.write_text("folder,date\na,2025-01-01\nb,2025-06-01\n", encoding="utf-8")
    assert "from 2025-01-01 to 2025-06-01" in run(*arguments, "--dates", table).stdout
    # Both were written on the same day, so that they cannot be told apart in time.
    said = run(*arguments, "--date-written").stdout
    assert said.startswith("No result of the 2 reports from 2026-11-30 to 2026-11-30")


def test_folders_without_reports(tmp_path):
    out = ("--out", tmp_path / "out")
    assert "found none, expected a folder" in refused("history", tmp_path / "nowhere", *out)
    assert "found no report.json in it or below it" in refused("history", tmp_path, *out)


def test_the_schema_describes_every_key():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)

    def described(part, path):
        for key, one in part.get("properties", {}).items():
            assert one.get("description"), f"{path}.{key}"
            for inner in (one, one.get("items", {}), *one.get("anyOf", [])):
                described(inner, f"{path}.{key}")

    described(SCHEMA, "")
    described(SCHEMA["$defs"]["size"], "size")
