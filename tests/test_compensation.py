"""Identified machines, their records, and the formats of compensation."""

import csv
import io
import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import vcal
from vcal.compensation import FORMATS, Tables, verify, working_volume
from vcal.compensation.base import left_over
from vcal.compensation.computed_tests import geometric_tests_of
from vcal.compensation.expected import after_alignment, drawn_errors, expected
from vcal.compensation.stored import machine_from, machine_record
from vcal.demo import FOLDER
from vcal.geometry.acceptance import geometric_tests
from vcal.geometry.compensated import compensated_points
from vcal.geometry.error_motions import error_motion_tables
from vcal.identification.model_averaging import Alternatives, model_average
from vcal.machine.chain import chain_from_string
from vcal.machine.parameters import Parameter
from vcal.model.simulate import simulate
from vcal.numerics.stored import NotStoredError, Reader, Writer

UM = 1e-6


@pytest.fixture(scope="module")
def study():
    return vcal.load_study(FOLDER / "setup.toml")


@pytest.fixture(scope="module")
def simulated(study):
    """A machine with backlash in Y and a column that tilts with its temperature, measured."""
    setup = study.model.setup(study.plan)
    backlash, tilt = (
        next(e for e in vcal.CATALOGUE[name].candidates(setup) if e.placement == "Y")
        for name in ("backlash", "thermal_tilt")
    )
    return simulate(study.model, study.plan, jax.random.key(3), effects=(backlash, tilt))


@pytest.fixture(scope="module")
def fit(simulated):
    return vcal.identify(simulated.model, simulated.measurement)


@pytest.fixture(scope="module")
def machine(fit, study):
    return vcal.IdentifiedMachine.of_fit(
        fit, check=study.check.plan, name="the machine", date="2026-01-31"
    )


@pytest.fixture(scope="module")
def built(machine):
    return {
        name: vcal.compensate(machine, name, {"points": 9}) for name in FORMATS if kind_takes(name)
    }


def kind_takes(name):
    """Formats of this file; others have tests of their own."""
    return name in ("csv", "linuxcnc", "linuxcnc-screw")


# --- the machine ---------------------------------------------------------------------------------


def test_tool_points_and_derivative_are_those_of_the_fit(machine, fit, study):
    plan = study.check.plan
    points, derivative = compensated_points(fit, plan)
    found, slopes = machine.whole.derivative(plan)
    np.testing.assert_allclose(found, points, atol=1e-15, rtol=0)
    mine = [i for i, e in enumerate(fit.model.effects) if not e.on_instrument]
    places = np.concatenate([fit.places_of(i)[0] for i in mine])
    np.testing.assert_allclose(slopes, derivative[:, :, places], atol=1e-15, rtol=0)


def test_uncertainty_is_that_of_the_posterior(machine, fit, study):
    _, derivative = compensated_points(fit, study.check.plan)
    variance = np.einsum("nik,kl,nil->ni", derivative, fit.covariance, derivative)
    found = machine.whole.uncertainty(study.check.plan)
    np.testing.assert_allclose(found, np.sqrt(variance), rtol=1e-9)


