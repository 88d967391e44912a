"""The moment of a jump: found between the steps of the scan, with its uncertainty."""

import dataclasses

import numpy as np
import pytest

from known import Known
from vcal import Measurement, close_loop, identify
from vcal.loop.search.certainty import jump_time_uncertainty
from vcal.loop.search.state import fitted


@pytest.fixture(scope="module")
def many(tmp_path_factory) -> Known:
    """More rows than moments that the scan tries."""
    return Known("laser_tracker", tmp_path_factory.mktemp("many"), plan={"shape": (7, 7, 5)})


def gap(it: Known, row: int) -> tuple[float, float]:
    t = np.unique(np.asarray(it.plan.covariate("t")))
    return float(t[row]), float(t[row + 1])


def noisy(it: Known, seed: int, at: float, size_um: float) -> Measurement:
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    noise = sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
    jump = it.effect(f"jump:tool:X_um={size_um},at_s={at}")
    return Measurement(it.plan, it.readings(jump) + noise)


@pytest.mark.campaign
def test_no_reading_beside_a_jump_is_taken_for_stray(many):
    scan = many.effect("jump:tool").scan(many.plan)["at"]
    t = np.unique(np.asarray(many.plan.covariate("t")))
    every = 0.5 * (t[1:] + t[:-1])
    assert len(scan) == 200 < len(every)
    # The moments that the scan leaves out are where it went wrong.
    (left_out,) = np.nonzero(~np.isin(every, scan))
    row = int(left_out[len(left_out) // 2])
    before, after = gap(many, row)
    found = close_loop(many.model, noisy(many, 1, before + 0.2 * (after - before), 40.0), draws=50)
    assert found.suspected == []
    (jump,) = found.effects
    assert (jump.effect.key, jump.status) == ("jump tool", "named")
    (at,) = (p for p in jump.parameters if p[0] == "at")
    assert before < at[1] < after
    # Even between the two readings.
    assert at[3] == pytest.approx((after - before) / np.sqrt(12.0), rel=1e-6)
    (size,) = (p for p in jump.parameters if p[0] == "X")
    assert abs(size[1] - 40.0) < 3.0 * size[3] < 3.0


@pytest.mark.campaign
def test_the_moment_is_as_uncertain_as_it_scatters(many):
    """Jumps at random moments, a few times as large as the noise of a reading."""
    rng, t = np.random.default_rng(5), np.unique(np.asarray(many.plan.covariate("t")))
    off = []
    for seed in range(16):
        moment = float(rng.uniform(np.quantile(t, 0.25), np.quantile(t, 0.75)))
        measurement = noisy(many, 100 + seed, moment, 3.0)
        effect = many.effect("jump:tool")
        effect = dataclasses.replace(effect, given=(("Y", 0.0, 0.0), ("Z", 0.0, 0.0)))
        best = _best(many, effect, measurement, t)
        u = jump_time_uncertainty(best, len(best.model.effects) - 1, many.room)["at"]
        off.append((best.fit.shapes[len(best.model.effects) - 1]["at"] - moment) / u)
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.mean(np.abs(off) < 2.0) > 0.8


def _best(it: Known, effect, measurement: Measurement, t: np.ndarray):
    """The fit with the jump at the moment that explains most, of all there are."""
    bare = fitted(it.model, measurement, None, it.room).fit
    jacobian = bare.jacobian
    port = it.model.layout.index("tool.X")
    g = np.einsum("nij,njp->nip", bare.whitener, bare.port_jacobian)[:, :, port]
    root = np.diag(np.sqrt(bare.precision))
    stacked = np.vstack([jacobian, root])
    rest = np.concatenate([bare.whitened, -np.sqrt(bare.precision) * bare.theta])
    q, _ = np.linalg.qr(stacked)
    gains = []
    rows = np.asarray(it.plan.covariate("t"))
    middles = 0.5 * (t[1:] + t[:-1])
    for at in middles:
        column = np.concatenate([(g * (rows > at)[:, None]).ravel(), np.zeros(len(root))])
        column = column - q @ (q.T @ column)
        gains.append((column @ rest) ** 2 / (column @ column))
    at = float(middles[int(np.argmax(gains))])
    model = it.model.with_effects(effect)
    start = identify(model, measurement, shapes={len(model.effects) - 1: {"at": at}}, room=it.room)
    return fitted(model, measurement, start, it.room)
