"""Where the truth has more to it than the fit; campaigns that share programs; a ram's sag."""

from dataclasses import replace

import numpy as np
import pytest

from vcal.design import gram_for, volumetric_gram
from vcal.effects.base import Setup
from vcal.effects.structure import PayloadSag
from vcal.machine.chain import chain_from_string
from vcal.machine.plan import Plan
from vcal.model.forward import Model
from vcal.reproduce.artefact_design.expected import bayes_um, task
from vcal.reproduce.artefact_design.influences import (
    SIZES,
    costs,
    effects,
    exact,
    judged_at,
    models,
)
from vcal.reproduce.artefact_design.machines import calibrate, measured_by
from vcal.reproduce.artefact_design.setting import TRAVEL, ball_line, outer_faces, placed
from vcal.reproduce.artefact_design.stylus import SIDE_M, with_star
from vcal.reproduce.artefact_design.sweep import designs
from vcal.reproduce.artefact_design.sweep import exact as exact_sweep
from vcal.uncertainty.mismatch import drawn_errors, expected_error
from vcal.uncertainty.programs import Programs


@pytest.fixture(scope="module")
def given():
    return task()


@pytest.fixture(scope="module")
def small():
    return placed(outer_faces()[::2], ball_line(5, 0.03, 0.03))


@pytest.mark.campaign
def test_what_is_not_fitted_by_drawing(given, small):
    """All influences in the truth: theory against machines with exact kinematics."""
    found = costs(given, small, "S")
    assert found["none"].ignored == pytest.approx(bayes_um(given, small, "S")[0], rel=1e-6)
    for name in SIZES:
        assert found["none"].ignored < found[name].identified < found[name].ignored
    for identified in (False, True):
        drawn = exact(given, small, "S", identified=identified, draws=1000, seed=3)
        cost = found["all"].identified if identified else found["all"].ignored
        assert drawn.rms() == pytest.approx(cost, rel=0.04)
        assert drawn.campaign.failed == 0


@pytest.mark.campaign
def test_machine_by_machine(given, small):
    """The linear estimate and exact kinematics on the same machines with the same noise."""
    model, plan = measured_by(given, small, "P")
    gram = gram_for(model, given.gram, given.model)
    drawn = calibrate(given, small, "P", draws=300, seed=4)
    linear = 1e6 * drawn_errors(model, model, plan, gram, draws=300, seed=4)
    for i, kind in enumerate(("aligned", "raw")):
        np.testing.assert_allclose(linear[:, i], drawn.errors("after", kind), rtol=0.01)


@pytest.mark.thorough
def test_the_parts_add_up(given, small):
    truth, fit, plan = models(given, small, "B", tuple(SIZES), False)
    left = expected_error(truth, fit, plan, volumetric_gram(truth, judged_at(given)))
    keys = {e.key for name in SIZES for e in effects(name)}
    assert keys < set(left.aligned)
    assert left.rms[0] ** 2 == pytest.approx(sum(v**2 for v in left.aligned.values()))
    assert left.rms[0] < left.rms[1]


@pytest.mark.thorough
def test_priors_have_to_agree(given, small):
    model, plan = measured_by(given, small, "S")
    (errors, *rest) = model.effects
    wider = replace(errors, locations=[replace(e, sigma=2 * e.sigma) for e in errors.locations])
    truth = Model(model.chain, model.instrument, (wider, *rest))
    with pytest.raises(ValueError, match="geometric, EA0Z: found different standard deviations"):
        expected_error(truth, model, plan, volumetric_gram(truth, judged_at(given)))


@pytest.mark.thorough
def test_what_only_the_fit_has_is_refused(given, small):
    """It is found to be something, and compensated."""
    more, less, plan = models(given, small, "B", ("ram sags",), False)
    with pytest.raises(ValueError, match="payload_sag Y', which the truth lacks"):
        expected_error(less, more, plan, volumetric_gram(less, judged_at(given)))


@pytest.mark.thorough
def test_gram_of_some_effects(given):
    points = judged_at(given)
    whole = given.model.with_effects(*effects("ram sags"))
    picked = gram_for(given.model, volumetric_gram(whole, points), whole)
    for one, other in zip(picked, given.gram, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-25)
    with pytest.raises(ValueError, match="payload_sag Y: found an effect"):
        gram_for(whole, given.gram, given.model)


