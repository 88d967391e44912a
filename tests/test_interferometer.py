"""Interferometer: lines of one axis, against the independent generator and plain arithmetic."""

import dataclasses
import json

import numpy as np
import pytest
from typer.testing import CliRunner

import vcal
from oracle import (
    COLUMNS,
    LINES,
    Laser,
    Line,
    in_si,
    line_readings,
    make_case,
    nominal_machine,
    tool_point,
)
from oracle import interferometer as oracle
from oracle.kinematics import AXES, with_errors
from report_schema import validated
from vcal.cli import app
from vcal.demo import STARTS
from vcal.design.optimiser import optimise
from vcal.errors import StudyError
from vcal.geometry.positioning_lines import positioning_tests
from vcal.instruments.interferometer import Interferometer
from vcal.loop.screening.candidates import candidates
from vcal.machine.chain import chain_from_string
from vcal.model.forward import observe_all
from vcal.study import read_header, write_table
from vcal.study.csv_table import read_table
from vcal.study.design.task import design_task
from vcal.study.unseen_errors import determined_errors

CHAINS = ("w X b Y Z t", "w Y b X Z t", "w b X Y Z t")
SMALL = {"targets": (9, 7, 6), "runs": 2}
QUIET = Laser(
    slope_sigma=0.0, laser_u=0.0, square_u=0.0, expansion=None, expansion_u=0.0, material_u=0.0,
    dead_path_u=0.0,
)  # fmt: skip
NONE = {
    "zero": np.zeros((6, 7)), "beam": np.zeros((6, 2)), "rotation": np.zeros((6, 3)),
    "scale": np.zeros(1), "expansion": np.zeros(1), "material": np.zeros(1),
    "dead_path": np.zeros(1),
}  # fmt: skip


def study_of(tmp_path, name="study", **options):
    plan = SMALL | options.pop("plan", {})
    case = make_case("interferometer", folder=tmp_path / name, plan=plan, n_check=60, **options)
    return case, vcal.load_study(tmp_path / name)


def rewritten(tmp_path, change, overrides=(), folder="start"):
    """The bundled study with a changed table."""
    out = tmp_path / folder
    out.mkdir()
    text = (STARTS / "interferometer" / "setup.toml").read_text(encoding="utf-8")
    (out / "setup.toml").write_text(text, encoding="utf-8")
    write_table(out / "data.csv", change(_table()))
    return vcal.load_study(out, overrides)


def _table():
    """The table of the bundled study."""
    path = STARTS / "interferometer" / "data.csv"
    read = [c for c in read_header(path) if c.startswith("meas_")]
    return dict(read_table(path, [], readings=read, read_by="line"))


# --- one observation -----------------------------------------------------------------------------


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.thorough
def test_readings_agree_with_the_oracle(chain, tmp_path):
    """Errors of the machine alone: all set-ups are perfect."""
    case, study = study_of(tmp_path, chain=chain, seed=5, noise_factor=0.0, **QUIET.__dict__ | {
        "lines": LINES, "drawn": {}})  # fmt: skip
    laser = dataclasses.replace(QUIET, drawn=NONE)
    # A squareness is a direction of travel to the oracle, and a translation to vcal.
    machine = dataclasses.replace(case.machine, squareness=np.zeros(3))
    ideal = line_readings(machine, case.lines, laser)
    shift, turn = oracle.twists(machine, case.lines.run, [])
    twists = np.concatenate([shift, turn], axis=2).reshape(len(ideal), -1)
    model = study.model
    ports = np.zeros((len(ideal), len(model.layout)))
    ports[:, : twists.shape[1]] = twists
    instrument = study.instrument
    found = np.asarray(
        observe_all(
            model.chain, instrument, study.plan.position, instrument.rows(study.plan), ports
        )
    )
    has = np.isfinite(ideal)
    np.testing.assert_array_equal(instrument.present(study.plan), has)
    # Rotations of some 100 urad: the oracle's readings have rotation vectors, vcal's their sine.
    np.testing.assert_allclose(found[has], ideal[has], atol=2e-12)
    assert (found[~has] == 0.0).all()
    assert np.abs(ideal[has]).max() > 1e-5


