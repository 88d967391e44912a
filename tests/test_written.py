"""Numbers in the tables that are written: as many digits as they need, and no more."""

import numpy as np
import pytest

from test_r_test import circles, write
from vcal import StudyError
from vcal.study import load_study, read_table, write_table
from vcal.study.simulated import write_simulated

UNIX = 1700000000.0


def cells(tmp_path, values):
    write_table(tmp_path / "t.csv", {"a": np.asarray(values)})
    return (tmp_path / "t.csv").read_text(encoding="utf-8").split()[1:]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1700000000.8, 1700000001.8, 1700000003.0], ["1700000000.8", "1700000001.8"]),
        ([1700000000.123456, 1700000000.123468, 1700000000.12348], ["1700000000.123456"]),
        ([1700000000.25, 1700000000.25], ["1700000000.25"] * 2),
        ([0.1 + 0.2, 0.1 + 0.2], ["0.3", "0.3"]),
        ([1e3 * 0.1001, 1e3 * 0.2002], ["100.1", "200.2"]),
        ([1.0 / 3.0, 2.0 / 3.0], ["0.3333333333", "0.6666666667"]),
        ([1000.0, 1000.0 + 2e-13], ["1000", "1000"]),
        ([20.0, np.nan, np.inf, 21.0], ["20", "nan", "inf", "21"]),
        (["XY", "YZ"], ["XY", "YZ"]),
        ([True, False], ["1", "0"]),
        ([3, 4], ["3", "4"]),
        ([], []),
    ],
)
def test_digits(tmp_path, values, expected):
    assert cells(tmp_path, values)[: len(expected)] == expected


def test_readings_have_ten_digits(tmp_path):
    noise = np.random.default_rng(0).normal(size=200)
    for values in (noise, 1e3 * (2.0 + noise), 20.0 + 0.5 * noise):
        assert (
            max(len(c.strip("-").replace(".", "").lstrip("0")) for c in cells(tmp_path, values))
            <= 10
        )


@pytest.mark.thorough
def test_times_since_1970_are_kept(tmp_path):
    table = circles(samples=40)
    table["t_s"] = np.round(table["t_s"], 6) + UNIX
    study = load_study(write(tmp_path / "unix", table))
    np.testing.assert_array_equal(study.plan.covariate("t_run"), table["t_s"])
    write_simulated(study, tmp_path / "made")
    again = load_study(tmp_path / "made")
    np.testing.assert_array_equal(again.plan.covariate("t_run"), table["t_s"])


def test_times_that_do_not_rise_are_told_apart(tmp_path):
    table = circles(samples=40)
    table["t_s"] = np.round(table["t_s"], 3) + UNIX
    table["t_s"][[3, 4]] = UNIX + 0.75, UNIX + 0.5
    with pytest.raises(StudyError, match=r"found 1700000000\.5 after 1700000000\.75, expected ris"):
        load_study(write(tmp_path / "unix", table))
    assert read_table(tmp_path / "unix" / "data.csv", [])["t_s"][3] == UNIX + 0.75
