"""An instrument that reads angles alone: no reading changes where the tool point is displaced."""

import jax.numpy as jnp
import numpy as np
import pytest

import vcal
from vcal.instruments import Instrument
from vcal.instruments.several import DataSet, several
from vcal.loop.outcome.unexplained import from_structure
from vcal.loop.residuals.dependence import dependence, displacements
from vcal.machine.chain import chain_from_string
from vcal.machine.plan import Plan
from vcal.machine.ports import group
from vcal.plots.residuals import unexplained

ARM, SIGMA = 0.2, 0.5e-6
CHAIN = chain_from_string("w X b Y Z t", {"X": (0.0, 1.0), "Y": (0.0, 0.6), "Z": (0.0, 0.5)})


class Zero(vcal.Effect):
    """How the level stands on the tool."""

    name = "zero"
    kind = "nuisance"
    where = "instrument"

    @property
    def parameters(self):
        return tuple(vcal.Parameter(c, "urad") for c in "AB")

    def response(self, plan, shape):
        return {(f"level.{c}", c): np.ones(plan.rows) for c in "AB"}


class Level(Instrument):
    """Roll and pitch of the tool against the horizon (ISO 230-1)."""

    @property
    def ports(self):
        return group("level", ("A", "B"))

    @property
    def readings(self):
        return ("roll", "pitch")

    def observe(self, row, rotation, tool, ports):
        x, y, _ = rotation.T.rows
        level = ports["level"]
        return [jnp.arcsin(y.z) + level[0], level[1] - jnp.arcsin(x.z)]

    def noise(self, plan, readings):
        return np.full((plan.rows, 2), SIGMA)

    def lengths(self, plan, readings):
        return np.full((plan.rows, 2), ARM)

    def effects(self, plan):
        return (Zero(),)

    def folds(self, plan):
        return np.arange(plan.rows) % 5, False

    def dimensions(self, plan):
        return np.full(plan.rows, 2)


def measured(moved, seed=2, rows=120):
    """Readings on a machine without errors, of which roll follows a column by `moved` (rad)."""
    rng = np.random.default_rng(seed)
    coolant = rng.uniform(-1.0, 1.0, rows)
    plan = Plan(CHAIN.axes, rng.uniform(0.1, 0.5, (rows, 3)), {"coolant": coolant})
    readings = SIGMA * rng.standard_normal((rows, 2))
    readings[:, 0] += moved * coolant
    return vcal.Measurement(plan, readings, "")


def fitted(instrument, measurement):
    model = vcal.Model(CHAIN, instrument, instrument.effects(measurement.plan))
    return vcal.identify(model, measurement)


def test_a_column_that_a_reading_follows_is_found():
    fit = fitted(Level(), measured(2e-6))
    told = dependence(fit, 200, 0)
    assert told.p_value < 1e-6 and told.single[0][0] == "coolant"
    # Roll about X, at the lever arm of the readings.
    assert np.allclose(displacements(fit)[:, 0], ARM * fit.residual[:, 0])
    what = from_structure(fit, 3.0, 0.01, 200, 0)
    assert what is not None and what.direction == "A"
    assert 0.9 < what.size_um / (1e6 * ARM * 2e-6 / np.sqrt(3.0)) < 1.1
    assert unexplained(fit, what).axes[0].get_ylabel() == "residual about X, µm"


@pytest.mark.parametrize("sets", [1, 2])
def test_noise_alone_is_no_finding(sets):
    measurement, instrument = measured(0.0), Level()
    if sets == 2:
        other = measured(0.0, seed=3)
        both = {"one": measurement, "two": other}
        members = {name: DataSet(Level(), one.plan) for name, one in both.items()}
        instrument, plan = several(members)
        readings = instrument.padded([one.readings for one in both.values()])
        measurement = vcal.Measurement(plan, readings, "")
    told = dependence(fitted(instrument, measurement), 200, 0)
    assert told.p_value > 0.05 and all(np.isfinite(share) for _, share in told.single)