def test_error_motions_are_those_of_the_report(machine, fit):
    reported = {table.name: table for table in error_motion_tables(fit, 11)}
    found = machine.error_motions(11)
    assert [t.name for t in found] == [*reported]
    for table in found:
        other = reported[table.name]
        np.testing.assert_allclose(table.u, other.u, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(table.information, other.information, atol=1e-9)
        if table.name in machine.shown:
            np.testing.assert_allclose(table.value, other.value, atol=1e-9)
        else:
            assert not table.value.any()


@pytest.mark.thorough
def test_what_the_readings_do_not_know_is_zero_and_named(machine, built):
    """The tool lies on the axis of Z in this machine: a roll of Z moves nothing."""
    assert "ECZ" in machine.unidentified
    assert not {*machine.unidentified} & {*machine.shown}
    for compensation in built.values():
        assert compensation.not_identified == machine.unidentified
        assert any("ECZ" in text for text in compensation.files.values())


def test_rivals_are_averaged_as_in_the_loop(fit, machine, study):
    other = replace(fit, theta=fit.theta + 0.5)
    plan = study.check.plan
    for averaged in (False, True):
        rivals = [Alternatives(fit, ((0.4, other),), averaged)]
        made = vcal.IdentifiedMachine.of_fit(fit, alternatives=rivals)
        moved, between = model_average(
            rivals, lambda f: compensated_points(f, plan)[0], np.zeros((plan.rows, 3))
        )
        points = compensated_points(fit, plan)[0] + moved
        np.testing.assert_allclose(made.whole.tool_points(plan), points, atol=1e-14)
        variance = made.whole.uncertainty(plan) ** 2 - machine.whole.uncertainty(plan) ** 2
        np.testing.assert_allclose(variance, between, rtol=1e-6, atol=1e-18)
        again = machine_from(json.loads(json.dumps(machine_record(made))))
        np.testing.assert_allclose(again.whole.tool_points(plan), points, atol=1e-14)


def test_geometric_deviations_are_those_of_the_report(fit):
    other = replace(fit, theta=fit.theta + 0.3)
    for rivals in ([], [Alternatives(fit, ((0.4, other),), True)]):
        made = vcal.IdentifiedMachine.of_fit(fit, alternatives=rivals)
        again = machine_from(json.loads(json.dumps(machine_record(made))))
        reported = geometric_tests(fit, alternatives=rivals, size=made.block)
        found = geometric_tests_of(again)
        assert [(t.name, t.what, t.unit) for t in found] == [
            (t.name, t.what, t.unit) for t in reported
        ]
        for one, its in zip(found, reported, strict=True):
            assert one.value == pytest.approx(its.value, abs=1e-6)
            assert one.u == pytest.approx(its.u, rel=1e-6, abs=1e-9)
            assert one.information == pytest.approx(its.information, abs=1e-6)


def test_a_correction_takes_the_tool_to_its_nominal_place(machine):
    class Exact(Tables):
        files = {}

        def applied(self, position, directions, covariates):
            return machine.correction(position, directions, covariates)

    use = working_volume(machine)
    assert np.abs(machine.displacement(use.plan(machine))).max() > 5 * UM
    assert np.abs(left_over(machine, Exact(), use)).max() < 1e-10


def test_positioning_and_backlash_of_an_axis(machine, fit):
    y = np.linspace(0.0, 0.5, 5)
    up, down = (machine.positioning("Y", y, direction) for direction in (1.0, -1.0))
    size = dict((key, v) for key, _, v, _ in fit.parameter_values() if key == "backlash Y")
    np.testing.assert_allclose(up - down, size["backlash Y"] * UM, rtol=1e-9)
    table = next(t for t in error_motion_tables(fit, 5) if t.name == "EYY")
    np.testing.assert_allclose((up + down) / 2, table.value * UM, atol=1e-15)


# --- the record ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def record(machine):
    return json.loads(json.dumps(machine_record(machine), allow_nan=False))


def test_a_record_gives_the_machine_again(machine, record, study):
    again, plan = machine_from(record), study.check.plan
    np.testing.assert_allclose(
        again.whole.tool_points(plan), machine.whole.tool_points(plan), atol=1e-9, rtol=0
    )
    np.testing.assert_allclose(again.uncertainty(plan), machine.uncertainty(plan), rtol=1e-6)
    assert [p.name for p in again.parts] == [p.name for p in machine.parts]
    assert again.unidentified == machine.unidentified and again.ranges == machine.ranges
    one, other = verify(machine, draws=20), verify(again, draws=20)
    assert one.raw["check points"].rms.mean == pytest.approx(other.raw["check points"].rms.mean)


def test_the_record_states_units(record, fit):
    """For other programs: values and covariance in the stated units."""
    stated = {(one["effect"], one["parameter"]): one for one in record["parameters"]}
    for key, p, value, u in fit.parameter_values():
        if (key, p.name) in stated:
            one = stated[key, p.name]
            assert one["unit"] == p.unit and one["value"] == pytest.approx(value)
            assert one["standard_uncertainty"] == pytest.approx(u)
    sizes = [one["standard_uncertainty"] for one in record["parameters"]]
    diagonal = [row[-1] for row in record["covariance"]]
    np.testing.assert_allclose(np.sqrt(diagonal), sizes, rtol=1e-6)


class Own(vcal.Effect):
    """An effect of a user."""

    name = "mine"

    @property
    def parameters(self):
        return (Parameter("size", "um", sigma=5.0),)

    def response(self, plan, shape):
        return {("EXX", "size"): plan.x("X")}


def test_an_effect_of_the_user_is_named_and_refused(machine):
    more = replace(
        machine,
        effects=(Own(placement="X"), *machine.effects),
        shapes=({}, *machine.shapes),
        theta=np.append(0.0, machine.theta),
        covariance=np.pad(machine.covariance, ((1, 0), (1, 0))),
        planned=np.pad(machine.planned, ((1, 0), (1, 0))),
        prior=np.append(1.0, machine.prior),
    )
    with pytest.raises(NotStoredError, match="'mine X', which is one of the user's own"):
        machine_from(json.loads(json.dumps(machine_record(more))))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: r["objects"]["records"][-1].update({"class": "os:system"}), "outside vcal"),
        (lambda r: r["objects"]["records"][-1]["fields"].popitem(), "another version of vcal"),
        (lambda r: r.pop("covariance"), "not complete"),
        (lambda r: r["covariance"].pop(), "no triangle"),
    ],
)
def test_a_damaged_record_is_refused(record, change, said):
    broken = json.loads(json.dumps(record))
    change(broken)
    with pytest.raises(NotStoredError, match=said):
        machine_from(broken)


