"""Effects that hide each other: what subsets of them are worth, and which are found."""

import itertools
import math

import numpy as np
import pytest

from known import Known
from vcal import Measurement, identify
from vcal.loop.screening.score_test import ScoreTest
from vcal.loop.search.state import chi2_per_dof
from vcal.loop.weighing.rivals import refit_all
from vcal.loop.weighing.subsets import _Linear, _together, smallest_subset

EFFECTS = (
    "backlash:X",
    "lateral_reversal:Z:component=EYZ",
    "scale_growth:Z",
    "lateral_reversal:Y:component=EXY",
)


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("subsets"))


def rivals_of(it: Known, *present: str):
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    noise = sigma * np.random.default_rng(4).standard_normal(sigma.shape)
    readings = it.readings(*map(it.effect, present)) + noise
    base = identify(it.model, Measurement(it.plan, readings), room=it.room)
    state = ScoreTest(base, 20, 0)
    peaks = [state.tests([it.effect(text)])[0].peaks(1)[0] for text in EFFECTS]
    keep = np.ones(len(it.plan.position), bool)
    rivals = refit_all(base, peaks, {p.effect.name: 3 for p in peaks}, keep, it.room)
    return base, rivals, keep


def test_the_evidence_of_a_subset_is_that_of_its_fit(known):
    base, rivals, keep = rivals_of(
        known, "backlash:X:size_um=8", "scale_growth:Z:alpha_um_per_m_K=5"
    )
    linear = _Linear.of(base, rivals)
    for places in itertools.combinations(range(len(rivals)), 2):
        fit = _together(base, tuple(rivals[i] for i in places), keep, known.room)
        prior = float(fit.theta**2 @ fit.precision)
        assert linear.chi2(places) == pytest.approx(fit.chi2 + prior, rel=1e-4)
        assert linear.declared_chi2(places) == pytest.approx(fit.chi2, rel=1e-3)
        # Both fits have the declared noise: at more, their minimum is a little off.
        for noise, within in ((1.0, 0.01), (1.7, 1.0)):
            gain = fit.log_evidence(noise) - base.log_evidence(noise)
            gain += sum(rivals[i].log_prior for i in places)
            assert linear.log_evidence(places, noise) == pytest.approx(gain, abs=within)


@pytest.mark.parametrize("number", [2, 3])
def test_no_more_are_taken_than_are_needed(known, number):
    present = (
        "backlash:X:size_um=20",
        "lateral_reversal:Y:component=EXY,size_EXY_um=20",
        "lateral_reversal:Z:component=EYZ,size_EYZ_um=-30",
    )[:number]
    base, rivals, keep = rivals_of(known, *present)

    def enough(fit) -> bool:
        return chi2_per_dof(fit) < 1.3

    found = smallest_subset(base, rivals, enough, math.inf, keep, known.room)
    assert found is not None
    keys = {" ".join(text.split(":")[:2]) for text in present}
    assert {rival.effect.key for rival in found.rivals} == keys
    assert smallest_subset(base, rivals, lambda fit: False, math.inf, keep, known.room) is None
    assert smallest_subset(base, rivals, enough, 0.0, keep, known.room) is None
