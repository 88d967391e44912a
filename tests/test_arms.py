"""What the loop finds of an arm, whose readings are those of the independent generator."""

import csv
import dataclasses
import io
import math

import numpy as np
import pytest

from oracle import make_case, write_study
from oracle.effects import joint_angles
from oracle.kinematics import arm_frames
from vcal import close_loop, identify, load_study
from vcal.effects.base import Setup
from vcal.effects.cyclic import GearHarmonic
from vcal.effects.events import Jump
from vcal.effects.reversal import Backlash
from vcal.effects.thermal import Drift, WarmUp
from vcal.effects.tracker import StationDrift, StationSettling
from vcal.identification.linearised import linearised_terms
from vcal.loop.search.certainty import rotation_of_machine, second_order
from vcal.model.forward import port_values
from vcal.report import effects_csv

OFF_THE_FLANGE = [0.06, -0.04, 0.05]


def closed(folder, *effects, poses=150, seed=5):
    case = make_case("reflectors", seed=seed, plan={"n": poses}, effects=effects)
    study = load_study(write_study(folder, case))
    return close_loop(study.model, study.measurement, draws=100)


def turned(closure, joint):
    """How far a joint turns beyond its command in every pose, less the mean, as the closed loop has
    it, and its standard uncertainty.
    """
    fit = closure.after
    model, plan = fit.model, fit.measurement.plan
    terms = linearised_terms(model, plan, fit.shapes, fit.theta)
    port = model.layout.index(f"ECJ{joint + 1}")
    angle = np.asarray(port_values(terms, fit.theta, len(model.layout)))[:, port]
    by_theta = np.zeros((plan.rows, len(fit.theta)))
    for k in np.flatnonzero(terms.port == port):
        by_theta[:, terms.parameter[k]] += np.asarray(terms.values)[:, k]
    by_theta -= by_theta.mean(0)
    variance = np.einsum("nj,jk,nk->n", by_theta, fit.covariance, by_theta)
    return angle - angle.mean(), np.sqrt(variance)


def put_in(*effects, joint, poses=150, seed=5):
    """The same of the oracle."""
    case = make_case("reflectors", seed=seed, plan={"n": poses}, effects=effects)
    q = case.arm_run.q
    off = (joint_angles(case.arm, q, case.arm_run.t, effects) - q)[:, joint]
    return off - off.mean()


@pytest.mark.parametrize(
    ("joint", "coefficient"),
    [(0, 2e-5), *(pytest.param(j, 4e-4, marks=pytest.mark.thorough) for j in (1, 2, 4))],
)
@pytest.mark.thorough
def test_a_bearing_that_yields_has_its_name(joint, coefficient, tmp_path):
    effect = {"effect": "bearing_compliance", "joint": joint, "coefficient": coefficient}
    closure = closed(tmp_path / "arm", effect | {"centre": OFF_THE_FLANGE})
    assert closure.verdict == "named"
    (found,) = closure.effects
    # A base that yields alike about both axes turns the arm as the bearing of its first joint does.
    assert f"bearing_compliance J{joint + 1}" in (found.effect.key, *found.equivalent)
    assert closure.errors["after"].chi2_per_dof == pytest.approx(1.0, abs=0.1)
    assert closure.errors["before"].chi2_per_dof > 1.2


@pytest.mark.parametrize("joint", [5, pytest.param(3, marks=pytest.mark.thorough)])
def test_a_tool_whose_mass_is_off_the_flange(joint, tmp_path):
    """The torque about the last axis is that of nothing else."""
    effect = {"effect": "joint_compliance", "joint": joint, "coefficient": 3e-4}
    closure = closed(tmp_path / "arm", effect | {"centre": OFF_THE_FLANGE})
    assert [found.effect.key for found in closure.effects] == [f"joint_compliance J{joint + 1}"]
    assert closure.errors["after"].chi2_per_dof == pytest.approx(1.0, abs=0.1)
    if joint != 5:
        return
    # What it amounts to on any poses: weight times coefficient, for masses 50 mm off the flange.
    amounts = {
        row["parameter"]: (float(row["value"]), float(row["standard_uncertainty"]))
        for row in csv.DictReader(io.StringIO(effects_csv(closure)))
        if row["unit"] == "urad/m"
    }
    assert {*amounts} == {"torsion_flange", "torsion_off_x", "torsion_off_y"}
    for name, centre in zip(("torsion_off_x", "torsion_off_y"), OFF_THE_FLANGE, strict=False):
        value, u = amounts[name]
        assert abs(value - 1e6 * 3e-4 * 9.81 * centre / 0.05) < 3.0 * u < 1200.0
    assert amounts["torsion_flange"] == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("order", [200.0, pytest.param(7.3, marks=pytest.mark.thorough)])
