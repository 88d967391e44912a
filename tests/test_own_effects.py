"""Effects of a user's own file that cannot be used, and searches that could test nothing."""

import dataclasses
import re
import sys
import typing
from functools import partial

import numpy as np
import pytest

import vcal.study.close_study
from designing import run, run_trusted
from vcal.effects.registry import load_effects
from vcal.errors import StudyError
from vcal.loop.screening.candidates import UntestableError
from vcal.model.measurement import Measurement
from vcal.report.html.folder import ReportFolder
from vcal.study import read_table, write_table
from vcal.study.close_study import close_study
from vcal.study.simulated import parse_with

load_study = partial(vcal.load_study, trust=True)

OWN = '''\
import vcal


class QuillSag(vcal.Effect):
    """The quill sags in proportion to its overhang."""

    name = "quill_sag"

    @property
    def parameters(self):
        return (vcal.Parameter("k", "um/m", sigma=20.0),)

    @property
    def needs(self):
        return ("Z",)

    def response(self, plan, shape):
        return {("EYZ", "k"): plan.x("Z")}

    @classmethod
    def candidates(cls, setup):
        yield cls(placement="Z")
'''
RESPONSE, PARAMETERS = (
    'return {("EYZ", "k"): plan.x("Z")}',
    '(vcal.Parameter("k", "um/m", sigma=20.0),)',
)
SHAPE = '(vcal.Parameter("k", "um", sigma=5.0), vcal.Parameter("at", "mm", shape=True))'
WRONG = {
    "no dict": (RESPONSE, "return None", "response: found NoneType, expected a dict"),
    "two values": (RESPONSE, 'return {("EYZ", "k"): [1.0, 2.0]}', "one number for each of the 48"),
    "unknown port": (
        RESPONSE,
        'return {("EYQ", "k"): plan.x("Z")}',
        "the port 'EYQ', expected",
    ),
    "unknown parameter": (RESPONSE, 'return {("EYZ", "q"): plan.x("Z")}', "the parameter 'q'"),
    "no pair": (RESPONSE, 'return {"EYZ": plan.x("Z")}', "the key 'EYZ', expected (port, param"),
    "not finite": (RESPONSE, 'return {("EYZ", "k"): plan.x("Z") * float("nan")}', "nan for"),
    "misspelled": (RESPONSE, 'return plan.nosuch("Z")', "response: found AttributeError: "),
    "unknown axis": (RESPONSE, 'return {("EYZ", "k"): plan.x("W")}', "response: found ValueError"),
    "unknown unit": ('"um/m"', '"furlong"', "parameters: found k: unit 'furlong'"),
    "negative sigma": ("sigma=20.0", "sigma=-20.0", "a sigma of at least 0"),
    "text for a parameter": (PARAMETERS, '("k",)', "parameters: found ('k',), expected a tuple"),
    "no parameters": ("def parameters", "def parametres", "body: found no parameters"),
    "no candidates": ('yield cls(placement="Z")', "return None", "candidates: found TypeError"),
    "no scan": (PARAMETERS, SHAPE, "scan: found no numbers for at"),
    "needs a text": ('return ("Z",)', 'return "Z"', "needs: found 'Z', expected a tuple"),
    "needs nothing": ('return ("Z",)', "return None", "needs: found None, expected a tuple"),
    "text for a sigma": ("sigma=20.0", 'sigma="20"', "sigma = '20' of 'k', expected a number"),
    "a number for a name": ('Parameter("k"', "Parameter(3", "name = 3 of 3, expected a name in"),
    "no unit": ('"um/m"', "None", "unit = None of 'k', expected a unit in quotes"),
    "a key for a parameter": (
        PARAMETERS,
        '(vcal.Parameter("placement", "1"),)',
        "parameters: found the name 'placement', expected letters",
    ),
    "unknown kind": ('name = "quill_sag"', 'name = "q"; kind = "bias"', "kind: found 'bias', exp"),
    "no odds": ('name = "quill_sag"', 'name = "q"; odds = 0', "odds: found 0, expected a number"),
    "scan without a dict": (
        PARAMETERS,
        SHAPE + "\n\n    def scan(self, plan):\n        return [1.0]",
        "scan: found list, expected a dict {shape: values}",
    ),
    "scan of texts": (
        PARAMETERS,
        SHAPE + '\n\n    def scan(self, plan):\n        return {"at": ["a"]}',
        "scan: found no numbers for at",
    ),
    "a colon in a place": ('="Z")', '="Z:1")', "candidates: found the placement 'Z:1', expected"),
    "a value for a place": ('="Z")', '="a=b")', "candidates: found the placement 'a=b', expected"),
    "a place of two lines": ('="Z")', '="a\\nb")', "found the placement 'a\\nb', expected a line"),
    "a number for a place": ('="Z")', "=3)", "candidates: found the placement 3, expected a line"),
    "no effect": ('yield cls(placement="Z")', "yield 3", "candidates: found 3, expected effects"),
}
AT = f"""{SHAPE}

    def scan(self, plan):
        return {{"at": [0.01, 0.02, 0.03]}}
"""
OF_A_SHAPE = {
    "numpy": ("np.sin(plan.x('Z') / shape['at'])", "found TracerArrayConversionError: "),
    "first": (
        "plan.x('Z') / float(np.ravel(shape['at'])[0])",
        "found TracerArrayConversionError: ",
    ),
    "condition": ("plan.x('Z') * (1 if shape['at'] > 0 else -1)", "found ValueError: The truth"),
    "no column": (
        "plan.x('Z') / np.resize(shape['at'], plan.rows - 1 if np.ndim(shape['at']) else ())",
        "found ValueError: operands could not be broadcast",
    ),
    "right": ("jnp.sin(plan.x('Z') / shape['at'])", ""),
    "either": ("namespace(shape['at']).sin(plan.x('Z') / shape['at'])", ""),
}


