"""Instruments of a user's own: the circular master beside, and files that cannot be used."""

import json
import re
import shutil
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

import vcal
from conftest import write_csv
from designing import run_trusted
from vcal.cli.start_studies import STARTS
from vcal.effects import CATALOGUE
from vcal.errors import StudyError
from vcal.instruments import INSTRUMENTS
from vcal.loop.screening.significance import LEAST_NOISE
from vcal.loop.search.state import fitted
from vcal.model.simulate import simulate
from vcal.study.plugins.instrument_trial import check_clusters
from vcal.study.plugins.trial import Trial
from vcal.study.simulated import parse_with, write_simulated

load_study = partial(vcal.load_study, trust=True)

EXAMPLE = Path(__file__).parent / "own_instrument"
DISC = (EXAMPLE / "disc_probe.py").read_text(encoding="utf-8")
PLANES = ((0, 1), (1, 2), (2, 0))


def circles(planes=PLANES, points=36):
    """Columns of circles about one place, once in either direction in every plane."""
    runs = []
    for first, second in planes:
        for sense in (1, -1):
            at = sense * 2.0 * np.pi * (np.arange(points) + 0.5) / points
            place, way = np.tile([300.0, 250.0, 225.0], (points, 1)), np.ones((points, 3))
            place[:, first] += 150.0 * np.cos(at)
            place[:, second] += 150.0 * np.sin(at)
            way[:, first] = np.sign(-sense * np.sin(at))
            way[:, second] = np.sign(sense * np.cos(at))
            runs.append((np.full(points, len(runs)), place, way))
    run, place, way = (np.concatenate(part) for part in zip(*runs, strict=True))
    columns = {"run": run} | {f"{c}_mm": place[:, i] for i, c in enumerate("xyz")}
    return columns | {f"dir_{c}": way[:, i] for i, c in enumerate("xyz")}


def write_disc(folder, columns, text=DISC):
    folder.mkdir(parents=True)
    shutil.copy(EXAMPLE / "setup.toml", folder)
    (folder / "disc_probe.py").write_text(text, encoding="utf-8")
    write_csv(folder / "data.csv", columns)
    return folder


@pytest.fixture
def small(tmp_path):
    """Two circles in one plane, a plan."""
    return write_disc(tmp_path / "small", circles(PLANES[:1], 12))


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    return write_disc(tmp_path_factory.mktemp("plan") / "disc", circles())


@pytest.fixture(scope="module")
def study(plan):
    return load_study(plan)


@pytest.fixture(autouse=True)
def _programs_of_the_tests(monkeypatch):
    """Commands keep their compiled programs where the tests do."""
    monkeypatch.setenv("VCAL_NO_CACHE", "1")


# --- what it finds --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loose(study, tmp_path_factory):
    """Data of a machine with backlash, in a folder of its own."""
    folder = tmp_path_factory.mktemp("loose") / "data"
    there = parse_with("backlash:Y:size_um=6", study.catalogue, study.model.setup(study.plan))
    write_simulated(study, folder, effects=[there], seed=3)
    return folder


@pytest.mark.thorough
def test_its_one_reading_is_counted_as_one(loose):
    assert "216 rows of 1 reading\n" in re.sub(" +\n", "\n", run_trusted("check", loose).output)


@pytest.mark.thorough
def test_backlash_in_circles(loose):
    assert (loose / "disc_probe.py").read_text(encoding="utf-8") == DISC
    study = load_study(loose)
    assert "disc_probe.py" in study.hashes
    closure = vcal.close_loop(study.model, study.measurement, draws=100)
    assert closure.verdict == "named"
    (found,) = closure.effects
    ((name, size, unit, u),) = found.parameters
    assert (found.effect.key, name, unit) == ("backlash Y", "size", "um")
    assert abs(size - 6.0) < 3.0 * u < 1.0
    before, after = (closure.errors[k].heldout.value for k in ("before", "after"))
    assert after < 0.5 < before


@pytest.mark.campaign
def test_report(loose, tmp_path):
    run_trusted("loop", loose, "--out", tmp_path / "report", "--set", "loop.draws=100")
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["verdict"] == "named" and "disc_probe.py" in report["input_files"]
    assert [(e["effect"], e["placement"]) for e in report["effects"]] == [("backlash", "Y")]


def test_nothing_is_found_where_nothing_is_missing(study):
    drawn = simulate(study.model, study.plan, jax.random.key(3))
    closure = vcal.close_loop(study.model, drawn.measurement, draws=100)
    assert closure.verdict == "nothing_missing" and not closure.effects