def test_every_effect_of_a_machine_can_be_stored(study):
    """Its response comes back to the last bit."""
    setup, count = study.model.setup(study.plan), 0
    effects = [e for kind in vcal.CATALOGUE.values() for e in list(kind.candidates(setup))[:1]]
    for effect in (*study.model.effects, *effects):
        if effect.on_instrument:
            continue
        writer = Writer()
        plain = json.loads(json.dumps(writer.plain(effect), allow_nan=False))
        again = Reader(writer.records, writer.arrays).value(plain)
        if study.plan.has(*effect.needs):
            shape = {n: grid[len(grid) // 2] for n, grid in effect.scan(study.plan).items()}
            shape |= {p.name: p.mean * p.si for p in effect.shapes if p.name not in shape}
            theirs = again.response(study.plan, shape)
            for key, values in effect.response(study.plan, shape).items():
                np.testing.assert_array_equal(np.asarray(theirs[key]), np.asarray(values))
            count += 1
        assert again.key == effect.key and again.parameters == effect.parameters
    assert count > 10


# --- formats: what is applied, against what is written -------------------------------------------


def test_csv_against_scipy(built, machine):
    compensation = built["csv"]
    use = working_volume(machine, 6)
    rows = [r for r in compensation.files["corrections.csv"].splitlines() if r[0] != "#"]
    table = list(csv.DictReader(io.StringIO("\n".join(rows))))
    lines = [sorted({float(r[f"{a}_mm"]) for r in table}) for a in "XYZ"]
    shape = [len(line) for line in lines]

    def of(column):
        values = np.array([float(r[column]) for r in table]).reshape(shape)
        return RegularGridInterpolator(lines, values)(1e3 * use.position)

    zero = machine.ranges["T_Y"].mean
    found = np.stack([of(f"correction_{a}_um") for a in "XYZ"], 1)
    for i, name in ((1, "dir_Y"), (None, "T_Y_K")):
        amount = use.directions[:, 1] if i else use.covariates["T_Y"] - zero
        slope = np.stack([of(f"correction_{a}_um_per_{name}") for a in "XYZ"], 1)
        found += amount[:, None] * slope
    applied = compensation.applied(use.position, use.directions, use.covariates)
    np.testing.assert_allclose(1e6 * applied, found, atol=1e-6)


def test_csv_to_subtract(machine, built):
    other = vcal.compensate(machine, "csv", {"sign": "subtract", "points": 9}, parts=False)
    text = other.files["corrections.csv"]
    assert "# sign: subtract from the command: error columns" in text
    rows = [[*map(float, r.split(","))] for r in text.splitlines() if r[0].isdigit()]
    same = built["csv"].files["corrections.csv"]
    expected_rows = [[*map(float, r.split(","))] for r in same.splitlines() if r[0].isdigit()]
    np.testing.assert_allclose(np.array(rows)[:, 3:], -np.array(expected_rows)[:, 3:])


def test_what_the_header_states(built):
    head = built["csv"].files["corrections.csv"].partition("\nX_mm")[0]
    for words in (
        "machine: the machine, w b X Y Z t",
        "date: 2026-01-31",
        "sign: add to the command",
        "tool offset: 0, 0, -120 mm",
        "T_Y: base holds at",
        "units: positions in mm",
        "not identified by the measurement, and zero here:",
    ):
        assert words in head


def test_grids_carry_everything_and_screws_do_not(built):
    for name in ("csv", "linuxcnc"):
        assert not built[name].not_carried
    screw = built["linuxcnc-screw"]
    carried = {part.name for part in screw.carried}
    assert {"EXX", "EYY", "EZZ", "backlash Y"} <= carried
    stays = {part.name: part for part in screw.not_carried}
    assert "depends on T_Y" in stays["thermal_tilt Y"].reason
    assert "by its own position only" in stays["EXY"].reason
    for part in stays.values():
        assert 0.0 < part.stays_rms_um <= part.stays_largest_um


def test_a_screw_table_of_the_volume_is_the_best_of_its_kind(machine):
    """No other function of one position leaves less, e.g. the positioning error of the axis."""
    use = working_volume(machine, 9)
    left = []
    for line in ("volume", "own"):
        tables = vcal.compensate(
            machine, "linuxcnc-screw", {"line": line, "points": 21}, parts=False
        ).tables
        left.append(np.sqrt((left_over(machine, tables, use) ** 2).sum(1).mean()))
    assert left[0] < 0.95 * left[1]


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["csv", "linuxcnc", "linuxcnc-screw"])
def test_rotary_axes_are_refused(machine, name):
    chain = chain_from_string(
        "w C b X Y Z t", {"X": (0, 0.5), "Y": (0, 0.5), "Z": (0, 0.5)}, rotary_m={"C": (0, 0, 0)}
    )
    more = replace(machine, chain=chain, volume=np.vstack([machine.volume, [0.0, 6.0]]), check=None)
    with pytest.raises(vcal.StudyError, match=r"(?s)format .*: found .* C, expected"):
        vcal.compensate(more, name)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"point": 5}, r"unknown option 'point' \(did you mean 'points'"),
        ({"points": "many"}, "option points: found 'many'"),
        ({"points": 60}, "makes 216000 nodes, expected at most"),
        ({"at": {"T_C": 20.0}}, r"option at: found 'T_C'.*\(T_Y\)"),
    ],
)
def test_options_are_checked(machine, options, said):
    with pytest.raises(vcal.StudyError, match=said):
        vcal.compensate(machine, "csv", options)