def with_own(folder, text):
    (folder / "own.py").write_text(text, encoding="utf-8")
    path = folder / "setup.toml"
    text = path.read_text(encoding="utf-8") + '\n[model]\neffects_file = "own.py"\n'
    path.write_text(text, encoding="utf-8")
    return folder


RUNS = "from pathlib import Path\n(Path(__file__).parent / 'was_run').write_text('yes')\n"


@pytest.mark.parametrize(
    "command",
    [
        ("check",),
        *((verb, "--out", "out") for verb in ("loop", "simulate", "uncertainty", "design")),
    ],
)
@pytest.mark.parametrize("key", ["model.effects_file", "instrument.kind_file"])
def test_a_file_that_is_only_named_is_not_run(
    small_tracker_study, tmp_path, monkeypatch, command, key
):
    """Whoever checks a study of somebody else has not asked for that."""
    monkeypatch.chdir(tmp_path)
    (small_tracker_study / "own.py").write_text(RUNS + OWN, encoding="utf-8")
    verb, *options = command
    told = run(verb, small_tracker_study, *options, "--set", f"{key}=own.py", code=2).stderr
    assert told.startswith("vcal: own.py, file: found Python code with ")
    assert "repeat the command with --trust (in Python: load_study(..., trust=True))" in told
    assert not (small_tracker_study / "was_run").exists() and not (tmp_path / "out").exists()


@pytest.mark.thorough
def test_a_file_that_is_trusted_is_run(small_tracker_study):
    (small_tracker_study / "own.py").write_text(RUNS + OWN, encoding="utf-8")
    own = ("--set", "model.effects_file=own.py")
    assert "quill_sag" in run_trusted("check", small_tracker_study, *own).stdout
    assert (small_tracker_study / "was_run").exists()
    with pytest.raises(StudyError, match="permission to run it"):
        vcal.load_study(small_tracker_study, ["model.effects_file=own.py"])


@pytest.mark.parametrize("case", WRONG)
def test_a_class_that_cannot_be_used(small_tracker_study, case):
    old, new, expected = WRONG[case]
    assert old in OWN
    with pytest.raises(StudyError) as caught:
        load_study(with_own(small_tracker_study, OWN.replace(old, new)))
    message = str(caught.value)
    assert message.startswith("own.py, class QuillSag, ") and message.endswith("correct the class")
    assert expected in message