def test_centres_and_radius_are_found(study):
    """The disc stands elsewhere than commanded."""
    model = study.model
    keys = [f"{e.key} {e.parameter.name}" for e in model.entries]
    truth = np.zeros(len(keys))
    steps = np.array([e.parameter.step for e in model.entries])
    for key, value in {"disc_centre 0.X": 30e-6, "disc_centre 2.Z": -20e-6}.items():
        truth[keys.index(key)] = value / steps[keys.index(key)]
    readings = np.asarray(vcal.predict(model, study.plan, truth))
    at = study.plan.values("run") == 0
    across = (np.asarray(study.plan.x("X")) - 0.3) / 0.15
    assert np.allclose(readings[at, 0], -30e-6 * across[at], atol=1e-8)
    fit = vcal.identify(model, vcal.Measurement(study.plan, readings, ""))
    assert np.allclose((fit.theta * steps)[:], truth * steps, atol=1e-9)
    # Across the plane of a circle, nothing is seen: there is no such parameter.
    assert "disc_centre 0.Z" not in keys and "disc_centre 2.X" not in keys


def test_folds_are_parts_of_every_circle(study):
    folds, apart = study.instrument.folds(study.plan)
    assert apart is False and np.bincount(folds).tolist() == [48, 42, 42, 42, 42]


def test_a_row_beside_its_circle(small):
    with pytest.raises(StudyError) as caught:
        load_study(small, ["instrument.radius_mm=145"])
    message = str(caught.value)
    assert message.startswith("data.csv, row ") and "5 mm beside the circle of run 0" in message


def test_keys_and_columns_are_checked(small):
    assert load_study(small, ["instrument.sigma_um=2"]).instrument.sigma == pytest.approx(2e-6)
    with pytest.raises(StudyError, match="'raduis_mm' .did you mean 'radius_mm'"):
        load_study(small, ["instrument.raduis_mm=150"])
    with pytest.raises(StudyError, match=r"key instrument.sigma_um: found -1, expected a number g"):
        load_study(small, ["instrument.sigma_um=-1"])
    write_csv(small / "data.csv", circles(PLANES[:1], 12) | {"deviation_um": np.full(24, 5000.0)})
    with pytest.raises(StudyError, match="column deviation_um: found 5000, expected a number fr"):
        load_study(small)


CLUSTERS = {
    "one row each": "np.arange(plan.rows)",
    "pairs": "np.arange(plan.rows) // 2",
    "runs": 'np.asarray(plan.groups["run"])',
}


def clustered(folder, indices, columns):
    method = f"    def clusters(self, plan):\n        return {indices}\n\n    def folds("
    return write_disc(folder, columns, DISC.replace("    def folds(", method))


@pytest.mark.thorough
@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("indices", CLUSTERS)
def test_the_noise_of_clusters_is_told_by_enough_rows(tmp_path, indices, noise):
    """One row says nothing of how it scatters: its noise is the declared one."""
    study = load_study(clustered(tmp_path / "plan", CLUSTERS[indices], circles()))
    there = parse_with("backlash:Y:size_um=60", study.catalogue, study.model.setup(study.plan))
    write_simulated(study, tmp_path / "data", effects=[there], seed=3, noise_factor=noise)
    study = load_study(tmp_path / "data")
    state = fitted(study.model, study.measurement, None, 0)
    used = state.scored.used
    ratio = (state.scored.whitener / state.fit.whitener)[used]
    if indices == "runs":
        assert ratio.min() < 0.5  # of what is missing
    else:
        assert (ratio == 1.0).all()
    model = study.model.with_effects(there)
    state = fitted(model, study.measurement, None, 0)
    assert (state.scored.whitener <= 1.01 / LEAST_NOISE * state.fit.whitener).all()
    assert np.isfinite(state.scored.covariance).all()


def test_rows_of_a_cluster_have_the_same_readings():
    trial, present = Trial("own.py", "Own"), np.array([[True, True], [True, True], [True, False]])
    check_clusters(trial, np.array([0, 0, 1]), present)
    check_clusters(trial, np.array([0, 0, -1]), present)
    with pytest.raises(StudyError, match="clusters: found rows 1 and 3 under one index, 4, with o"):
        check_clusters(trial, np.array([4, -1, 4]), present)


