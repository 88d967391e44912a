"""Designing measurements: derivatives, the largest of several criteria, weights, rank."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vcal import Model, Plan, predict
from vcal.design import (
    apportion,
    covariance,
    curvature,
    expanded,
    flat_rank,
    information,
    minimax,
    precision,
    rank_of,
    weigh,
)
from vcal.design.judged import error_motions, judge, straight_lines
from vcal.effects.geometric import ErrorMotion, GeometricErrors, LocationError
from vcal.effects.reversal import Repeatability
from vcal.effects.thermal import WarmUp
from vcal.identification.batch import prepare_batch
from vcal.instruments.laser_frame import LaserFrame, beam_path
from vcal.machine.chain import chain_from_string
from vcal.machine.error_functions import Legendre
from vcal.model.forward import port_values, tool_points
from vcal.model.simulate import prepare

TRAVEL = {"X": (0.0, 0.3), "Y": (0.0, 0.2), "Z": (0.0, 0.25)}


def setup():
    chain = chain_from_string("w b X Y Z t", TRAVEL)
    segments = beam_path("3d", TRAVEL)
    instrument = LaserFrame.of(segments, chain, sigma=1e-6, lever=0.01)
    position = 1e3 * np.concatenate([s.positions for s in segments])
    table = {f"{c}_mm": position[:, i] for i, c in enumerate("xyz")}
    table["segment"] = np.repeat([s.number for s in segments], [s.points for s in segments])
    plan = instrument.plan(chain, table)
    errors = GeometricErrors(
        motions=tuple(
            ErrorMotion(name, name[2], Legendre(TRAVEL[name[2]], (2, 3), 1e-5))
            for name in ("EYX", "EZX", "EXY", "EYZ")
        ),
        locations=(LocationError.of(chain, "EC0Y", 3e-5),),
    )
    noisy = Repeatability(port="EYY", unit="um", placement="Y")
    return Model(chain, instrument, (errors, *instrument.effects(plan), noisy)), plan


@pytest.mark.thorough
def test_the_curvature_is_that_of_an_identification():
    model, plan = setup()
    batch = prepare_batch(model, plan)
    np.testing.assert_allclose(curvature(model, plan), batch.curvature, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(covariance(model, plan), batch.inverse, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(
        information(model, plan).sum(0) + precision(model), batch.curvature, rtol=1e-9, atol=1e-6
    )


@pytest.mark.thorough
def test_its_gradient_against_finite_differences():
    model, plan = setup()
    rng = np.random.default_rng(0)
    d = rng.standard_normal((3, len(model.entries)))
    # Generic places, away from ends and symmetries.
    base = np.asarray(plan.position) + 0.004 * rng.standard_normal(plan.position.shape)
    way = rng.standard_normal(base.shape)

    @jax.jit
    def U(step):
        there = plan.with_position(jnp.asarray(base) + step * way)
        return expanded(jnp.asarray(d), covariance(model, there))

    slope = jax.jacfwd(U)(0.0)
    h = 1e-5
    found = (8.0 * (U(h) - U(-h)) - (U(2 * h) - U(-2 * h))) / (12.0 * h)
    np.testing.assert_allclose(slope, found, rtol=1e-6)


def test_a_free_shape_parameter_is_refused():
    model, plan = setup()
    loose = WarmUp(port="EZZ", unit="um", placement="Z")
    with pytest.raises(ValueError, match="free shape parameter 'tau'"):
        curvature(model.with_effects(loose), plan)


def test_declared_shape_parameters_are_where_they_are_declared():
    model, plan = setup()
    plan = Plan(plan.axes, plan.position, {"t": 10.0 * np.arange(plan.rows)}, plan.groups)
    grown = model.with_effects(
        WarmUp(port="EZZ", unit="um", placement="Z", given=(("tau", 0.25, 0.0),))
    )
    assert grown.shapes_at(plan) == {2: {"tau": 900.0}}
    (motion,) = (m for m in error_motions(grown, plan) if m.name == "EZZ")
    assert np.isfinite(motion.functionals).all() and motion.functionals.any()
    theta = 0.1 * np.ones(len(grown.entries))
    same = predict(grown, plan, theta, {2: {"tau": 900.0}})
    np.testing.assert_array_equal(predict(grown, plan, theta), same)
    assert prepare(grown, plan).fixed == {2: {"tau": 900.0}}


@pytest.mark.thorough
def test_squareness_and_slopes_against_lines_through_the_paths():
    """Angles between numpy's least-squares lines through the paths of the whole forward model."""
    chain = chain_from_string("w X Y b Z t", TRAVEL)
    model, plan = setup()
    own = GeometricErrors(
        motions=tuple(
            ErrorMotion(name, name[2], Legendre(TRAVEL[name[2]], (1, 2, 3), 1e-6))
            for name in ("EXX", "EYX", "EXY", "EXZ", "EBX", "EAY")
        ),
        locations=(LocationError.of(chain, "EC0Y", 3e-6),),
    )
    model = Model(chain, model.instrument, (own,))
    found = {m.name: m for m in straight_lines(model, plan)}
    assert {*found} == {
        "EC(0X)Y", "EB(0X)Z", "EA(0Y)Z", "EXX slope", "EYY slope"
    }  # fmt: skip
    theta = np.random.default_rng(1).standard_normal(len(model.entries))
    middle = [np.mean(TRAVEL[a]) for a in chain.axes]
    ways, slopes = {}, {}
    for k, axis in enumerate(chain.axes):
        q = np.tile(middle, (21, 1))
        q[:, k] = np.linspace(*TRAVEL[axis], 21)
        terms = model.terms(plan.elsewhere(q, np.zeros(21, int)))
        points = np.asarray(tool_points(chain, q, port_values(terms, theta, len(model.layout))))
        ways[axis] = np.polyfit(q[:, k], points, 1)[0]
        slopes[axis] = np.linalg.norm(ways[axis]) - 1.0

    def beyond_square(a, b, sign):
        a, b = (way / np.linalg.norm(way) for way in (ways[a], ways[b]))
        return sign * -np.arcsin(a @ b)

    expected = {
        "EC(0X)Y": beyond_square("X", "Y", 1.0),
        "EB(0X)Z": beyond_square("X", "Z", -1.0),
        "EA(0Y)Z": beyond_square("Y", "Z", 1.0),
        **{f"E{a}{a} slope": slopes[a] for a in "XY"},
    }
    for name, value in expected.items():
        told = float(found[name].functionals[0] @ theta)
        assert told == pytest.approx(value, abs=1e-9), name
    assert abs(expected["EC(0X)Y"]) > 1e-6
    # They count where they are asked for, and only there.
    by_default = judge(model, plan, (3, 3, 3))
    assert all(by_default.motions[i].amplitudes for i in by_default.chosen)
    asked = judge(model, plan, (3, 3, 3), ["EC(0X)Y"])
    assert [asked.motions[i].name for i in asked.chosen] == ["EC(0X)Y"]


