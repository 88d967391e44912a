"""Gauss-Newton step by step, against numpy and scipy."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from known import KINDS, Known, know_all
from vcal.effects.registry import CATALOGUE
from vcal.identification.linearised import slopes
from vcal.loop.screening.candidates import candidates
from vcal.numerics.anderson import anderson_step
from vcal.numerics.gauss_newton import Point, minimise


def problem(residual, jacobian, precision):
    """Points of min |residual(theta)|^2 + theta' L theta; `jacobian` is that of the model, which
    is the reading less the residual.
    """
    points = []

    def at(theta):
        left = residual(theta)
        points.append(
            Point(
                theta=theta,
                precision=precision,
                residual=left[:, None],
                by_port=np.zeros((len(left), 1, 0)),
                whitened=left,
                derive=lambda: -jacobian(theta).T,
            )
        )
        return points[-1]

    return at, points


def test_a_linear_problem_takes_one_step():
    rng = np.random.default_rng(1)
    a, y = rng.standard_normal((40, 5)), rng.standard_normal(40)
    precision = np.array([0.0, 1.0, 4.0, 0.0, 2.0])
    at, _ = problem(lambda x: y - a @ x, lambda _: -a, precision)
    found, steps, ended = minimise(at, np.zeros(5), 1e-9)
    both = np.concatenate([a, np.diag(np.sqrt(precision))])
    expected = np.linalg.lstsq(both, np.concatenate([y, np.zeros(5)]))[0]
    np.testing.assert_allclose(found.theta, expected, rtol=1e-12, atol=1e-12)
    assert (steps, ended) == (1, True)
    left = np.concatenate([y, np.zeros(5)]) - both @ expected
    assert found.cost == pytest.approx(left @ left, rel=1e-12)
    assert found.decrement < 1e-10


def circle(seed, noise):
    """Distances of points all around from a centre, measured badly: curved, with much left over."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * np.pi, 60)
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    measured = 1.0 + noise * rng.standard_normal(60)

    def residual(x):
        return measured - np.linalg.norm(points - x, axis=1)

    def jacobian(x):
        away = points - x
        return away / np.linalg.norm(away, axis=1)[:, None]

    return residual, jacobian


def test_curved_problems_with_large_residuals_end_where_scipy_does():
    taken, alone, begin = 0, 0, np.array([0.2, -0.1])
    for seed in range(8):
        residual, jacobian = circle(seed, 0.6)
        at, points = problem(residual, jacobian, np.zeros(2))
        found, steps, ended = minimise(at, begin, 1e-8)
        expected = least_squares(residual, begin, jac=jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-14)
        assert ended
        np.testing.assert_allclose(found.theta, expected.x, atol=1e-7)
        assert steps == len(points) - 1
        taken, x = taken + steps, begin
        for _ in range(200):
            step = np.linalg.lstsq(-jacobian(x), residual(x))[0]
            if np.linalg.norm(jacobian(x) @ step) < 1e-8:
                break
            x, alone = x + step, alone + 1
    # Gauss-Newton alone converges linearly.
    assert taken < 0.8 * alone


def test_what_is_badly_conditioned_is_left_alone():
    rng = np.random.default_rng(2)
    a, y = rng.standard_normal((40, 3)), rng.standard_normal(40)
    for third in (a[:, 0] + 1e-8 * a[:, 2], 0.0 * a[:, 0], np.nan * a[:, 0]):
        columns = np.column_stack([a[:, :2], third])
        at, _ = problem(lambda x, c=columns: y - c @ x, lambda _, c=columns: -c, np.zeros(3))
        found, steps, ended = minimise(at, np.zeros(3), 1e-6)
        assert (steps, ended, found.well_conditioned) == (0, False, False)
        np.testing.assert_array_equal(found.theta, 0.0)


