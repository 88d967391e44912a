"""The command line as a user runs it."""

import html
import io
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

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

import vcal
import vcal.cli.show
import vcal.fleet.one_study
import vcal.report
import vcal.study.close_study
from vcal import CATALOGUE, StudyError
from vcal.cli import app, interruption, start_studies
from vcal.cli.interruption import listen
from vcal.cli.session import compiling, working
from vcal.cli.start_studies import example
from vcal.demo import starts
from vcal.design.spaces import SPACES, settings_of
from vcal.instruments import INSTRUMENTS
from vcal.instruments.laser_frame import SegmentSettings
from vcal.loop.outcome.closure import Errors
from vcal.loop.weighing.cross_validation import Rms
from vcal.numerics.program_cache import cache_folder, keep_programs
from vcal.plots import signatures
from vcal.report.effects.page import page as effect_page
from vcal.report.html.sheet import sheet
from vcal.study import load_study, read_table
from vcal.study.reading.formats import FORMAT_KEYS
from vcal.study.settings import (
    DataSettings,
    FourierSettings,
    JointSettings,
    LinkSettings,
    LoopSettings,
    MachineSettings,
    SmoothSettings,
)
from vcal.words import counted, plural

DEMO = Path(vcal.__file__).parent / "demo"
STARTS = DEMO / "start"


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("VCAL_NO_CACHE", "1")


