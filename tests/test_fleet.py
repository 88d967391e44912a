"""The loop closed on many studies: none harms another, and none is lost."""

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jsonschema
import pytest

import vcal
from clusters import LEAKS, client_of
from fleet_work import square
from test_cli import refused, run
from vcal import StudyError, load_study
from vcal.fleet import Settings, close_fleet, one_study
from vcal.fleet.index import errors_of, write_index
from vcal.fleet.jobs import jobs_of
from vcal.fleet.one_study import Job, Member, close_one, up_to_date
from vcal.numerics.processes import TRIES, Ended, in_processes

(FILE,) = Path(vcal.__file__).parent.rglob("fleet.schema.json")
SCHEMA = json.loads(FILE.read_text(encoding="utf-8"))
FEW = '\n[loop]\neffects = ["backlash"]\ndraws = 50\n'
INTERRUPTIBLE = (
    "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); "
    "os.execv(sys.argv[1], sys.argv[1:])"
)
"""Starts a command that Ctrl-C ends: in the background of a shell, SIGINT is ignored."""
posix = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr("vcal.report.loop.write.pictures", lambda *args: [])
    monkeypatch.setattr("vcal.report.loop.write.machine_pictures", lambda *args: [])
    monkeypatch.setattr("vcal.report.loop.write.scenes", lambda *args: [])


@pytest.fixture
def study(small_tracker_study):
    with (small_tracker_study / "setup.toml").open("a") as file:
        file.write(FEW)
    return small_tracker_study


@pytest.mark.slow
@posix
def test_a_process_that_ends_is_replaced_and_takes_nothing_with_it(tmp_path):
    numbers = [2, 11, 21, 3]
    found = dict(in_processes(square, [(n, tmp_path) for n in numbers], 2))
    assert found.pop(2) == Ended(-signal.SIGKILL)
    assert found == {i: n**2 for i, n in enumerate(numbers) if n != 21}
    begun = {p.name: len(p.read_text()) for p in tmp_path.iterdir()}
    assert begun == {"2": 1, "11": 2, "21": TRIES, "3": 1}


def test_a_report_has_the_place_of_its_study(tmp_path):
    def names(*setups):
        jobs = jobs_of([tmp_path / one for one in setups], tmp_path / "out", Settings())
        assert all(job.out == tmp_path / "out" / "reports" / job.name for job in jobs)
        return [job.name for job in jobs]

    assert names("a/setup.toml") == ["a"]
    assert names("line 1/m3/setup.toml", "line 2/m3") == ["line 1/m3", "line 2/m3"]
    assert names("a/first.toml", "a/second.toml") == ["first", "second"]
    # A study whose folder holds another one.
    assert names("a", "a/b/setup.toml", "c") == ["a/setup", "a/b", "c"]
    with pytest.raises(StudyError, match=r"arguments, SETUP: found .*a.setup\.toml twice"):
        names("a", "b", "a/setup.toml")


def test_the_command_of_one_report(tmp_path):
    settings = Settings(("loop.alpha=0.05",), trust=True, compensate_anyway=True)
    (job,) = jobs_of([Path("my study")], Path("out"), settings)
    assert job.command == (
        "vcal loop 'my study' --out 'out/reports/my study' --set loop.alpha=0.05 --trust "
        "--compensate-anyway"
    )


@pytest.mark.slow
def test_a_report_is_kept_while_it_is_up_to_date(study, tmp_path, no_pictures):
    job = Job(study, "tracker", tmp_path / "report", "vcal loop ...")
    first = close_one(job, Settings())
    assert first.status == "closed" and first.done and not first.message
    assert first.content["command"] == job.command
    written = (job.out / "report.json").stat().st_mtime_ns
    second = close_one(job, Settings())
    assert second.status == "up to date" and second.content == first.content
    assert (job.out / "report.json").stat().st_mtime_ns == written

    def kept(*overrides, **settings):
        return up_to_date(load_study(study, overrides), job.out, Settings(overrides, **settings))

    assert kept()
    assert not kept("loop.seed=1")
    assert not kept("instrument.range_sigma_um=2")
    content = dict(first.content)
    for key, value in {"interrupted": True, "versions": {"vcal": "0"}, "input_files": {}}.items():
        (job.out / "report.json").write_text(json.dumps(content | {key: value}))
        assert not kept()
    (job.out / "report.json").write_text("{")
    assert not kept()


def test_what_fails_is_told_and_not_raised(study, tmp_path, monkeypatch):
    def ended(setup=study, out=tmp_path / "report"):
        found = close_one(Job(setup, "one", out), Settings())
        assert not found.done and not out.exists()
        return found.status, found.message

    def fails(*args):
        raise RuntimeError("of no one's making")

    status, message = ended(tmp_path / "none")
    assert status == "refused" and "expected a study file in TOML" in message
    monkeypatch.setattr(one_study, "close_study", fails)
    assert ended() == ("failed", "RuntimeError: of no one's making")
    (study / "setup.toml").write_text("chain = ", encoding="utf-8")
    status, message = ended()
    assert status == "refused" and message.startswith("setup.toml, end of document")


