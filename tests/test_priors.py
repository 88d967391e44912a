"""Distributions as priors of the parameters of effects."""

import dataclasses
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from known import know_all
from vcal import StudyError, load_study
from vcal.distributions import (
    Arcsine,
    Beta,
    CurvilinearTrapezoid,
    Empirical,
    Gamma,
    LogNormal,
    MultivariateNormal,
    MultivariateT,
    Normal,
    StudentT,
    Trapezoidal,
    Triangular,
    Uniform,
)
from vcal.machine.parameters import Prior
from vcal.model.prior import Amplitudes
from vcal.model.simulate import draw, draw_scatter, ideal_readings, prepare
from vcal.numerics.compiled import jit_outermost
from vcal.uncertainty import ErrorMotionErrors, linearised, virtual_pair
from vcal.uncertainty.linear import sources
from vcal.uncertainty.quantities import State

KEYS = jax.random.split(jax.random.key(5), 4000)


@pytest.fixture(scope="module")
def tracker(tmp_path_factory):
    return know_all(tmp_path_factory.mktemp("known"))["laser_tracker"]


@pytest.fixture(scope="module")
def screw(tracker):
    return tracker.effect("screw_cyclic:X")


SLOW = pytest.mark.thorough
UNIVARIATE = [
    Normal(3.0, 2.0),
    StudentT(3.0, 2.0, 5),
    Uniform(8.0, 12.0),
    Triangular(0.0, 3.0, 1.0),
    Arcsine(-1.0, 2.0),
    Trapezoidal(0.0, 4.0, 0.5),
    CurvilinearTrapezoid(0.0, 4.0, 0.5),
    LogNormal(0.5, 0.4),
    Gamma(2.0, 1.5),
    Beta(2.0, 3.0),
    Empirical(np.linspace(0.0, 1.0, 50) ** 2),
]


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(law, marks=() if isinstance(law, Normal | Triangular | Empirical) else SLOW)
        for law in UNIVARIATE
    ],
    ids=lambda law: law.name,
)
@pytest.mark.thorough
def test_machines_are_drawn_from_the_declared_distribution(law, screw):
    effect = dataclasses.replace(screw, priors=(Prior("sine", law),))
    own = effect.amplitudes[0]
    assert own.mean == pytest.approx(float(law.mean))
    assert own.sigma == pytest.approx(float(law.std))
    theta = np.asarray(jax.jit(jax.vmap(Amplitudes.of([effect]).sample))(KEYS))
    value = own.mean + own.sigma * theta[:, 0]
    # The share of the draws below x is F(x): uniform, but for an empirical one's steps.
    share = np.asarray(law.cdf(value)) if law.name != "empirical" else None
    if share is None:
        drawn = np.sort(value)
        asked = np.asarray(law.quantile((np.arange(len(drawn)) + 0.5) / len(drawn)))
        assert np.abs(drawn - asked).mean() < 0.05 * float(law.std)
    else:
        assert stats.kstest(share, "uniform").pvalue > 1e-3
    # The parameter beside it is drawn as before.
    plain = jax.random.normal(jax.random.fold_in(KEYS[7], 0), (2,))
    np.testing.assert_array_equal(theta[7, 1], plain[1])


@pytest.mark.thorough
def test_a_joint_distribution(screw):
    covariance = [[4.0, -1.2], [-1.2, 1.0]]
    for law in (
        MultivariateNormal([1.0, 2.0], covariance),
        MultivariateT([1.0, 2.0], covariance, 8),
    ):
        effect = dataclasses.replace(screw, priors=(Prior(("sine", "cosine"), law),))
        theta = np.asarray(jax.vmap(Amplitudes.of([effect]).sample)(KEYS))
        sigma = np.array([p.sigma for p in effect.amplitudes])
        found = np.cov(theta.T) * np.outer(sigma, sigma)
        np.testing.assert_allclose(found, law.covariance, rtol=0.12)
        assert [p.mean for p in effect.amplitudes] == [1.0, 2.0]


