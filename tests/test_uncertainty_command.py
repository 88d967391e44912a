"""`vcal uncertainty`: what a plan will give, the report, interruption, mistakes."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import vcal
from vcal.cli import app
from vcal.cli.uncertainty import parse_draws
from vcal.model.forward import port_values, tool_points
from vcal.model.simulate import conditions_at
from vcal.report import Badge, Picture, Section, Table, Tile, sheet
from vcal.report.html.folder import ReportFolder
from vcal.report.uncertainty.page import _badge, _volumetric
from vcal.report.uncertainty.pictures import pictures
from vcal.report.uncertainty.record import sentence
from vcal.uncertainty.virtual import Scalar, VirtualCalibration, virtual_calibration

SETUP = """\
name = "a plan"

[machine]
chain = "w b X Y Z t"
[machine.travel_mm]
X = [0, 2000]
Y = [0, 1000]
Z = [0, 600]

[instrument]
kind = "laser_tracker"
range_sigma_um = 1.0
angle_sigma_urad = 2.0
station_mm = [-900.0, 300.0, 700.0]

[[model.effect]]
name = "scale_growth"
placement = "X"
alpha_um_per_m_K = 10
alpha_um_per_m_K_sigma = 3
[[model.effect]]
name = "backlash"
placement = "Z"
"""
OPTIONS = ("--draws", "9500", "--seed", "3", "--with", "scale_growth:Y")


pytestmark = pytest.mark.usefixtures("kept_programs")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A plan: 36 positions visited in a zigzag on a machine that warms up, no readings."""
    folder = tmp_path_factory.mktemp("study")
    lines = ["x_mm,y_mm,z_mm,dir_x,dir_y,dir_z,t_s,T_x_degC,T_y_degC,T_z_degC"]
    for i in range(36):
        x, y, z = 400 * (i % 5) + 150, 300 * (i // 5 % 3) + 100, 90 * (i * 7 % 6) + 20
        way = [1 if k % 2 else -1 for k in (i, i // 2, i // 3)]
        t = 20.0 + 2.0 * (1.0 - np.exp(-i / 12))
        numbers = (x, y, z, *way, 10 * i, t, t + 0.4 * (i % 3), t)
        lines.append(",".join(f"{v:.6g}" for v in numbers))
    (folder / "data.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "setup.toml").write_text(SETUP, encoding="utf-8")
    return folder


def run(*arguments, code=0):
    """Run a command in this process; what it printed, and nothing else, is checked for its code."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


@pytest.fixture(scope="module")
def report(study, tmp_path_factory):
    """Folder of a report, and what the command printed."""
    out = tmp_path_factory.mktemp("written") / "deep" / "report"
    printed = run("uncertainty", study, "--out", out, *OPTIONS)
    return out, printed


def strict(path):
    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


# --- numbers -------------------------------------------------------------------------------------


@pytest.mark.campaign
def test_numbers_against_linear_algebra(study, report):
    """Posterior covariance and what an effect that is not fitted does, from finite differences."""
    found = strict(report[0] / "result.json")
    model, plan = (loaded := vcal.load_study(study)).model, loaded.plan
    extra = vcal.CATALOGUE["scale_growth"](port="EYY", placement="Y")
    truth = model.with_effects(extra)
    at = np.zeros(len(truth.entries))
    nominal = np.asarray(vcal.predict(truth, plan, at))
    weight = 1.0 / np.asarray(model.instrument.noise(plan, nominal)).reshape(-1)
    columns = [
        np.asarray(vcal.predict(truth, plan, h) - vcal.predict(truth, plan, -h)).reshape(-1) / 2e-3
        for h in 1e-3 * np.eye(len(at))
    ]
    whole = np.stack(columns, 1) * weight[:, None]
    count = len(model.entries)
    fitted = whole[:, :count]
    prior = np.array([float(e.parameter.informed) for e in model.entries])
    posterior = np.linalg.inv(fitted.T @ fitted + np.diag(prior))
    pulled = posterior @ fitted.T @ whole[:, count:]
    step = np.array([e.parameter.step / e.parameter.si for e in model.entries])
    u = step * np.sqrt(np.diag(posterior) + (pulled**2).sum(1))
    # A flat prior adds no uncertainty of its own: the station stays nominal in every draw.
    gum = np.array([p["gum"]["u"] for p in found["parameters"]])
    np.testing.assert_allclose(gum, u, rtol=1e-4)
    drawn = np.array([p["monte_carlo"]["u"] for p in found["parameters"]])
    np.testing.assert_allclose(drawn, u, rtol=4.0 / np.sqrt(2 * 9500))
    # Of lines through the paths of the tool point: what is fitted, and what is not.
    slopes = line_errors(truth, plan)
    u = np.sqrt(
        np.einsum("ki,ij,kj->k", slopes[:, :count], posterior, slopes[:, :count])
        + ((slopes[:, count:] - slopes[:, :count] @ pulled) ** 2).sum(1)
    )
    lines = found["straight_lines"]
    assert [line["name"] for line in lines] == [
        *("EC(0X)Y", "EB(0X)Z", "EA(0Y)Z"),
        *("EXX slope", "EYY slope", "EZZ slope"),
    ]
    np.testing.assert_allclose([line["gum"]["u"] for line in lines], u, rtol=1e-3, atol=1e-6)
    drawn = [line["monte_carlo"]["u"] for line in lines]
    np.testing.assert_allclose(drawn, u, rtol=4.0 / np.sqrt(2 * 9500), atol=1e-6)
    before = np.sqrt((slopes**2).sum(1))
    np.testing.assert_allclose([line["prior"] for line in lines], before, rtol=1e-3, atol=1e-6)
    page = (report[0] / "index.html").read_text(encoding="utf-8")
    table = page[page.index("Squareness and scale of the axes") :]
    assert "EXX slope" in table and "EC(0X)Y" not in table  # of which nothing is declared


def line_errors(model, plan) -> np.ndarray:
    """Squareness, urad, and slopes of positioning, um/m, per amplitude (6, k), by differences."""
    travel = np.array([joint.travel for joint in model.chain.joints])
    position = np.tile(travel.mean(1), (3, 9, 1))
    for k in range(3):
        position[k, :, k] = np.linspace(*travel[k], 9)
    where = conditions_at(plan, position.reshape(-1, 3))
    terms = model.terms(where)

    def told(theta: np.ndarray) -> np.ndarray:
        ports = port_values(terms, theta, len(model.layout))
        errors = np.asarray(tool_points(model.chain, where.position, ports))
        errors = 1e6 * (errors - model.chain.tool_point(where.position)).reshape(3, 9, 3)
        s = np.array([np.polyfit(position[k, :, k], errors[k], 1)[0] for k in range(3)])
        square = [-s[1, 0] - s[0, 1], s[2, 0] + s[0, 2], -s[2, 1] - s[1, 2]]
        return np.array([*square, *np.diag(s)])

    steps = 1e-2 * np.eye(len(model.entries))
    return np.stack([(told(h) - told(-h)) / 2e-2 for h in steps], 1)


@pytest.mark.slow
def test_gum_and_monte_carlo_agree_on_the_volumetric_error(report):
    found = strict(report[0] / "result.json")
    rms = found["rms_after_um"]
    after = found["volumetric_error_um"]["after"]["rms"]
    assert rms["monte_carlo"] == pytest.approx(np.hypot(after["mean"], after["u"]), rel=1e-12)
    assert rms["gum"] == pytest.approx(rms["monte_carlo"], rel=0.1)
    sources = {s["source"]: s for s in found["sources"]}
    assert sum(s["share"] for s in sources.values()) == pytest.approx(1.0)
    assert sum(s["rms"] ** 2 for s in sources.values()) == pytest.approx(rms["gum"] ** 2)
    assert sources["scale_growth Y"]["origin"] == "not fitted"
    assert sources["scale_growth X"]["origin"] == sources["backlash Z"]["origin"] == "fitted"
    noise = [f"noise of the reading {name}" for name in ("range", "azimuth", "elevation")]
    assert {sources[name]["origin"] for name in noise} == {"noise"}
    assert found["sources"][0]["source"] == "scale_growth Y"
    assert found["error_motions"][0]["name"] == "EXX"
    left = {m["name"]: m for m in found["error_motions"]}
    # Nothing is declared or hidden in a straightness error; a scale error grows along its axis.
    assert not any(left["EZX"]["u"]) and not any(left["EZX"]["prior"])
    assert left["EYY"]["u"][-1] > 2 * left["EXX"]["u"][-1] > 0
    assert 0.5 < found["improved_share"] <= 1.0


@pytest.mark.thorough
def test_the_same_in_python(study, report):
    found = strict(report[0] / "result.json")
    loaded = vcal.load_study(study)
    extra = vcal.CATALOGUE["scale_growth"](port="EYY", placement="Y")
    result = virtual_calibration(
        loaded.model.with_effects(extra), loaded.model, loaded.plan, draws=9500, seed=3
    )
    after = result.volumetric("rms", "after")
    assert after._asdict() == found["volumetric_error_um"]["after"]["rms"]
    assert result.campaign.retried == found["draws"]["retried_share"]
    with pytest.raises(ValueError, match="found two effects 'backlash Z', expected at most one"):
        virtual_calibration(
            loaded.model.with_effects(loaded.model.effects[-1]), loaded.model, loaded.plan
        )


# --- the report ----------------------------------------------------------------------------------


def test_report(study, report):
    out, printed = report
    found = strict(out / "result.json")
    page = (out / "index.html").read_text(encoding="utf-8")
    assert printed.stderr == ""
    assert printed.stdout == f"{found['sentence']}\nReport: {out / 'index.html'}\n"
    assert found["schema"] == "vcal-uncertainty/1"
    # The campaign's own folder is gone once the report is complete.
    assert sorted(p.name for p in out.iterdir()) == sorted(found["files"])
    assert {"volumetric.png", "field.png", "sources.png", "error_motions.png"} < set(found["files"])
    targets = re.findall(r'(?:src|href)="([^"]*)"', page)
    own = ("data:image/", "#")
    assert [t for t in targets if not t.startswith(own)] == ["result.json"]
    text = re.sub('data:image/[a-z+]*;base64,[^"]*', "", page)
    for part in ("scale_growth Y", "present but not identified", "clause 8", found["sentence"]):
        assert part in text
    assert found["settings"]["seed"] == 3 and found["settings"]["with"] == ["scale_growth:Y"]
    assert found["draws"] == {
        "done": 9500,
        "failed": 0,
        "retried_share": 0.0,
        "gradients_per_draw": found["draws"]["gradients_per_draw"],
        "quantiles": "exact",
        "settled": None,
    }
    # Two sub-blocks of 10 000 draws are what the standard asks for.
    assert found["clause_8"]["parameters"]["undecided"] == len(found["parameters"])
    assert any("Clause 8 is undecided" in note for note in found["notes"])
    command = f"vcal uncertainty {study} --out {out} --draws 9500 --seed 3"
    assert found["command"].startswith(command)
    assert not found["interrupted"]


@pytest.mark.parametrize("largest", [0.0, 1e-9, 0.1])
def test_a_machine_without_errors_has_nothing_to_improve(largest):
    """It is said, and how to declare one; no picture shows zeros."""

    def volumetric(statistic, when):
        return Scalar(largest / 2, 0.0, 0.0, largest)

    result = SimpleNamespace(
        volumetric=volumetric, improved=0.0, coverage=0.95, ensemble=SimpleNamespace(interrupted=0),
        nodes=(np.zeros(2),) * 3, contributions=(), motions=(), points=SimpleNamespace(rows=8),
    )  # fmt: skip
    result.faultless = VirtualCalibration.faultless.fget(result)  # type: ignore[attr-defined]
    assert result.faultless == (largest < 1e-6)
    said = sentence(result)  # type: ignore[arg-type]
    section = _volumetric(result, {})  # type: ignore[arg-type]
    badge = _badge(result)  # type: ignore[arg-type]
    if not result.faultless:
        assert "it decreases on only 0.0 % of them" in said and badge.tone == "bad"
        assert "on 0.0 % of the machines" in section.paragraphs[0]
        return
    assert said.startswith("No error of the machine is declared")
    assert "[model.geometric]" in said and "[[model.effect]]" in said
    assert badge == Badge("No error to improve")
    assert section.paragraphs[0].startswith("No machine drawn has an error. Evaluated at 8 points")
    assert not list(pictures(result))  # type: ignore[arg-type]


def test_sheet():
    table = Table(("a", "b"), [("one", "<2>")], "lr", note="small", strong=frozenset([0]))
    picture = Picture("p", "", "what it shows", b"\x89PNG")
    sections = [
        Section("First & last", ("a < b",), ("point",), (table,), (picture,)),
        Section("Lesser", minor=True, tables=(Table(("",), [("x",)], fold="more"),)),
    ]
    page = sheet(
        "T <t>",
        "S",
        sections,
        badge=Badge("B", "bad"),
        facts=[("term", "what")],
        warnings=["careful"],
        tiles=[Tile("n", "v")],
    )
    for part in (
        "<h1>T &lt;t&gt;</h1>",
        '<h2 id="s1">First &amp; last</h2>',
        "<h3>Lesser</h3>",
        "<p>a &lt; b</p>",
        '<tr class="strong"><td>one</td><td class="n">&lt;2&gt;</td></tr>',
        '<img src="data:image/png;base64,iVBORw=="',
        '<span class="badge bad">B</span>',
        "<details><summary>more</summary>",
        '<p class="warning">careful</p>',
    ):
        assert part in page
    assert "Lesser</a>" not in page
    with pytest.raises(ValueError, match="found a row of 1 cells"):
        Table(("a", "b"), [("one",)])
    with pytest.raises(ValueError, match="found 'lx', expected 2 letters"):
        Table(("a", "b"), [], "lx")


def test_only_a_report_of_its_own_kind_is_replaced(tmp_path):
    mine = ReportFolder(record="result.json", schema="vcal-uncertainty/", beside="draws")
    (tmp_path / "draws").mkdir()
    mine.check(tmp_path)
    (tmp_path / "result.json").write_text('{"schema": "vcal-other/1"}')
    with pytest.raises(vcal.StudyError, match="found other files"):
        mine.check(tmp_path)
    (tmp_path / "result.json").write_text('{"schema": "vcal-uncertainty/1", "files": ["old.png"]}')
    (tmp_path / "old.png").write_bytes(b"")

    def fail(work):
        (work / "result.json").write_text("new")
        raise RuntimeError("while it was made")

    with pytest.raises(RuntimeError):
        mine.fill(tmp_path, fail)
    assert (tmp_path / "old.png").exists()

    def make(work):
        (work / "result.json").write_text('{"schema": "vcal-uncertainty/1"}')
        return ["result.json"]

    mine.fill(tmp_path, make)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["draws", "result.json"]


# --- mistakes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--draws", "1"), "--draws, value: found '1', expected a whole number from 11 to 2^32"),
        (("--draws", "10"), "--draws, value: found '10', expected a whole number from 11 to 2^32"),
        (("--draws", "many"), "found 'many'"),
        (("--draws", "1e4"), "found '1e4'"),
        (("--draws", str(2**32 + 1)), "or 'adaptive'; correct it"),
        (("--with", "backlsh:Y"), "unknown effect 'backlsh' (did you mean 'backlash'?)"),
        (("--with", "backlash:Z"), "effect backlash Z: found an effect that the study or"),
        (("--with", "backlash:Q"), "--with backlash:Q"),
        (("--noise-factor", "-1"), "--noise-factor, value: found -1"),
        (("--set", "instrument.kind=tracker"), "(did you mean 'laser_tracker'?)"),
    ],
)
def test_mistakes_in_options(study, tmp_path, options, message):
    told = run("uncertainty", study, "--out", tmp_path / "a" / "out", *options, code=2)
    assert told.stdout == "" and told.stderr.startswith("vcal: ")
    assert message in told.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_shape_that_nothing_would_tell(study, tmp_path):
    folder = Path(shutil.copytree(study, tmp_path / "study"))
    setup = folder / "setup.toml"
    row = '[[model.effect]]\nname = "warm_up"\nplacement = "Y"\ncomponent = "EYY"\n'
    setup.write_text(setup.read_text() + row)
    found = run("uncertainty", folder, "--out", tmp_path / "report", code=2)
    assert (
        "setup.toml, [[model.effect]] warm_up Y, key tau_h: found no value, and no size_EYY_um at"
        in found.stderr
    )
    assert "give tau_h, or a size with its sigma" in found.stderr
    assert not (tmp_path / "report").exists()


def test_mistakes_in_places(study, tmp_path):
    out = tmp_path / "out"
    assert "found no such file" in run("uncertainty", "nowhere", "--out", out, code=2).stderr
    assert not out.exists()
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    assert "found other files (mine.txt" in run("uncertainty", study, "--out", out, code=2).stderr
    file = tmp_path / "file"
    file.write_text("")
    assert "found a file" in run("uncertainty", study, "--out", file, code=2).stderr


def test_draws():
    assert (parse_draws("adaptive"), parse_draws("11"), parse_draws("4294967296")) == (
        "adaptive",
        11,
        2**32,
    )


def test_interrupted_before_there_is_anything(study, tmp_path, monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("vcal.cli.uncertainty.virtual_calibration", interrupted)
    out = tmp_path / "deep" / "out"
    shown = run("uncertainty", study, "--out", out, code=130)
    assert shown.stderr == "vcal: interrupted; nothing was written\n"
    assert list(tmp_path.iterdir()) == []


# --- interrupted, killed, resumed ----------------------------------------------------------------

SLOWLY = """
import signal
import time
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run unattended
import vcal.uncertainty.campaign as campaign
import vcal.uncertainty.streaming as stream
from vcal.cli import main
stream._CHUNK_S = stream._SAVING = 0.0
evaluate = campaign._Evaluate.__call__
def slowly(*args, **more):
    time.sleep({pause})
    return evaluate(*args, **more)
campaign._Evaluate.__call__ = slowly
main()
"""


class Process:
    """The command in a process of its own, a checkpoint after every thousand draws."""

    def __init__(self, study, out, pause):
        command = ["uncertainty", study, "--out", out, *map(str, OPTIONS)]
        self.state = out / "draws" / "campaign.state"
        self.process = subprocess.Popen(
            [sys.executable, "-c", SLOWLY.format(pause=pause), *map(str, command)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(Path(vcal.__file__).parents[1])},
        )

    def stop_after_a_checkpoint(self, number):
        before = self.state.stat().st_mtime_ns if self.state.exists() else 0
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline and self.process.poll() is None:
            if self.state.exists() and self.state.stat().st_mtime_ns > before:
                break
            time.sleep(0.01)
        assert self.process.poll() is None, self.process.communicate()
        self.process.send_signal(number)
        return self.end()

    def end(self):
        stdout, stderr = self.process.communicate(timeout=120)
        return self.process.returncode, stdout, stderr


@pytest.mark.campaign
@pytest.mark.skipif(os.name == "nt", reason="signals are sent to a process")
def test_interrupted_killed_and_resumed(study, report, tmp_path):
    out = tmp_path / "out"
    code, stdout, stderr = Process(study, out, 0.4).stop_after_a_checkpoint(signal.SIGINT)
    assert (code, stderr) == (
        130,
        "vcal: interrupted: the report holds the results so far; the same command resumes\n",
    )
    first = strict(out / "result.json")
    assert first["interrupted"] and 1000 <= first["draws"]["done"] < 9500
    assert stdout.startswith(first["sentence"])
    assert "Interrupted after" in (out / "index.html").read_text(encoding="utf-8")

    code, stdout, stderr = Process(study, out, 0.4).stop_after_a_checkpoint(signal.SIGKILL)
    assert (code, stdout) == (-signal.SIGKILL, "")
    assert strict(out / "result.json") == first

    # What was tampered with, or belongs to another campaign, is refused and left alone.
    other = tmp_path / "other"
    shutil.copytree(out, other)
    state = other / "draws" / "campaign.state"
    content = state.read_bytes()
    told = run("uncertainty", study, "--out", other, *OPTIONS, "--seed", 6, code=2).stderr
    assert "belongs to another campaign: found seed = 3, expected 6" in told
    state.write_bytes(content[:-3] + bytes([content[-3] ^ 1]) + content[-2:])
    told = run("uncertainty", study, "--out", other, *OPTIONS, code=2).stderr
    assert told.startswith(f"vcal: {state}: found") and told.count("\n") == 1
    assert strict(other / "result.json") == first

    code, stdout, stderr = Process(study, out, 0.0).end()
    assert (code, stderr) == (0, "")
    assert not (out / "draws").exists()
    resumed, straight = (strict(folder / "result.json") for folder in (out, report[0]))
    assert resumed["draws"]["done"] == 9500
    for key in ("seconds", "command", "sha256"):  # and so the sums of page and record
        assert resumed.pop(key) != straight.pop(key)
    assert resumed == straight