@pytest.mark.parametrize("case", OF_A_SHAPE)
def test_what_is_made_of_a_shape(small_tracker_study, case):
    """It is evaluated for a whole grid at once, and traced."""
    made, expected = OF_A_SHAPE[case]
    text = (
        "import jax.numpy as jnp\nimport numpy as np\nfrom vcal.numerics.arrays import namespace\n"
        + OWN
    )
    text = text.replace(PARAMETERS, AT).replace('plan.x("Z")}', made + "}")
    folder = with_own(small_tracker_study, text)
    if not expected:
        assert "quill_sag" in load_study(folder).catalogue
        return
    with pytest.raises(StudyError) as caught:
        load_study(folder)
    message = str(caught.value)
    assert message.startswith(f"own.py, class QuillSag, response: {expected}")
    assert message.endswith("correct the class") and "\n" not in message


def test_a_class_that_can(small_tracker_study):
    assert "quill_sag" in load_study(with_own(small_tracker_study, OWN)).catalogue


def of_a_column(folder, column, unit, response):
    """A study with a column of its own, and an effect that depends on it."""
    table = read_table(folder / "data.csv", [])
    values = 40.0 + 5.0 * np.sin(np.arange(len(table["x_mm"])))
    write_table(folder / "data.csv", {**table, column: values})
    text = OWN.replace('return ("Z",)', f'return ("Z", "{column}")').replace('"um/m"', f'"{unit}"')
    return with_own(folder, text.replace('plan.x("Z")}', response + "}"))


@pytest.mark.parametrize(
    ("column", "unit", "factor"),
    [
        ("humidity_pct", "um/%", "0.01"),
        ("gap_mm", "um/mm", "0.001"),
        ("gap_mm", "um/m", "0.001"),  # a length is a length
        ("feed_mm_per_s", "um s/mm", "0.001"),
    ],
)
@pytest.mark.parametrize("response", ["{}", "-{}", "{} - 40.0"])
def test_a_column_in_another_unit_than_its_parameter(
    small_tracker_study, column, unit, factor, response
):
    """The parameter is converted to SI, the column is not."""
    told = f"found the numbers of the column {column} in "
    values = response.format(f'plan.covariate("{column}")')
    with pytest.raises(StudyError, match=re.escape(told)) as caught:
        load_study(of_a_column(small_tracker_study, column, unit, values))
    assert f"expected {factor} times these numbers" in str(caught.value)


@pytest.mark.parametrize(
    ("column", "unit", "response", "said"),
    [
        ("humidity_pct", "um/%", "0.01 * {}", ""),
        ("humidity_pct", "um", "{}", ""),  # per nothing of its kind
        ("load_N", "um/N", "{}", ""),  # SI already
        ("humidity_pct", "um/%", 'plan.x("Z") * {}', "multiply the column by 0.01"),
    ],
)
def test_a_column_that_may_be_converted(small_tracker_study, column, unit, response, said):
    values = response.format(f'plan.covariate("{column}")')
    folder = of_a_column(small_tracker_study, column, unit, values)
    printed = " ".join(run_trusted("check", folder).output.split())
    assert (said in printed) if said else "multiply the column" not in printed


def test_units_that_are_unknown_are_refused_where_they_are_written():
    with pytest.raises(StudyError, match=r"gain: unit 'um/pct': found 'pct', expected one of"):
        vcal.Parameter("gain", "um/pct")


def test_an_unknown_unit_in_every_command(small_tracker_study, tmp_path):
    folder = with_own(small_tracker_study, OWN.replace('"um/m"', '"um/pct"'))
    for more in (("check", folder), ("loop", folder, "--out", tmp_path / "out")):
        told = run_trusted(*more, code=2).stderr
        assert "own.py, class QuillSag, parameters: found k: unit 'um/pct': found 'pct'" in told


