"""The history of a machine: tests of series against closed forms and scipy, and its reports."""

import datetime

import numpy as np
import pytest
from scipy.stats import binom, chi2, multivariate_normal

from histories import DATES, STEP, records, write_report, write_reports
from vcal import StudyError
from vcal.history import (
    Entry,
    Part,
    Sample,
    Series,
    Size,
    against_constant,
    effective_number,
    outcomes,
    read_dates,
    read_history,
    read_reports,
)
from vcal.history.change_points import remaining

TIMES = np.array([0.0, 30.0, 90.0, 200.0, 365.0])
U = np.array([1.0, 2.0, 1.0, 0.5, 1.5])
DAYS = [datetime.date(2025, 1, 1) + datetime.timedelta(days=float(t)) for t in TIMES]


def sample(values, times=TIMES, u=U):
    return Sample(times, np.asarray(values)[:, None], (u**2)[:, None, None])


def series(values, u=U, name="EYX: straightness"):
    entries = [
        Entry("measured", Size(np.array([v]), np.array([[s * s]])))
        for v, s in zip(values, u, strict=True)
    ]
    return Series(name, "straightness", (Part("", "um"),), tuple(entries))


# --- the tests of one series ---------------------------------------------------------------------


def test_sizes_are_those_of_weighted_least_squares():
    values = np.array([3.0, 1.0, 4.0, 1.0, 5.0])
    found = against_constant(sample(values))
    assert found is not None
    assert [(a.kind, a.after) for a in found.alternatives] == [
        ("step", 1), ("step", 2), ("step", 3), ("step", 4), ("drift", 0)
    ]  # fmt: skip
    w = 1.0 / U**2
    for k, one in enumerate(found.alternatives[:-1], 1):
        size = np.average(values[k:], weights=w[k:]) - np.average(values[:k], weights=w[:k])
        variance = 1.0 / w[k:].sum() + 1.0 / w[:k].sum()
        assert one.size.value[0] == pytest.approx(size)
        assert one.size.u[0] == pytest.approx(np.sqrt(variance))
        assert one.size.chi2 == pytest.approx(size**2 / variance)
    slope, covariance = np.polyfit(TIMES, values, 1, w=1.0 / U, cov="unscaled")
    drift = found.alternatives[-1].size
    assert drift.value[0] == pytest.approx(slope[0])
    assert drift.u[0] == pytest.approx(np.sqrt(covariance[0, 0]))
    # The chi-square of each is the decrease of the sum of squares that it gives.
    mean = np.average(values, weights=w)
    line = np.polyval(slope, TIMES)
    decrease = (w * ((values - mean) ** 2 - (values - line) ** 2)).sum()
    assert drift.chi2 == pytest.approx(decrease)
    left = chi2.sf((w * (values - line) ** 2).sum(), len(values) - 2)
    assert remaining(sample(values), [], drift=True) == pytest.approx(left)


def test_the_effective_number_is_that_of_the_multivariate_normal():
    """P(largest |z| >= c), with the correlation of the tests, by scipy's integral over a box."""
    unit = [against_constant(sample(U * e)) for e in np.eye(len(U))]
    contrasts = np.array(
        [[a.size.value[0] / a.size.u[0] for a in one.alternatives] for one in unit]
    ).T
    correlation = contrasts @ contrasts.T
    np.testing.assert_allclose(np.diag(correlation), 1.0)
    for limit in (1.0, 2.5):
        box = np.full(len(contrasts), limit)
        normal = multivariate_normal(
            np.zeros(len(box)), correlation, allow_singular=True, seed=1, maxpts=20_000, abseps=1e-4
        )
        wanted = 1.0 - normal.cdf(box, lower_limit=-box)
        number = effective_number(contrasts[:, None, :], limit**2, seed=1, draws=8000)
        assert number * chi2.sf(limit**2, 1) == pytest.approx(wanted, rel=0.02)
    assert 1.0 < number < len(contrasts)
    # Far out the tests no longer share anything; tests of the same contrast are one.
    assert effective_number(contrasts[:, None, :], 100.0, seed=1) == pytest.approx(5.0, rel=0.02)
    assert effective_number(contrasts[[0, 0, 0], None, :], 9.0, seed=1) == pytest.approx(1.0)


