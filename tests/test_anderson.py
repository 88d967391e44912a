"""Anderson acceleration: the step in numpy and the one in a compiled program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vcal.numerics.anderson import anderson_step, anderson_step_traced


def problem(seed: int, size: int, moves: int):
    """A metric R and random vectors: the step, the last moves and the changes of the step."""
    rng = np.random.default_rng(seed)
    metric = np.eye(size) + 0.1 * rng.standard_normal((size, size))
    step, moved, changed = (rng.standard_normal(s) for s in (size, (moves, size), (moves, size)))
    return metric, step, moved, changed


def on_host(metric, step, moved, changed):
    """The combined step in numpy: computed in coordinates of the metric, and mapped back."""
    found = anderson_step(metric @ step, metric @ moved.T, metric @ changed.T)
    return np.linalg.solve(metric, found)


@jax.jit
def compiled(metric, step, moved, changed):
    image = (metric @ jnp.concatenate([step[None], changed]).T).T
    return anderson_step_traced(step, moved, changed, image[0], image[1:])


@pytest.mark.parametrize(("size", "moves"), [(1, 1), (3, 2), (7, 3), (40, 3), (40, 1)])
def test_both_give_the_same_step(size, moves):
    for seed in range(10):
        given = problem(seed, size, moves)
        expected = on_host(*given)
        accuracy = 1e-10 * np.abs(expected).max()
        np.testing.assert_allclose(compiled(*given), expected, rtol=0.0, atol=accuracy)


def test_the_predicted_next_step_is_the_shortest_of_all_combinations():
    """Against the normal equations of |R (f - sum w_i c_i)|."""
    metric, step, moved, changed = problem(5, 9, 3)
    normal = metric.T @ metric
    weights = np.linalg.solve(changed @ normal @ changed.T, changed @ normal @ step)
    expected = step - weights @ (moved + changed)
    np.testing.assert_allclose(on_host(metric, step, moved, changed), expected, atol=1e-11)
    np.testing.assert_allclose(compiled(metric, step, moved, changed), expected, atol=1e-11)


def test_a_linear_iteration_in_three_dimensions_ends_after_three_moves():
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    rate, goal = turn @ np.diag([0.9, 0.5, 0.2]) @ turn.T, rng.standard_normal(3)
    x, path, steps = np.zeros(3), [], []
    for _ in range(4):
        path, steps = [*path, x], [*steps, rate @ (goal - x)]
        x = x + steps[-1]
    moved, changed = np.diff(path, axis=0), np.diff(steps, axis=0)
    for found in (on_host, compiled):
        step = found(np.eye(3), steps[-1], moved, changed)
        np.testing.assert_allclose(path[-1] + step, goal, atol=1e-9)


def test_rows_of_zeros_and_repeated_changes_add_nothing():
    """Unused rows of the history are zero; a change that is repeated to rounding is not new."""
    metric, step, moved, changed = problem(8, 6, 2)
    expected = on_host(metric, step, moved, changed)
    none = np.zeros((1, 6))
    found = compiled(metric, step, np.vstack([moved, none]), np.vstack([changed, none]))
    np.testing.assert_allclose(found, expected, atol=1e-11)
    again = np.vstack([changed, (1.0 + 1e-9) * changed[:1]])
    found = compiled(metric, step, np.vstack([moved, moved[:1]]), again)
    np.testing.assert_allclose(found, expected, atol=1e-11)
    found = compiled(metric, step, np.vstack([none, none]), np.vstack([none, none]))
    np.testing.assert_array_equal(found, step)