def test_annotations_that_are_text(small_tracker_study):
    """Dataclasses look them up in the module, which therefore has to be among the others."""
    text = "from __future__ import annotations\n\nfrom typing import ClassVar\n" + OWN.replace(
        '    name = "quill_sag"\n',
        '    name: ClassVar[str] = "quill_sag"\n    overhang: float = 2.0\n',
    )
    kind = load_study(with_own(small_tracker_study, text)).catalogue["quill_sag"]
    assert [f.name for f in dataclasses.fields(kind)][-1] == "overhang"
    hints = typing.get_type_hints(kind)
    assert hints["overhang"] is float and hints["name"] == typing.ClassVar[str]


def test_files_of_one_name_stay_apart(tmp_path):
    kinds = []
    for i in range(2):
        path = tmp_path / str(i) / "own.py"
        path.parent.mkdir()
        path.write_text(OWN.replace("import vcal", f"import vcal\n\nNUMBER = {i}"))
        kinds += load_effects(path)
    modules = [sys.modules[kind.__module__] for kind in kinds]
    assert [module.NUMBER for module in modules] == [0, 1]
    assert [module.QuillSag for module in modules] == kinds
    path.write_text("NUMBER = 2\nraise ValueError")
    before = dict(sys.modules)
    with pytest.raises(StudyError, match="cannot be run: ValueError"):
        load_effects(path)
    assert sys.modules == before
    path.rename(tmp_path / "other.py")
    with pytest.raises(StudyError, match="cannot be run: ValueError"):
        load_effects(tmp_path / "other.py")
    assert sys.modules == before


ENDS = {
    "sys.exit": ("import sys\nsys.exit(3)", "SystemExit: 3"),
    "exit": ("exit()", "SystemExit: None"),
    "another end": ("class End(BaseException): pass\nraise End('no')", "End: no"),
}


@pytest.mark.parametrize("way", ENDS)
def test_a_file_that_ends_the_program(small_tracker_study, way):
    text, said = ENDS[way]
    folder = with_own(small_tracker_study, f"{OWN}\n{text}\n")
    with pytest.raises(StudyError, match=re.escape(f"own.py: cannot be run: {said}")):
        load_study(folder)


def test_an_interruption_is_none_of_the_file(small_tracker_study):
    folder = with_own(small_tracker_study, OWN + "\nraise KeyboardInterrupt\n")
    with pytest.raises(KeyboardInterrupt):
        load_study(folder)


@pytest.mark.parametrize("method", ["response", "candidates"])
def test_a_method_that_ends_the_program(small_tracker_study, method):
    """As it is tried, and as it is looked for a place for it where it is declared."""
    text = re.sub(rf"(def {method}\(.*\n)", r"\1        exit(0)\n", OWN)
    assert text != OWN
    folder = with_own(small_tracker_study, text)
    told = run_trusted("check", folder, code=2).stderr
    assert "own.py, " in told and f"{method}: found SystemExit: 0 (line " in told
    if method == "candidates":
        with open(folder / "setup.toml", "a", encoding="utf-8") as file:
            file.write('\n[[model.effect]]\nname = "quill_sag"\n')
        told = run_trusted("check", folder, code=2).stderr
        assert "candidates: found SystemExit: 0 (line " in told


def test_a_file_in_the_folder_of_the_report(small_tracker_study, monkeypatch):
    """Started from that of an earlier report: neither edited nor as it was left may it go."""

    def unexpected(*args, **kwargs):
        raise AssertionError("the loop was run")

    monkeypatch.setattr(vcal.study.close_study, "close_loop", unexpected)
    out = small_tracker_study / "out"

    def make(work):
        (work / "own_effect.py").write_text(OWN, encoding="utf-8")
        (work / "report.json").write_text('{"schema": "vcal-report/1", "files": ["own_effect.py"]}')
        return ["own_effect.py", "report.json"]

    ReportFolder(record="report.json", schema="vcal-report/").fill(out, make)
    setup = small_tracker_study / "setup.toml"
    text = setup.read_text(encoding="utf-8") + '\n[model]\neffects_file = "out/own_effect.py"\n'
    setup.write_text(text, encoding="utf-8")
    told = run_trusted("loop", setup, "--out", out, code=2).stderr
    assert f"{out}, output folder: found own_effect.py, which the study reads, expected" in told
    (out / "own_effect.py").write_text(OWN + "# mine\n", encoding="utf-8")
    told = run_trusted("loop", setup, "--out", out, code=2).stderr
    assert f"{out}, output folder: found own_effect.py, not as the earlier report left it" in told
    assert "rename or move what is to be kept, or choose another folder" in told
    assert (out / "own_effect.py").read_text(encoding="utf-8") == OWN + "# mine\n"