def test_a_rotary_axis_that_is_held_turns_nothing_but_the_frame():
    """Readings are in the directions of the bed, whatever the angle of the table."""
    chain = chain_from_string(
        "w C b X Y Z t", {a: (0.0, 1.0) for a in "XYZ"} | {"C": (-4.0, 4.0)}, (0.0, 0.0, -0.1),
        {"C": (0.3, 0.2, 0.0)},
    )  # fmt: skip
    n = 7
    table = {
        "line": np.repeat([0, 1], n),
        "x_mm": np.concatenate([np.linspace(10, 900, n), np.full(n, 400.0)]),
        "y_mm": np.concatenate([np.full(n, 300.0), np.linspace(10, 900, n)]),
        "z_mm": np.full(2 * n, 200.0),
        "c_deg": np.repeat([0.0, 70.0], n),
    }
    settings = Interferometer.Settings(kind="interferometer", reads=(
        "position", "straight_x", "straight_y", "straight_z", "angle_a", "angle_b", "angle_c",
    ))  # fmt: skip
    instrument = Interferometer.build(settings, chain, table, lambda *_: {})
    plan = instrument.plan(chain, table)
    ports = np.zeros((2 * n, 6 * 4 + 6 + len(instrument.ports)))
    y = list(chain.axes).index("Y")
    ports[:, 6 * y : 6 * y + 6] = [1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6]
    found = np.asarray(observe_all(chain, instrument, plan.position, instrument.rows(plan), ports))
    names = instrument.readings
    seen = dict(zip(names, found.T, strict=True))
    second = slice(n, None)
    # Line along y with the table at 70 deg: the errors of Y plus levers of the tool.
    tool = np.array([400.0, 0.0, 200.0 - 100.0]) * 1e-3
    lever = np.cross([4e-6, 5e-6, 6e-6], tool) - np.cross([4e-6, 5e-6, 6e-6], [0.4, 0, 0])
    moved = np.array([1e-6, 2e-6, 3e-6]) + lever
    for name, expected in (("meas_straight_x", moved[0]), ("meas_position", moved[1]),
                           ("meas_straight_z", moved[2]), ("meas_angle_a", 4e-6),
                           ("meas_angle_b", 5e-6), ("meas_angle_c", 6e-6)):  # fmt: skip
        np.testing.assert_allclose(seen[name][second], expected, atol=1e-10)


# --- identification ------------------------------------------------------------------------------


def test_a_clean_case_is_noise_and_its_set_ups_are_found(tmp_path):
    case, study = study_of(tmp_path, seed=2)
    fit = vcal.identify(study.model, study.measurement)
    assert fit.converged and 0.85 < fit.chi2 / fit.dof < 1.15
    values = {(key, p.name): value for key, p, value, _ in fit.parameter_values()}
    u = {(key, p.name): s for key, p, _, s in fit.parameter_values()}
    # The rotation of the optics, which all lines share, up to squareness errors that the prior
    # divides from it, and the error of the optical square.
    for i, c in enumerate("ABC"):
        key = "beam_alignment", f"table.{c}"
        true = 1e6 * np.mean(case.laser.drawn["rotation"][:, i])
        assert abs(values[key] - true) < 4.0 * u[key] + 2.0
    # Without noise, the readings are described but for terms of the second order.
    _, study = study_of(tmp_path, "exact", seed=2, noise_factor=0.0)
    fit = vcal.identify(study.model, study.measurement)
    assert fit.chi2 / fit.dof < 0.02