# --- commands -------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_commands(small, tmp_path):
    (small / "code").mkdir()
    shutil.move(small / "disc_probe.py", small / "code" / "disc.py")
    moved = ("--set", "instrument.kind_file=code/disc.py")
    assert "disc_probe" in run_trusted("check", small, *moved).stdout
    out = tmp_path / "out"
    run_trusted("simulate", small, "--out", out, *moved)
    assert (out / "code" / "disc.py").read_text(encoding="utf-8") == DISC
    assert load_study(out).measurement is not None
    told = run_trusted("design", small, "--out", tmp_path / "design", *moved, code=2).stderr
    assert "'disc_probe', for which no design space exists" in told
    shutil.move(small / "code" / "disc.py", small.parent / "disc.py")
    outside = ("--set", "instrument.kind_file=../disc.py")
    told = run_trusted("simulate", small, "--out", tmp_path / "no", *outside, code=2).stderr
    assert "outside the folder of the study" in told


@pytest.mark.campaign
def test_uncertainty_before_measuring(small, tmp_path):
    told = run_trusted("uncertainty", small, "--out", tmp_path / "out", "--draws", 200).stdout
    assert "the rms volumetric error" in told


@pytest.mark.thorough
def test_what_fails_later_is_told_in_one_line(small, tmp_path):
    text = DISC.replace(
        "return {**linear_plan_table(plan)",
        "assert np.ptp(readings) < 1e-9\n        return {**linear_plan_table(plan)",
    )
    (small / "disc_probe.py").write_text(text, encoding="utf-8")
    told = run_trusted("simulate", small, "--out", tmp_path / "out", code=2).stderr
    assert re.fullmatch(
        r"vcal: disc_probe.py, to_table: found AssertionError \(line \d+\), expected code that runs"
        "; correct the class\n",
        told,
    )
    assert not (tmp_path / "out").exists()


# --- several --------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_studies_stay_apart(tmp_path):
    """Of one kind in different files; read again and again; what they register is forgotten."""
    again = "from vcal.instruments.base import register\n" + DISC.replace(
        "class DiscProbe", "@vcal.register\nclass Mine(DiscRadius):\n    name = 'mine'\n\n\n"
        "@register\nclass DiscProbe",
    )  # fmt: skip
    columns = circles(PLANES[:1], 12)
    one = write_disc(tmp_path / "one", columns)
    two = write_disc(tmp_path / "two", columns, again.replace('summary = "error', 'summary = "two'))
    known, effects = dict(INSTRUMENTS), dict(CATALOGUE)
    for _ in range(2):
        texts = [load_study(folder).model.effects[-1].summary[:5] for folder in (one, two)]
        assert texts == ["error", "two o"]
        assert known == INSTRUMENTS and effects == CATALOGUE
    with pytest.raises(StudyError, match="unknown instrument 'disc_probe'"):
        write = (one / "setup.toml").read_text().replace('kind_file = "disc_probe.py"', "")
        (one / "setup.toml").write_text(write)
        load_study(one)


TURNING = (
    'machine.chain="w C b X Y Z t"',
    "machine.rotary.C={at_mm=[300, 250, 0], travel_deg=[0, 360]}",
)


def test_rotary_axes_are_for_those_who_say_so(small):
    write_csv(small / "data.csv", circles(PLANES[:1], 12) | {"c_deg": np.zeros(24)})
    with pytest.raises(StudyError, match="'disc_probe' on a machine with 'w C b X Y Z t'"):
        load_study(small, TURNING)
    text = DISC.replace('kind = "disc_probe"', 'kind = "disc_probe"\n    rotary = True')
    (small / "disc_probe.py").write_text(text, encoding="utf-8")
    assert load_study(small, TURNING).plan.axes == ("X", "Y", "Z", "C")
    (small / "disc_probe.py").write_text(text.replace("= True", "= 1"), encoding="utf-8")
    with pytest.raises(StudyError, match="rotary: found 1, expected True or False"):
        load_study(small, TURNING)


def test_annotations_that_are_text(small):
    text = "from __future__ import annotations\n\n" + DISC
    (small / "disc_probe.py").write_text(text, encoding="utf-8")
    assert load_study(small).instrument.radius == 0.15


QUICK = ("laser_tracker", "laser_frame")
KINDS = [k if k in QUICK else pytest.param(k, marks=pytest.mark.thorough) for k in INSTRUMENTS]


