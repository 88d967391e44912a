"""What an effect of the model changes with: its size in parts of the readings, and its code."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import vcal
from known import Known
from test_r_test import circles, write
from vcal import CATALOGUE, Fit, Measurement, identify, load_study
from vcal.effects.base import Effect, Fitted
from vcal.effects.reversal import ReversalSpike
from vcal.instruments.conditions import file_column
from vcal.loop.empirical import Changing
from vcal.loop.empirical.base import written
from vcal.loop.empirical.covariates import angles_around
from vcal.loop.empirical.product import about_the_middle
from vcal.loop.residuals.dependence import bins
from vcal.loop.screening.score_test import Peak
from vcal.loop.weighing.rivals import Rival
from vcal.machine.plan import Plan
from vcal.plots import changing_sizes
from vcal.plots.changing import changing


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("tracker"))


@pytest.fixture(scope="module")
def spiked(tmp_path_factory):
    """A study of two accelerations, with quadrant peaks of 3 um that change with nothing."""
    table = circles(levels=(0.5, 2.0), matrix=np.zeros((3, 3)), samples=80, spike=(3.0, 0.06))
    return load_study(write(tmp_path_factory.mktemp("spiked") / "study", table))


def by(fit: Fit, effect: Effect, quantity: str) -> Rival:
    """The description by which an effect of a fit changes with a quantity."""
    place = fit.model.effects.index(effect)
    rows = fit.values_of(place)
    sizes = {p.name: float(v) * p.si for _, p, v, _ in rows if not p.shape}
    setup = dataclasses.replace(
        fit.model.setup(fit.measurement.plan),
        fitted=(Fitted(effect, dict(fit.shapes.get(place, {})), sizes),),
    )
    (description,) = Changing.candidates(setup)
    names = [(q.name, q.logarithm) for q in description.quantities]
    which = float(names.index((quantity, False)))
    shapes = {**fit.shapes, len(fit.model.effects): {"which": which}}
    model = fit.model.with_effects(description)
    there = Peak(description, {}, np.zeros(0), 0.0, 0.0, 0)
    return Rival(there, identify(model, fit.measurement, shapes=shapes), 0.0, 0.0, 0.0)


def peaks(spiked, placement="", **given) -> tuple[Fit, Effect]:
    placed = ReversalSpike.candidates(spiked.model.setup(spiked.measurement.plan))
    spike = next(e for e in placed if e.placement == placement)
    spike = dataclasses.replace(spike, **given)
    place = len(spiked.model.effects)
    model = spiked.model.with_effects(spike)
    return identify(model, spiked.measurement, shapes={place: {"decay": 6e-5}}), spike


@pytest.mark.thorough
@pytest.mark.parametrize("given", [{}, {"given": (("size", 2.5, 1.0),)}], ids=["free", "declared"])
def test_sizes_are_values_whatever_was_believed_before(spiked, given):
    """They were differences from what is declared."""
    fit, spike = peaks(spiked, **given)
    best = by(fit, spike, "a_set_m_s2")
    sizes = changing_sizes(fit, best)
    assert sizes is not None
    assert sizes.quantity == pytest.approx([0.5, 2.0])
    assert (np.abs(sizes.size - sizes.overall) < 4.0 * sizes.u).all() and (sizes.u < 0.1).all()
    assert sizes.overall == pytest.approx(3.0, abs=0.1)
    assert sizes.line[[0, -1]] == pytest.approx(sizes.size, abs=0.1)
    assert changing(fit, best) is not None


def test_parts_that_say_nothing_are_not_shown(spiked):
    """X stands still in circles of the plane YZ: there its peaks are not zero, but unknown."""
    fit, spike = peaks(spiked, "X")
    run = np.asarray(spiked.measurement.plan.groups["run"])
    moving = [r for r in np.unique(run) if np.ptp(np.asarray(fit.measurement.plan.x("X"))[run == r])
              > 1e-3]  # fmt: skip
    sizes = changing_sizes(fit, by(fit, spike, "run"))
    assert sizes is not None and len(moving) < len(np.unique(run))
    assert set(sizes.quantity) <= set(moving)
    assert (np.abs(sizes.size - 3.0) < 4.0 * sizes.u).all() and (sizes.u < 0.3).all()


def test_sizes_are_those_of_a_fit_of_every_part(tracker):
    """Against fits in which a part of the readings alone has the effect, two of one key apart."""
    placed = CATALOGUE["lateral_reversal"].candidates(tracker.setup)
    first, second = (e for e in placed if e.placement == "X")
    assert first.key == second.key and not first.alike(second)
    size = second.amplitudes[0].name
    put_in = dataclasses.replace(second, given=((size, 8.0, 0.0),))
    measurement = Measurement(tracker.plan, tracker.readings(put_in))
    fit = identify(tracker.model.with_effects(first, second), measurement)
    best = by(fit, second, "Y")
    sizes = changing_sizes(fit, best)
    assert sizes is not None and sizes.parameter == size
    index = bins(np.asarray(tracker.plan.x("Y")))
    parts = [index == part for part in np.unique(index)]

    class Split(Effect):
        name = "split"

        @property
        def parameters(self):
            return tuple(
                vcal.Parameter(f"size{i}", "um", sigma=np.inf, scale=10.0)
                for i in range(len(parts))
            )

        def response(self, plan, shape):
            ((port, _), moved), *_ = second.response(plan, {}).items()
            return {(port, f"size{i}"): jnp.where(rows, moved, 0.0) for i, rows in enumerate(parts)}

    whole = identify(tracker.model.with_effects(first, Split()), measurement)
    rows = whole.values_of(len(whole.model.effects) - 1)
    assert sizes.size == pytest.approx([float(v) for *_, v, _ in rows], abs=0.02)
    assert sizes.u == pytest.approx([float(u) for *_, u in rows], rel=0.02)


def test_logarithms_are_of_what_has_a_zero(tracker):
    """And stay what they are where less was measured: a check point may be beyond."""
    plan = tracker.plan
    (screw, *_) = CATALOGUE["screw_cyclic"].candidates(tracker.setup)
    found = Fitted(screw, {"pitch": 0.02}, {"sine": 2e-6, "cosine": 1e-6})
    rng = np.random.default_rng(2)
    recorded = {"speed_m_s": rng.uniform(0.01, 0.3, plan.rows)}
    recorded["T_oil"] = rng.uniform(10.0, 30.0, plan.rows)
    plan = dataclasses.replace(plan, covariates={**plan.covariates, **recorded})
    setup = dataclasses.replace(tracker.setup, plan=plan, fitted=(found,))
    (description,) = Changing.candidates(setup)
    logarithms = {q.name: q for q in description.quantities if q.logarithm}
    assert "speed_m_s" in logarithms
    assert {"X", "Y", "Z", "t", "T_oil"}.isdisjoint(logarithms)
    assert {name for name, _ in description.response(plan, {"which": 0.0})} == {screw.port}
    # A period is no scale: after many of them a longer one is no small change.
    assert [p.name for p in description.amplitudes] == ["sine", "cosine"]
    beyond = dataclasses.replace(plan, covariates={"speed_m_s": np.full(plan.rows, -1.0)})
    assert logarithms["speed_m_s"].values(beyond) == pytest.approx(-1.0)
    scope = {"jnp": jnp, "plan": beyond}
    code = logarithms["speed_m_s"].code(lambda name: f'plan.covariate("{name}")')
    assert np.asarray(eval(code, scope)) == pytest.approx(-1.0, abs=1e-5)


def test_play_does_not_change_with_its_own_sense_of_travel(tracker):
    """That product is one, but where the sense is not known: it would tell these rows. Peaks may be
    higher one way, and play may change with the sense of another axis.
    """
    known = np.asarray(tracker.plan.covariate("dir_Y"))
    sense = np.where(np.arange(tracker.plan.rows) < 2, 0.0, known)
    covariates = {**tracker.plan.covariates, "dir_Y": sense}
    plan = dataclasses.replace(tracker.plan, covariates=covariates)
    (play,) = (e for e in CATALOGUE["backlash"].candidates(tracker.setup) if e.placement == "Y")
    found = Fitted(play, {}, {"size": 1e-5})
    (description,) = Changing.candidates(
        dataclasses.replace(tracker.setup, plan=plan, fitted=(found,))
    )
    names = {q.name for q in description.quantities}
    assert "dir_Y" not in names and {"X", "Y", "dir_X"} <= names


def test_what_changes_of_an_instrument_is_no_error_of_the_machine(tracker):
    """It is not compensated, and no check point needs what the instrument recorded."""
    (scale,) = CATALOGUE["range_scale"].candidates(tracker.setup)
    (play, *_) = CATALOGUE["backlash"].candidates(tracker.setup)
    fitted = tuple(
        Fitted(effect, {}, {p.name: 1e-6 for p in effect.amplitudes}) for effect in (scale, play)
    )
    setup = dataclasses.replace(tracker.setup, fitted=fitted)
    found = {one.effect.name: one for one in Changing.candidates(setup)}
    assert found["range_scale"].where == "instrument" and found["range_scale"].on_instrument
    assert found["backlash"].where == "machine" and not found["backlash"].on_instrument


@pytest.mark.parametrize("start", [0.0, 1.7534e9, -3.0])
def test_code_has_the_digits_that_its_range_needs(start):
    """A clock may count from 1970."""
    t = start + np.linspace(0.0, 763.1, 50)
    factor = about_the_middle("t", t)
    code = factor.code(lambda _: "t")
    assert eval(code, {"t": t}) == pytest.approx(factor.of(t), abs=1e-5)
    assert float(written(t[17], np.ptp(t))) == pytest.approx(t[17], abs=1e-3)


def test_an_angle_of_a_swivel_goes_not_round():
    """Nor does what a joint has travelled; a spindle that stops twelve times per turn does."""
    rng = np.random.default_rng(8)
    angles = {
        "head_deg": rng.uniform(-140.0, 140.0, 240),
        "move_J1": rng.uniform(-3.0, 3.0, 240),
        "spindle_deg": rng.integers(0, 12, 240) * 30.0,
        "turned_rad": rng.uniform(0.0, 20.0, 240),
        "table_deg": rng.uniform(0.0, 360.0, 240),
    }
    plan = Plan(("X",), np.linspace(0.0, 1.0, 240)[:, None], angles, {})
    assert file_column("move_J1", plan.axes)[0].endswith("_deg")
    assert angles_around(plan) == [
        "spindle_deg",
        "turned_rad",
        "table_deg",
    ]