def test_what_runs_away_is_left_alone():
    """exp(-x) falls for ever."""
    at, points = problem(
        lambda x: np.exp(-x) * np.ones(3),
        lambda x: -np.exp(-x)[None] * np.ones((3, 1)),
        np.zeros(1),
    )
    found, steps, ended = minimise(at, np.zeros(1), 1e-9)
    assert not ended
    assert found.cost < points[0].cost
    assert found is points[-1]
    assert len(points) == steps + 1 < 30


def test_without_parameters_there_is_nothing_to_do():
    at, _ = problem(lambda _: np.ones(4), lambda _: np.zeros((4, 0)), np.zeros(0))
    found, steps, ended = minimise(at, np.zeros(0), 1e-5)
    assert (steps, ended, found.cost) == (0, True, 4.0)


def test_steps_of_a_linear_iteration_taken_together_end_it():
    """x -> x + B (c - x): after as many moves as there are directions the rest is known."""
    rng = np.random.default_rng(3)
    rate = np.diag([0.9, 0.5, 0.2])
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    b, c = turn @ rate @ turn.T, rng.standard_normal(3)
    x, way, steps = np.zeros(3), [], []
    for _ in range(4):
        way, steps = [*way, x], [*steps, b @ (c - x)]
        x = x + steps[-1]
    moved, changed = np.diff(way, axis=0).T, np.diff(steps, axis=0).T
    np.testing.assert_allclose(way[-1] + anderson_step(steps[-1], moved, changed), c, atol=1e-9)


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> dict[str, Known]:
    return know_all(tmp_path_factory.mktemp("known"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.thorough
def test_slopes_by_differences_are_the_derivatives(known, kind):
    """Of every kind of candidate with a shape that moves, at a place between the steps of its scan,
    some of them kinks.
    """
    it, seen = known[kind], set()
    for effect in candidates(it.model, it.measurement, CATALOGUE.values())[0]:
        moving = {p.name for p in effect.shapes if p.moves}
        if not moving or effect.name in seen:
            continue
        seen.add(effect.name)
        model = it.model.with_effects(effect)
        place, shape = len(model.effects) - 1, {}
        for name, grid in effect.scan(it.plan).items():
            here = len(grid) // 2
            other = max(here - 1, 0) if name in moving else here
            shape[name] = float(0.63 * grid[here] + 0.37 * grid[other])
        theta = np.zeros(len(model.entries))
        theta[model.places[place]] = 1.0
        shapes = {**model.shapes_at(it.plan), place: shape}
        exact, nearly = (slopes(model, it.plan, shapes, theta, way) for way in (False, True))
        assert len(exact) == len(nearly) == len(moving)
        for one, other in zip(exact, nearly, strict=True):
            np.testing.assert_array_equal(one.port, other.port)
            largest = np.abs(one.values).max()
            assert largest > 0.0
            np.testing.assert_allclose(other.values, one.values, atol=1e-6 * largest, rtol=0)
    assert seen


@pytest.mark.parametrize(("bent", "same"), [(1e-4, True), (0.3, False)])
def test_on_the_way_the_derivative_of_the_step_before_is_enough_where_it_is_the_same(bent, same):
    """Of a line that is bent by so much on the way."""
    a = np.array([1.0, 2.0, -1.0])
    derived: list[float] = []

    def at(theta: np.ndarray) -> Point:
        x = float(theta[0])
        slope = a * (1.0 + bent * x)

        def derive() -> np.ndarray:
            derived.append(x)
            return slope[None, :]

        left = a * (0.01 - 0.5 * bent * x**2 - x)
        by_port = slope[:, None, None]
        return Point(np.array([x]), np.zeros(1), left[:, None], by_port, left, derive)

    begin = np.array([1.0])
    found, steps, ended = minimise(at, begin, 1e-2, reuse_derivative=True)
    assert ended and steps >= 1
    assert found.theta[0] == pytest.approx(0.01, abs=1e-2)
    np.testing.assert_allclose(found.rows[0], a, rtol=1e-2)
    assert (derived == [1.0]) == same
    # What is reported has its own.
    exact, *_ = minimise(at, begin, 1e-9)
    assert derived[-1] == exact.theta[0]