@pytest.mark.campaign
@pytest.mark.parametrize("kind", KINDS)
def test_a_class_of_ones_own_after_one_that_is_there(tmp_path, kind):
    """What the instruments of vcal do passes for what is asked of others."""
    folder, base = tmp_path / kind, INSTRUMENTS[kind]
    shutil.copytree(STARTS / kind, folder)
    own = f"from {base.__module__} import {base.__name__}\n\n\n"
    own += f'class Mine({base.__name__}):\n    kind = "mine"\n'
    (folder / "mine.py").write_text(own, encoding="utf-8")
    old = load_study(folder)
    new = load_study(folder, ["instrument.kind=mine", "instrument.kind_file=mine.py"])
    assert type(new.instrument).__name__ == "Mine"
    assert (new.measurement.readings == old.measurement.readings).all()


def test_a_file_of_effects_and_instruments(small):
    """It is run once, so that both come from one module."""
    study = load_study(small, ['model.effects_file="disc_probe.py"'])
    assert type(study.instrument.effects(study.plan)[0]) is study.catalogue["disc_centre"]


@pytest.mark.thorough
def test_data_sets_with_files_of_their_own(small):
    columns = circles(PLANES[:1], 12)
    write_csv(small / "other.csv", columns | {"x_mm": columns["x_mm"] + 50.0})
    (small / "other.py").write_text(DISC.replace("dimension = 1", "dimension = 2"))
    text = (small / "setup.toml").read_text(encoding="utf-8")
    machine, rest = text.split("[instrument]\n")
    instrument, model = rest.split("[model.geometric]")
    model = "[model.geometric]" + model.split("[data]")[0]
    rows = [
        f'[[data]]\nname = "{name}"\nfile = "{name}.csv"\n[data.instrument]\n'
        + instrument.replace("disc_probe.py", file)
        for name, file in (("data", "disc_probe.py"), ("other", "other.py"))
    ]
    (small / "setup.toml").write_text(machine + "\n".join(rows) + model, encoding="utf-8")
    study = load_study(small)
    assert study.instrument.dimensions(study.plan).tolist() == [1] * 24 + [2] * 24
    assert study.instrument.folds(study.plan)[0].max() == 9
    assert {"disc_probe.py", "other.py"} <= set(study.hashes)
    with pytest.raises(StudyError, match="no.py, file: found no such file"):
        load_study(small, ["data.1.instrument.kind_file=no.py"])
    with pytest.raises(StudyError, match="key data.1.instrument.kind: found the unknown instrumen"):
        load_study(small, ["data.1.instrument.kind=disc"])
    (small / "other.py").write_text(
        DISC.replace("return np.ones((plan", "return np.ones((1 + plan")
    )
    with pytest.raises(StudyError, match=r"other.py, class DiscProbe, lengths: found shape"):
        load_study(small)


# --- files that cannot be used --------------------------------------------------------------------