def run(*arguments, code=0):
    """Run a command in this process; what it printed, and nothing else, is checked for its code."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result


def refused(*arguments):
    """The message of a command that must fail with exit code 2."""
    result = run(*arguments, code=2)
    assert result.stdout == ""
    assert result.stderr.startswith("vcal: ")
    return result.stderr


def process(*arguments, cwd, **environment):
    """Run vcal in a process of its own."""
    package = str(Path(vcal.__file__).parents[1])
    return subprocess.run(
        [sys.executable, "-m", "vcal", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=300,
        env={**os.environ, "PYTHONPATH": package, **environment},
    )


# --- without computing ---------------------------------------------------------------------------


@pytest.mark.thorough
def test_version_and_help(tmp_path):
    assert process("--version", cwd=tmp_path).stdout == f"vcal {vcal.__version__}\n"
    help_text = run("--help").output
    for command in ("loop", "demo", "init", "simulate", "check", "effects"):
        assert command in help_text
        assert "--help" in run(command, "--help").output


@pytest.mark.thorough
def test_a_mistake_in_a_process_of_its_own(tmp_path):
    found = process("loop", "nowhere.toml", "--out", "out", cwd=tmp_path)
    assert found.returncode == 2
    assert found.stdout == ""
    assert found.stderr.startswith("vcal: nowhere.toml, file: found no such file")
    assert found.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
    assert process("loop", "nowhere.toml", cwd=tmp_path).returncode == 2  # no --out


@pytest.mark.parametrize(
    "command",
    [
        *((name, "x") for name in ("loop", "simulate", "uncertainty", "design")),
        ("demo",),
        ("reproduce", "acceleration"),
        ("effects",),
        ("init",),
    ],
)
def test_a_folder_without_a_name(command, tmp_path, monkeypatch):
    """It is not the one that the user is in."""
    monkeypatch.chdir(tmp_path)
    told = run(*command, *(["--out"] * (command != ("init",))), "", code=2).stderr
    assert "found '', expected the name of a folder; give one" in re.sub(r"[\s│]+", " ", told)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_pages_of_effects(tmp_path):
    done = run("effects", "reversal_spike", "--out", tmp_path / "one").output
    page = (tmp_path / "one" / "reversal_spike.html").read_text()
    assert "reversal_spike.html" in done and "since_x_mm" in page and "data:image/png" in page
    assert "reversal_spike:size_um=5" in page
    # What no bundled study has a column for is shown with one made up.
    run("effects", "probe_lobing", "--out", tmp_path / "one")
    assert {p.name for p in (tmp_path / "one").iterdir()} == {
        "effects.json", "probe_lobing.html", "probe_lobing.png"
    }  # fmt: skip
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    assert "found other files" in refused("effects", "drift", "--out", tmp_path / "mine")


@pytest.mark.parametrize(
    ("name", "unit"), [("gear_ripple", "°"), ("screw_cyclic", "mm"), ("scale_interpolation", "µm")]
)
def test_a_period_is_shown_in_its_own_unit(name, unit):
    effect, setup = example(vcal.CATALOGUE[name])
    (first, _) = signatures(effect, setup)
    period = effect.scan(setup.plan)[effect.shapes[0].name] / effect.shapes[0].si
    assert first.x_label.endswith(f" {unit}, {unit}")
    assert 0.0 <= first.x.min() < first.x.max() <= period.max()


def test_commands_on_pages_of_effects_can_be_used():
    vcal.enable_float64()
    catalogue = vcal.CATALOGUE
    pages = {
        name: html.unescape(effect_page(catalogue[name], example(catalogue[name])))
        for name in ("ball_error", "repeatability")
    }
    assert "--with 'ball_error:ball " in pages["ball_error"]
    assert "--effects ball_error" in pages["ball_error"]
    assert "--with repeatability:X:" in pages["repeatability"]
    assert "vcal loop" not in pages["repeatability"]
    assert "keeps its prior" in pages["repeatability"]


def test_the_port_by_which_the_tool_moves_most_is_shown():
    """Metres and radians are compared by what they do."""
    vcal.enable_float64()
    (sag,) = signatures(*example(vcal.CATALOGUE["payload_sag"]))
    assert sag.port == "EZY" and sag.unit == "um"


@pytest.mark.campaign
def test_a_page_for_every_effect(tmp_path):
    out = tmp_path / "all"
    run("effects", "--out", out)
    index = (out / "index.html").read_text()
    for name, effect in vcal.CATALOGUE.items():
        assert f'href="{name}.html"' in index
        page = (out / f"{name}.html").read_text()
        assert effect.summary[1:] in html.unescape(page)
        assert (out / f"{name}.png").is_file(), name


def test_effects():
    listed = run("effects").output
    for name in vcal.CATALOGUE:
        assert name in listed
    page = run("effects", "thermal_tilt").output
    assert "k (T_axis - 20 degC)" in page and "Disturbs the machine; systematic." in page
    assert "k_EAX_urad_per_K (50)" in page and "depends on: T_x_degC" in page
    page = run("effects", "jerk_crosstalk").output  # beside another effect only
    assert "matrix_XX_nm_s3_per_m (0.3)" in page and "v_x_m_s" in page
    page = run("effects", "tool_interface").output  # to be declared only
    assert "X_um (0.1)" in page and "depends on: no recorded column" in page
    assert "pattern1_urad (500)" in run("effects", "joint_compliance").output
    assert "unknown effect 'backlsh' (did you mean 'backlash'?)" in refused("effects", "backlsh")


def test_check(small_tracker_study):
    shown = " ".join(run("check", small_tracker_study / "setup.toml").output.split())
    assert "small: " in shown
    assert "w X b Y Z t; X 0 to 2000 mm, Y 0 to 1000 mm, Z 0 to 600 mm" in shown
    assert "48 rows of 3 readings" in shown
    assert "geometric (93 parameters), station (6 parameters)" in shown
    assert "candidates of" in shown and "backlash" in shown
    assert "not testable payload_sag: needs payload_kg" in shown
    assert shown.endswith("not testable spindle_growth: needs speed_rpm")
    assert "constant dir_x: effects of its variation" in shown


def test_check_names_what_did_not_vary(small_tracker_study):
    data = small_tracker_study / "data.csv"
    table = {**read_table(data, []), "payload_kg": np.full(48, 7.0)}
    vcal.study.write_table(data, table | {"T_y_degC": np.full(48, 21.0)})
    shown = " ".join(run("check", small_tracker_study).output.split())
    assert "constant dir_x, T_y_degC, payload_kg: effects of their variation are not seen" in shown


@pytest.mark.parametrize("kept", [24, 0])
def test_temperatures_that_were_hardly_recorded_are_ignored(small_tracker_study, kept):
    """As other columns are; so are comments, and `check` says it."""
    data = small_tracker_study / "data.csv"
    table: dict = dict(read_table(data, []))
    table["T_y_degC"] = np.array([f"{20 + 0.1 * i:.1f}" if i < kept else "" for i in range(48)])
    vcal.study.write_table(data, table | {"remark": np.full(48, "fine")})
    assert not vcal.load_study(small_tracker_study).plan.has("T_Y")
    shown = " ".join(run("check", small_tracker_study).output.split())
    assert "ignored T_y_degC, remark: no more than half of the cells are numbers" in shown
    if kept:  # one more, and it is one of numbers
        table["T_y_degC"][kept] = "21.0"
        vcal.study.write_table(data, table)
        assert "row 26 (line 27), column T_y_degC" in refused("check", small_tracker_study)


def test_check_names_what_goes_together(small_tracker_study):
    """While the order can still be changed, and the conditions varied."""
    data = small_tracker_study / "data.csv"
    table = dict(read_table(data, []))
    rng = np.random.default_rng(0)
    apart = {n: rng.uniform(20.0, 25.0, 48) for n in table if n.startswith("T_")}
    vcal.study.write_table(data, table | apart | {"t_s": rng.permutation(48) * 60.0})
    assert "confounded" not in run("check", small_tracker_study).output
    climbing = 100.0 + table["z_mm"] + rng.uniform(0.0, 20.0, 48)
    wet = {"humidity_pct": 30.0 - 2.0 * apart["T_y_degC"], "steady_pct": np.full(48, 5.0)}
    vcal.study.write_table(data, table | apart | {"t_s": climbing} | wet)
    shown = " ".join(run("check", small_tracker_study).output.split())
    assert (
        "confounded t_s is correlated with z_mm (1.00): a dependence on one cannot be "
        "distinguished from one on the other; measure in random order"
    ) in shown
    assert "confounded T_y_degC is correlated with humidity_pct (1.00): " in shown
    assert shown.count("confounded") == 2


@pytest.mark.thorough
def test_check_says_where_times_run_backwards(small_tracker_study):
    data = small_tracker_study / "data.csv"
    table = dict(read_table(data, []))

    def told(**columns):
        vcal.study.write_table(data, table | columns)
        return " ".join(run("check", small_tracker_study).output.split())

    assert "backwards" not in told()
    assert "times t_s runs backwards at 47 rows (2, 3, 4, 5, 6, ...): eff" in told(
        t_s=-table["t_s"]
    )
    slipped = table["t_s"].copy()
    slipped[20] = slipped[18]
    assert "t_s runs backwards at 1 row (21): effects of time follow" in told(t_s=slipped)
    clock = np.tile(table["t_s"][:24], 2)
    assert "t_s runs backwards at 1 row (25)" in told(t_s=clock)
    assert "backwards" not in told(t_s=clock, run=np.repeat([0, 1], 24))
    assert "t_s runs backwards at 23 rows (26, " in told(
        t_s=np.concatenate([clock[:24], -clock[24:]]), run=np.repeat([0, 1], 24)
    )


def test_check_says_of_which_axis_little_is_covered(small_tracker_study):
    shown = " ".join(
        run("check", small_tracker_study, "--set", "machine.travel_mm.Z=[0, 3000]").output.split()
    )
    assert "covered 17 % of Z: errors of the rest of the travel are not seen" in shown
    assert "covered" not in run("check", small_tracker_study).output


def test_check_names_what_cannot_be_tested(small_tracker_study):
    table = read_table(small_tracker_study / "data.csv", [])
    kept = {name: v for name, v in table.items() if not name.startswith(("dir_", "T_"))}
    vcal.study.write_table(small_tracker_study / "data.csv", kept)
    shown = " ".join(run("check", small_tracker_study).output.split())
    assert "not testable" in shown
    assert "backlash, lateral_reversal, angular_reversal: " in shown


def test_check_lists_what_is_read(small_tracker_study):
    """An ignored column is none of them."""
    data = small_tracker_study / "data.csv"
    lines = data.read_text().splitlines()
    kept = [lines[0] + ",remark", *(f"{line},good" for line in lines[1:])]
    data.write_text("\n".join(kept) + "\n")
    shown = run("check", small_tracker_study).output
    columns, ignored = (
        " ".join(re.search(rf"(?s)^{label} +(.*?)^\S", shown, re.M)[1].split())
        for label in ("columns", "ignored")
    )
    assert columns.endswith("range_mm, azimuth_rad, elevation_rad")
    assert ignored == "remark: no more than half of the cells are numbers"


BAD = "a\x1b]0;title\x07\x1b[31mRED\x1b[2J\u202e\u2028b\nvcal: fake line [bold]x[/bold]"
SHOWN = r"a\x1b]0;title\x07\x1b[31mRED\x1b[2J\u202e\u2028b\nvcal: fake line [bold]x[/bold]"


def harmless(text):
    """Whether no character of a text controls a terminal."""
    assert not re.findall("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2028\u2029]", text)
    return text


def test_a_name_cannot_control_the_terminal(small_tracker_study, tmp_path):
    override = ("--set", f"name={json.dumps(BAD)}")
    printed = harmless(run("check", small_tracker_study, *override).output)
    assert printed.startswith(f"{SHOWN}: ")
    study = load_study(small_tracker_study, {"name": BAD})
    assert study.name == study.measurement.name == SHOWN
    assert SHOWN in html.unescape(harmless(sheet(study.name, "", ())))
    assert SHOWN in html.unescape(harmless(sheet(BAD.replace("\n", "\\n"), "", ())))


@pytest.mark.parametrize(
    "options",
    [
        ("--set", f"{BAD}=1"),
        ("--set", f"loop.effects=[{json.dumps(BAD)}]"),
        ("--set", f"data.data={json.dumps(BAD)}"),
        ("--set", f"machine.chain={json.dumps(BAD)}"),
    ],
)
def test_a_message_cannot_control_the_terminal(small_tracker_study, options):
    assert harmless(refused("check", small_tracker_study, *options)).count("\n") == 1


def test_a_column_cannot_control_the_terminal(small_tracker_study):
    data = small_tracker_study / "data.csv"
    text = data.read_text().replace("T_air_degC", "humidity\x1b[2J_pct", 1)
    data.write_text(text)
    assert r"humidity\x1b[2J_pct" in harmless(run("check", small_tracker_study).output)
    data.write_text(text.replace("range_mm", "range\x1b[2J_mm", 1))
    assert r"range\x1b[2J_mm" in harmless(refused("check", small_tracker_study))


def test_counts_in_singular_and_plural():
    assert counted(1, "reading") == "1 reading" and counted(0, "reading") == "0 readings"
    assert plural(1, "is", "are") == "is" and plural(2, "is", "are") == "are"


def test_check_says_what_the_check_points_lack(small_tracker_study):
    assert "lacking there" not in run("check", small_tracker_study).output
    check = small_tracker_study / "check.csv"
    table = read_table(check, [])
    kept = {k: v for k, v in table.items() if k not in ("T_y_degC", "t_s")}
    vcal.study.write_table(check, kept)
    shown = " ".join(run("check", small_tracker_study).output.split())
    assert "lacking there T_y_degC: without it, the error at the check points excludes" in shown
    of_time = shown.partition("lacking there t_s: ")[2].partition(" excludes ")[2]
    of_time = re.split(" (?:lacking|declared) ", of_time)[0].split(", ")
    assert "drift" in of_time and "backlash" not in of_time


def test_check_sees_a_column_in_another_case(small_tracker_study):
    data = small_tracker_study / "data.csv"
    vcal.study.write_table(data, {**read_table(data, []), "Payload_kg": np.arange(48.0)})
    shown = " ".join(run("check", small_tracker_study).output.split())
    assert "payload_sag: needs payload_kg (rename Payload_kg)" in shown


def test_check_with_overrides(small_arm_study):
    setup = small_arm_study / "setup.toml"
    assert "16 rows of 9 readings" in run("check", setup, "--set", "instrument.joints=read").output
    message = refused("check", setup, "--set", "instrument.joints=red")
    assert "override instrument.joints=red" in message and "(did you mean 'read'?)" in message
    assert "expected key=value" in refused("check", setup, "--set", "joints")


# --- init ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("instrument", starts())
@pytest.mark.slow
def test_init_writes_a_study_that_can_be_used(tmp_path, instrument):
    folder = tmp_path / "new" / "study"
    printed = run("init", folder, "--instrument", instrument).output
    assert "setup.toml" in printed and f"vcal check {folder / 'setup.toml'}" in printed
    assert "can be used" in run("check", folder).output
    assert load_study(folder).measurement is not None
    assert [p.name for p in folder.parent.iterdir()] == ["study"]
    before = sorted(folder.iterdir())
    assert "found a folder that is not empty" in refused("init", folder)
    assert "plan" not in printed
    # True of these data, not of others that are simulated from the study, which copy its comments.
    assert "without any other effect" in printed
    assert "without any other effect" not in (folder / "setup.toml").read_text(encoding="utf-8")
    assert sorted(folder.iterdir()) == before


def test_init_says_that_a_table_is_a_plan(tmp_path, monkeypatch):
    starts_of = tmp_path / "start"
    shutil.copytree(STARTS / "laser_tracker", starts_of / "laser_tracker")
    data = starts_of / "laser_tracker" / "data.csv"
    table = read_table(data, [])
    readings = ("range_mm", "azimuth_rad", "elevation_rad")
    vcal.study.write_table(data, {k: v for k, v in table.items() if k not in readings})
    for module in ("vcal.demo", "vcal.cli.start_studies"):
        monkeypatch.setattr(f"{module}.STARTS", starts_of)
    printed = run("init", tmp_path / "study").output
    assert "data.csv is a plan without readings: measure them, or use vcal simulate." in printed
    assert "were simulated" not in printed
    printed = run("check", tmp_path / "study").output
    assert "rows without readings: a plan" in printed


def test_init_of_an_instrument_there_is_not(tmp_path):
    message = refused("init", tmp_path / "x", "--instrument", "laser")
    assert "found 'laser' (did you mean 'laser_frame'?), expected one of " in message
    assert message.rstrip().endswith(f"one of {', '.join(starts())}; correct the name")
    assert not (tmp_path / "x").exists()
    told = " ".join(run("init", "--help").stdout.replace("│", " ").split())
    assert f"one of {', '.join(starts())}." in told


def test_every_key_is_explained():
    texts = {kind: (STARTS / kind / "setup.toml").read_text() for kind in starts()}
    assert starts() == sorted(INSTRUMENTS)
    for kind, text in texts.items():
        known = [DataSettings, LoopSettings, INSTRUMENTS[kind].Settings]
        known += [settings_of(kind)] if kind in SPACES else []
        if INSTRUMENTS[kind].machine is None:  # else it has no travel to err over
            arm = "[[machine.joint]]" in text
            known += [LinkSettings, JointSettings] if arm else [FourierSettings, SmoothSettings]
        for settings in known:
            for key in settings.model_fields:
                if key in FORMAT_KEYS and kind != "laser_tracker":
                    continue  # how a file is read does not depend on the instrument
                assert key in text, f"{key} of {settings.__name__} in start/{kind}"
        assert "[[model.effect]]" in text and "effects_file" in text
    for key in MachineSettings.model_fields:
        assert any(key in text for text in texts.values()), key


@pytest.mark.parametrize("instrument", starts())
@pytest.mark.thorough
def test_keys_that_are_commented_out_can_be_used(tmp_path, instrument):
    run("init", tmp_path / "study", "--instrument", instrument)
    setup = tmp_path / "study" / "setup.toml"
    lines = setup.read_text(encoding="utf-8").splitlines()
    # A table that is not there, a line of text, and probes, whose own readings the table lacks.
    other = (
        "# effects_file",
        "# family",
        "# probes",
        *([] if (STARTS / instrument / "check.csv").is_file() else ["# check"]),
    )
    if instrument == "laser_frame":  # a table that is not there, and a path beside the named one
        keys = [key for key in SegmentSettings.model_fields if key != "psd"]
        other += (
            "# table",
            "# psd_map",
            "# psd = ",
            "# [[instrument",
            *(f"# {key} = " for key in keys),
        )
    lines = [
        line[2:] if re.match(r"# (\[|\w+ = )", line) and not line.startswith(other) else line
        for line in lines
    ]
    setup.write_text("\n".join(lines), encoding="utf-8")
    study = load_study(setup)
    assert len(study.settings.model.effect) == 1
    assert study.options.model_fields_set == set(LoopSettings.model_fields)
    plain = LoopSettings(effects=("backlash",))
    assert study.options == plain  # what is shown is the default


# --- simulate ------------------------------------------------------------------------------------


@pytest.mark.campaign
def test_simulate_makes_a_study_of_the_same_kind(tmp_path, small_tracker_study):
    out = tmp_path / "made"
    arguments = ("--with", "backlash:Y:size_um=12", "--with", "screw_cyclic:X:pitch_mm=20")
    shown = run("simulate", small_tracker_study, "--out", out, *arguments, "--seed", 4)
    assert shown.stderr == ""
    assert "undeclared: backlash Y, size_um = 12" in shown.output
    names = ["check.csv", "data.csv", "errors.csv", "setup.toml", "truth.json"]
    assert sorted(p.name for p in out.iterdir()) == names
    for name in ("setup.toml", "errors.csv"):
        assert (out / name).read_bytes() == (small_tracker_study / name).read_bytes()
    header = (small_tracker_study / "data.csv").read_text().splitlines()[0]
    assert (out / "data.csv").read_text().splitlines()[0] == header
    truth = json.loads((out / "truth.json").read_text())
    assert truth["seed"] == 4
    backlash, screw = truth["undeclared"]
    assert backlash == {"effect": "backlash", "placement": "Y", "size_um": 12.0}
    assert screw["pitch_mm"] == pytest.approx(20) and abs(screw["sine_um"]) < 15
    assert [e["effect"] for e in truth["declared"]] == ["geometric", "station"]
    assert truth["declared"][0]["EXX.a1_um"] != 0
    # It can be read again, its check points too, and they lie all over the travel.
    study = load_study(out)
    assert study.measurement.rows == 48
    low, high = study.check.plan.position.min(0), study.check.plan.position.max(0)
    assert (high - low > [1.9, 0.95, 0.57]).all()
    error = study.check.tool_point - study.check.plan.position - [0, 0, -0.15]
    assert 2e-6 < np.sqrt(np.mean(error**2)) < 200e-6


@pytest.mark.thorough
def test_simulate_with_a_key_replaced(tmp_path, small_tracker_study):
    """The study beside the data is that which they were made with."""
    more = ("--set", "name=mine", "--set", "instrument.range_sigma_um=40")
    for name, options in (("as it is", ()), ("replaced", more)):
        run("simulate", small_tracker_study, "--out", tmp_path / name, *options)
    before, after = (load_study(tmp_path / name) for name in ("as it is", "replaced"))
    assert (after.name, after.one.settings.range_sigma_um) == ("mine", 40.0)
    assert before.one.settings.range_sigma_um != 40.0
    off = after.measurement.readings - before.measurement.readings
    assert 20e-6 < off[:, 0].std() < 80e-6 and np.abs(off[:, 1:]).max() < 1e-9
    told = refused("simulate", small_tracker_study, "--out", tmp_path / "x", "--set", "nam=mine")
    assert "the unknown key 'nam' (did you mean 'name'?)" in told


@pytest.mark.campaign
def test_simulate_depends_on_the_seed_alone(tmp_path, small_ball_study):
    def made(name, *more):
        run("simulate", small_ball_study, "--out", tmp_path / name, *more)
        return {p.name: p.read_bytes() for p in (tmp_path / name).iterdir()}

    first = made("a", "--seed", 1)
    assert made("b", "--seed", 1) == first
    other = made("c", "--seed", 2)
    assert other["data.csv"] != first["data.csv"]
    assert other["artefact.csv"] == first["artefact.csv"]


@pytest.mark.campaign
def test_simulate_fills_a_plan_of_an_arm(tmp_path, small_arm_study):
    table = read_table(small_arm_study / "data.csv", [])
    plan = {name: v for name, v in table.items() if name == "pose" or name.startswith("q")}
    vcal.study.write_table(small_arm_study / "data.csv", plan)
    message = refused("loop", small_arm_study, "--out", tmp_path / "out")
    assert "data.csv, header: found a plan without columns of readings" in message
    run("simulate", small_arm_study, "--out", tmp_path / "made", "--with", "backlash:J1")
    study = load_study(tmp_path / "made")
    assert study.measurement.readings.shape == (16, 9)
    assert study.check is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("backlsh:Y", "name: found the unknown effect 'backlsh' (did you mean 'backlash'?)"),
        ("backlash:y", "key placement (backlash): found 'y' (did you mean 'Y'?), expected one of"),
        ("backlash", "key placement (backlash): found nothing, expected one of X, Y, Z"),
        ("backlash:Y:siz_um=3", "found the unknown key 'siz_um' (did you mean 'size_um'?)"),
        ("backlash:Y:size_um=big", 'key size_um (backlash): found "big", expected a number'),
        ("backlash:Y:size_um", "expected NAME, NAME:PLACEMENT or NAME:PLACEMENT:KEY=VALUE"),
        ("backlash:Y:size_um=1,size_um=2", "values: found size_um a second time, expected"),
        ("backlash:Y:size_um=", "values: found 'size_um=', expected KEY=VALUE"),
        (":Y", "found ':Y', expected NAME, NAME:PLACEMENT"),
        ("thermal_tilt:Y", "found 3 effects that these keys fit, expected one, by its component"),
        ("thermal_tilt:Y:k_EAY_urad_per_K=1,k_EBY_urad_per_K=2", "write one --with for each"),
        ("range_scale:Y:component=3", "key component: found 3, expected text"),
        ("joint_compliance:X", "an effect without a possible placement"),
        ("artefact_expansion", "an effect without a possible placement"),
    ],
)
def test_mistakes_in_with(tmp_path, small_tracker_study, text, message):
    out = tmp_path / "made"
    told = refused("simulate", small_tracker_study, "--out", out, "--with", text)
    assert told.startswith(f"vcal: --with {text}")
    assert message in told
    assert "model.effect" not in told
    assert not out.exists()


def test_an_effect_that_is_there_already(tmp_path, small_tracker_study):
    out, twice = tmp_path / "made", ("--with", "backlash:Y", "--with", "backlash:Y:size_um=3")
    told = refused("simulate", small_tracker_study, "--out", out, *twice)
    assert "--with backlash:Y:size_um=3, effect backlash Y: found an effect that the study" in told
    setup = small_tracker_study / "setup.toml"
    declared = '\n[[model.effect]]\nname = "backlash"\nplacement = "Y"\nsize_um = 3\n'
    setup.write_text(setup.read_text(encoding="utf-8") + declared, encoding="utf-8")
    assert "every effect once" in refused("simulate", setup, "--out", out, *twice[:2])
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("lateral_reversal", "component, required: EYX or EZX"),
        ("gear_harmonic", "order, required: 1 or 2 or 3 or 4"),
        ("cross_axis", "other, required: Y or Z"),
        # Its reach differs as well, and follows from that.
        ("gear_wind_up", "component, required: arm or tool\n  parameters"),
    ],
)
def test_an_effect_tells_what_it_has_to_be_told(name, said):
    assert said in run("effects", name).output


def test_an_effect_without_its_covariate(tmp_path, small_tracker_study):
    table = read_table(small_tracker_study / "data.csv", [])
    del table["T_y_degC"]
    vcal.study.write_table(small_tracker_study / "data.csv", table)
    text = "thermal_tilt:Y:k_EAY_urad_per_K=40"
    out = tmp_path / "made"
    told = refused("simulate", small_tracker_study, "--out", out, "--with", text)
    assert "data.csv, column T_y_degC: found no such column" in told
    assert "model.effect" not in told


def test_simulate_leaves_alone_what_is_there(tmp_path, small_tracker_study):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    simulated = ("simulate", small_tracker_study, "--out")
    assert "found a folder that is not empty" in refused(*simulated, tmp_path / "out")
    assert "found a file, expected" in refused(*simulated, tmp_path / "file")
    assert "noise-factor, value: found -1" in refused(
        *simulated, tmp_path / "new", "--noise-factor=-1"
    )
    names = ["file", "out", small_tracker_study.name]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["mine.txt"]


def test_a_folder_that_cannot_be_made(tmp_path, small_tracker_study):
    (tmp_path / "file").write_text("mine")
    for command in ("loop", "simulate", "uncertainty", "design"):
        told = refused(command, small_tracker_study, "--out", tmp_path / "file" / "sub")
        assert f"output folder: found the file {tmp_path / 'file'} in its path" in told
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--with", "backlash:Y:size_um=1e14"), "found 1e+14, expected a number of at most"),
        (("--noise-factor", "1e300"), "found 1e+300, expected a number of at least 0 and at most"),
        (("--noise-factor", "nan"), "found nan, expected a number of at least 0 and at most"),
        (("--noise-factor", "1e6"), "in the simulation, expected a number from"),
    ],
)
def test_simulate_writes_only_what_can_be_read_again(
    tmp_path, small_tracker_study, options, message
):
    assert message in refused("simulate", small_tracker_study, "--out", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def test_simulate_copies_no_file_from_elsewhere(tmp_path, small_tracker_study):
    (small_tracker_study / "errors.csv").rename(tmp_path / "errors.csv")
    setup = small_tracker_study / "setup.toml"
    setup.write_text(setup.read_text().replace("errors.csv", "../errors.csv"))
    told = refused("simulate", setup, "--out", tmp_path / "made", "--allow-outside")
    assert "file ../errors.csv: found a file outside the folder of the study" in told


# --- the loop ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_simulate_then_loop(tmp_path, small_tracker_study):
    made, out = tmp_path / "made", tmp_path / "deep" / "report"
    run("simulate", small_tracker_study, "--out", made, "--with", "backlash:Y:size_um=60")
    options = ("--effects", "backlash,scale_growth", "--max-effects", 2, "--set", "name=mine")
    options += ("--set", "acceptance.volumetric_um=1")
    shown = run("loop", made, "--out", out, "--draws", 100, "--seed", 5, *options)
    assert shown.stderr == ""
    assert "The declared model lacked backlash Y." in shown.output
    assert "check points, aligned" in shown.output
    assert f"Report: {out / 'index.html'}" in shown.output
    assert "backlash" in (out / "index.html").read_text(encoding="utf-8")
    report = json.loads((out / "report.json").read_text())
    assert f"\n{report['acceptance']['sentence']}\nReport: " in shown.output
    assert report["acceptance"]["before"]["verdict"] == "does_not_conform"
    assert (report["verdict"], report["name"]) == ("named", "mine")
    assert report["settings"]["draws"] == 100
    assert report["settings"]["effects"] == ["backlash", "scale_growth"]
    assert report["seconds"] > 0
    expected = f"vcal loop {made} --out {out} --seed 5 --draws 100 --max-effects 2"
    options_set = "--set name=mine --set acceptance.volumetric_um=1"
    assert report["command"] == f"{expected} --effects backlash,scale_growth {options_set}"
    # A report may replace an earlier one, but nothing else, and that is known before the work.
    (tmp_path / "deep" / "mine.txt").write_text("mine")
    assert "found other files (mine.txt" in refused("loop", made, "--out", tmp_path / "deep")


def test_numbers_are_shown_to_the_digits_of_their_uncertainty(capsys, monkeypatch):
    backlash = SimpleNamespace(name="backlash")
    found = SimpleNamespace(
        effect=backlash, placement="Y", joint=False, p_value=0.002, status="named", separation="",
        equivalent=["angular_reversal Y"],
        alternatives=[("warm_up", "X", 0.43), ("jump", "", 0.01)], hint="",
    )  # fmt: skip
    unsure = SimpleNamespace(**vars(found) | {"placement": "X", "hint": "its rivals are as likely"})
    errors = Errors(Rms(5.2312, 1.26), None, Rms(0.9412, 0.183), Rms(0.9, 0.1), 1.0)
    closure = SimpleNamespace(
        sentence="A sentence.", found=[found], hints=[unsure], errors={"after": errors},
        suspected=[], notes=[],
        unexplained=SimpleNamespace(reason="no more effects may be added"),
    )  # fmt: skip
    rows = [("size_um", 11.98765, "um", 0.6123)]
    monkeypatch.setattr(vcal.cli.show, "parameters", lambda *_: rows)
    play, known = SimpleNamespace(key="backlash X"), SimpleNamespace(key="drift X")
    listed = [(play, [("size", 12.98, "um", 0.21)]), (known, [("rate", 1.0, "um/h", 0.0)])]
    monkeypatch.setattr(vcal.cli.show, "declared", lambda *_: listed)
    vcal.cli.show.show_closure(closure)
    shown = " ".join(capsys.readouterr().out.split())
    assert "backlash Y: size_um = 12.0 ± 1.2 um (k = 2), p = 0.002, named" in shown
    assert "equivalent on these data: angular_reversal Y" in shown
    assert "what each may be: backlash X: size_um" in shown
    assert "a hint only: its rivals are as likely" in shown
    assert "alternatives: warm_up X (43 %)" in shown and "jump" not in shown
    assert "backlash X: size = 12.98 ± 0.42 um (k = 2), declared" in shown and "drift" not in shown
    assert "no more effects may be added" in shown
    assert "rms error, µm, ± one standard uncertainty after" in shown
    assert "check points, aligned 5.2 ± 1.3" in shown
    assert "held-out readings 0.94 ± 0.18" in shown


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--effects", "backlash,drif"), "unknown effect 'drif' (did you mean 'drift'?)"),
        (("--alpha", 2), "override loop.alpha=2.0"),
        (("--alpha", 0.02, "--set", "loop.alpha=2"), "override loop.alpha=0.02"),
        (("--draws", 0), "expected a number of at least 25"),
        (("--set", "loop.alfa=0.1"), "the unknown key 'alfa' (did you mean 'alpha'?)"),
        (("--set", "instrument.kind=lasertracker"), "(did you mean 'laser_tracker'?)"),
    ],
)
def test_mistakes_in_options(tmp_path, small_tracker_study, options, message):
    told = refused("loop", small_tracker_study, "--out", tmp_path / "out", *options)
    assert message in told
    assert not (tmp_path / "out").exists()


def test_interrupted_before_there_is_anything(tmp_path, small_tracker_study, monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(vcal.study.close_study, "close_loop", interrupted)
    shown = run("loop", small_tracker_study, "--out", tmp_path / "out", code=130)
    assert shown.stderr == "vcal: interrupted; nothing was written\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("becomes", [ImportError("initialization failed"), StudyError("not there")])
def test_an_interruption_that_becomes_another_error(small_tracker_study, monkeypatch, becomes):
    """Where a compiled module is imported, `KeyboardInterrupt` becomes an `ImportError`."""

    def interrupted(*args, **kwargs):
        monkeypatch.setattr(interruption._STATE, "number", signal.SIGTERM)
        raise becomes

    monkeypatch.setattr(vcal.study.close_study, "close_loop", interrupted)
    out = small_tracker_study / "out"
    shown = run("loop", small_tracker_study, "--out", out, code=128 + signal.SIGTERM)
    assert shown.stderr == "vcal: interrupted; nothing was written\n"
    assert not out.exists()
    # A later command of the same process does not remember it.
    assert "no such file" in refused("loop", "nowhere", "--out", out)


def test_an_effect_is_shown_without_reading_all_bundled_studies(monkeypatch):
    read, load = [], start_studies.declared_model
    monkeypatch.setattr(
        start_studies,
        "declared_model",
        lambda path, *more: read.append(path.name) or load(path, *more),
    )
    monkeypatch.setattr(start_studies, "_setup", start_studies._setup.__wrapped__)
    found = start_studies.example(CATALOGUE["backlash"])
    assert found is not None and found[0].name == "backlash"
    assert len(read) == 1


def test_interrupted_with_something_to_tell(tmp_path, small_tracker_study, monkeypatch):
    def write(closure, study, out, *, command, seconds, compensate_anyway):
        assert not compensate_anyway
        out.mkdir()
        (out / "index.html").write_text(f"{closure.found} after {seconds >= 0}: {command}")
        return out / "index.html"

    closure = SimpleNamespace(interrupted=True, found="what is known")
    monkeypatch.setattr(vcal.study.close_study, "close_loop", lambda *args, **kwargs: closure)
    monkeypatch.setattr(vcal.fleet.one_study, "write_report", write)
    monkeypatch.setattr(vcal.cli.show, "show_closure", lambda closure: print("a sentence"))
    out = tmp_path / "out"
    shown = run("loop", small_tracker_study, "--out", out, code=130)
    assert shown.stdout == f"a sentence\nReport: {out / 'index.html'}\n"
    assert "the report holds the results so far" in shown.stderr
    assert (out / "index.html").read_text().startswith("what is known after True: vcal loop ")


def test_an_output_that_cannot_be_written(small_tracker_study, monkeypatch):
    def unwritable(*args, **kwargs):
        raise PermissionError(13, "Permission denied", "/nowhere/out")

    monkeypatch.setattr(vcal.study.close_study, "close_loop", unwritable)
    told = refused("loop", small_tracker_study, "--out", small_tracker_study / "out")
    assert told == "vcal: /nowhere/out: Permission denied\n"


@pytest.mark.thorough
def test_demo(tmp_path):
    """The first thing a user runs: in a process of its own, in an empty folder. `.ci/run` has it
    from the README.
    """
    cache = tmp_path / "cache"
    (tmp_path / "work").mkdir()
    found = process("demo", cwd=tmp_path / "work", VCAL_NO_CACHE="", XDG_CACHE_HOME=str(cache))
    assert found.returncode == 0, found.stderr
    assert found.stderr == ""
    assert "The declared model lacked thermal_tilt Y." in found.stdout
    out = tmp_path / "work" / "vcal-demo"
    assert [p.name for p in (tmp_path / "work").iterdir()] == [out.name]
    report = json.loads((out / "report.json").read_text())
    (effect,) = report["effects"]
    (truth,) = json.loads((DEMO / "truth.json").read_text())["undeclared"]
    assert (effect["effect"], effect["placement"]) == (truth["effect"], truth["placement"])
    (parameter,) = effect["parameters"]
    off = parameter["value"] - truth["k_EAY_urad_per_K"]
    assert abs(off) < 3 * parameter["standard_uncertainty"] < 3
    errors = report["errors"]
    assert errors["after"]["check_rms_um"] < 0.6 * errors["before"]["check_rms_um"]
    # Compiled programs were kept for the next run.
    kept = list((cache / "vcal").glob("*/*-cache"))
    assert any("compared_with_jacobian" in path.name for path in kept)


# --- the session ---------------------------------------------------------------------------------


def test_where_compiled_programs_are_kept(monkeypatch, tmp_path):
    assert cache_folder() is None
    monkeypatch.delenv("VCAL_NO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder().parent == tmp_path / "vcal"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    for platform, expected in (
        ("linux", ".cache"),
        ("darwin", "Library/Caches"),
        ("win32", "AppData/Local"),
    ):
        monkeypatch.setattr(sys, "platform", platform)
        monkeypatch.delenv("LOCALAPPDATA", raising=False)
        assert cache_folder().parent == tmp_path / expected / "vcal"


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_programs_are_kept_in_the_users_own_folder_only(monkeypatch, tmp_path):
    kept: dict[str, object] = {}
    monkeypatch.delenv("VCAL_NO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = SimpleNamespace(jax_compilation_cache_dir=None, update=kept.__setitem__)
    monkeypatch.setattr("vcal.numerics.program_cache.jax.config", config)
    keep_programs()
    folder = Path(str(kept.pop("jax_compilation_cache_dir")))
    assert folder == cache_folder() and folder.stat().st_mode & 0o777 == 0o700
    kept.clear()
    folder.chmod(0o770)  # what another user has put there would be run
    keep_programs()
    assert not kept
    folder.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    keep_programs()
    assert not kept


def test_ctrl_c_is_not_lost_in_the_garbage_collector(monkeypatch):
    class Held:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def _xla_gc_callback():
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    began = time.monotonic()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        listen(watched=False)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        _xla_gc_callback()
        with pytest.raises(KeyboardInterrupt):
            time.sleep(20)
        held = Held()
        with pytest.raises(KeyboardInterrupt):
            del held  # an exception in it is printed and dropped
            time.sleep(20)
        assert time.monotonic() - began < 10
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_progress_is_for_terminals_only(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setenv("TERM", "xterm")
    for stream, shows in ((io.StringIO(), False), (Terminal(), True)):
        monkeypatch.setattr(sys, "stderr", stream)
        with working("first") as progress:
            progress("round 1: screening")
        assert ("round 1: screening" in stream.getvalue()) == shows


@pytest.mark.parametrize("words", [["-m", "vcal", "effects"], ["-c", "import vcal; vcal.identify"]])
def test_ctrl_c_while_modules_are_imported(tmp_path, words):
    """No traceback from a command; a program that imports vcal sees its own exception."""
    # A module that is imported early waits until it is interrupted.
    (tmp_path / "jax.py").write_text("import time\nprint('waiting', flush=True)\ntime.sleep(60)\n")
    package = str(Path(vcal.__file__).parents[1])
    # Tests in the background of a shell ignore it, and so would a process that they start.
    own = signal.signal(signal.SIGINT, signal.default_int_handler)
    found = subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), package])},
    )
    signal.signal(signal.SIGINT, own)
    assert found.stdout.readline() == "waiting\n"
    found.send_signal(signal.SIGINT)
    _, told = found.communicate(timeout=30)
    if words[0] == "-m":
        assert (found.returncode, told) == (130, "vcal: interrupted\n")
    else:
        assert "KeyboardInterrupt" in told


@pytest.mark.parametrize(
    ("before", "after"),
    [("enable", "True False"), ("disable", "False False"), ("freeze", "True True")],
)
@pytest.mark.thorough
def test_importing_leaves_the_collector_as_it_was(before, after):
    code = (
        f"import gc; gc.{before}(); import vcal; vcal.identify; "
        "print(gc.isenabled(), gc.get_freeze_count() > 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == after


@pytest.mark.parametrize(("argument", "given", "expected"), [
    (["-m", "vcal", "effects"], None, "1"), (["-m", "vcal", "effects"], "3", "3"),
    (["-c", "import vcal; vcal.identify"], None, "None"),
])  # fmt: skip
@pytest.mark.thorough
def test_a_command_has_one_thread_for_linear_algebra_unless_it_is_told(
    tmp_path, argument, given, expected
):
    (tmp_path / "jax.py").write_text(
        "import os\nprint(os.environ.get('OPENBLAS_NUM_THREADS'), flush=True)\nos._exit(0)\n"
    )
    kept = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    path = os.pathsep.join([str(tmp_path), str(Path(vcal.__file__).parents[1])])
    more = {"OPENBLAS_NUM_THREADS": given} if given else {}
    done = subprocess.run(
        [sys.executable, *argument],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**kept, **more, "PYTHONPATH": path},
    )
    assert done.stdout.strip() == expected


def test_compilations_are_counted():
    """Also those that are in the cache: what is shown is empty again at the end."""
    shown = []
    with compiling(shown.append):
        jax.jit(lambda x: x * 0.75 + 0.5)(1.0)
    assert "compiling program 1" in shown and shown[-1] == ""
    before = len(shown)
    jax.jit(lambda x: x - 0.25)(1.0)
    assert len(shown) == before