@pytest.mark.campaign
def test_shared_programs_change_nothing(given, small):
    other = placed(outer_faces()[1::2], ball_line(5, 0.02, 0.05))
    programs = Programs()
    for poses in (small, other):
        alone = calibrate(given, poses, "B", draws=150, seed=1)
        shared = calibrate(given, poses, "B", draws=150, seed=1, programs=programs)
        np.testing.assert_allclose(shared.errors(), alone.errors(), rtol=1e-9)
    kept = programs.count
    calibrate(given, other, "B", draws=150, seed=1, programs=programs)
    assert programs.count == kept
    calibrate(given, placed(outer_faces()[:5], ball_line(5, 0.02, 0.05)), "B", draws=150, seed=1,
              programs=programs)  # fmt: skip
    assert programs.count > kept
    fresh, some = Programs(), [d.key for d in designs() if d.varied != "N"][:2]
    exact_sweep(given, "B", draws=150, seed=1, programs=fresh, only=some[:1])
    kept = fresh.count
    assert kept > 0
    exact_sweep(given, "B", draws=150, seed=1, programs=fresh, only=some)
    assert fresh.count == kept


@pytest.mark.thorough
def test_a_star_keeps_to_the_travel(given):
    poses = placed(outer_faces(), ball_line(11, 0.03, 0.03))
    star = with_star(poses)
    at = np.asarray(star.position(given.model.chain))
    low, high = (np.array([TRAVEL[c][i] for c in "XYZ"]) for i in (0, 1))
    assert (at > low - 1e-9).all() and (at < high + 1e-9).all()
    side = np.linalg.norm(np.asarray(star.tool)[..., :2], axis=-1)
    np.testing.assert_allclose(side[:, ::2], SIDE_M)
    np.testing.assert_allclose(side[:, 1::2], 0.0)
    for known, least in (("S", 0.15), ("P", 0.15), ("B", 0.15)):
        straight, alternating = (bayes_um(given, p, known)[0] for p in (poses, star))
        assert alternating < (1.0 - least) * straight
    with pytest.raises(ValueError, match="no room for a stylus 4000 mm"):
        with_star(poses, 4.0)


@pytest.mark.parametrize("clamped", ["low", "high"])
@pytest.mark.parametrize("axis", ["X", "Y"])
def test_sag_of_a_cantilever(axis, clamped):
    """The bending line integrated step by step from the moment of a force at the tip."""
    travel = {"X": (0.1, 3.0), "Y": (-0.2, 1.5), "Z": (0.0, 1.3)}
    chain = chain_from_string("w b X Y Z t", travel, (0.0, 0.0, 0.0))
    plan = Plan(chain.axes, np.array([[0.4, 0.1, 0.2], [2.0, 1.1, 0.3]]),
                {"payload_kg": np.array([10.0, 40.0])})  # fmt: skip
    setup = Setup(chain, Model(chain, task().model.instrument).layout, plan)
    (sag,) = (
        e for e in PayloadSag.candidates(setup) if e.placement == axis and e.clamped == clamped
    )
    found = sag.response(plan, {})
    low, high = travel[axis]
    for row in range(2):
        x = float(plan.position[row, "XYZ".index(axis)])
        out = x - low if clamped == "low" else high - x
        s = np.linspace(0.0, out, 20001)
        moment = plan.covariates["payload_kg"][row] * (out - s)  # force times lever, E I = 1
        slope = np.concatenate([[0.0], np.cumsum(0.5 * (moment[1:] + moment[:-1]) * np.diff(s))])
        line = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(s))])
        # One kg at full overhang falls by one unit.
        unit = (high - low) ** 3 / 3.0
        (fall, turn) = (np.asarray(v)[row] for v in found.values())
        assert fall == pytest.approx(-line[-1] / unit, rel=1e-6)
        assert abs(turn) == pytest.approx(slope[-1] / unit, rel=1e-6)
        # What is further out along the ram has to be lower.
        (_, (port, _)) = found
        away = np.zeros(3)
        away["XYZ".index(axis)] = 1.0 if clamped == "low" else -1.0
        about = np.eye(3)["ABC".index(port[1])] * float(turn)
        assert np.cross(about, away)[2] < 0.0