# --- what is to be tried --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effects", "expected"),
    [
        ([], "key loop.effects: found [], expected at least 1"),
        (["repeatability"], "found 'repeatability', which can only be declared"),
        (["backlash:Y"], "found 'backlash:Y', expected the name alone, 'backlash'"),
        (["backlsh"], "did you mean 'backlash'?"),
    ],
)
def test_effects_that_cannot_be_tried(small_tracker_study, effects, expected):
    text = "[" + ", ".join(f'"{name}"' for name in effects) + "]"
    with pytest.raises(StudyError) as caught:
        load_study(small_tracker_study, [f"loop.effects={text}"])
    assert expected in str(caught.value)
    assert str(caught.value).startswith(f"setup.toml (override loop.effects={text}), key ")


def test_none_of_the_effects_can_be_tested(small_tracker_study):
    study = load_study(small_tracker_study, ['loop.effects=["spindle_growth"]'])
    expected = r"found none that could be tested \(spindle_growth: the data have no speed_rpm\)"
    with pytest.raises(StudyError, match=expected):
        close_study(study, study.measurement, lambda text: None)
    texts = []
    with pytest.raises(UntestableError, match="the data have no speed_rpm") as caught:
        vcal.close_loop(
            study.model,
            study.measurement,
            effects=study.tried,
            require_testable=True,
            progress=texts.append,
        )
    assert texts == [] and [one.effect for one in caught.value.untestable] == ["spindle_growth"]


def test_equations_without_a_solution_may_be_due_to_either_file(small_tracker_study, monkeypatch):
    def unsolvable(*args, **kwargs):
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(vcal.study.close_study, "close_loop", unsolvable)
    study = load_study(small_tracker_study)
    with pytest.raises(StudyError) as caught:
        close_study(study, study.measurement, lambda text: None)
    told = str(caught.value)
    assert told.startswith("data.csv, setup.toml, columns of positions and readings, tables ")
    assert "declared noise, errors and effects of the size that they have" in told


def edited(folder, column, change, file="data.csv"):
    path = folder / file
    head, *rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    place = head.index(column)
    for row in rows:
        row[place] = change(row[place])
    path.write_text("\n".join(",".join(row) for row in (head, *rows)) + "\n", encoding="utf-8")


@pytest.mark.campaign
def test_what_does_not_vary_is_not_said_to_be_absent(small_tracker_study):
    for axis in "xyz":
        edited(small_tracker_study, f"T_{axis}_degC", lambda cell: "20")
    study = load_study(small_tracker_study, ['loop.effects=["scale_growth"]', "loop.draws=25"])
    closure = close_study(study, study.measurement, lambda text: None)
    assert closure.sentence.startswith("Nothing could be tested")


# --- readings and positions that cannot be --------------------------------------------------------


def test_positions_in_metres(small_tracker_study):
    for axis in "xyz":
        edited(small_tracker_study, f"{axis}_mm", lambda cell: f"{float(cell) / 1000:.9g}")
    with pytest.raises(StudyError, match=r"data.csv, columns x_mm, y_mm, z_mm: found positions"):
        load_study(small_tracker_study)


def test_readings_that_are_all_the_same(small_tracker_study):
    for name in ("range_mm", "azimuth_rad", "elevation_rad"):
        edited(small_tracker_study, name, lambda cell: "1")
    with pytest.raises(StudyError, match="found the same numbers in every row"):
        load_study(small_tracker_study)


def test_a_column_that_effects_ask_for_holds_numbers(small_tracker_study):
    edited(small_tracker_study, "T_x_degC", lambda cell: "5 kg")
    path = small_tracker_study / "data.csv"
    path.write_text(path.read_text().replace("T_x_degC", "payload_kg", 1))
    with pytest.raises(StudyError, match="row 1 .*column payload_kg: found '5 kg', expected a num"):
        load_study(small_tracker_study)