def test_compensation_leaves_little_at_check_points(tmp_path):
    _, study = study_of(tmp_path, seed=4)
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, draws=100,
                              effects=[vcal.CATALOGUE["backlash"]])  # fmt: skip
    assert closure.verdict == "nothing_missing"
    errors = closure.errors
    assert errors["after"].check.value < 0.1 * errors["uncompensated"].check.value


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("effect", "key"),
    [
        ({"effect": "backlash", "axis": "X", "size_um": 3.0}, "backlash X"),
        ({"effect": "screw_cyclic", "axis": "Y", "amplitude_um": 1.5, "pitch_mm": 12.0, "phase": 1},
         "screw_cyclic Y"),
        ({"effect": "scale_growth", "axis": "X", "um_per_m_K": 8.0}, "scale_growth X"),
        ({"effect": "thermal_tilt", "axis": "Y", "component": "A", "urad_per_K": 6.0},
         "thermal_tilt Y"),
        ({"effect": "angular_reversal", "axis": "Z", "component": "B", "size_urad": 4.0},
         "angular_reversal Z"),
        ({"effect": "lateral_reversal", "axis": "Y", "component": "Z", "size_um": 3.0},
         "lateral_reversal Y"),
    ],
)  # fmt: skip
def test_effects_of_an_axis_are_named(effect, key, tmp_path):
    plan = {"targets": (17, 13, 11), "cycles": True}
    _, study = study_of(tmp_path, seed=6, effects=[effect], plan=plan)
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, draws=200)
    assert closure.verdict == "named", closure.sentence
    assert [e.effect.key for e in closure.effects] == [key]


def test_all_effects_of_the_axis_are_candidates():
    study = vcal.load_study(STARTS / "interferometer")
    found, _ = candidates(study.model, study.measurement, vcal.CATALOGUE.values())
    keys = {e.key for e in found}
    for axis in "XYZ":
        assert {f"{name} {axis}" for name in (
            "backlash", "screw_cyclic", "scale_growth", "thermal_offset", "thermal_tilt",
            "lateral_reversal", "angular_reversal", "warm_up", "drift",
        )} <= keys  # fmt: skip


# --- nuisances -----------------------------------------------------------------------------------


def test_zero_of_every_run():
    study = vcal.load_study(STARTS / "interferometer", ["instrument.zero=run"])
    (zero,) = (e for e in study.model.effects if e.name == "line_zero")
    assert len(zero.parameters) == 3 * 3 * 6
    assert zero.parameters[0].name == "0.0.position"
    folds, apart = study.instrument.folds(study.plan)
    assert set(folds) == set(range(5)) and not apart


@pytest.mark.thorough
def test_slope_is_free_or_known_or_none():
    names = {}
    for value in ("0", "0.5", "free"):
        study = vcal.load_study(
            STARTS / "interferometer", [f"instrument.slope_sigma_um_per_m={value}"]
        )
        names[value] = {e.name for e in study.model.effects} & {"beam_slope", "free_beam_slope"}
    assert names == {"0": set(), "0.5": {"beam_slope"}, "free": {"free_beam_slope"}}
    # With an unknown slope, the scale of no axis is determined.
    found = determined_errors(study.chain, study.instrument, study.plan)
    assert found.rank == 51 - 3 and set(found.mixed) == {"EXX", "EYY", "EZZ"}
    must = ["data.must_see={EXX=1}", "instrument.slope_sigma_um_per_m=free"]
    with pytest.raises(StudyError, match="EXX is not identified"):
        vcal.load_study(STARTS / "interferometer", must)


@pytest.mark.parametrize(
    ("reads", "alignment", "rank", "unseen"),
    [
        ("all", "table", 51, set()),
        # Without an optical square, nothing shows a squareness.
        ("all", None, 48, {"EC0Y", "EB0Z", "EA0Z"}),
        # Positioning at one place per axis: three positioning errors, and Abbe errors with them.
        (["position"], "table", 9, {"EYX", "EZX", "EAX", "EC0Y", "ECZ"}),
    ],
)
@pytest.mark.thorough
def test_rank_says_which_errors_lines_do_not_show(reads, alignment, rank, unseen, tmp_path):
    text = (STARTS / "interferometer" / "setup.toml").read_text(encoding="utf-8")
    if alignment is None:
        text = text.replace('alignment = "table"', "")
    if reads != "all":
        start = text.index("reads = [")
        text = (
            text[:start] + f"reads = {reads!r}".replace("'", '"') + text[text.index("\n", start) :]
        )
    out = tmp_path / "study"
    out.mkdir()
    (out / "setup.toml").write_text(text, encoding="utf-8")
    for name in ("data.csv", "check.csv"):
        (out / name).write_bytes((STARTS / "interferometer" / name).read_bytes())
    study = vcal.load_study(out)
    found = determined_errors(study.chain, study.instrument, study.plan)
    assert (found.columns, found.errors, found.rank) == (51, 21, rank)
    assert unseen <= set(found.unseen) and (unseen or not found.unseen)
    printed = CliRunner().invoke(app, ["check", str(out)], terminal_width=200).output
    assert f"{rank} of 51 coefficients of the 21 errors" in " ".join(printed.split())