HEAD, LAST = 'kind = "disc_probe"\n', "        return fold, False\n"
OBSERVE = 'return [jnp.sqrt(arm.dot(arm)) - self.radius + ports["read"][0]]'
OF_FILE = {
    "not Python": ("def", "disc_probe.py: cannot be run: SyntaxError: "),
    "fails": ("import vcal\n1 / 0", "cannot be run: ZeroDivisionError: division by zero (line 2)"),
    "ends the program": ("import sys\nsys.exit(3)", "cannot be run: SystemExit: 3 (line 2)"),
    "nothing in it": ("x = 1", "holds no instrument, expected at least one class derived from"),
    "without a kind": (DISC.replace(HEAD, "pass\n"), "class DiscProbe has no 'kind', expected"),
    "two of a kind": (
        DISC + "\n\nclass Again(DiscProbe):\n    pass\n",
        "disc_probe.py, class Again, kind: found 'disc_probe', which is taken",
    ),
}
WRONG = {
    "a kind there is": (HEAD, 'kind = "r_test"\n', "kind: found 'r_test', which is taken, expec"),
    "a kind with a blank": (
        HEAD,
        'kind = "disc probe"\n',
        "kind: found 'disc probe', expected letter",
    ),
    "not all methods": (
        "def noise",
        "def nois",
        "body: found no noise, expected all abstract methods",
    ),
    "settings": (
        "Settings = DiscSettings",
        "Settings = 3",
        "Settings: found 3, expected a cl",
    ),
    "dimension": ("dimension = 1", "dimension = 0", "dimension: found 0, expected a whole number"),
    "labels": ("dimension = 1", 'dimension = 1; labels = "a"', "labels: found 'a', expected a t"),
    "machine": ("dimension = 1", 'dimension = 1; machine = "X"', "machine: found ValueError: chai"),
    "columns fail": ("1e3 * settings.range_mm", "settings.nosuch", "columns: found AttributeError"),
    "columns of readings alone": (
        "return plain + [",
        "return plain * (not readings) + [",
        "columns: found run without readings only, expected a list of",
    ),
    "texts for columns": (
        'Column(name="run", low=0, integer=True)',
        '"run"',
        "columns: found ['run'], expected a list of vcal.instruments.Column",
    ),
    "build fails": ("settings.sigma_um *", "settings.no *", "build: found AttributeError: "),
    "build makes nothing": (
        "        return cls(\n",
        "        return None\n        return cls(\n",
        "build: found NoneType, expected an instance of DiscProbe",
    ),
    "a static list": (
        "runs=runs,",
        "runs=list(runs),",
        "build: found the static field runs: unhashable type: 'list', expected",
    ),
    "plan fails": ("linear_plan(chain, table, r", "linear_plan(chain, {}, r", "plan: found KeyErr"),
    "no plan": (
        "return linear_plan(",
        "linear_plan(",
        "plan: found NoneType, expected a vcal.Plan",
    ),
    "a shorter plan": (
        'readings=("deviation_um",))',
        'readings=("deviation_um",)).take(np.arange(3))',
        "plan: found one of 3 rows with the axes X, Y, Z, expected a vcal.Plan of 24 rows",
    ),
    "readings of one axis": (
        "float)[:, None] *",
        "float) *",
        "measured: found shape (24,), expected readings radius, SI, an array of the shape (24, 1)",
    ),
    "a text for readings": (
        '("radius",)\n\n    @c',
        '"radius"\n\n    @c',
        "readings: found 'radius'",
    ),
    "a port of the tool": (
        'group("read"',
        'group("tool"',
        "ports: found 'tool.radius', expected a",
    ),
    "a port without a group": ('group("read", ("radius",))', '("read",)', "ports: found 'read', e"),
    "ports apart": (
        'group("centre", ("X", "Y", "Z")) + group("read", ("radius",))',
        '("centre.X", "read.radius", "centre.Y", "centre.Z")',
        "ports: found 'centre.Y' apart from its group, expected groups in one piece",
    ),
    "rows fail": (
        "np.searchsorted(self.runs,",
        "np.searchsorted(self.nos,",
        "rows: found Attribute",
    ),
    "few rows": ('plan.groups["run"]))]', 'plan.groups["run"]))][1:]', "rows: found shape (23, 3)"),
    "two numbers": (
        OBSERVE,
        OBSERVE[:-1] + ", 0.0]",
        "observe: found 2 numbers, expected 1 number",
    ),
    "one number": (OBSERVE, "return jnp.sqrt(arm.dot(arm))", "observe: found TypeError"),
    "a column": (
        OBSERVE,
        "return [jnp.zeros(3)]",
        "observe: found shape (3,) for radius, expected",
    ),
    "numpy": (OBSERVE, OBSERVE.replace("jnp", "np"), "observe: found TracerArrayConversionError: "),
    "float": (OBSERVE, "return [float(tool.x)]", "observe: found ConcretizationTypeError: "),
    "not finite": (
        OBSERVE,
        "return [jnp.log(-1.0 + 0 * tool.x)]",
        "observe: found nan in row 1, ex",
    ),
    "no derivative": (
        OBSERVE,
        'return [jnp.sqrt(jnp.square(ports["centre"][0])) + tool.x]',
        "observe: found no finite derivative of radius in row 1",
    ),
    "noise of one axis": (
        "np.full((plan.rows, 1),",
        "np.full(plan.rows,",
        "noise: found shape (24,)",
    ),
    "no noise": ("self.sigma)", "0.0)", "noise: found 0 for radius in row 1, expected standard"),
    "lengths": ("np.ones((plan.rows, 1))", "None", "lengths: found None, expected metres per unit"),
    "dimensions": (
        LAST,
        LAST + "\n    def dimensions(self, plan):\n        return 1\n",
        "dimensions: found 1, expected readings that make a point, an array of the shape (24,)",
    ),
    "clusters": (
        LAST,
        LAST + "\n    def clusters(self, plan):\n        return np.zeros(plan.rows)\n",
        "clusters: found an array of float64, expected an index for every row",
    ),
    "nothing present": (
        LAST,
        LAST + "\n    def present(self, plan):\n        return np.zeros((plan.rows, 1), bool)\n",
        "present: found no reading in row 1, expected True or False for every reading",
    ),
    "record": (
        LAST,
        LAST + "\n    def record(self, plan, ideal, noise):\n        return ideal(plan)\n",
        "record: found ndarray, expected a pair: a vcal.Plan of 24 rows",
    ),
    "start": (
        LAST,
        LAST + "\n    def start(self, chain, plan, readings):\n        return None\n",
        "start: found NoneType, expected an instance of DiscProbe",
    ),
    "difference": (
        LAST,
        LAST + "\n    def difference(self, measured, predicted):\n        return measured[:, 0]\n",
        "difference: found shape (24,), expected the shape (24, 1)",
    ),
    "reduce": (
        LAST,
        LAST + "\n    def reduce(self, values, plan):\n        return values[1:]\n",
        "reduce: found shape (23, 1), expected as many readings as its argument has",
    ),
    "folds alone": (LAST, "        return fold\n", "folds: found ndarray, expected a pair"),
    "folds of runs": (
        LAST,
        "        return fold[:2], False\n",
        "folds: found shape (2,), expected",
    ),
    "folds of numbers": (
        LAST,
        "        return fold / 2, True\n",
        "folds: found an array of float64",
    ),
    "one fold": (
        LAST,
        "        return 0 * fold, False\n",
        "folds: found no rows outside one of the",
    ),
    "nothing to fit": (
        LAST,
        "        return fold, True\n",
        "folds: found no rows outside one of the",
    ),
    "no fold": (LAST, "        return 0 * fold - 1, True\n", "folds: found -1 for every row"),
    "apart per fold": (
        LAST,
        "        return fold, np.ones(5, bool)\n",
        "folds: found bool of shape",
    ),
    "no boolean": (
        LAST,
        "        return fold, 0\n",
        "folds: found 0 for what is kept out of every",
    ),
    "a list of effects": (
        "return (DiscCentre(seen=tuple(seen)), DiscRadius(u_um=self.radius_u_um))",
        "return DiscCentre(seen=tuple(seen))",
        "effects: found DiscCentre",
    ),
    "an effect twice": (
        "DiscCentre(seen=tuple(seen)), ",
        "DiscCentre(seen=tuple(seen)), DiscCentre(seen=()), ",
        "effects: found disc_centre, disc_centre, disc_radius, expected a tuple of vcal.Effect, ea",
    ),
    "written in another unit": (
        "readings[:, 0] * 1e6",
        "readings[:, 0] * 1e3",
        "to_table: found the reading radius in row",
    ),
    "a property that is a method": (
        "@property\n    def readings",
        "def readings",
        "readings: found a method without @property, expected a tuple of at least one name",
    ),
    "a default that is refused": (
        "sigma_um: float = Field(gt=0, le=1000)",
        "sigma_um: float = Field(gt=0, le=1000, default=-1)",
        "Settings: found the default -1 of sigma_um, expected Input should be greater than 0",
    ),
    "a column twice": (
        'plain = [Column(name="run", low=0, integer=True)]',
        'plain = [Column(name="run", low=0, integer=True)] * 2',
        "columns: found run twice, expected every column once",
    ),
    "unique with nothing": (
        'Column(name="run", low=0, integer=True)',
        'Column(name="run", unique_with=("nosuch",))',
        "columns: found run unique_with nosuch, expected some of run",
    ),
    "a column with a key that is none": (
        'Column(name="run", low=0, integer=True)',
        'Column(nam="run")',
        "columns: found ValidationError: name: Field required (Column) (line ",
    ),
    "a row there is not": (
        "raise RowError(\n                    int(mine[np.argmax(np.abs(off))]),",
        "raise RowError(\n                    24,",
        "body: found RowError(24, ...), expected an index from 0 to 23",
    ),
    "readings that are covariates": (
        'linear_plan(chain, table, readings=("deviation_um",))',
        "linear_plan(chain, table)",
        "plan: found deviation_um among the covariates, expected no reading, as by linear_",
    ),
    "writes into the plan": (
        'return self.centres[np.searchsorted(self.runs, np.asarray(plan.groups["run"]))]',
        "plan.position[0] = 0.0",
        "rows: found ValueError: assignment destination is read-only (line ",
    ),
    "writes into the table": (
        "run, radius = np.asarray(",
        'table["x_mm"] *= 1e-3\n        run, radius = np.asarray(',
        "build: found ValueError: output array is read-only (line ",
    ),
    "rows of text": (
        'return self.centres[np.searchsorted(self.runs, np.asarray(plan.groups["run"]))]',
        'return np.full(plan.rows, "a")',
        "rows: found an array of <U1, expected arrays of numbers whose first axis",
    ),
    "single precision": (
        OBSERVE,
        "return [jnp.float32(tool.x)]",
        "observe: found float32 for radius, expected float64",
    ),
    "chance": (
        OBSERVE,
        "return [tool.x + np.random.default_rng().normal()]",
        "observe: found another result when it was called again, expected the same",
    ),
    "folds by chance": (
        LAST,
        "        return np.random.default_rng().permutation(plan.rows), False\n",
        "folds: found another result when it was called again, expected the same",
    ),
    "a list of lengths": (
        "np.ones((plan.rows, 1))",
        "[[1.0]] * plan.rows",
        "lengths: found a list, expected metres per unit of the readings, an array of numpy",
    ),
    "no lengths": (
        "np.ones((plan.rows, 1))",
        "np.zeros((plan.rows, 1))",
        "lengths: found 0 for every reading, expected metres per unit of the readings, above 0",
    ),
    "complex noise": (
        "np.full((plan.rows, 1), self.sigma)",
        "np.full((plan.rows, 1), 1j)",
        "noise: found an array of complex128, expected standard deviations",
    ),
    "temperature_offset_K": (
        LAST,
        LAST + '\n    temperature_offset_K = "a"\n',
        "temperature_offset_K: found 'a', expected a finite number of K",
    ),
    "an artefact": (
        LAST,
        LAST + "\n    artefact = 3\n",
        "artefact: found 3, expected a vcal.effects.base.Artefact, or None",
    ),
    "members": (
        LAST,
        LAST + "\n    members = {1: 2}\n",
        "members: found some, expected none, as a study joins its data sets itself",
    ),
    "reduce to squares": (
        LAST,
        LAST + "\n    def reduce(self, values, plan):\n        return values**2\n",
        "reduce: found a step that is not linear, expected reduce(a + b) to be their sum",
    ),
    "what is held out alone tells something": (
        LAST,
        "        return np.where(run == 1, 0, -1), True\n",
        "folds: found all rows that identify disc_centre 1.X, disc_centre 1.Y held out of every fi",
    ),
    "does not write the readings": (
        ', "deviation_um": readings[:, 0] * 1e6}',
        "}",
        "to_table: found KeyError: 'deviation_um' (line ",
    ),
    "writes a condition in another unit": (
        "linear_plan_table(plan), ",
        'linear_plan_table(plan), "dir_x": 2 * np.asarray(plan.covariate("dir_X")), ',
        "to_table: found the dir_X in row 1, -1, off by -1 as read, expected the inverse of plan",
    ),
    "writes nothing": (
        "return {**linear_plan_",
        "{**linear_plan_",
        "to_table: found NoneType, expe",
    ),
}


