"""Learned family sizes and the robust loss, on machines made by the independent generator."""

import dataclasses

import numpy as np
import pytest

import vcal
from oracle import make_case, write_study
from vcal.learn import learned_sizes, with_sizes
from vcal.loop.heldout import check_rms
from vcal.robust import identify_robust


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clean")
    write_study(folder, make_case("laser_tracker", "w X b Y Z t", seed=3))
    return vcal.load_study(folder / "setup.toml")


@pytest.fixture(scope="module")
def fit(study):
    return vcal.identify(study.model, study.measurement)


def test_sizes_declared_ten_times_too_large_are_learned_back(study, fit):
    names = [m.name for m in study.model.effects[0].motions]
    wrong = with_sizes(study.model, dict.fromkeys(names, 10.0))
    factors = learned_sizes(vcal.identify(wrong, study.measurement))
    seen = [factors[name] for name in names if name[1] in "XYZ" and name[2] in "XY"]
    assert 0.04 < np.exp(np.mean(np.log(seen))) < 0.25


def test_learning_raises_the_evidence(study, fit):
    learned = vcal.identify(with_sizes(study.model, learned_sizes(fit)), study.measurement)
    assert learned.log_evidence() > fit.log_evidence()


def test_robust_loss_ignores_two_gross_readings(study, fit):
    readings = study.measurement.readings.copy()
    readings[10, 0] += 300e-6
    readings[50, 1] += 1e-4
    spoiled = dataclasses.replace(study.measurement, readings=readings)
    clean = check_rms(fit, study.check)[0].value
    squares = check_rms(vcal.identify(study.model, spoiled), study.check)[0].value
    robust, weights = identify_robust(study.model, spoiled)
    assert set(np.argsort(weights)[:2]) == {10, 50}
    assert check_rms(robust, study.check)[0].value < 1.15 * clean < squares