def test_off_axis_lines_show_an_angle_by_the_abbe_lever():
    """Positioning along two lines at different heights shows the pitch of the axis."""
    reflector = [Line(0, (0.0, 0.0, z), (0, 0.5, 0.5), reads=COLUMNS[:1]) for z in (0.0, 0.2)]
    machine = nominal_machine("w X b Y Z t", (1.0, 0.6, 0.5), (0.0, 0.0, -0.15))
    pitched = with_errors(machine, {"EBX": [0, 2e-5, 0, 0, 0, 0, 0, 0]})
    laser = dataclasses.replace(QUIET, lines=tuple(reflector),
                                drawn={k: v[:2] for k, v in NONE.items()})  # fmt: skip
    plan = oracle.line_plan(machine, np.random.default_rng(1), reflector, (9, 7, 6), 1)
    near, far = np.split(line_readings(pitched, plan, laser)[:, 0], 2)
    x = np.split(plan.run.q[:, 0], 2)
    # An axis X under the workpiece pitches by e: the tool point above it moves by -e z against it.
    slope = [np.polyfit(a, b, 1)[0] for a, b in zip(x, (near, far), strict=True)]
    assert abs(slope[1] - slope[0]) == pytest.approx(0.2 * 4e-5, rel=1e-3)


# --- tables --------------------------------------------------------------------------------------


def test_directions_follow_from_the_order_of_rows(tmp_path):
    given = vcal.load_study(STARTS / "interferometer")
    study = rewritten(tmp_path, lambda t: {k: v for k, v in t.items() if k[:4] != "dir_"})
    for axis, line in zip("XYZ", range(3), strict=True):
        mine = np.asarray(study.plan.groups["line"]) == line
        np.testing.assert_array_equal(
            np.asarray(study.plan.covariate(f"dir_{axis}"))[mine],
            np.asarray(given.plan.covariate(f"dir_{axis}"))[mine],
        )


@pytest.mark.thorough
def test_lines_have_readings_of_their_own(tmp_path):
    def change(table):
        other = dict(table)
        second = table["line"] == 1
        for name in ("meas_angle_a_urad", "meas_angle_b_urad", "meas_straight_z_um"):
            other[name] = np.where(second, np.nan, table[name])
        other["meas_position_um"] = table["meas_position_um"].copy()
        other["meas_position_um"][[0, 5]] = np.nan  # not read in two rows of line 0
        del other["meas_angle_c_urad"]
        return other

    text = 'instrument.reads=["position", "straight_x"]'
    study = rewritten(tmp_path, change, [text])
    assert study.instrument.readings == ("meas_position", "meas_straight_x")
    out = tmp_path / "own"
    out.mkdir()
    setup = (tmp_path / "start" / "setup.toml").read_text(encoding="utf-8")
    start = setup.index("reads = [")
    (out / "setup.toml").write_text(setup[:start] + setup[setup.index("\n", start) :])
    (out / "data.csv").write_bytes((tmp_path / "start" / "data.csv").read_bytes())
    study = vcal.load_study(out)
    assert study.one.table.blank_rows == (1, 6)
    here = study.instrument.present(study.plan)
    line = np.asarray(study.plan.groups["line"])
    names = study.instrument.readings
    assert "meas_angle_c" not in names
    by_line = {k: {n for n, h in zip(names, here[line == k][0], strict=True) if h} for k in (0, 1)}
    assert by_line[0] == {"meas_position", "meas_straight_y", "meas_straight_z", "meas_angle_a",
                          "meas_angle_b"}  # fmt: skip
    assert by_line[1] == {"meas_position", "meas_straight_x"}
    assert vcal.identify(study.model, study.measurement).chi2 < 3.0 * here.sum()
    # A simulation leaves blank what a line does not read.
    done = CliRunner().invoke(app, ["simulate", str(out), "--out", str(tmp_path / "again")])
    assert done.exit_code == 0, done.output
    again = vcal.load_study(tmp_path / "again")
    np.testing.assert_array_equal(again.instrument.present(again.plan), here)