MEASURED = (
    "start",
    "readings of one axis",
    "readings that are covariates",
    "does not write the readings",
    "written in another unit",
)
SETS = {
    "a kind there is": ["instrument.kind=r_test"],
    "a row there is not": ["instrument.radius_mm=145"],
}


@pytest.mark.parametrize("case", OF_FILE)
def test_a_file_that_cannot_be_used(small, case):
    text, expected = OF_FILE[case]
    (small / "disc_probe.py").write_text(text, encoding="utf-8")
    with pytest.raises(StudyError) as caught:
        load_study(small)
    assert expected in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("case", WRONG)
def test_a_class_that_cannot_be_used(small, case):
    old, new, expected = WRONG[case]
    assert DISC.count(old) >= 1
    (small / "disc_probe.py").write_text(DISC.replace(old, new), encoding="utf-8")
    if case in MEASURED:
        read = np.linspace(-5.0, 5.0, 24)
        write_csv(small / "data.csv", circles(PLANES[:1], 12) | {"deviation_um": read})
    with pytest.raises(StudyError) as caught:
        load_study(small, SETS.get(case, []))
    message = str(caught.value)
    assert message.startswith("disc_probe.py, class DiscProbe, ") and "\n" not in message
    assert message.endswith("; correct the class")
    assert expected in message


