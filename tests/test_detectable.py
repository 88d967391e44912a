"""The smallest effects that a measurement names, against closed forms and against the loop."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from oracle import make_case, write_study
from vcal import CATALOGUE, close_loop, identify, load_study
from vcal.loop.detectable import detectable
from vcal.loop.screening.candidates import candidates
from vcal.loop.screening.score_test import ScoreTest
from vcal.loop.screening.screening import screen
from vcal.loop.screening.spanned import spanned_on_plan

ALPHA = 0.01


def measured(folder, *effects, seed=4):
    case = make_case("laser_tracker", seed=seed, effects=effects)
    return load_study(write_study(folder, case))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return measured(tmp_path_factory.mktemp("seen") / "study")


@pytest.fixture(scope="module")
def fit(study):
    return identify(study.model, study.measurement)


def seen(fit, *names, alpha=ALPHA):
    classes = [CATALOGUE[name] for name in names]
    tried, _ = candidates(fit.model, fit.measurement, classes)
    screening = screen(ScoreTest(fit, 200, 1), tried)
    return screening, detectable(fit, classes, screening, alpha=alpha, seed=2)


def test_without_rivals_it_is_the_power_of_a_chi_square_test(fit):
    """Least squares of the whitened column on the Jacobian and the rows of the prior leave c; the
    drop by two amplitudes is non-central chi-square with a^2 |c|^2.

    At this alpha, what is significant is also 19 times as probable as nothing.
    """
    alpha = 1e-9
    screening, found = seen(fit, "range_scale", alpha=alpha)
    state = ScoreTest(fit, 1, 0)
    root = np.sqrt(fit.precision)
    beside = np.concatenate([fit.jacobian, np.diag(root)])
    (kind,) = screening.kinds
    alone = 1.0 - (1.0 - alpha) ** (1.0 / screening.trials / kind.trials)
    # Student's factor for an estimated noise.
    needed = fit.dof * math.expm1(chi2.isf(alone, 2) / fit.dof)
    power = brentq(lambda x: ncx2.sf(needed, 2, x) - 0.95, 0.1 * needed, 10.0 * needed)
    assert len(found.limits) == 2
    for k, limit in enumerate(found.limits):
        column = state.columns(limit.effect, {})[:, k]
        padded = np.concatenate([column, np.zeros(len(root))])
        left = padded - beside @ np.linalg.lstsq(beside, padded, rcond=None)[0]
        unit = limit.amplitude.step / limit.amplitude.si
        expected = unit * math.sqrt(power) / np.linalg.norm(left)
        assert limit.rivals == ()
        assert limit.size == pytest.approx(expected, rel=0.05)


def test_a_rival_raises_the_limit_and_a_twin_prevents_the_name(fit):
    """A step of the frame of the station by a translation is one of the tool, but for the axes that
    carry the workpiece; one that drifts with time is one of the machine that does.
    """
    alone = {x.effect.placement: x.size for x in seen(fit, "drift")[1].limits}
    _, both = seen(fit, "drift", "station_drift")
    drifts = [x for x in both.limits if x.effect.name == "drift"]
    assert all(math.isfinite(size) for size in alone.values())
    raised = [x for x in drifts if "station_drift" in x.rivals]
    assert raised
    assert any(math.isinf(x.size) for x in raised)


@pytest.mark.parametrize(("times", "status"), [(1.3, "named"), (0.4, None)])
def test_the_loop_names_an_effect_of_that_size(fit, times, status, tmp_path):
    _, found = seen(fit, *CATALOGUE)
    limit = next(x for x in found.limits if x.effect.key == "lateral_reversal X")
    component = limit.amplitude.name[-2]
    size = times * limit.size
    effect = {"effect": "lateral_reversal", "axis": "X", "component": component, "size_um": size}
    study = measured(tmp_path / "study", effect)
    closure = close_loop(study.model, study.measurement, draws=200)
    told = {e.effect.key: e.status for e in closure.effects}
    assert told == ({"lateral_reversal X": status} if status else {})


def test_what_the_model_spans_has_no_limit(fit):
    _, found = seen(fit, "tool_offset", "backlash")
    assert [(one.effect.key, set(one.by)) for one in found.spanned] == [
        ("tool_offset", {"geometric", "station"})
    ]
    assert {x.effect.name for x in found.limits} == {"backlash"}


def test_what_cannot_be_seen_is_known_before_a_measurement(fit):
    """The tool points do not move by a rotation about the direction of the tool, wherever the axes
    stand; what moves all of them alike is the place of the tracker.
    """
    classes = [CATALOGUE[name] for name in ("tool_offset", "angular_reversal", "backlash")]
    for given in (fit.measurement, fit.measurement.plan):
        found = {
            (one.effect.key, *(p.name for p in one.effect.amplitudes)): set(one.by)
            for one in spanned_on_plan(fit.model, given, classes)
        }
        assert found == {
            ("tool_offset", "X", "Y", "Z"): {"geometric", "station"},
            ("angular_reversal Y", "size_ECY"): set(),
            ("angular_reversal Z", "size_ECZ"): set(),
        }