MISTAKES = {
    "two axes": (
        lambda t: t | {"y_mm": np.where(t["line"] == 0, t["x_mm"] / 2, t["y_mm"])},
        "line 0, in which X and Y move",
    ),
    "one line": (
        lambda t: t | {"line": np.zeros_like(t["line"])},
        "rows of one index have the same readings",
    ),
    "positions": (
        lambda t: t | {"meas_position_um": 1e3 * t["x_mm"] + t["meas_position_um"]},
        "they follow the commanded positions: subtract these",
    ),
    "the other sign": (
        lambda t: t | {"meas_position_um": -1e3 * t["x_mm"]},
        "with the other sign: subtract these",
    ),
    "along the line": (
        lambda t: t | {"meas_straight_x_um": np.zeros(len(t["line"]))},
        "",
    ),
    "a reading that is missing": (
        lambda t: {k: v for k, v in t.items() if k != "meas_angle_c_urad"},
        "angle_c, which the rows of line 0 lack",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_tables_that_are_no_lines(mistake, tmp_path):
    change, message = MISTAKES[mistake]
    if not message:  # the readings that are declared leave that along the line out
        assert rewritten(tmp_path, change).measurement is not None
        return
    with pytest.raises(StudyError) as refused:
        rewritten(tmp_path, change)
    assert message in str(refused.value)


def test_settings_that_contradict_each_other(tmp_path):
    def refused(*overrides):
        with pytest.raises(StudyError) as error:
            vcal.load_study(STARTS / "interferometer", list(overrides))
        return str(error.value)

    rows = "instrument.line=[{line=7, dead_path_mm=10}]"
    assert "line 7, of which there is no row" in refused(rows)
    rows = "instrument.line=[{line=0}, {line=0}]"
    assert "two rows [[instrument.line]] of line 0" in refused(rows)
    rows = 'instrument.line=[{line=0, reads=["straight_x"]}]'
    assert "straight_x in line 0 along X" in refused(rows)


def test_a_plan_says_what_is_read(tmp_path):
    out = tmp_path / "plan"
    out.mkdir()
    text = (STARTS / "interferometer" / "setup.toml").read_text(encoding="utf-8")
    start = text.index("reads = [")
    (out / "setup.toml").write_text(text[:start] + text[text.index("\n", start) :])
    table = _table()
    write_table(out / "data.csv", {k: v for k, v in table.items() if k[:5] != "meas_"})
    with pytest.raises(StudyError, match="a plan that does not say what is read"):
        vcal.load_study(out)


# --- ISO 230-2 beside the identified machine -----------------------------------------------------


def test_positioning_tests_of_a_known_machine(tmp_path):
    effects = [{"effect": "backlash", "axis": "X", "size_um": 4.0}]
    declared = [{"name": "backlash", "placement": "X"}]
    case, study = study_of(tmp_path, seed=8, effects=effects, declared=declared,
                           chain="w b X Y Z t")  # fmt: skip
    fit = vcal.identify(study.model, study.measurement)
    tests = positioning_tests(fit)
    assert [(t.line, t.axis) for t in tests] == list(enumerate("XYZXYZ"))
    for test in tests:
        stated, mine = test.stated, case.data["line"] == test.line
        assert stated.runs == 2
        # Its readings, evaluated from the table of the case.
        axis = AXES.index(test.axis)
        x, way = case.data[f"{test.axis.lower()}_mm"], case.data[f"dir_{test.axis.lower()}"]
        up = [
            case.data["meas_position_um"][mine & (way > 0) & (np.abs(x - 1e3 * t) < 1e-3)].mean()
            for t in stated.target
        ]
        np.testing.assert_allclose(stated.mean_up, up, atol=1e-6)
        # And those of the true machine at the tool point, at the same targets and temperatures.
        errors = _true_means(case, axis, mine, stated.target)
        true = {"E+": np.ptp(errors[0]), "M": np.ptp(errors.mean(0)),
                "B": np.abs(errors[0] - errors[1]).max()}  # fmt: skip
        for name, value in true.items():
            found, u = test.estimated[name]
            assert abs(found - value) < 4.0 * u + 0.15, (test.line, name)
    assert tests[0].estimated["B_mean"][0] == pytest.approx(4.0, abs=0.2)


def _true_means(case, axis, rows, targets):
    """Mean deviations of the true tool point (2, m), um, positive direction first; compensated to
    20 degC as the readings are.
    """
    run = case.lines.run
    effects = [in_si(e) for e in case.effects]
    p = tool_point(case.machine, run, effects)
    nominal = tool_point(oracle.without_errors(case.machine), run)
    x, way = run.q[:, axis], run.direction[:, axis]
    s = x - 0.5 * (x[rows].min() + x[rows].max())
    warm = run.extra["T_material_degC"] - 20.0
    d = 1e6 * ((p - nominal)[:, axis] - case.laser.expansion * warm * s)
    return np.array([
        [d[rows & (way == sign) & (np.abs(x - t) < 1e-6)].mean() for t in targets]
        for sign in (1, -1)
    ])  # fmt: skip


@pytest.mark.slow
def test_the_report_states_iso_230_2(tmp_path):
    out = tmp_path / "report"
    done = CliRunner().invoke(
        app,
        ["loop", str(STARTS / "interferometer"), "--out", str(out), "--set", "loop.draws=100",
         "--set", 'loop.effects=["backlash"]'],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    report = validated(json.loads((out / "report.json").read_text(encoding="utf-8")))
    assert [t["axis"] for t in report["positioning"]] == ["X", "Y", "Z"]
    names = [q["name"] for q in report["positioning"][0]["quantities"]]
    assert names == ["A", "A+", "A-", "R", "R+", "R-", "E", "E+", "E-", "M", "B", "B_mean"]
    page = (out / "index.html").read_text(encoding="utf-8")
    assert "Positioning (ISO 230-2)" in page and "Axis Y, line 1: 13 targets" in page


def test_other_instruments_have_no_positioning_tests():
    study = vcal.load_study(STARTS / "laser_tracker")
    fit = vcal.identify(study.model, study.measurement)
    assert positioning_tests(fit) == []


# --- design --------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_design_keeps_the_lines(tmp_path):
    study = vcal.load_study(
        STARTS / "interferometer",
        ["design.starts=1", "design.steps=3", "design.places=true", 'design.goal="largest"',
         'design.errors=["EXX", "EC0Y"]'],
    )  # fmt: skip
    space = design_task(study).space
    z = np.asarray(space.start)
    assert len(z) == 21 + 13 + 11 + 3 * 2
    placed = space.placed(z)
    np.testing.assert_allclose(placed.position, study.plan.position, atol=1e-12)
    moved = z.copy()
    moved[0] += 0.01
    apart = np.asarray(space.placed(moved).position) - np.asarray(placed.position)
    rows = np.flatnonzero(np.abs(apart).max(1) > 0)
    # One target of line 0, in both directions of all of its runs.
    assert len(rows) == 6 and np.ptp(np.asarray(study.plan.x("X"))[rows]) == 0.0
    assert (np.asarray(study.plan.groups["line"])[rows] == 0).all()


@pytest.mark.campaign
def test_a_design_is_no_worse_than_its_start():
    study = vcal.load_study(
        STARTS / "interferometer", ["design.places=true", "design.grid=[4, 3, 3]"]
    )
    found = optimise(design_task(study), seed=0, starts=1, steps=2)
    assert found.gain >= 0.0