def test_rank_by_hand():
    """A frame of unknown pose sees no constant, and no slope of its own."""
    model, plan = setup()
    chain, instrument = model.chain, model.instrument
    line = GeometricErrors(motions=(ErrorMotion("EYX", "X", Legendre(TRAVEL["X"], (2, 3), 1e-5)),))
    found = rank_of(Model(chain, instrument, (line, *instrument.effects(plan))), plan)
    assert (found.columns, found.rank, found.mixed) == (8, 8, ())
    moved = GeometricErrors(motions=(ErrorMotion("EZZ", "Z", Legendre(TRAVEL["Z"], (1, 2), 1e-5)),))
    both = Model(chain, instrument, (moved, *instrument.effects(plan)))
    found = rank_of(both, plan)
    # The beams cross Z at two heights only, and none reads along the upright one.
    assert found.rank < found.columns
    assert {both.entries[i].parameter.name for i in found.mixed} & {"EZZ.P1", "EZZ.P2"}


def test_rank_of_what_has_no_prior():
    """Beside it, what has one takes nothing away; an effect whose shape is yet to be found may be
    told there.
    """
    model, plan = setup()
    found = flat_rank(model, plan)
    assert (found.columns, found.rank, found.mixed) == (6, 6, ())
    flat = (("size_EZZ", 0.0, np.inf),)
    plan = Plan(plan.axes, plan.position, {"t": 10.0 * np.arange(plan.rows)}, plan.groups)
    late = WarmUp(port="EZZ", unit="um", placement="Z", given=flat)
    assert flat_rank(model.with_effects(late), plan).columns == 6
    told = WarmUp(port="EZZ", unit="um", placement="Z", given=(*flat, ("tau", 0.25, 0.0)))
    twice = model.with_effects(told, told)
    found = flat_rank(twice, plan)
    assert (found.columns, found.rank) == (8, 7)
    assert [twice.entries[i].parameter.name for i in found.mixed] == ["size_EZZ"] * 2