def test_a_joint_distribution_with_a_number_that_is_known(screw):
    """Without variance there is nothing to standardise: it stays at its mean."""
    law = MultivariateNormal([1.0, 2.0], [[4.0, 0.0], [0.0, 0.0]])
    effect = dataclasses.replace(screw, priors=(Prior(("sine", "cosine"), law),))
    prior = Amplitudes.of([effect])
    theta = np.asarray(jax.vmap(prior.sample)(KEYS))
    assert theta[:, 0].std() == pytest.approx(1.0, abs=0.05)
    np.testing.assert_array_equal(theta[:, 1], 0.0)
    np.testing.assert_allclose(prior.root @ prior.root.T, np.diag([1.0, 0.0]), atol=1e-15)


@pytest.mark.campaign
def test_a_joint_distribution_counts_jointly_in_the_gum(tracker, screw):
    effect = dataclasses.replace(screw, given=(("pitch", 20.0, 0.0),))
    law = MultivariateNormal([0.0, 0.0], [[4.0, -1.8], [-1.8, 1.0]])
    effect = dataclasses.replace(effect, priors=(Prior(("sine", "cosine"), law),))
    truth = tracker.model.with_effects(effect)
    pair = virtual_pair(truth, tracker.model, tracker.plan)
    parameters = sources(pair)[effect.key].parameters
    assert parameters is not None
    np.testing.assert_allclose(
        (parameters @ parameters.T)[-2:, -2:], [[1.0, -0.9], [-0.9, 1.0]], atol=1e-12
    )
    # The same by draws, of which a fit that knows nothing of the effect makes what it can.
    measure = ErrorMotionErrors(nodes=3).measure(pair)
    told = linearised(pair, [measure]).budget
    still = jnp.zeros(len(truth.entries))
    scatter = jnp.zeros((tracker.plan.rows, 0))

    def judged(two):
        true = still.at[-2:].set(two)
        found, _ = pair.batch.linear(ideal_readings(pair.simulator, true, scatter))
        return measure(State(true, {}, found, {}))["error motion"]

    drawn = jax.vmap(Amplitudes.of([effect]).sample)(KEYS)
    u = np.asarray(jit_outermost(jax.vmap(judged))(drawn)).std(0)
    moved = u > 0.05 * u.max()
    assert moved.sum() > 5
    contribution = told.contribution[moved, told.source.labels.index(effect.key)]
    np.testing.assert_allclose(contribution, u[moved], rtol=0.06)


@pytest.mark.thorough
def test_a_shape_parameter_in_its_own_unit(tracker, screw):
    effect = dataclasses.replace(screw, priors=(Prior("pitch", Uniform(19.0, 21.0)),))
    model = tracker.model.with_effects(effect)
    simulator = prepare(model, tracker.plan, draw_shapes=True)
    place = len(model.effects) - 1
    drawn = jax.jit(jax.vmap(lambda k: draw(simulator, k).shapes[place]["pitch"]))(KEYS[:500])
    assert stats.kstest((np.asarray(drawn) * 1e3 - 19.0) / 2.0, "uniform").pvalue > 1e-3


@pytest.mark.thorough
def test_the_fourier_family_is_uniform(tracker):
    geometric = next(e for e in tracker.model.effects if e.name == "geometric")
    theta = np.asarray(jax.vmap(Amplitudes.of([geometric]).sample)(KEYS))
    assert np.abs(theta).max() <= np.sqrt(3.0)
    for column in theta.T[:5]:
        share = (column / np.sqrt(3.0) + 1.0) / 2.0
        assert stats.kstest(share, "uniform").pvalue > 1e-3
    np.testing.assert_allclose(theta.std(0), 1.0, atol=0.04)


@pytest.mark.thorough
def test_scatter_has_a_distribution_too(tracker):
    scatter = tracker.effect("repeatability:X")
    (p,) = scatter.amplitudes
    effect = dataclasses.replace(scatter, priors=(Prior(p.name, Uniform(-3.0, 3.0)),))
    simulator = prepare(tracker.model.with_effects(effect), tracker.plan)
    drawn = np.asarray(jax.vmap(lambda k: draw_scatter(simulator, k))(KEYS[:100])).ravel()
    assert np.abs(drawn).max() <= np.sqrt(3.0)
    assert drawn.std() == pytest.approx(1.0, abs=0.05)
    shifted = dataclasses.replace(effect, priors=(Prior(p.name, Uniform(0.0, 3.0)),))
    with pytest.raises(ValueError, match="expected a univariate one with the mean zero"):
        prepare(tracker.model.with_effects(shifted), tracker.plan)