def test_two_results_are_compared_by_their_difference():
    found = against_constant(sample([1.0, 4.0], TIMES[:2], U[:2]))
    assert found is not None and found.effective == 1.0
    assert found.p_value == pytest.approx(chi2.sf(3.0**2 / 5.0, 1))
    assert against_constant(sample([1.0], TIMES[:1], U[:1])) is None
    assert against_constant(sample([1.0, 4.0], np.zeros(2), U[:2])) is None  # of one date


def test_parts_are_tested_together_with_their_covariance():
    covariance = np.array([[2.0, 1.2], [1.2, 1.0]])
    values = np.array([[0.0, 0.0], [3.0, -1.0]])
    found = against_constant(Sample(TIMES[:2], values, np.stack([covariance, covariance])))
    assert found is not None
    difference = values[1] - values[0]
    wanted = difference @ np.linalg.inv(2.0 * covariance) @ difference
    assert found.best.size.chi2 == pytest.approx(wanted)
    assert found.p_value == pytest.approx(chi2.sf(wanted, 2))


@pytest.mark.parametrize("parts", [1, 2])
def test_p_values_are_uniform_where_nothing_has_changed(parts):
    """A share alpha of unchanged series is significant, whatever alpha."""
    random = np.random.default_rng(7)
    root = np.linalg.cholesky(np.eye(parts) + 0.5)
    roots = U[:, None, None] * root
    covariances = roots @ roots.swapaxes(1, 2)
    count = 150
    draws = random.standard_normal((count, len(U), parts))
    found = [
        against_constant(Sample(TIMES, np.einsum("nij,nj->ni", roots, one), covariances), seed=i)
        for i, one in enumerate(draws)
    ]
    p = np.array([one.p_value for one in found if one is not None])
    for alpha in (0.05, 0.2, 0.5):
        low, high = binom.interval(0.999, count, alpha)
        assert low <= (p <= alpha).sum() <= high


def test_any_change_in_a_history_without_one_has_probability_alpha():
    random = np.random.default_rng(11)
    alpha, count = 0.2, 40
    alarms = 0
    for _ in range(count):
        drawn = [series(U * random.standard_normal(len(U)), name=f"{i}") for i in range(4)]
        alarms += any(one.changes for one in outcomes(drawn, DAYS, alpha))
    low, high = binom.interval(0.999, count, 1.0 - (1.0 - alpha / 4) ** 4)
    assert low <= alarms <= high


def test_steps_are_found_with_their_sizes_within_their_uncertainties():
    random = np.random.default_rng(3)
    u = np.full(9, 0.5)
    days = [datetime.date(2020 + i, 1, 1) for i in range(9)]
    truth = np.repeat([0.0, 6.0, 2.0], 3)
    errors = []
    for _ in range(20):
        one, still = outcomes(
            [series(truth + u * random.standard_normal(9), u), series(np.zeros(9), u)], days, 0.01
        )
        assert [c.kind for c in one.changes] == ["step", "step"] and not still.changes
        assert [(c.first.year, c.last.year) for c in one.changes] == [(2022, 2023), (2025, 2026)]
        for change, wanted in zip(one.changes, (6.0, -4.0), strict=True):
            assert change.size.u[0] == pytest.approx(0.5 * np.sqrt(2.0 / 3.0))
            errors.append((change.size.value[0] - wanted) / change.size.u[0])
        assert [(s.first, s.last) for s in one.segments] == [(0, 2), (3, 5), (6, 8)]
    inside = (np.abs(errors) <= 2.0).sum()
    low, high = binom.interval(0.999, len(errors), 0.9545)
    assert low <= inside <= high


def test_a_drift_is_told_from_a_step_and_stated_over_the_whole_time():
    u = np.full(9, 0.5)
    days = [datetime.date(2020, 1, 1) + datetime.timedelta(days=100 * i) for i in range(9)]
    (one,) = outcomes([series(np.arange(9.0), u)], days, 0.05)
    (change,) = one.changes
    assert (change.kind, change.first, change.last) == ("drift", days[0], days[-1])
    assert change.size.value[0] == pytest.approx(8.0)
    assert change.size.u[0] == pytest.approx(8.0 * 0.5 / np.sqrt(60.0))
    assert one.segments[0].start[0] == pytest.approx(0.0, abs=1e-9)
    assert one.segments[0].end[0] == pytest.approx(8.0)
    assert one.remaining_p_value == pytest.approx(1.0)


