"""The posterior of one campaign as the prior of the next."""

import json

import numpy as np
import pytest

from arms import COLUMN, poses, write_arm
from vcal.effects.geometric import link_errors
from vcal.effects.previous import PreviousGeometry, posterior_of
from vcal.errors import StudyError
from vcal.identification.identify import identify
from vcal.loop.close_loop import close_loop
from vcal.loop.weighing.cross_validation import fit_rms
from vcal.machine.chain import chain_from_dh
from vcal.machine.plan import Plan
from vcal.report.loop.record import record
from vcal.study.study import load_study

ARM = COLUMN[1:]


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """A campaign of 120 poses with its record, and one of the same arm from elsewhere
    with another reflector.
    """
    folder = tmp_path_factory.mktemp("campaigns")
    rng = np.random.default_rng(9)
    twist = np.column_stack(
        [3e-4 * rng.standard_normal((6, 3)), 5e-4 * rng.standard_normal((6, 3))]
    )
    first = load_study(write_arm(folder / "first", ARM, poses(ARM, 120), errors=twist))
    closure = close_loop(
        first.model, first.measurement, effects=["backlash"], draws=25, max_effects=0
    )
    later = write_arm(
        folder / "later",
        ARM,
        poses(ARM, 70, seed=8),
        errors=twist,
        reflector=np.array([-0.04, 0.06, 0.15]),
        seed=5,
    )
    text = json.dumps(record(closure, first))
    (later / "report.json").write_text(text)
    return later, closure, text


FEW = np.arange(70) < 6


def fitted(study):
    """From the first six poses: 18 readings for nine parameters without a prior."""
    return identify(study.model, study.measurement, keep=FEW)


def predicted(fit):
    """Rms error of the prediction of the other poses, um."""
    return 1e6 * np.sqrt((fit.residual[~FEW] ** 2).sum(1).mean())


@pytest.mark.thorough
def test_a_later_campaign_of_few_poses(campaigns):
    later, closure, _ = campaigns
    alone = fitted(load_study(later))
    study = load_study(later, {"model.from": "report.json"})
    both = fitted(study)
    assert fit_rms(both).value < 60.0
    # The noise alone is 35 um.
    assert predicted(both) < 90.0 < 0.5 * predicted(alone)
    # Before its readings, the later model knows what the first campaign left.
    effect = next(e for e in study.model.effects if e.name == "geometric")
    parameters, mean, covariance = posterior_of(effect, effect.start, np.eye(len(effect.start)))
    fit = closure.after
    values = {p.name: (v, u) for key, p, v, u in fit.parameter_values() if key == "geometric"}
    for p, value, variance in zip(parameters, mean, np.diag(covariance), strict=True):
        assert value == pytest.approx(values[p.name][0], rel=1e-6, abs=1e-6)
        assert variance**0.5 == pytest.approx(values[p.name][1], rel=1e-5)
    place = [k for k, (key, _) in enumerate(fit.entries) if key == "geometric"]
    steps = np.array([p.step / p.si for key, p in fit.entries if key == "geometric"])
    np.testing.assert_allclose(
        covariance,
        fit.covariance[np.ix_(place, place)] * np.outer(steps, steps),
        rtol=1e-5,
        atol=1e-6 * covariance.max(),
    )


def test_a_joint_prior_against_numpy():
    """The ports of theta = M c are those of theta, and c has the prior of theta."""
    rng = np.random.default_rng(0)
    rows = [{"type": "revolute", "a": 0.3, "alpha": 1.0}, {"type": "revolute", "d": 0.2}]
    errors = link_errors(chain_from_dh(rows), 1e-4, 1e-4)
    k = len(errors.parameters)
    a = rng.standard_normal((k, k))
    covariance, mean = a @ a.T, rng.standard_normal(k)
    effect = PreviousGeometry.of(errors, mean, covariance)
    np.testing.assert_allclose(effect.root @ effect.root.T, covariance, atol=1e-9)
    np.testing.assert_allclose(effect.root @ effect.start, mean, atol=1e-6)
    c = rng.standard_normal(k)
    theta = dict(zip((p.name for p in errors.parameters), effect.root @ c, strict=True))
    plan = Plan(("J1", "J2"), rng.uniform(-1, 1, (4, 2)))
    mine: dict[str, np.ndarray] = {}
    for (port, name), column in effect.response(plan, {}).items():
        mine[port] = mine.get(port, 0.0) + column * c[int(name[1:]) - 1]
    for (port, name), column in errors.response(plan, {}).items():
        np.testing.assert_allclose(mine[port], 1e-6 * theta[name] * column, atol=1e-12)


@pytest.mark.parametrize(
    ("edit", "keys", "words"),
    [
        (lambda t: "[]", {}, ("report.json, file", "what is no such report")),
        (lambda t: '{"schema": "x"}', {}, ("no posterior of geometric errors",)),
        (lambda t: t.replace("6 joints", "5 joints"), {}, ("model.from", "'5 joints")),
        (
            lambda t: t,
            {"model.geometric.link": [{"joint": "J2", "fixed": True}]},
            ("model.from", "other geometric errors", "EXJ2.0"),
        ),
        (lambda t: t.replace("NaN", "0"), {"model.fron": "x"}, ("did you mean 'from'",)),
        (lambda t: t, {"model.from": "other.json"}, ("other.json", "no such file")),
    ],
)
def test_wrong_reports(campaigns, edit, keys, words):
    later, _, text = campaigns
    (later / "wrong.json").write_text(edit(text))
    given = {"model.from": "wrong.json"} | keys
    if "model.fron" in keys:
        del given["model.from"]
    with pytest.raises(StudyError) as refused:
        load_study(later, given)
    message = str(refused.value).replace("wrong.json", "report.json")
    assert all(word in message for word in words), message