@pytest.mark.thorough
def test_the_gear_of_a_joint_has_its_name_and_pitch(order, tmp_path):
    effect = {"effect": "gear_ripple", "joint": 2, "amplitude_urad": 60, "phase": 1.0}
    closure = closed(tmp_path / "arm", effect | {"pitch_deg": 360.0 / order})
    assert [found.effect.key for found in closure.effects] == ["gear_ripple J3"]
    values = {name: (value, u) for name, value, _, u in closure.effects[0].parameters}
    pitch, u = values["pitch"]
    assert abs(360.0 / pitch - order) <= 3.0 * 360.0 / pitch**2 * u < 0.5
    (sine, us), (cosine, uc) = values["sine"], values["cosine"]
    assert abs(math.hypot(sine, cosine) - 60.0) <= 3.0 * max(us, uc)


@pytest.mark.thorough
def test_a_gear_that_yields_most_to_small_loads_has_its_name(tmp_path):
    """Beside the compliance of the same joint, of which the oracle's wind-up is a part."""
    effects = (
        {"effect": "joint_compliance", "joint": 1, "coefficient": 2e-5},
        {"effect": "gear_wind_up", "joint": 1, "size_urad": 150, "knee_mm": 15},
    )
    closure = closed(tmp_path / "arm", *effects)
    assert closure.verdict == "named"
    names = {found.effect.key for found in closure.effects}
    assert names == {"joint_compliance J2", "gear_wind_up J2"} and len(closure.effects) == 2
    assert closure.errors["after"].chi2_per_dof == pytest.approx(1.0, abs=0.1)
    assert closure.errors["before"].chi2_per_dof > 10.0
    (gear,) = (found for found in closure.effects if found.effect.key == "gear_wind_up J2")
    values = {name: (value, u) for name, value, _, u in gear.parameters}
    knee, u = values["knee"]
    assert abs(knee - 15.0) < 3.0 * u < 8.0
    size, u = values["size_arm"]
    assert abs(size - 150.0) < 3.0 * u < 10.0
    angle, u = turned(closure, 1)
    expected = put_in(*effects, joint=1)
    assert expected.std() > 150e-6 and u.max() < 15e-6
    assert np.abs(angle - expected).max() < 15e-6
    assert np.mean(((angle - expected) / u) ** 2) < 2.0