def test_what_has_become_of_all_is_told_where_the_page_cannot_be_written(
    study, tmp_path, monkeypatch
):
    written = []

    def write_index(*arguments, **keys):
        if written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "index.html"))
        written.append(arguments)

    def in_processes(work, jobs, workers):
        yield 0, Member(jobs[0], "refused", "data.csv: found 1, expected 2")

    monkeypatch.setenv("VCAL_NO_CACHE", "1")
    monkeypatch.setattr("vcal.fleet.fleet.write_index", write_index)
    monkeypatch.setattr("vcal.fleet.fleet.in_processes", in_processes)
    shown = run("loop", study, "--out", tmp_path / "out", "--again", code=2)
    assert shown.stdout == "0 studies closed, 0 up to date, 1 without a report.\n"
    first, last = shown.stderr.splitlines()
    assert first == f"vcal: {study.name}: data.csv: found 1, expected 2"
    assert last.startswith(f"vcal: {tmp_path / 'index.html'}: No space left on device; make room")


def member(folder, name, status="closed", **content):
    stage = {"check_rms_um": None, "heldout_rms_um": 4.0, "u_heldout_rms_um": 0.1}
    after = stage | {"heldout_rms_um": 1.25, "u_heldout_rms_um": None}
    base = {
        "verdict": "named", "sentence": "One was found.", "interrupted": False, "no_gain": "",
        "effects": [{"effect": "backlash", "placement": "Y", "found": True}],
        "errors": {"uncompensated": stage, "before": stage, "after": after},
    }  # fmt: skip
    done = status in ("closed", "up to date")
    job = Job(folder / name, name, folder / "reports" / name)
    said = "" if done or status == "not begun" else "setup.toml: found 1, expected 2"
    return Member(job, status, said, content=base | content if done else {})


def test_the_page_lists_every_study_with_what_to_do(tmp_path):
    members = [
        member(tmp_path, "m1"),
        member(tmp_path, "m2", "up to date", verdict="unexplained"),
        member(tmp_path, "m3", verdict="ambiguous"),
        member(tmp_path, "m4", no_gain="It gains nothing.", verdict="nothing_missing", effects=[]),
        member(tmp_path, "m5", declared_sizes={"gross": True}),
        member(tmp_path, "m6", interrupted=True, verdict=None),
        *(member(tmp_path, f"n {s}", s) for s in ("refused", "failed", "lost", "not begun")),
    ]
    page = write_index(members, tmp_path, command="vcal loop ...").read_text(encoding="utf-8")
    content = json.loads((tmp_path / "fleet.json").read_text(encoding="utf-8"))
    jsonschema.validate(content, SCHEMA)
    assert content["sentence"] == (
        "6 of 10 studies have a report: 1 failed, 1 lost its process, 1 cannot be used, 1 not "
        "begun."
    )
    assert content["sentence"] in page
    assert content["studies"][0]["errors_um"] == {
        "uncompensated": 4.0,
        "before": 4.0,
        "after": 1.25,
    }
    assert [one["status"] for one in content["studies"]] == [one.status for one in members]
    rows = re.findall(r"<tr>(.*?)</tr>", page, re.S)
    told = {
        m: next(row for row in rows if f">{m}</a>" in row)
        for m in ("m1", "m2", "m3", "m4", "m5", "m6")
    }
    assert '<a href="reports/m1/index.html">m1</a>' in told["m1"] and "backlash Y" in told["m1"]
    advice = {
        "m1": "compensate",
        "m2": "look at the residuals",
        "m3": "decide between the names",
        "m4": "do not compensate",
        "m5": "correct the declaration",
        "m6": "repeat the command",
    }
    assert all(f"<td>{words}" in told[name] for name, words in advice.items())
    assert "setup.toml: found 1, expected 2" in page
    assert re.search('<table class="[a-z ]*sortable">', page)
    # A page that needs no script has none.
    assert page.count("<script>") == 1 == page.count("'sha256-")


def test_the_errors_of_a_report():
    both = {"check_rms_um": 1.0, "u_check_rms_um": 0.1, "heldout_rms_um": 2.0}
    assert errors_of({"errors": {"before": both}}) == ("check points", {"before": (1.0, 0.1)})
    held = both | {"check_rms_um": None}
    assert errors_of({"errors": {"before": held}}) == ("held-out readings", {"before": (2.0, None)})
    assert errors_of({"errors": {"before": both, "after": {}}}) == ("", {})
    assert errors_of({}) == ("", {})