OF_EFFECTS = {
    "a port there is not": (
        '("read.radius", "error")',
        '("read.raduis", "error")',
        "DiscRadius, response: found the port 'read.raduis', expected one",
    ),
    "no scale": ("scale=100.0", "scale=0.0", "DiscCentre, parameters: found 0.X with scale 0, exp"),
    "scatter without a size": (
        '("error", "um", sigma=self.u_um),)',
        '("error", "um"),)\n\n    kind = "random"',
        "DiscRadius, parameters: found error of a random effect without sigma, expected its "
        "standard deviation",
    ),
    "what was not recorded": (
        'return ("run",)',
        'return ("run", "T_bar")',
        "DiscCentre, needs: found T_bar, which the plan does not have, expected what it has; else "
        "DiscProbe.effects has to leave it out",
    ),
    "a name of the catalogue": (
        'name = "disc_radius"',
        'name = "range_scale"',
        "DiscRadius, name: found 'range_scale', which is taken, expected a name of its own",
    ),
}


@pytest.mark.parametrize("case", OF_EFFECTS)
def test_effects_of_an_instrument_are_tried(small, case):
    old, new, expected = OF_EFFECTS[case]
    assert DISC.count(old) == 1
    (small / "disc_probe.py").write_text(DISC.replace(old, new), encoding="utf-8")
    with pytest.raises(StudyError, match=re.escape(f"disc_probe.py, class {expected}")):
        load_study(small)