def test_minimax_of_known_problems():
    # Two parabolas meet at zero, where neither is at its own minimum.
    def two(z):
        return jnp.stack([(z[0] - 1.0) ** 2, (z[0] + 1.0) ** 2]) + 1.0

    found = minimax(two, np.array([0.8]), np.array([-2.0]), np.array([2.0]))
    assert found.converged and found.z[0] == pytest.approx(0.0, abs=1e-5)
    assert found.largest == pytest.approx(2.0, abs=1e-5)
    np.testing.assert_allclose(found.start, two(np.array([0.8])))
    # A bound and a constraint that hold it back.
    assert minimax(two, np.array([0.8]), np.array([0.5]), np.array([2.0])).z[0] == pytest.approx(
        0.5
    )
    kept = (np.array([[1.0]]), np.array([0.3]))
    found = minimax(two, np.array([0.8]), np.array([-2.0]), np.array([2.0]), at_least=kept)
    assert found.z[0] == pytest.approx(0.3, abs=1e-6)
    # The same with derivatives given.
    by_hand = minimax(
        lambda z: np.asarray(two(z)),
        np.array([0.8]),
        np.array([-2.0]),
        np.array([2.0]),
        slopes=lambda z: np.array([[2.0 * (z[0] - 1.0)], [2.0 * (z[0] + 1.0)]]),
    )
    assert by_hand.largest == pytest.approx(2.0, abs=1e-5)
    with pytest.raises(ValueError, match="violates a bound"):
        minimax(two, np.array([3.0]), np.array([-2.0]), np.array([2.0]))
    with pytest.raises(ValueError, match="not finite"):
        minimax(lambda z: two(z) / 0.0, np.array([0.5]), np.array([-2.0]), np.array([2.0]))


def test_minimax_of_criteria_below_zero():
    def two(z):
        return jnp.stack([(z[0] - 0.3) ** 2 - 1.0, z[0] - 5.0])

    for start in (0.0, 1.3):
        found = minimax(two, np.array([start]), np.array([-1.0]), np.array([2.0]))
        assert found.z[0] == pytest.approx(0.3, abs=1e-3)
        assert found.largest == pytest.approx(-1.0, abs=1e-6)


def test_the_slope_of_an_uncertainty_of_nothing():
    """An odd error is zero in the middle, whatever its amplitude."""
    rows = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, -1.0]])

    def largest(scale):
        C = jnp.diag(scale**2)
        return expanded(rows, C).max() + 0.0 * expanded(rows, C).sum()

    scale = jnp.array([2.0, 1.0])
    U = np.asarray(expanded(rows, jnp.diag(scale**2)))
    np.testing.assert_allclose(U, [0.0, 4.0, 2.0 * np.sqrt(5.0)], atol=1e-14)
    np.testing.assert_allclose(
        jax.grad(largest)(scale), 2.0 * np.array([2.0, 1.0]) / np.sqrt(5.0), rtol=1e-12
    )


def test_weights_of_a_line():
    """Offset and slope of a line: half of the measurements at either end (Kiefer and Wolfowitz)."""
    x = np.linspace(-1.0, 1.0, 21)
    rows = np.stack([np.ones_like(x), x], 1)
    F = np.einsum("nk,nl->nkl", rows, rows)
    found = weigh(F, np.zeros((2, 2)), rows[[0, -1]], 10.0)  # value at both ends
    assert found.largest == pytest.approx(np.sqrt(2.0 / 10.0), rel=1e-3)
    assert found.weights.sum() == pytest.approx(10.0)
    assert found.weights[[0, -1]].min() > 4.9
    # The slope alone; and a quadratic at its ends and middle: no design is better than k / n.
    assert weigh(F, np.zeros((2, 2)), np.array([[0.0, 1.0]]), 4.0).largest == pytest.approx(
        0.5, rel=1e-3
    )
    cubic = np.stack([x**0, x, x**2], 1)
    F = np.einsum("nk,nl->nkl", cubic, cubic)
    assert weigh(F, np.zeros((3, 3)), cubic, 1.0).largest == pytest.approx(3**0.5, rel=2e-3)
    with pytest.raises(ValueError, match="undetermined"):
        weigh(F[:2], np.zeros((3, 3)), cubic, 1.0)


def test_sharing_out():
    assert apportion(np.array([1.0, 1.0, 1.0]), 10).tolist() in ([4, 3, 3], [3, 4, 3], [3, 3, 4])
    assert apportion(np.array([12.03, 11.94, 11.13, 7.1, 8.8]), 51).tolist() == [12, 12, 11, 7, 9]
    assert apportion(np.array([50.0, 0.5, 0.5]), 51, 3).tolist() == [45, 3, 3]
    assert apportion(np.array([2.0, 1.0]), 3).sum() == 3
    with pytest.raises(ValueError, match="at least 15"):
        apportion(np.ones(5), 12, 3)
    for shares in (np.zeros(3), np.array([1.0, np.nan]), np.array([2.0, -1.0])):
        with pytest.raises(ValueError, match="found the shares"):
            apportion(shares, 3)