def test_too_few_check_points(small_tracker_study):
    columns = "x_mm,y_mm,z_mm,tcp_x_mm,tcp_y_mm,tcp_z_mm"
    rows = ["100,100,100,100,100,-50", "200,100,100,200,100,-50"]
    for count in (1, 2):
        text = "\n".join([columns, *rows[:count]]) + "\n"
        (small_tracker_study / "check.csv").write_text(text)
        with pytest.raises(StudyError, match=rf"check.csv.*found {count} check .*at least 3"):
            load_study(small_tracker_study)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "backlash:Y:size_um=1e308",
            "found 1e308, expected zero, or a number from 1e-15 to 1e+15",
        ),
        ("screw_cyclic:Y:pitch_mm=0", "key pitch_mm (screw_cyclic): found 0, expected a number gr"),
    ],
)
def test_a_size_that_nothing_has(small_tracker_study, text, message):
    study = load_study(small_tracker_study)
    setup = study.model.setup(study.plan)
    with pytest.raises(StudyError, match=re.escape(message)):
        parse_with(text, study.catalogue, setup)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_size_that_is_no_number(small_tracker_study, value):
    study = load_study(small_tracker_study)
    setup = study.model.setup(study.plan)
    with pytest.raises(StudyError, match=f"key size_um: found {value}, expected a finite number"):
        parse_with(f"backlash:Y:size_um={value}", study.catalogue, setup)
    assert np.isfinite(study.measurement.readings).all()


def test_columns_that_were_exchanged(small_tracker_study):
    path = small_tracker_study / "data.csv"
    head, rows = path.read_text(encoding="utf-8").split("\n", 1)
    exchanged = {"azimuth_rad": "elevation_rad", "elevation_rad": "azimuth_rad"}
    head = ",".join(exchanged.get(name, name) for name in head.split(","))
    path.write_text(f"{head}\n{rows}", encoding="utf-8")
    with pytest.raises(StudyError, match="away from the tool point"):
        load_study(small_tracker_study)


@pytest.mark.campaign
def test_readings_that_were_exchanged_in_a_program(small_tracker_study):
    """Nothing refuses them there; the result tells."""
    study = load_study(small_tracker_study, ["loop.draws=25", 'loop.effects=["backlash"]'])
    exchanged = study.measurement.readings[:, [0, 2, 1]]
    closure = close_study(study, Measurement(study.plan, exchanged), lambda text: None)
    assert any("mm, larger than any machine error" in note for note in closure.notes)


@pytest.mark.parametrize(
    ("column", "change", "said"),
    [
        ("azimuth_rad", lambda cell: str(-float(cell)), "the readings are a mirror image of that"),
        ("x_mm", lambda cell: str(2000.0 - float(cell)), "the readings are a mirror image of that"),
        ("azimuth_rad", lambda cell: str(float(cell) * 0.9), "degrees instead of gon in azimuth_r"),
        ("azimuth_rad", lambda cell: str(float(cell) * 1.9), "compare signs, units and order"),
    ],
)
def test_readings_that_do_not_follow_linear_axes(small_tracker_study, column, change, said):
    """An azimuth that counts clockwise, or an axis that counts the other way: geometry has room to
    take in what it must not.
    """
    edited(small_tracker_study, column, change)
    with pytest.raises(StudyError, match=f"away from the tool point.*{said}"):
        load_study(small_tracker_study)


def test_what_is_there_twice(small_tracker_study):
    path = small_tracker_study / "setup.toml"
    row = '\n[[model.effect]]\nname = "backlash"\nplacement = "Y"\nsize_um = 3\n'
    text = path.read_text(encoding="utf-8")
    path.write_text(text + row + row, encoding="utf-8")
    with pytest.raises(StudyError, match="the same effect at the same place a second time"):
        load_study(small_tracker_study)
    path.write_text(text + '\n[data]\ndata = "."\n', encoding="utf-8")
    with pytest.raises(StudyError, match="found a folder, expected a CSV table"):
        load_study(small_tracker_study)
