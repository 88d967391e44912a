"""Printed numbers beside those that came out."""

import math

from ..registry import Row
from .results import Results
from .setting import FINAL_UM, INITIAL_UM, TESTS
from .trials import Trials


def table(results: Results) -> list[Row]:
    """All printed numbers, and those that belong beside them."""
    first = next(iter(results.many))
    rows = [
        Row("tests", TESTS, float(results.few[first].ensemble.draws), "1", "and a longer campaign"),
        Row("tests, longer campaign", None, float(results.draws), "1"),
        *_initial(results.few[first]),
        *_initial(results.many[first]),
    ]
    for reading in results.many:
        rows += _final(reading, results.few[reading])
        rows += _final(reading, results.many[reading])
    for reading, trials in results.many.items():
        rows += _left(reading, trials)
    failed = sum(t.failed for t in (*results.few.values(), *results.many.values()))
    rows.append(Row("identifications that failed", None, float(failed), "1"))
    rows.append(
        Row(
            "parameters of the machine that the points at Z = 0 can tell apart",
            None,
            float(results.rank.rank),
            "1",
            f"of {results.rank.parameters}; {results.rank.silent} change no reading at all",
        )
    )
    return rows


def _initial(trials: Trials) -> list[Row]:
    pooled = trials.pooled["initial", "distance"]
    tests = _tests(trials)
    error = f"{tests}; standard error of the mean {pooled.u_mean:.2f} µm"
    note = f"{error}. Sizes of the family are found so that both printed numbers are met"
    return [
        Row("initial error, mean of |d|", INITIAL_UM[0], pooled.mean, "um", note),
        Row("initial error, standard deviation of |d|", INITIAL_UM[1], pooled.sd, "um", tests),
    ]


def _final(reading: str, trials: Trials) -> list[Row]:
    pooled = trials.pooled["residual", "distance"]
    note = f"{reading}; {_tests(trials)}; residual of the readings"
    mean, sd = FINAL_UM
    return [
        Row("final error, mean of |d|", mean, pooled.mean, "um", note),
        Row("final error, standard deviation of |d|", sd, pooled.sd, "um", note),
        Row(
            "final error, root mean square",
            math.hypot(mean, sd),
            math.hypot(pooled.mean, pooled.sd),
            "um",
            f"{note}; the printed one from mean and standard deviation",
        ),
        Row(
            "final error, mean + 2 standard deviations",
            mean + 2.0 * sd,
            pooled.mean + 2.0 * pooled.sd,
            "um",
            f"{note}; 95 % lie below {pooled.quantile(0.95):.2f} µm",
        ),
    ]


def _left(reading: str, trials: Trials) -> list[Row]:
    pooled = trials.pooled["left", "distance"]
    note = f"{reading}; {_tests(trials)}; true less predicted point, not to be seen in a workshop"
    return [
        Row("error left, mean of |d|", None, pooled.mean, "um", note),
        Row("error left, standard deviation of |d|", None, pooled.sd, "um", note),
        Row("error left, 95 % lie below", None, pooled.quantile(0.95), "um", note),
    ]


def _tests(trials: Trials) -> str:
    return f"{trials.ensemble.draws} tests"