def test_what_instruments_of_a_file_have_in_common(small):
    """A base class needs no kind; labels are no quantities."""
    text = DISC.replace("class DiscProbe(TableInstrument)", "class Bar(TableInstrument)")
    text = text.replace(HEAD, 'labels = ("who",)\n')
    text = text.replace("return cls(\n", "return cls(\n            ")
    for name, kind in (("Double", "disc_probe"), ("Other", "other")):
        text += f'\n\nclass {name}(Bar):\n    kind = "{kind}"\n'
    (small / "disc_probe.py").write_text(text, encoding="utf-8")
    lines = (small / "data.csv").read_text(encoding="utf-8").splitlines()
    lines = [lines[0] + ",who", *(line + ",me" for line in lines[1:])]
    (small / "data.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for kind, name in (("disc_probe", "Double"), ("other", "Other")):
        study = load_study(small, [f"instrument.kind={kind}"])
        assert type(study.instrument).__name__ == name and "who" not in study.plan.covariates


def test_nothing_to_be_found(small):
    text = DISC.replace("return (DiscCentre(seen=tuple(seen)), DiscRadius(u_um=self.radius_u_um))",
                       "return ()")  # fmt: skip
    (small / "disc_probe.py").write_text(text, encoding="utf-8")
    setup = (small / "setup.toml").read_text(encoding="utf-8")
    geometric = setup[setup.index("[model.geometric]") : setup.index("[data]")]
    (small / "setup.toml").write_text(setup.replace(geometric, ""), encoding="utf-8")
    with pytest.raises(StudyError, match="found no parameter, neither of the machine, nor"):
        load_study(small)


@pytest.mark.parametrize("says", ['raise ValueError("no\\ndisc")', "assert False"])
def test_a_validator_that_refuses(small, says):
    text = DISC.replace("from pydantic import Field", "from pydantic import Field, field_validator")
    text = text.replace(
        "class DiscCentre",
        f'    @field_validator("radius_mm")\n    def short(cls, value):\n        {says}\n\n\n'
        "class DiscCentre",
        1,
    )
    (small / "disc_probe.py").write_text(text, encoding="utf-8")
    with pytest.raises(StudyError) as caught:
        load_study(small)
    said = " (no disc)" if "disc" in says else ""
    assert str(caught.value) == (
        "setup.toml, key instrument.radius_mm: found 150, expected a value that its validator "
        f"accepts{said}; correct the value"
    )


def test_a_validator_that_fails(small):
    text = DISC.replace("from pydantic import Field", "from pydantic import Field, model_validator")
    text = text.replace(
        "class DiscCentre",
        '    @model_validator(mode="after")\n    def short(self):\n        return self.nosuch\n\n\n'
        "class DiscCentre",
        1,
    )
    (small / "disc_probe.py").write_text(text, encoding="utf-8")
    with pytest.raises(StudyError, match=r"disc_probe.py, short: found AttributeError: .*line \d+"):
        load_study(small)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("3", "key instrument.kind_file: found 3, expected the name of a Python file"),
        ("no.py", "no.py, file: found no such file in "),
        ("setup.toml", "setup.toml: not a Python file, expected a name that ends in .py"),
    ],
)
def test_a_file_there_is_not(small, value, expected):
    with pytest.raises(StudyError, match=re.escape(expected)):
        load_study(small, [f"instrument.kind_file={value}"])


def test_a_kind_that_the_file_does_not_define(small):
    with pytest.raises(StudyError) as caught:
        load_study(small, ["instrument.kind=laser_tracker"])
    assert "found the unknown instrument 'laser_tracker', expected one of disc_probe, as def" in (
        str(caught.value)
    )
    assert f"without the kind_file, it may be one of {', '.join(INSTRUMENTS)}" in str(caught.value)
