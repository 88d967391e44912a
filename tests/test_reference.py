"""Effects whose reference value, such as the temperature at which they are zero, is uncertain."""

import math

import numpy as np
import pytest

import vcal
from oracle import make_case, with_other_zero, write_study
from vcal.effects import CATALOGUE
from vcal.effects.forms import JointAmplitude, JointPorts
from vcal.effects.reference import FreeReference, with_free_reference, with_known_reference
from vcal.effects.structure import PayloadSag
from vcal.effects.thermal import Drift, ThermalTilt, WarmUp
from vcal.loop.screening.candidates import candidates
from vcal.machine.parameters import Parameter
from vcal.machine.plan import Plan
from vcal.units import si_factor, times


@pytest.fixture
def plan():
    rng = np.random.default_rng(0)
    warm = {
        "T_X": rng.uniform(20, 30, 9),
        "t": np.arange(9.0) * 600,
        "T_coolant": rng.normal(size=9),
    }
    return Plan(("X", "Y"), rng.uniform(0, 1, (9, 2)), warm)


@pytest.mark.parametrize(
    ("unit", "other", "product"),
    [
        ("um/(m K)", "K", "um/m"),
        ("urad/K", "K", "urad"),
        ("um/kg", "kg", "um"),
        ("um/h", "h", "um"),
        ("um", "K", "um K"),
        ("1/K", "K", "1"),
        ("um", "1", "um"),
    ],
)
def test_the_unit_of_a_constant_part(unit, other, product):
    assert times(unit, other) == product
    assert si_factor(product) == pytest.approx(si_factor(unit) * si_factor(other))


@pytest.mark.parametrize("name", ["scale_growth", "thermal_tilt", "squareness_temperature"])
def test_a_constant_part_is_another_reference_value(name, plan):
    """k (T - T0) = k (T - 20 degC) + c with c = k (20 degC - T0)."""
    effect = CATALOGUE[name](port="EXX", placement="X")
    free = with_free_reference(effect)
    moved = Plan(plan.axes, plan.position, {**plan.covariates, "T_X": plan.covariate("T_X") - 7.0})
    (wanted,) = effect.response(moved, {}).values()
    own, constant = free.response(plan, {}).values()
    np.testing.assert_allclose(own - 7.0 * constant, wanted, atol=1e-12)
    assert free.key == effect.key and not free.alike(effect)
    assert with_known_reference(free) is effect
    own, constant = free.parameters
    assert constant.sigma == pytest.approx(10.0 * own.sigma)


def test_effects_of_time_and_load_have_a_reference_too(plan):
    drift = with_free_reference(Drift(port="EXX", unit="um", placement="X"))
    assert [p.unit for p in drift.parameters] == ["um/h", "um"]
    np.testing.assert_allclose(list(drift.response(plan, {}).values())[1], 1.0)
    warm = with_free_reference(WarmUp(port="EXX", unit="um", placement="X"))
    assert [p.name for p in warm.parameters] == ["size_EXX", "size_EXX_at_zero", "tau"]
    loaded = with_free_reference(PayloadSag(low=0.0, high=1.0, placement="X"))
    assert [p.unit for p in loaded.parameters] == ["um/kg", "um"]
    assert with_free_reference(CATALOGUE["backlash"](port="EXX", unit="um", placement="X")) is None


class Coolant(JointAmplitude):
    """An effect of a user, of a temperature."""

    name = "coolant_growth"
    uses = ("T_coolant",)
    acts_on = JointPorts("X")
    amplitude = Parameter("k_{port}", "um/K", sigma=5.0)

    def factor(self, plan, shape):
        return plan.covariate("T_coolant") - 20.0


def test_an_effect_of_a_user_has_it_without_a_line_more(plan):
    free = with_free_reference(Coolant(port="EXX", placement="X"))
    np.testing.assert_allclose(list(free.response(plan, {}).values())[1], 1.0)


def test_a_constant_alone_is_no_effect(plan):
    """A size of nothing with a constant needs a reference value that is out of the question."""
    free = with_free_reference(ThermalTilt(port="EAX", placement="X"))
    own, constant = (p.name for p in free.parameters)
    si = 1e-6
    sure = {own: 0.1 * si, constant: 1.0 * si}
    assert free.shape_odds(plan, {own: 10 * si, constant: -100 * si}, sure) == pytest.approx(1.0)
    odds = free.shape_odds(plan, {own: 0.1 * si, constant: -100 * si}, sure)
    assert odds < 1e-40


def test_the_reference_value_with_its_uncertainty():
    free = with_free_reference(ThermalTilt(port="EAX", placement="X"))
    covariance = np.diag([0.1, 2.0]) ** 2
    zero, u = free.zero(np.array([12.0, -120.0]), covariance)
    assert zero == pytest.approx(10.0)
    assert u == pytest.approx(math.hypot(120.0 / 144.0 * 0.1, 2.0 / 12.0))
    assert free.zero(np.array([0.1, -120.0]), covariance) is None


def _study(folder, degrees):
    tilt = {"effect": "thermal_tilt", "axis": "Y", "component": "A", "urad_per_K": 25.0}
    case = make_case("laser_tracker", "w X b Y Z t", seed=4, effects=[tilt], plan={"cycles": True})
    write_study(folder, with_other_zero(case, degrees))
    return vcal.load_study(folder / "setup.toml")


def test_every_candidate_is_tried_with_both(tmp_path):
    study = _study(tmp_path, 0.0)
    tried, _ = candidates(study.model, study.measurement, [ThermalTilt])
    free = [e for e in tried if isinstance(e, FreeReference)]
    assert len(free) == len(tried) // 2 and {e.key for e in free} == {e.key for e in tried}
    # The declared effect excludes both.
    model = study.model.with_effects(free[0])
    fewer, _ = candidates(model, study.measurement, [ThermalTilt])
    assert len(fewer) == len(tried) - 2


@pytest.mark.slow
def test_a_machine_compensated_at_another_temperature(tmp_path):
    """With all temperatures 10 K higher the name is right, and the reference value is found."""
    study = _study(tmp_path, 10.0)
    names = ["thermal_tilt", "scale_growth", "thermal_offset", "squareness_temperature", "drift"]
    closure = vcal.close_loop(study.model, study.measurement, effects=names, draws=200)
    (found,) = closure.effects
    assert found.effect.key == "thermal_tilt Y" and found.status == "named"
    values = {name: (value, u) for name, value, _, u in found.parameters}
    value, u = values["k_EAY"]
    assert abs(value - 25.0) < 3.5 * u and u < 3.0
    value, u = values["zero_shift"]
    assert abs(value - 10.0) < 3.5 * u and u < 3.0