def test_tables_without_a_condition_hold_where_they_are_asked_to(machine):
    """A screw table for another temperature differs by the tilt at that temperature."""
    use = working_volume(machine)
    warm = machine.ranges["T_Y"].high
    use = replace(use, covariates={"T_Y": np.full(len(use.position), warm)})
    left = []
    for options in ({"points": 11}, {"points": 11, "at": {"T_Y": warm}}):
        tables = vcal.compensate(machine, "linuxcnc-screw", options, parts=False).tables
        left.append(np.sqrt((left_over(machine, tables, use) ** 2).sum(1).mean()))
    assert left[1] < left[0]


def test_unknown_formats(machine):
    with pytest.raises(vcal.StudyError, match=r"unknown compensation format 'cvs' \(did you mean"):
        vcal.compensate(machine, "cvs")


@pytest.mark.parametrize("name", [*FORMATS])
def test_every_format_says_what_it_is(name):
    kind = FORMATS[name]
    for attribute in ("summary", "source", "sign", "units", "resolution", "limits"):
        assert getattr(kind, attribute)
    for key, about in kind.options.model_fields.items():
        assert about.description, key


# --- the expected error --------------------------------------------------------------------------


def test_expected_error_in_closed_form(machine):
    """E mean |r|^2 = mean |r0|^2 + mean tr(D C D'), with r0 and D at the mean of the posterior."""
    use = working_volume(machine)
    errors = drawn_errors(machine, use, draws=4000, seed=1)
    points, slopes = machine.whole.derivative(use.plan(machine.whole))
    variance = np.einsum("nik,kl,nil->n", slopes, machine.covariance, slopes, optimize=True)
    square = ((points - machine.nominal(use.position)) ** 2).sum(1) + variance
    assert (errors**2).sum(2).mean() == pytest.approx(square.mean(), rel=0.02)


@pytest.mark.slow
def test_expected_error_is_the_realised_one(machine, fit):
    """Machines drawn from the prior, measured and identified by the normal equations in scipy: the
    mean of what is foretold is the mean of what is realised.
    """
    mine = [i for i, e in enumerate(fit.model.effects) if not e.on_instrument]
    places = np.concatenate([fit.places_of(i)[0] for i in mine])
    use, nominal = working_volume(machine, 4), None
    random = np.random.default_rng(5)
    sigma = np.where(fit.precision > 0, 1.0, 0.0)
    foretold, realised = [], []
    for seed in range(40):
        truth = random.standard_normal(len(sigma)) * sigma
        readings = fit.jacobian @ truth + random.standard_normal(len(fit.jacobian))
        mean = np.linalg.solve(fit.hessian(), fit.jacobian.T @ readings)
        estimated = replace(machine, theta=mean[places])
        true = replace(machine, theta=truth[places]).whole
        tables = vcal.compensate(estimated, "csv", {"points": 4}, parts=False).tables
        nominal = machine.nominal(use.position) if nominal is None else nominal
        errors = after_alignment(drawn_errors(estimated, use, tables, draws=40, seed=seed), nominal)
        foretold.append(expected(errors).rms.mean)
        left = after_alignment(left_over(true, tables, use)[None], nominal)
        realised.append(expected(left).rms.mean)
    # The mean of 40 has a standard deviation of less than 2 %; benchmarks/compensation.py has 500.
    assert np.mean(foretold) == pytest.approx(np.mean(realised), rel=0.05)