def test_neighbouring_places_widen_the_interval_of_a_step():
    """A result that is hardly known belongs to neither side: the step may be before or after it."""
    for u, first, last in ((50.0, 1, 3), (1.0, 2, 3)):
        uncertain = np.array([1.0, 1.0, u, 1.0, 1.0])
        (one,) = outcomes([series([0.0, 0.0, 0.0, 10.0, 10.0], uncertain)], DAYS, 0.05)
        (change,) = one.changes
        assert (change.kind, change.first, change.last) == ("step", DAYS[first], DAYS[last])


def test_since_the_last_report():
    before = series([0.0, 0.0, 1.0, 2.0, 5.0])
    gone = Series("gone", "effects", (Part("", "um"),), (*before.entries[:4], Entry("not named")))
    one, without = outcomes([before, gone], DAYS, 0.05)
    since = one.since
    assert since is not None and without.since is None
    assert (since.first, since.last) == (DAYS[3], DAYS[4])
    assert since.size.value[0] == pytest.approx(3.0)
    assert since.p_value == pytest.approx(chi2.sf(9.0 / (U[3] ** 2 + U[4] ** 2), 1))


# --- reports -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reports")
    write_reports(folder)
    return read_history(folder)


def test_series_of_a_folder_of_reports(found):
    assert [str(one.date) for one in found.reports] == list(DATES)
    assert found.serial_number == "A 17" and found.machine == "w X b Y Z t"
    by_name = {one.series.name: one for one in found.outcomes}
    assert list(by_name) == [
        "EC(0X)Y: squareness of Y to X",
        "EYX: straightness",
        "thermal_tilt Y",
        "backlash Y",
        "volumetric error, rms",
        "volumetric error, largest",
        "check points, rms before compensation",
        "check points, rms after compensation",
    ]  # the positioning has no information from the data in any report
    (change,) = by_name["EC(0X)Y: squareness of Y to X"].changes
    assert abs(change.size.value[0] - STEP) <= 2.0 * change.size.u[0]
    assert (str(change.first), str(change.last)) == (DATES[2], DATES[3])
    assert [one.series.name for one in found.changed] == ["EC(0X)Y: squareness of Y to X"]
    assert not found.recent and not found.notes
    assert found.tests == 7 * 5 + 1 and 7 < found.effective < found.tests


def test_an_effect_that_was_not_named_stays_in_the_series(found):
    (one,) = found.appeared
    assert one.series.name == "backlash Y"
    assert [entry.state for entry in one.series.entries] == ["not named"] * 3 + ["named"] * 2
    assert [entry.smallest for entry in one.series.entries[:3]] == [(1.5,)] * 3
    (appearance,) = one.appearances
    assert (appearance.what, str(appearance.first)) == ("appeared", DATES[2])
    assert (appearance.value, appearance.u, appearance.smallest) == (6.0, 0.5, 1.5)


def edited(folder, *changes, **more):
    """Two reports of different dates, the second one changed."""
    first, second = (records(i, date=DATES[i]) for i in range(2))
    for change in changes:
        change(*second)
    write_report(folder / "a", *first)
    write_report(folder / "b", *second)
    return read_history(folder, **more)


def state(history, name):
    (one,) = (o for o in history.outcomes if o.series.name == name)
    return [entry.state for entry in one.series.entries]


def test_states_of_effects_without_a_tested_value(tmp_path):
    def with_backlash(report, machine, **keys):
        other, its = records(1, backlash=6.0, date=DATES[1])
        report["effects"] = [other["effects"][0] | keys]
        machine["parameters"], machine["covariance"] = its["parameters"], its["covariance"]

    def ambiguous(report, machine):
        with_backlash(report, machine, status="ambiguous")

    found = edited(tmp_path / "1", ambiguous)
    assert all(o.series.name != "backlash Y" for o in found.outcomes)  # no report to be tested

    def known(report, machine):
        machine["covariance"][1][1] = 0.0

    assert state(edited(tmp_path / "2", known), "thermal_tilt Y") == ["declared", "not stated"]

    def gone(what):
        def change(report, machine):
            report["declared"] = []
            machine["parameters"].pop()
            machine["covariance"].pop()
            report |= what

        return change

    for i, (key, what) in enumerate(
        {
            "not named": {},
            "cannot be seen": {"cannot_be_seen": [{"effect": "thermal_tilt", "placement": "Y"}]},
            "not searched for": {"settings": {"effects": ["backlash"]}},
        }.items()
    ):
        found = edited(tmp_path / f"gone {i}", gone(what))
        assert state(found, "thermal_tilt Y") == ["declared", key]


