"""Factors of the noise against dense matrices: a reading in one component, and in several."""

import numpy as np
import pytest
from scipy.linalg import block_diag

import vcal
from oracle import make_case, write_study
from vcal.effects import CATALOGUE
from vcal.loop.residuals.variance_components import components
from vcal.model.declared_noise import declared_covariances


def study_of(folder, instrument, random=False):
    """A clean study, also with repeatability declared of two axes."""
    plan = {"shape": (4, 4, 3)} if instrument == "laser_tracker" else {}
    write_study(folder, make_case(instrument, seed=9, plan=plan))
    study = vcal.load_study(folder / "setup.toml")
    if not random:
        return study.model, study.measurement
    scatter = list(CATALOGUE["repeatability"].candidates(study.model.setup(study.measurement.plan)))
    return study.model.with_effects(*scatter[:2]), study.measurement


@pytest.mark.parametrize("instrument", ["laser_tracker", "ball_array"])
@pytest.mark.parametrize("random", [False, True], ids=["each in one", "in several"])
def test_estimates_are_almost_unbiased_with_dense_matrices(tmp_path, instrument, random):
    fit = vcal.identify(*study_of(tmp_path, instrument, random))
    found = components(fit)
    n, m = fit.residual.shape
    parts = [block_diag(*v) for _, v in declared_covariances(fit.model, fit.measurement)]
    V = sum(c.factor**2 * part for c, part in zip(found.parts, parts, strict=True))
    J = (np.linalg.inv(fit.whitener) @ fit.jacobian.reshape(n, m, -1)).reshape(n * m, -1)
    inverse = np.linalg.inv(V)
    H = J.T @ inverse @ J + np.diag(fit.within_scans)
    delta = np.linalg.solve(H, J.T @ inverse @ fit.residual.ravel() - fit.within_scans * fit.theta)
    e = fit.residual.ravel() - J @ delta
    P = inverse - inverse @ J @ np.linalg.solve(H, J.T @ inverse)
    assert len(found.parts) == (5 if random else 3)
    estimated = [(c, part) for c, part in zip(found.parts, parts, strict=True) if c.u == c.u]
    assert len(estimated) >= 3
    for c, part in estimated:
        # The ratio by which the next round would change the variance.
        ratio = (e @ inverse @ part @ inverse @ e) / np.trace(P @ part)
        assert ratio == pytest.approx(1.0, abs=4e-3)
        dof = c.factor**2 * np.trace(P @ part)
        assert c.u == pytest.approx(c.factor / np.sqrt(2.0 * dof), rel=1e-2)


def test_a_reading_in_one_component_takes_sums_that_are_those_of_all_rows(tmp_path, monkeypatch):
    fit = vcal.identify(*study_of(tmp_path, "laser_tracker"))
    once = components(fit)
    monkeypatch.setattr(
        "vcal.loop.residuals.variance_components._Problem._separate", lambda *_: None
    )
    general = components(fit)
    for one, other in zip(once.parts, general.parts, strict=True):
        assert one.factor == pytest.approx(other.factor, rel=1e-9)
        assert one.u == pytest.approx(other.u, rel=1e-9)
    assert once.factor == pytest.approx(general.factor, rel=1e-9)
    assert once.p_value == pytest.approx(general.p_value, rel=1e-6)
