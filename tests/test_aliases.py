"""Pitches that positions in equal steps cannot distinguish, and their class."""

import numpy as np
import pytest
from typer.testing import CliRunner

import vcal
from oracle import make_case, write_study
from vcal.cli import app
from vcal.effects.cyclic import GearRipple, ScrewCyclic
from vcal.effects.shape_class import ShapeClass
from vcal.machine.plan import Plan
from vcal.numerics.lattice import lattice_step

SCREW = ScrewCyclic(port="EXX", placement="X")


def waves(x, pitch):
    return np.stack([np.sin(2 * np.pi * x / pitch), np.cos(2 * np.pi * x / pitch)], axis=1)


def at(x, axis="X"):
    return Plan((axis,), np.asarray(x, float)[:, None])


def same(one, other):
    """Whether two pairs of columns span the same space."""
    both = np.linalg.svd(np.concatenate([one, other], axis=1), compute_uv=False)
    return both[2] < 1e-8 * both[0]


def test_the_step_of_a_lattice():
    rng = np.random.default_rng(0)
    assert lattice_step(0.3 + 0.047 * np.arange(20), 1e-5) == pytest.approx(0.047)
    assert lattice_step(np.array([0.0, 30, 50, 90, 100]), 1e-3) == pytest.approx(10.0)
    off = 0.047 * np.arange(30) + rng.uniform(-3e-5, 3e-5, 30)
    assert lattice_step(off, 4e-5) == pytest.approx(0.047, rel=1e-4)
    assert lattice_step(rng.uniform(0, 1, 30), 4e-5) is None
    assert lattice_step(np.array([0.0, 0.3, 0.6]), 4e-5) is None


@pytest.mark.parametrize("step", [40e-3, 47e-3, 50e-3, 60e-3, 10e-3])
def test_the_aliases_of_a_pitch_are_those_of_the_formula_and_of_the_readings(step):
    x = 0.1 + step * np.arange(20)
    found = SCREW.aliases(at(x))
    assert found.step == pytest.approx(step)
    first, *others = found.alike
    for pitch in others:
        assert same(waves(x, first), waves(x, pitch))
    for pitch in found.unseen:
        assert np.ptp(waves(x, pitch), axis=0).max() < 1e-8
    # No pitch of a fine grid of the scan is missing.
    grid = SCREW.scan(at(x))["pitch"]
    frequencies = np.linspace(1 / grid.max(), 1 / grid.min(), 20_001)
    aliased = frequencies[np.abs((frequencies * step + step / first) % 1.0) < 1e-3]
    listed = 1 / np.array(found.alike)
    assert all(np.abs(listed - f).min() < 0.1 for f in aliased)


def test_positions_off_a_lattice_have_no_aliases():
    x = np.random.default_rng(1).uniform(0, 1, 40)
    assert SCREW.aliases(at(x)) is None
    assert SCREW.aliases(at(np.arange(0, 1, 1.5e-3))) is None


def test_the_ripple_of_a_joint_has_aliases_too():
    ripple = GearRipple(port="ECJ2", unit="urad", usual=50.0, placement="J2")
    q = np.radians(7.0) * np.arange(15)
    first, *others = ripple.aliases(at(q, "J2")).alike
    assert others
    for pitch in others:
        assert same(waves(q, first), waves(q, pitch))


def _study(folder, step, count, pitch, seed=5, phase=0.7):
    screw = {"effect": "screw_cyclic", "axis": "X", "amplitude_um": 6.0, "pitch_mm": pitch,
             "phase": phase}  # fmt: skip
    case = make_case(
        "laser_tracker",
        seed=seed,
        effects=[screw],
        travel=np.array([(count - 1) * step, 600.0, 500.0]) * 1e-3,
        plan={"shape": (count, 2, 2), "margin": 0.0, "jitter": 0.0},
    )
    write_study(folder, case)
    return folder / "setup.toml"


