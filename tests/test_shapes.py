"""Steps of shape parameters: at the end of a scan, and where the linear model is wrong."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares, minimize_scalar

from known import Known
from vcal import Effect, Measurement, Parameter, Plan, identify
from vcal.effects.cyclic import ScrewCyclic
from vcal.geometry.compensated import compensated_points
from vcal.identification.fit import shape_step
from vcal.identification.shape_steps import ShapeSteps, Step
from vcal.loop.empirical import Kink


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("shapes"))


class Hump(Effect):
    """A hump of X in Z, from three hundredths of the travel on."""

    name = "hump"
    narrowest = 0.03

    @property
    def parameters(self):
        return (
            Parameter("a", "um", sigma=50.0),
            Parameter("centre", "m", shape=True),
            Parameter("width", "m", shape=True),
        )

    @property
    def needs(self):
        return ("X",)

    def response(self, plan, shape):
        x = plan.x("X")
        return {("EZX", "a"): jnp.exp(-0.5 * ((x - shape["centre"]) / shape["width"]) ** 2)}

    def scan(self, plan):
        x = np.asarray(plan.x("X"))
        travel = float(np.ptp(x))
        return {
            "centre": np.linspace(x.min(), x.max(), 41),
            "width": travel * np.geomspace(self.narrowest, 0.3, 9),
        }


def cost_at(it: Known, measurement: Measurement, shape: dict[str, float]) -> float:
    """The least cost of a hump whose shape is known, which is a linear problem."""
    given = tuple((name, float(value), 0.0) for name, value in shape.items())
    fit = identify(it.model.with_effects(Hump(given=given)), measurement, room=it.room)
    return fit.chi2 + float(fit.theta**2 @ fit.precision)


@pytest.mark.thorough
def test_at_an_end_of_the_scan_all_others_are_at_their_best(tracker):
    """A hump narrower than any that is looked for: the narrowest, with the amplitude and the centre
    that suit that, by scipy over the centre.
    """
    x = np.asarray(tracker.plan.x("X"))
    travel, at = float(np.ptp(x)), float(np.quantile(np.unique(x), 0.4))
    true = {"a": 80.0, "centre": at, "width": 0.012 * travel}
    hump = Hump(given=tuple((name, float(v), 0.0) for name, v in true.items()))
    sigma = tracker.instrument.noise(tracker.plan, tracker.measurement.readings)
    noise = sigma * np.random.default_rng(5).standard_normal(sigma.shape)
    measurement = Measurement(tracker.plan, tracker.readings(hump) + noise)
    place = len(tracker.model.effects)
    begin = {place: {"centre": at + 0.01 * travel, "width": 0.05 * travel}}
    model = tracker.model.with_effects(Hump())
    fit = identify(model, measurement, shapes=begin, room=tracker.room)
    assert fit.converged
    narrowest = Hump().scan(tracker.plan)["width"].min()
    assert fit.shapes[place]["width"] == narrowest
    cost = fit.chi2 + float(fit.theta**2 @ fit.precision)
    found = minimize_scalar(
        lambda c: cost_at(tracker, measurement, {"centre": c, "width": narrowest}),
        bounds=(at - 0.03 * travel, at + 0.03 * travel),
        method="bounded",
        options={"xatol": 1e-6 * travel},
    )
    assert cost == pytest.approx(found.fun, abs=0.01)
    assert fit.shapes[place]["centre"] == pytest.approx(found.x, abs=1e-3 * travel)
    uphill = fit.jacobian.T @ fit.whitened - fit.precision * fit.theta
    *others, width = uphill / np.sqrt((fit.jacobian**2).sum(0) + fit.precision)
    assert np.abs(others).max() < 0.02  # standard uncertainties
    assert width < -0.1  # and the width would go further


def iterated(factor: float, start: float, best: float = 0.3) -> tuple[list[float], bool]:
    """The values of a shape whose linear model steps `factor` times the distance to the minimum of
    100 (s - best)^2, in a scan of steps of 0.1 from 0 to 1; and whether the iteration ended.
    """
    p = SimpleNamespace(name="s", moves=True, si=1.0)
    effect = SimpleNamespace(shapes=(p,), scan=lambda plan: {"s": np.linspace(0.0, 1.0, 11)})

    def at_best(shapes):
        s = shapes[0]["s"]
        cost = 100.0 * (s - best) ** 2

        def step(still):
            # The linear model predicts half of the reduction.
            moves = np.where(still, 0.0, factor * (best - s) / 0.1)
            return Step(np.zeros(1), moves, 0.0 if still.all() else 0.5 * cost)

        return SimpleNamespace(shapes=shapes, cost=cost, step=step)

    iteration = ShapeSteps(SimpleNamespace(effects=(effect,)), None)  # type: ignore[arg-type]
    shapes, values = {0: {"s": start}}, []
    for _ in range(25):
        values.append(shapes[0]["s"])
        if iteration.converged(at_best(shapes)):
            return values, True
        shapes, _ = iteration.propose()
    return values, False


def test_what_is_foretold_elsewhere_is_as_certain_as_its_shape(tracker):
    """Derivatives of tool points by the centre and the width of a hump, against differences."""
    x = np.asarray(tracker.plan.x("X"))
    travel, at = float(np.ptp(x)), float(np.quantile(np.unique(x), 0.4))
    true = {"a": 80.0, "centre": at, "width": 0.12 * travel}
    hump = Hump(given=tuple((name, float(v), 0.0) for name, v in true.items()))
    place, model = len(tracker.model.effects), tracker.model.with_effects(Hump())
    begin = {place: {name: true[name] for name in ("centre", "width")}}
    measurement = Measurement(tracker.plan, tracker.readings(hump))
    fit = identify(model, measurement, shapes=begin, room=tracker.room)
    elsewhere = Plan(tracker.plan.axes, np.asarray(tracker.plan.position)[::7] * 0.9)
    _, derivative = compensated_points(fit, elsewhere)
    grids = Hump().scan(tracker.plan)
    for k, p in enumerate(Hump().shapes, start=len(model.entries)):
        value = fit.shapes[place][p.name]
        step = shape_step(p, value, grids)
        ends = [
            compensated_points(
                dataclasses.replace(
                    fit, shapes={**fit.shapes, place: {**fit.shapes[place], p.name: value + h}}
                ),
                elsewhere,
            )[0]
            for h in (-1e-4 * step, 1e-4 * step)
        ]
        slope = (ends[1] - ends[0]) / 2e-4
        assert np.abs(slope).max() > 1e-6
        np.testing.assert_allclose(derivative[:, :, k], slope, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.6, 2.8, 6.0])
def test_the_iteration_converges_where_steps_are_too_long(factor):
    values, ended = iterated(factor, 0.33)
    assert ended
    assert values[-1] == pytest.approx(0.3, abs=2e-3)


def test_no_shape_moves_by_more_than_a_step_of_its_scan():
    values, ended = iterated(1.0, 0.85)
    assert ended and values[-1] == pytest.approx(0.3, abs=2e-3)
    assert np.abs(np.diff(values)).max() <= 0.1 + 1e-12


def test_a_shape_is_held_at_the_end_of_its_scan():
    values, ended = iterated(1.0, 0.15, best=-0.2)
    assert ended
    assert values[-1] == 0.0


@pytest.mark.parametrize("seed", [1, 7])
def test_the_iteration_ends_at_a_corner(tracker, seed):
    """A kink at a position that was measured: on either side the cost says that it is on the other
    one, and no slope is zero. Against scipy over the position, at which all else is linear.
    """
    x = np.unique(tracker.plan.x("X"))
    at = float(x[len(x) // 2])
    kink = Kink(port="EZX", unit="um", placement="X")
    given = ("slope", 90.0, 0.0), ("at", 1e3 * at, 0.0)
    true = tracker.readings(dataclasses.replace(kink, given=given))
    sigma = tracker.instrument.noise(tracker.plan, tracker.measurement.readings)
    noise = 0.3 * sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
    measurement = Measurement(tracker.plan, true + noise)
    place = len(tracker.model.effects)
    begin = {place: {"at": at + 4e-4}}
    fit = identify(tracker.model.with_effects(kink), measurement, shapes=begin, room=tracker.room)

    def cost_of(fit) -> float:
        return fit.chi2 + float(fit.theta**2 @ fit.precision)

    def known(position: float) -> float:
        shape = dataclasses.replace(kink, given=(("at", 1e3 * float(position), 0.0),))
        return cost_of(identify(tracker.model.with_effects(shape), measurement, room=tracker.room))

    assert fit.converged
    near = fit.shapes[place]["at"]
    found = minimize_scalar(known, bounds=(near - 2e-3, near + 2e-3), method="bounded",
                            options={"xatol": 1e-7})  # fmt: skip
    assert cost_of(fit) < found.fun + 2e-3
    # Where a reading is: from one side to the other the slope changes at once, and its sign.
    corner = float(x[np.abs(x - found.x).argmin()])
    assert found.x == pytest.approx(corner, abs=1e-6)
    slopes = [(known(corner + s * 2e-6) - known(corner + s * 1e-6)) / (s * 1e-6) for s in (-1, 1)]
    assert slopes[0] < -1.0 < 1.0 < slopes[1]


def test_a_warming_up_longer_than_the_measurement_against_scipy(tracker):
    """A drift taken for a warming-up: at the end of the scan of its time constant, where amplitude
    and all else are a linear problem.
    """
    measurement = Measurement(
        tracker.plan, tracker.readings(tracker.effect("drift:Y:rate_EZY_um_per_h=3000"))
    )
    place = len(tracker.model.effects)
    effect = tracker.effect("warm_up:Y:component=EZY")
    effect = dataclasses.replace(effect, given=(("size_EZY", 0.0, 1e5),))
    model = tracker.model.with_effects(effect)
    fit = identify(model, measurement, room=tracker.room)
    tau = fit.shapes[place]["tau"]
    assert fit.converged and tau == effect.scan(tracker.plan)["tau"].max()
    k = len(model.entries)
    whole = np.vstack([fit.jacobian[:, :k], np.diag(np.sqrt(fit.precision[:k]))])
    left = np.concatenate([fit.whitened, -np.sqrt(fit.precision[:k]) * fit.theta[:k]])
    step = least_squares(lambda d: left - whole @ d, np.zeros(k), method="lm").x
    sigma = np.sqrt(np.diag(np.linalg.inv(whole.T @ whole)))
    np.testing.assert_allclose(step / sigma, 0.0, atol=0.05)


def test_a_problem_without_a_solution_has_no_corner():
    """Numbers that are nan, as for weights beyond all bounds, are not divided by a step of zero."""
    place = SimpleNamespace(
        shapes={0: {"s": np.nan}},
        cost=np.nan,
        step=lambda still: Step(np.zeros(1), np.zeros(1), np.nan),
    )
    p = SimpleNamespace(name="s", moves=True, si=1.0)
    effect = SimpleNamespace(shapes=(p,), scan=lambda plan: {"s": np.linspace(0.0, 1.0, 11)})
    iteration = ShapeSteps(SimpleNamespace(effects=(effect,)), None)  # type: ignore[arg-type]
    for _ in range(2):
        assert not iteration.converged(place)


@pytest.mark.parametrize("grid", [[0.2], [0.2, 0.2, 0.2], [0.1, 0.2, 0.2, 0.2]])
def test_a_scan_that_has_no_step(grid):
    p = Parameter("s", "m", shape=True)
    assert shape_step(p, 0.2, {"s": np.array(grid)}) > 0.0


class Grown(ScrewCyclic):
    """A screw whose error grows from nothing to twice as much along the axis."""

    def response(self, plan, shape):
        x = plan.x("X")
        share = (x - x.min()) / np.ptp(x)
        return {k: 2.0 * share * v for k, v in super().response(plan, shape).items()}


@pytest.mark.parametrize("phase", [0.0, 0.7, 1.4])
def test_shapes_come_to_an_end_where_an_effect_is_not_quite_that(tracker, phase):
    """A screw whose error grows, fitted by one whose error does not: what a move of the pitch would
    do, x cos(2 pi x/p), is what is left, and is not to be had. It ends at the minimum over the
    pitch, by scipy, and stays there.
    """
    pitch, place = 0.02, len(tracker.model.effects)

    def screw(kind, pitch, *sizes):
        values = *zip(("sine", "cosine"), sizes, strict=False), ("pitch", 1e3 * pitch)
        return kind(placement="X", port="EXX", given=tuple((k, float(v), 0.0) for k, v in values))

    true = screw(Grown, pitch, 14.0 * np.cos(phase), 14.0 * np.sin(phase))
    measurement = Measurement(tracker.plan, tracker.readings(true))

    def fitted(effect, **options):
        model = tracker.model.with_effects(effect)
        fit = identify(model, measurement, room=tracker.room, **options)
        return fit, fit.chi2 + float(fit.theta**2 @ fit.precision)

    best = minimize_scalar(
        lambda p: fitted(screw(ScrewCyclic, p))[1],
        bounds=(0.0198, 0.0202),
        method="bounded",
        options={"xatol": 1e-8},
    )
    begin = {"shapes": {place: {"pitch": float(best.x) + 1e-5}}}
    for _ in range(3):  # as the loop refits what it has found
        fit, cost = fitted(ScrewCyclic(placement="X", port="EXX"), **begin)
        assert fit.converged
        assert cost == pytest.approx(best.fun, abs=0.01)
        begin = {"shapes": fit.shapes, "theta": fit.theta}


@pytest.mark.parametrize("size_um", [0.02, 2000.0])
def test_a_shape_that_is_not_told_is_somewhere_in_its_scan(size_um, tracker):
    """By so many standard deviations of a uniform distribution over the scan, and not by what the
    curvature says, which there is next to none of; what is told, is as certain as that says.
    """
    true = tracker.effect(f"warm_up:Y:component=EZY,size_EZY_um={size_um},tau_h=0.2")
    free = dataclasses.replace(true, given=())
    measurement = Measurement(tracker.plan, tracker.readings(true))
    fit = identify(tracker.model.with_effects(free), measurement, room=tracker.room)
    place = len(tracker.model.effects)
    p, value, u = next(v[1:] for v in fit.values_of(place) if v[1].name == "tau")
    value, u = p.si * value, p.si * u
    grid = free.scan(tracker.plan)["tau"]
    step = shape_step(p, value, {"tau": grid})
    plain = np.linalg.inv(fit.jacobian.T @ fit.jacobian + np.diag(fit.precision))
    ((last,),) = (fit.places_of(place)[1],)
    curvature = step * np.sqrt(plain[last, last])
    within = step * len(grid) / np.sqrt(12.0)
    # Of two that know of each other nothing else.
    assert u == pytest.approx(1.0 / np.hypot(1.0 / curvature, 1.0 / within), rel=1e-6)
    assert (curvature > 3.0 * within) if size_um < 1.0 else (curvature < 0.3 * within)
