"""Machines that do not stand with Z up: horizontal spindles, arms that hang."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from known import Known
from oracle import example_arm, make_case, write_study
from vcal import StudyError, load_study
from vcal.design.spaces.ball_information import ArrayPoses, derived
from vcal.effects import Setup
from vcal.effects.arm import gravity_moments
from vcal.effects.structure import PayloadSag
from vcal.machine.chain import chain_from_dh, chain_from_string
from vcal.machine.plan import Plan
from vcal.machine.ports import PortLayout
from vcal.model.forward import effect_terms, port_values, tool_points

TRAVEL = {"X": (0.0, 0.8), "Y": (0.0, 0.6), "Z": (0.0, 0.5)}
LYING = Rotation.from_euler("X", -90, degrees=True).as_matrix()
"""Takes the frame of an upright machine to that of one with +Y up: Z to Y, Y to -Z."""


def rams(chain, plan: Plan) -> list[PayloadSag]:
    return [*PayloadSag.candidates(Setup(chain, PortLayout.of(chain.axes, ()), plan))]


def sagging(chain, axis: str, clamped: str, q: np.ndarray) -> np.ndarray:
    """How far the tool point moves (n, 3), um, under 50 kg at these positions (n, 3), m, where the
    ram falls by 0.2 um/kg at full overhang.
    """
    plan = Plan(chain.axes, q, {"payload_kg": np.full(len(q), 50.0)})
    (sag,) = (e for e in rams(chain, plan) if (e.placement, e.clamped) == (axis, clamped))
    layout = PortLayout.of(chain.axes, ())
    terms = effect_terms(sag, layout, plan, {})
    size = np.array([0.2e-6 / sag.parameters[0].step])
    ports = np.asarray(port_values(terms, size, len(layout)))
    nominal = np.asarray(tool_points(chain, q, np.zeros_like(ports)))
    return 1e6 * (np.asarray(tool_points(chain, q, ports)) - nominal)


@pytest.mark.parametrize("clamped", ["low", "high"])
def test_a_horizontal_ram_of_the_spindle_falls_towards_minus_y(clamped):
    """c m s^3 at the tip, and the tool, 0.15 m in front of it, by its slope 1.5 c m s^2 / L more;
    what is clamped at the high end of the travel reaches back, and so does its slope.
    """
    chain = chain_from_string("w X b Y Z t", TRAVEL, (0.0, 0.0, 0.15), up="+Y")
    q = np.array([[0.1, 0.2, z] for z in (0.0, 0.25, 0.5)])
    got = sagging(chain, "Z", clamped, q)
    s, lever = (q[:, 2] / 0.5, 0.15) if clamped == "low" else (1.0 - q[:, 2] / 0.5, -0.15)
    np.testing.assert_allclose(got[:, 1], -10.0 * (s**3 + 1.5 * s**2 * lever / 0.5), atol=1e-3)
    np.testing.assert_allclose(got[:, [0, 2]], 0.0, atol=1e-3)


@pytest.mark.parametrize(("up", "level"), [("+Z", "XY"), ("-Y", "XZ"), ("+X", "YZ")])
def test_only_level_axes_sag(up, level):
    chain = chain_from_string("w b X Y Z t", TRAVEL, up=up)
    assert {e.placement for e in rams(chain, Plan(chain.axes, np.zeros((2, 3))))} == {*level}


@pytest.mark.parametrize("clamped", ["low", "high"])
@pytest.mark.parametrize(("axis", "turned"), [("X", "X"), ("Y", "Z")])
def test_a_machine_that_is_laid_down_sags_as_the_upright_one(axis, turned, clamped):
    """Y of the upright machine is -Z of the other one, which reaches out the other way."""
    q = np.array([[0.1, 0.3, 0.2], [0.5, 0.1, 0.4]])
    tool = np.array([0.02, -0.05, -0.1])
    upright = chain_from_string("w b X Y Z t", TRAVEL, tuple(tool))
    spans = {"X": TRAVEL["X"], "Y": TRAVEL["Z"], "Z": (-0.6, 0.0)}
    lying = chain_from_string("w b X Z Y t", spans, tuple(LYING @ tool), up="+Y")
    other = clamped if turned == axis else {"low": "high", "high": "low"}[clamped]
    expected = sagging(upright, axis, clamped, q) @ LYING.T
    np.testing.assert_allclose(sagging(lying, turned, other, q @ LYING.T), expected, atol=1e-6)
    assert np.abs(expected).max() > 0.5


def test_gravity_in_the_frame_of_an_artefact(tmp_path):
    """An artefact that is laid down with the machine has gravity from the same side, in a study and
    in a design.
    """
    it = Known("ball_array", tmp_path)
    instrument, plan = it.instrument, it.plan
    upright = instrument.with_geometry(plan)
    turned = np.einsum("ij,njk->nik", LYING, instrument.pose_rotation)
    lying = dataclasses.replace(instrument, pose_rotation=turned).with_geometry(
        plan, up=(0.0, 1.0, 0.0)
    )
    balls = np.asarray(instrument.centres)
    beam = instrument.beam()[0]
    by_design = [
        derived(ArrayPoses(balls, poses, np.asarray(instrument.pose_origin)), beam, up)
        for poses, up in ((instrument.pose_rotation, (0, 0, 1)), (turned, (0, 1, 0)))
    ]
    for name in ("gravity_x", "gravity_y", "gravity_z", "tilt"):
        np.testing.assert_allclose(lying.covariates[name], upright.covariates[name], atol=1e-12)
        np.testing.assert_allclose(by_design[1][name], by_design[0][name], atol=1e-12)
    assert np.abs(upright.covariates["gravity_z"]).max() > 0.9


@pytest.mark.thorough
def test_torques_of_an_arm_that_hangs_are_the_other_way_round():
    arm = example_arm()
    rows = [
        {"type": "revolute", "a": a, "d": d, "alpha": alpha, "theta": theta}
        for a, d, alpha, theta in zip(arm.a, arm.d, arm.alpha, arm.theta, strict=True)
    ]
    q = np.random.default_rng(2).uniform(-1.0, 1.0, (5, len(rows)))
    stands, hangs = (gravity_moments(chain_from_dh(rows, up=up), q, "J2") for up in ("+Z", "-Z"))
    assert np.abs(stands).max() > 0.1
    np.testing.assert_allclose(hangs, -stands, atol=1e-12)


def test_a_study_says_which_axis_is_up(tmp_path):
    folder = write_study(tmp_path / "study", make_case("ball_array", seed=3, plan={"repeats": 1}))
    setup = folder / "setup.toml"
    as_it_was = setup.read_text()
    upright = load_study(setup)
    setup.write_text(as_it_was.replace("[machine]", '[machine]\nup = "+Y"', 1))
    lying = load_study(setup)
    assert lying.chain.up == (0.0, 1.0, 0.0) and lying.chain.text == f"{upright.chain.text}, +Y up"
    down = [s.plan.covariates["gravity_z"] for s in (upright, lying)]
    assert np.abs(down[0] - down[1]).max() > 0.1
    setup.write_text(as_it_was.replace("[machine]", '[machine]\nup = "Y"', 1))
    with pytest.raises(StudyError, match=r"machine\.up") as refused:
        load_study(setup)
    assert "'+Y'" in str(refused.value)