@pytest.mark.slow
def test_a_class_of_pitches_is_named_and_what_is_common_is_compensated(tmp_path):
    """Steps of 47 mm and a pitch of 9 mm, which is not a usual one."""
    study = vcal.load_study(_study(tmp_path, 47.0, 21, 9.0))
    closure = vcal.close_loop(
        study.model, study.measurement, check=study.check, effects=["screw_cyclic"], draws=200
    )
    (found,) = closure.effects
    assert found.effect.key == "screw_cyclic X" and found.status == "named"
    pitches = np.array([shape["pitch"] for shape in found.shapes])
    assert np.abs(pitches - 9.0).min() < 0.005
    wanted = np.abs(1 / 9.0 + np.arange(-20, 20) / 47.0)
    wanted = wanted[(wanted < 1 / 4.0) & (wanted > 1 / 235.0)]
    for frequency in wanted:
        assert np.abs(1 / pitches - frequency).min() < 2e-5
    value, u = next((v, u) for name, v, _, u in found.parameters if name == "pitch")
    assert np.abs(pitches - value).max() <= 2 * u * (1 + 1e-9)
    before, after = closure.errors["before"].check, closure.errors["after"].check
    assert after.value <= before.value + after.u
    assert any("gives the same readings" in note for note in closure.notes)
    # In the readings the class is as good as its members; between them it is smaller.
    (shared,) = (e for e in closure.after.model.effects if isinstance(e, ShapeClass))
    plan = study.measurement.plan
    mean = list(shared.response(plan, {}).values())
    first = list(shared.effect.response(plan, dict(shared.members[0][1])).values())
    np.testing.assert_allclose(mean, first, atol=0.02)
    between = plan.with_position(np.asarray(plan.position) + 0.5 * 0.047)
    size = [np.sqrt(np.mean(np.square(list(of.values()))))
            for of in (shared.response(between, {}), shared.effect.response(
                between, dict(shared.members[0][1])))]  # fmt: skip
    assert size[0] < 0.5 * size[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("step", "count", "pitch", "without"),
    [
        (50.0, 20, 17.0, "geometric_order EXX"),  # a wave of 850 mm along 950 mm of travel
        # a wave of 564 mm: one dent describes it
        pytest.param(47.0, 21, 12.0, "local_bump X", marks=pytest.mark.thorough),
        (50.0, 20, 13.0, "larger sizes"),  # a wave of 325 mm, nearly a term of the geometry
    ],
)
def test_all_shapes_of_a_class_count_beside_what_has_one_shape(
    tmp_path, step, count, pitch, without
):
    """A tenth of the class alone is too improbable beside a polynomial, a dent or larger sizes."""
    seed = 71_000
    phase = np.random.default_rng([seed, int(step), int(10 * pitch)]).uniform(-np.pi, np.pi)
    path = _study(tmp_path, step, count, pitch, seed + int(pitch), phase)
    study = vcal.load_study(path)
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, seed=seed)
    (found,) = closure.effects
    certain = found.status == "named"
    if found.effect.key == without:
        assert not certain
        assert ("screw_cyclic", "X") in [rival[:2] for rival in found.alternatives]
    else:
        assert found.effect.key == "screw_cyclic X"
        pitches = np.array([shape["pitch"] for shape in found.shapes])
        assert np.abs(1 / pitches - 1 / pitch).min() * (count - 1) * step < 0.25


@pytest.mark.slow
def test_a_polynomial_that_fits_as_well_as_a_class_of_pitches_is_not_certain(tmp_path):
    """The noise of this set makes the polynomial fit better than the true pitch."""
    step, count, pitch, seed = 50.0, 20, 17.0, 200_000
    phase = np.random.default_rng([seed, int(step), int(10 * pitch)]).uniform(-np.pi, np.pi)
    study = vcal.load_study(_study(tmp_path, step, count, pitch, seed + int(pitch), phase))
    effects = ["screw_cyclic", "geometric_order"]
    closure = vcal.close_loop(study.model, study.measurement, effects=effects, draws=200)
    (found,) = closure.effects
    assert found.effect.key == "geometric_order EXX"
    assert found.probability > 0.95 and found.status == "ambiguous"
    ((name, place, _),) = found.alternatives
    pitches = np.array([shape["pitch"] for shape in found.shapes_of(name, place)])
    assert (name, place) == ("screw_cyclic", "X") and len(pitches) > 10
    assert np.abs(1 / pitches - 1 / pitch).min() * (count - 1) * step < 0.25
    assert "between those measured" in found.separation


@pytest.mark.thorough
def test_check_says_which_pitches_cannot_be_distinguished_or_seen(tmp_path):
    """Steps of 50 mm: five and ten are divisors of it."""
    path = _study(tmp_path, 50.0, 20, 10.0)
    result = CliRunner().invoke(app, ["check", str(path)])
    assert result.exit_code == 0
    said = " ".join(result.output.split())
    assert "positions of X every 50 mm: pitches of 12," in said
    assert "cannot be distinguished" in said
    unseen = said[said.index("cannot be distinguished") :]
    assert "pitches of 50, 25, 16.67, 12.5, 10," in unseen and "cannot be seen" in unseen


def test_the_loop_says_which_pitches_were_not_seen(tmp_path):
    study = vcal.load_study(_study(tmp_path, 50.0, 20, 10.0))
    closure = vcal.close_loop(
        study.model, study.measurement, effects=["screw_cyclic"], draws=100, max_effects=1
    )
    assert not closure.effects
    (unseen,) = (said for said in closure.unseen if said.startswith("screw_cyclic X"))
    assert "a pitch of 50 or 25 or 16.67 or 12.5 or 10 or 8.333 mm, or one of 6 others" in unseen
