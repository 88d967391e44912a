"""Learned family sizes and the robust loss, on machines made by the independent generator."""

import dataclasses

import numpy as np
import pytest

import vcal
from oracle import make_case, write_study
from vcal.distributions import Normal
from vcal.identification.family_sizes import learned_sizes, with_sizes
from vcal.identification.robust import identify_robust
from vcal.loop.weighing.cross_validation import check_rms


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


def test_what_is_declared_of_one_error_stays(study):
    prior = vcal.Prior("EC0Y", Normal(30.0, 2.0))
    effects = study.model.effects
    (place,) = (i for i, e in enumerate(effects) if e.name == "geometric")
    known = dataclasses.replace(effects[place], priors=(prior,))
    model = vcal.Model(
        study.model.chain, study.model.instrument, (*effects[:place], known, *effects[place + 1 :])
    )
    factors = learned_sizes(vcal.identify(model, study.measurement))
    assert "EC0Y" not in factors and "EB0Z" in factors
    for sizes in (factors, {"EC0Y": 0.1}):
        (same,) = (e for e in with_sizes(model, sizes).effects if e.name == "geometric")
        (p,) = (p for p in same.amplitudes if p.name == "EC0Y")
        assert (p.mean, p.sigma) == (30.0, pytest.approx(2.0))


def test_learned_sizes_are_the_most_likely(fit):
    """No factor of one error alone, a fifth larger or smaller, is likelier by the marginal
    likelihood of the linearised fit, with a prior of ln 3 on the logarithm of each; also of those
    that the data hardly tell.
    """
    factors = learned_sizes(fit)
    names = [p.name.split(".")[0] for _, p in fit.entries]
    normal = fit.jacobian.T @ fit.jacobian
    pull = fit.jacobian.T @ (fit.whitened + fit.jacobian @ fit.theta)

    def log_density(logs: dict[str, float]) -> float:
        f = np.exp([logs.get(name, 0.0) for name in names])
        h = normal * f[:, None] * f + np.diag(fit.precision)
        gain = 0.5 * (f * pull) @ np.linalg.solve(h, f * pull) - 0.5 * np.linalg.slogdet(h)[1]
        return gain - 0.5 * sum(v**2 for v in logs.values()) / np.log(3.0) ** 2

    found = {name: float(np.log(value)) for name, value in factors.items()}
    best = log_density(found)
    for name in found:
        for step in (-0.2, 0.2):
            assert log_density(found | {name: found[name] + step}) < best + 1e-3


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