def test_what_a_reader_has_to_know(tmp_path):
    def otherwise(report, machine):
        machine["working_volume"][0]["high"] = 0.4
        machine["tool_offset_mm"] = [0.0, 0.0, -150.0]
        machine["objects"]["check"] = None
        report["interrupted"] = True

    found = edited(tmp_path / "1", otherwise)
    said = " ".join(found.notes)
    assert "interrupted in b" in said and "tool point has 2 places" in said
    assert "different working volumes" in said
    assert not any("volumetric" in o.series.name for o in found.outcomes)

    write_report(tmp_path / "2", *records(date=DATES[0]))
    alone = read_history(tmp_path / "2")
    assert "one report only" in alone.notes[0] and not alone.tested and not alone.changed


def test_reports_of_different_machines_are_refused(tmp_path):
    def chain(report, machine):
        machine["machine"] = "w b X Y Z t"

    with pytest.raises(StudyError, match=r"kinematic chains \(a: w X b Y Z t; b: w b X Y Z t\)"):
        edited(tmp_path / "1", chain)
    for i, (one, other) in enumerate([("A 17", "A 18"), ("A 17", None)]):
        folder = tmp_path / f"serial {i}"
        write_report(folder / "a", *records(0, date=DATES[0], serial_number=one))
        write_report(folder / "b", *records(1, date=DATES[1], serial_number=other))
        if other is None:
            assert len(read_reports(folder)) == 2
        else:
            with pytest.raises(StudyError, match="b: w X b Y Z t, serial number A 18"):
                read_reports(folder)


def test_reports_of_the_same_readings_are_refused(tmp_path):
    def same(report, machine):
        report["input_files"] = records(0)[0]["input_files"]

    with pytest.raises(StudyError, match="a, b, readings: found the same data file in several"):
        edited(tmp_path, same)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("report.json", "{", "report.json, file: found no JSON"),
        ("report.json", "[]", 'key schema: found null, expected "vcal-report/1"'),
        ("machine.json", '{"schema": "vcal-machine/7"}', 'found "vcal-machine/7"'),
        ("machine.json", None, "machine.json, file: found none"),
    ],
)
def test_records_that_cannot_be_read(tmp_path, file, content, message):
    write_report(tmp_path / "a", *records(date=DATES[0]))
    (tmp_path / "a" / file).unlink()
    if content is not None:
        (tmp_path / "a" / file).write_text(content)
    if file == "report.json" and content is None:
        return
    with pytest.raises(StudyError) as told:
        read_reports(tmp_path)
    assert message in str(told.value)


def test_no_date_is_invented(tmp_path):
    for i, name in enumerate("abc"):
        write_report(tmp_path / name, *records(i, date=DATES[0] if name == "b" else None))
    with pytest.raises(StudyError, match=r"^a, c, date of the measurement: found none") as told:
        read_reports(tmp_path)
    assert "[measurement]" in str(told.value) and "--dates" in str(told.value)
    table = tmp_path / "dates.csv"
    table.write_text("folder,date\na,2020-05-01\nb,2021-05-01\n", encoding="utf-8")
    given = read_dates(table)
    with pytest.raises(StudyError, match="^c, date"):
        read_reports(tmp_path, given)
    found = read_reports(tmp_path, given, written=True)
    assert [(r.folder, str(r.date)) for r in found] == [
        ("a", "2020-05-01"), ("b", "2021-05-01"), ("c", "2026-11-30")
    ]  # fmt: skip
    with pytest.raises(StudyError, match="column folder: found d, expected folders of reports"):
        read_reports(tmp_path, {"d": DAYS[0]}, written=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "header: found nothing, expected folder,date"),
        ("name,date\n", "header: found name,date"),
        ("folder,date\na,14.3.2026\n", "line 2, column date: found '14.3.2026', expected year"),
        ("folder,date\na\n", "line 2: found 1 cells, expected 2"),
        ("folder,date\na,2026-03-14\n\na,2026-03-15\n", "line 4: found 'a' again"),
    ],
)
def test_tables_of_dates_that_cannot_be_read(tmp_path, text, message):
    table = tmp_path / "dates.csv"
    table.write_text(text, encoding="utf-8")
    with pytest.raises(StudyError) as told:
        read_dates(table)
    assert message in str(told.value)