@pytest.mark.parametrize("alone", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_the_soft_gear_of_a_wrist(alone, tmp_path):
    """Less its compliance, and with it."""
    effect = {"effect": "gear_wind_up", "joint": 4, "size_urad": 200, "knee_mm": 30}
    effect |= {"masses": "tool", "departure": alone}
    closure = closed(tmp_path / "arm", effect)
    expected = {"gear_wind_up J5"} if alone else {"joint_compliance J5", "gear_wind_up J5"}
    assert closure.verdict == "named"
    assert {found.effect.key for found in closure.effects} == expected
    assert len(closure.effects) == len(expected)
    assert closure.errors["after"].chi2_per_dof == pytest.approx(1.0, abs=0.1)
    angle, u = turned(closure, 4)
    put = put_in(effect, joint=4)
    assert put.std() > 40e-6 and u.max() < 15e-6
    assert np.mean(((angle - put) / u) ** 2) < 2.0


def test_where_no_time_was_recorded_the_poses_count(tmp_path):
    """A joint that slips between two poses, and an arm in which nothing does."""
    case = make_case("reflectors", seed=5, plan={"n": 150})
    after = 61
    t0 = 0.5 * float(case.arm_run.t[after - 1] + case.arm_run.t[after])
    closure = closed(tmp_path / "arm", {"effect": "jump", "joint": 1, "size_urad": 80, "t0_s": t0})
    assert "t" not in closure.after.measurement.plan.covariates
    (one,) = closure.effects
    assert (closure.verdict, one.effect.key) == ("named", "jump J2")
    values = {name: (value, unit, u) for name, value, unit, u in one.parameters}
    size, unit, u = values["size"]
    assert unit == "urad" and abs(size - 80.0) <= 3.0 * u
    at, unit, _ = values["at"]
    assert unit == "pose" and after - 1 <= at <= after
    assert any(row["unit"] == "pose" for row in csv.DictReader(io.StringIO(effects_csv(closure))))


def test_effects_of_time_by_pose_are_those_of_time(tmp_path):
    """Alike, where every pose takes as long: the same deviations, per pose instead of per hour."""
    case = make_case("reflectors", seed=5, plan={"n": 40}, recording=("t_s",))
    timed = load_study(write_study(tmp_path / "timed", case))
    plan, setup = timed.plan, Setup(timed.model.chain, timed.model.layout, timed.plan)
    every = 36.0  # a hundred poses in an hour
    clocked = {**plan.covariates, "t": every * plan.covariate("order")}
    bare = {name: x for name, x in plan.covariates.items() if name != "t"}
    by_time = dataclasses.replace(setup, plan=dataclasses.replace(plan, covariates=clocked))
    by_pose = dataclasses.replace(setup, plan=dataclasses.replace(plan, covariates=bare))
    for cls in (Drift, WarmUp, Jump, StationDrift, StationSettling):
        for one, other in zip(cls.candidates(by_time), cls.candidates(by_pose), strict=True):
            assert other.needs == ("order",) and one.needs == ("t",)
            units = [[p.unit for p in effect.parameters] for effect in (one, other)]
            assert [u.replace("/pose", "/h").replace("pose", "h" if cls is WarmUp else "s")
                    for u in units[1]] == units[0]  # fmt: skip
            shape = {"tau": 1800.0, "at": 36.0 * 20.5}
            mine = one.response(by_time.plan, shape)
            theirs = other.response(by_pose.plan, {k: v / every for k, v in shape.items()})
            per = every if cls in (Drift, StationDrift, StationSettling) else 1.0
            for key, values in mine.items():
                np.testing.assert_allclose(values, per * np.asarray(theirs[key]), atol=1e-12)


@pytest.mark.thorough
def test_a_reflector_that_slipped_by_millimetres_hides_nothing(tmp_path):
    """250 standard deviations of what a jump is expected to be, with a joint that yields."""
    yields = {"effect": "joint_compliance", "joint": 1, "coefficient": 1.5e-4}
    plan = {"n": 200, "reflectors": 1, "fixed": 0}
    case = make_case("reflectors", seed=8, plan=plan, effects=[yields], sigma=50e-6)
    slipped = np.array([1.4e-3, 4.8e-3, 0.2e-3])
    frames, _ = arm_frames(case.arm, case.arm_run.q)
    shift = (frames[:, -1] @ slipped) @ case.arm_run.rotation.T
    for i, a in enumerate("xyz"):
        case.data[f"smr1_{a}_mm"][80:] += 1e3 * shift[80:, i]
    study = load_study(write_study(tmp_path, case))
    found = close_loop(study.model, study.measurement, draws=100)
    jump, compliance = found.effects[:2]
    assert {jump.effect.key, compliance.effect.key} == {"jump tool", "joint_compliance J2"}
    if jump.effect.key != "jump tool":
        jump = compliance
    values = {name: (value, u) for name, value, _, u in jump.parameters}
    for axis, expected in zip("XYZ", slipped, strict=True):
        assert abs(values[axis][0] - 1e6 * expected) < 3.0 * values[axis][1] + 20.0
    assert 79.0 < values["at"][0] < 80.0
    assert found.errors["after"].chi2_per_dof < 1.3


@pytest.mark.parametrize(("harmonic", "backlash", "doubtful"), [(2e4, 15, True), (2e4, 3000, False),
                                                                (2e2, 15, False)])  # fmt: skip
def test_what_may_be_a_product_of_a_larger_effect_is_not_certain(
    harmonic, backlash, doubtful, tmp_path
):
    """A harmonic of 20 mrad in an arm whose links are turned by 15 mrad in all has products of at
    most 700 urad with them and with itself; one of 0.2 mrad, of 3 urad.
    """
    effects = (
        {"effect": "gear_harmonic", "joint": 1, "order": 2, "amplitude_urad": harmonic},
        {"effect": "backlash", "joint": 2, "size_urad": backlash},
    )
    case = make_case("reflectors", seed=5, plan={"n": 60}, effects=effects)
    study = load_study(write_study(tmp_path / "arm", case))
    setup = study.model.setup(study.measurement.plan)
    harmonics = (e for e in GearHarmonic.candidates(setup) if e.placement == "J2")
    large = next(e for e in harmonics if e.order == 2)
    small = next(e for e in Backlash.candidates(setup) if e.key == "backlash J3")
    # Declared with the sizes that they have, so that the fit does not put them into the links.
    expected = tuple((p.name, 0.0, harmonic) for p in large.amplitudes)
    large = dataclasses.replace(large, given=expected)
    small = dataclasses.replace(small, given=(("size", 0.0, backlash),))
    fit = identify(study.model.with_effects(large, small), study.measurement)
    place = len(fit.model.effects) - 1
    assert 0.01 < rotation_of_machine(fit) < 0.04
    why = second_order(fit, place)
    assert bool(why) == doubtful
    assert not doubtful or "gear_harmonic J2" in why
    assert second_order(fit, place - 1) == ""
