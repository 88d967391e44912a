"""Broken studies are read or refused in one message, and those that are read can be computed.

``-s`` prints the counts of the campaign of 10,000 inputs; ``benchmarks/fuzz.py`` keeps them.
"""

import time

import pytest

import vcal
from vcal.errors import StudyError

hypothesis = pytest.importorskip("hypothesis", reason="the extra dev has it")

from broken_studies import Outcome, read, studies  # noqa: E402

OPTIONS = {
    "deadline": None,
    "database": None,
    "derandomize": True,
    "suppress_health_check": list(hypothesis.HealthCheck),
}
MOST_SECONDS = 10.0


def fuzz(folder, count, seed=0, then=lambda study: None):
    """Read `count` broken studies; `then` gets those that are accepted."""
    outcome = Outcome()

    @hypothesis.seed(seed)
    @hypothesis.settings(max_examples=count, **OPTIONS)
    @hypothesis.given(studies())
    def one(made):
        began = time.process_time()
        study = read(folder, *made, outcome)
        assert time.process_time() - began < MOST_SECONDS, "it took too long"
        if study is not None:
            then(study)

    one()
    return outcome


def test_a_few_broken_studies(tmp_path):
    outcome = fuzz(tmp_path, 40)
    counts = outcome.counts
    assert counts["refused"] > 0 and counts["refused"] + counts["accepted"] == counts["inputs"]


@pytest.mark.campaign
def test_ten_thousand_broken_studies(tmp_path):
    counts = fuzz(tmp_path, 10_000).counts
    print(dict(sorted(counts.items())))
    assert counts["inputs"] >= 5_000 and counts["accepted"] > 100


@pytest.mark.campaign
def test_the_loop_ends_on_those_that_are_accepted(tmp_path):
    """With a verdict, or with one message."""
    ended = []

    def compute(study):
        if study.measurement is None or len(ended) >= 200:
            return
        try:
            ended.append(
                vcal.close_loop(study.model, study.measurement, check=study.check, draws=25)
            )
        except StudyError as error:
            ended.append(str(error))

    fuzz(tmp_path, 2_500, seed=1, then=compute)
    assert len(ended) >= 200