@pytest.mark.thorough
def test_the_budget_names_them(tracker, screw):
    effect = dataclasses.replace(screw, given=(("pitch", 20.0, 0.0),))
    effect = dataclasses.replace(effect, priors=(Prior("sine", Triangular(-5.0, 5.0)),))
    pair = virtual_pair(tracker.model.with_effects(effect), tracker.model, tracker.plan)
    source = linearised(pair, [ErrorMotionErrors(nodes=2).measure(pair)]).budget.source
    named = dict(zip(source.labels, source.distributions, strict=True))
    assert named["screw_cyclic X"] == "triangular, normal"
    assert named["geometric"] == "uniform"


def test_mistakes(screw):
    with pytest.raises(ValueError, match="found a distribution of 2 numbers"):
        Prior("sine", MultivariateNormal([0.0, 0.0], np.eye(2)))
    twice = dataclasses.replace(
        screw, given=(("sine", 1.0, 0.0),), priors=(Prior("sine", Uniform(0.0, 1.0)),)
    )
    with pytest.raises(ValueError, match="each at most once"):
        _ = twice.amplitudes
    joint = Prior(("sine", "pitch"), MultivariateNormal([0.0, 20.0], np.eye(2)))
    with pytest.raises(ValueError, match="shape parameter pitch in a distribution of several"):
        _ = dataclasses.replace(screw, priors=(joint,)).shapes


GROWTH = """
[[model.effect]]
name = "scale_growth"
placement = "X"
"""


def told(folder, line):
    path = folder / "setup.toml"
    before = path.read_text(encoding="utf-8")
    path.write_text(before + GROWTH + line + "\n", encoding="utf-8")
    tomllib.loads(path.read_text(encoding="utf-8"))
    try:
        return load_study(path).model.effects
    finally:
        path.write_text(before, encoding="utf-8")


def test_in_a_study_file(small_tracker_study):
    line = 'alpha_um_per_m_K = { distribution = "uniform", low = 8, high = 12 }'
    effect = next(e for e in told(small_tracker_study, line) if e.name == "scale_growth")
    (p,) = effect.amplitudes
    assert p.mean == 10.0
    assert p.sigma == pytest.approx(4.0 / np.sqrt(12.0))
    assert p.law.name == "uniform"
    assert float(p.law.low) == 8.0


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("alpha_um_per_m_K = { low = 8, high = 12 }", "alpha_um_per_m_K.distribution"),
        (
            'alpha_um_per_m_K = { distribution = "unifrom", low = 8, high = 12 }',
            "did you mean 'uniform'",
        ),
        ('alpha_um_per_m_K = { distribution = "uniform", low = 8 }', "high missing"),
        ('alpha_um_per_m_K = { distribution = "uniform", low = 9, high = 8 }', "low < high"),
        ('alpha_um_per_m_K = { distribution = "normal", mean = 1, std = -1 }', "above 0"),
        (
            'alpha_um_per_m_K = { distribution = "uniform", low = 8, high = 12, x = 1 }',
            "unknown setting 'x'",
        ),
        ('alpha_um_per_m_K = { distribution = "t", mean = 0, scale = 1, dof = 2 }', "more than 2"),
        ('alpha_um_per_m_K_sigma = { distribution = "uniform", low = 8, high = 12 }', "a number"),
        ('alfa_um_per_m_K = { distribution = "uniform", low = 8, high = 12 }', "unknown key"),
        (
            "alpha_um_per_m_K = { distribution = 'uniform', low = 8, high = 12 }\n"
            "alpha_um_per_m_K_sigma = 1",
            "given twice",
        ),
    ],
)
def test_mistakes_in_a_study_file(small_tracker_study, line, said):
    with pytest.raises(StudyError) as error:
        told(small_tracker_study, line)
    assert said in str(error.value)
    assert "model.effect.0" in str(error.value)