def test_mistakes_of_the_command(tmp_path, study):
    out = tmp_path / "out"
    both = refused("loop", study, "--out", out, "--workers", 2, "--scheduler", "tcp://here:1")
    assert "found both, expected one of them" in both
    twice = refused("loop", study, study / "setup.toml", "--out", out)
    assert "twice, expected every study once" in twice
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    assert "other files" in refused("loop", study, tmp_path, "--out", tmp_path / "other")
    assert not out.exists()
    with pytest.raises(StudyError, match="at least one study"):
        close_fleet([], out)


def test_a_cluster_that_is_not_there(study, tmp_path, monkeypatch):
    pytest.importorskip("distributed")

    def silent(address, timeout):
        raise OSError(f"timed out after {timeout:g} s")

    monkeypatch.setattr("distributed.Client", silent)
    out = tmp_path / "out"
    for command in (("loop", study), ("uncertainty", study)):
        said = refused(*command, "--out", out, "--scheduler", "tcp://there:8786")
        assert "option --scheduler: found 'tcp://there:8786'" in said
        assert "start one with dask scheduler" in said and not out.exists()
    monkeypatch.setitem(sys.modules, "distributed", None)
    said = refused("uncertainty", study, "--out", out, "--workers", 2)
    assert "option, --workers: found no package distributed" in said
    assert "pip install 'vcal[cluster]'" in said


def test_a_report_that_was_written_before_an_interruption_counts(tmp_path, monkeypatch):
    """Its process had no time to tell of it."""
    jobs = jobs_of([tmp_path / "a", tmp_path / "b"], tmp_path / "out", Settings())
    earlier, new = (member(tmp_path, name, seconds=2.5) for name in "ab")

    def written(one, job):
        job.out.mkdir(parents=True)
        (job.out / "report.json").write_text(json.dumps(one.content), encoding="utf-8")

    def interrupted(work, jobs, workers):
        written(new, jobs[1])
        raise KeyboardInterrupt
        yield

    written(earlier, jobs[0])
    monkeypatch.setattr("vcal.fleet.fleet.in_processes", interrupted)
    found = close_fleet([job.setup for job in jobs], tmp_path / "out")
    assert found.interrupted and [one.status for one in found.members] == ["not begun", "closed"]
    assert found.members[1].content == new.content and found.members[1].seconds == 2.5


@pytest.mark.thorough
@posix
def test_killed_broken_and_interrupted_studies_lose_nothing(study, tmp_path, programs):
    """One of four processes' worth of mistakes each, and a restart."""
    for name in "abcd":
        shutil.copytree(study, tmp_path / "studies" / name)
    (tmp_path / "studies" / "b" / "data.csv").unlink()
    studies = sorted((tmp_path / "studies").iterdir())
    out = tmp_path / "out"
    command = [sys.executable, "-c", INTERRUPTIBLE, sys.executable, "-m", "vcal", "loop", *studies,
               "--out", out, "--workers", "1"]  # fmt: skip
    begun = subprocess.Popen(
        [*map(str, command)], env=os.environ | programs, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        _until(lambda: (out / "reports" / "a" / "report.json").exists())
        # Ctrl-C in a terminal reaches the command and its processes.
        os.killpg(begun.pid, signal.SIGINT)
        assert begun.wait(60) == 130
    finally:
        if begun.poll() is None:
            os.killpg(begun.pid, signal.SIGKILL)
    content = json.loads((out / "fleet.json").read_text(encoding="utf-8"))
    assert content["interrupted"] and content["studies"][0]["status"] == "closed"
    assert "not begun" in {one["status"] for one in content["studies"]}
    first = (out / "reports" / "a" / "report.json").read_bytes()
    said = run("loop", *studies, "--out", out, "--workers", "2", code=2)
    assert said.stdout.startswith("2 studies closed, 1 up to date, 1 without a report.")
    assert "b: " in said.stderr and "data.csv" in said.stderr
    assert (out / "reports" / "a" / "report.json").read_bytes() == first
    # The studies are alike, and so are the reports, whichever process made them.
    alike = [_numbers(out / "reports" / name / "report.json") for name in "acd"]
    assert alike[0] == alike[1] == alike[2]


def _until(happened, seconds=300.0):
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


def _numbers(path):
    content = json.loads(path.read_text(encoding="utf-8"))
    return {k: v for k, v in content.items() if k not in ("seconds", "command", "sha256")}


@LEAKS
@pytest.mark.thorough
def test_a_cluster_makes_the_same_reports(study, tmp_path):
    shutil.copytree(study, tmp_path / "other")
    (tmp_path / "other" / "data.csv").write_text("x_mm\n1\n")
    studies = [study, tmp_path / "other"]
    alone = close_fleet(studies, tmp_path / "alone")
    with client_of(1) as client:
        found = close_fleet(studies, tmp_path / "cluster", client=client)
    assert [one.status for one in found.members] == ["closed", "refused"]
    assert [one.message for one in found.members] == [one.message for one in alone.members]
    same = [_numbers(one.job.out / "report.json") for one in (alone.members[0], found.members[0])]
    assert same[0] == same[1]
