"""The cases of the power benchmark: an effect of the oracle is the effect of that name in vcal."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import power
import power_summary
from power_cases import (
    ENTRIES,
    OUTSIDE,
    OWN_NOISE,
    drawn,
    make,
    noise_seed,
    unresolved_degree,
    world_of,
)

from vcal import close_loop
from vcal.identification.identify import identify

SEED = 20_000
ALONE = sorted(name for name, entry in ENTRIES.items() if entry.group == "catalogue")
QUICK = {"laser_tracker/payload_sag", "laser_frame/refraction"}


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.campaign) for n in ALONE]
)
@pytest.mark.thorough
def test_the_true_effect_leaves_no_residual(name):
    """Without noise the effect of this name, placement and component explains the data."""
    entry = ENTRIES[name]
    world = world_of(entry.instrument, SEED)
    made = make(entry, world, drawn(entry, world), [entry.kinds[0].large], noise=0.0)
    study = power.load(made.case)
    before = identify(study.model, study.measurement, room=len(study.model.entries) + 16)
    keep = np.ones(study.measurement.plan.rows, bool)
    after = power.true_fit(study, before, made.terms, keep)
    assert name not in QUICK or before.chi2 / before.dof > 0.3  # others may be hidden by the plan
    assert after.chi2 / after.dof < 0.02


@pytest.mark.campaign
def test_a_detection_limit_is_that_of_the_effect_by_itself():
    """A plan that does not detect a tilt does not detect it with outliers either."""
    limits = []
    for name in ("laser_tracker/thermal_tilt", "laser_tracker/thermal_tilt, strays"):
        entry = ENTRIES[name]
        world = world_of(entry.instrument, 20_014)
        (tilt,) = drawn(entry, world)
        limits.append(power.limit_of(entry, world, tilt, entry.kinds[0]))
    assert limits == [np.inf, np.inf]


def test_sets_of_one_seed_share_all_but_the_size():
    entry = ENTRIES["laser_tracker/backlash"]
    world = world_of("laser_tracker", SEED)
    sized = drawn(entry, world)
    one, two = (make(entry, world, sized, [size]).case for size in (1.0, 2.0))
    np.testing.assert_array_equal(one.run.q, two.run.q)
    np.testing.assert_array_equal(one.machine.motion, two.machine.motion)
    assert one.effects[0]["axis"] == two.effects[0]["axis"]
    other = world_of("laser_tracker", SEED + 3)
    assert other.chain == world.chain and other.travel != world.travel


def test_noise_of_its_own():
    """From one seed on every set with an effect has its own noise; a set with outliers has that of
    the same set without.
    """
    plain, strays = ENTRIES["laser_tracker/backlash"], ENTRIES["laser_tracker/backlash, strays"]
    clean, seed = ENTRIES["laser_tracker/clean"], OWN_NOISE
    assert noise_seed(plain, 3.0, seed - 1) == seed - 1 and noise_seed(clean, 0.0, seed) == seed
    assert noise_seed(plain, 5.0, seed) == noise_seed(strays, 5.0, seed)
    different = {noise_seed(plain, m, s) for m in (3.0, 5.0) for s in (seed, seed + 1)}
    assert len(different) == 4
    world = world_of("laser_tracker", seed)
    sized = drawn(plain, world)
    same, other = (make(plain, world, sized, [1.0], noise_seed=s).case for s in (seed, seed + 1))
    np.testing.assert_array_equal(same.readings, make(plain, world, sized, [1.0]).case.readings)
    np.testing.assert_array_equal(same.run.q, other.run.q)
    np.testing.assert_array_equal(same.check_tcp, other.check_tcp)
    assert (same.readings != other.readings).all()


def test_intervals_count_draws_of_the_noise():
    """Equal sets of one draw count as one set; sets of independent draws count in full."""
    hits = np.random.default_rng(1).uniform(size=400) < 0.3
    assert power_summary.effective(np.repeat(hits, 10), np.arange(4000) // 10) == pytest.approx(
        399, rel=1e-12
    )
    assert power_summary.effective(hits, np.arange(400)) == pytest.approx(399, rel=1e-12)
    assert power_summary.effective([False] * 7, np.arange(7)) == 7
    # An independent estimate: the scatter of the share in a bootstrap over whole draws.
    rng = np.random.default_rng(2)
    rates, sizes = rng.beta(1, 9, 200), rng.integers(1, 40, 200)
    draws = np.repeat(np.arange(200), sizes)
    hits = rng.uniform(size=len(draws)) < rates[draws]
    k, n = np.bincount(draws, hits), np.bincount(draws)
    again = rng.integers(0, 200, (4000, 200))
    scatter = np.std(k[again].sum(1) / n[again].sum(1))
    p = hits.mean()
    found = np.sqrt(p * (1 - p) / power_summary.effective(hits, draws))
    assert found == pytest.approx(scatter, rel=0.05)


def test_degrees_that_a_family_does_not_follow():
    """Odd waves alone leave the second degree, half and whole waves of both kinds the fourth."""
    assert unresolved_degree((0, 0, 0.5, 1, 0, 0, 0, 0)) == 2
    assert unresolved_degree((0, 0, 0.5, 1, 1, 1, 1, 1)) == 4


def line(verdict, *found, truth=(("backlash X",),), **more):
    parts = [
        {"key": key, "status": status, "parameters": {}, "equivalent": same, "rivals": []}
        for key, status, same in found
    ]
    return {"verdict": verdict, "found": parts, "truth": [list(t) for t in truth], **more}


@pytest.mark.parametrize(
    ("set_line", "expected"),
    [
        (line("named", ("backlash X", "named", [])), "right"),
        (line("named", ("backlash Y", "named", ["backlash X"])), "right"),
        (line("ambiguous", ("backlash X", "ambiguous", [])), "right first"),
        (line("ambiguous", ("drift X", "ambiguous", [])), "another first"),
        (line("named", ("drift X", "named", [])), "wrong"),
        (line("named", ("backlash X", "named", []), ("drift X", "named", [])), "wrong"),
        (line("named", ("backlash X", "named", []), truth=(("backlash X",), ("drift Y",))),
         "one of two"),
        (line("unexplained"), "unexplained"),
        (line("nothing_missing"), "nothing"),
        (line("named", ("backlash X", "named", []), truth=()), "wrong"),
    ],
)  # fmt: skip
def test_outcomes(set_line, expected):
    assert power_summary.outcome(set_line) == expected


def test_every_set_has_its_place_once():
    names = sorted(ENTRIES)
    found = list(power.jobs(names, [], range(SEED, SEED + 2)))
    assert len(found) == len(set(found))
    for name, entry in ENTRIES.items():
        mine = [job for job in found if job[0] == name]
        assert len(mine) == (20 if entry.clean else 2 * len(entry.multiples))
    far = list(power.jobs(names, [3.0, 30.0], range(SEED, SEED + 1)))
    assert ("laser_tracker/backlash", 3.0, SEED) in far
    assert ("laser_tracker/backlash", 30.0, SEED) in far and len(far) == len(set(far))
    assert ("laser_tracker/backlash", 5.0, SEED) not in far
    apart = list(power.jobs(names, [3.0, 5.0], range(SEED, SEED + 2), own_machines=True))
    assert (
        len(apart)
        == len(set(apart))
        == len(list(power.jobs(names, [3.0, 5.0], range(SEED, SEED + 2))))
    )
    seeds = {(name, seed) for name, _, seed in apart if name.startswith("laser_frame/")}
    shared = {seed for name, seed in seeds if name == "laser_frame/backlash"}
    assert len(shared) == 2
    assert not shared & {seed for name, seed in seeds if name == "laser_frame/jump of the frame"}
    assert {kind.name for kind in OUTSIDE} <= {k.name for e in ENTRIES.values() for k in e.kinds}


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("name", "seed", "sizes", "begun"),
    [
        # An error that grows with Y from one moment on describes a tilt and a part of the backlash.
        # This description ends the first search, and the second one begins without descriptions.
        ("laser_tracker/backlash and thermal_tilt", 20_005, [4.632, 7.689], 2),
        # A product of two quantities. A frame that grows in Z is found first and removed later.
        ("laser_frame/head_expansion and backlash", 20_009, [0.2754, 2.117], 1),
    ],
)
def test_two_effects_that_one_description_fits_better_than_each(name, seed, sizes, begun):
    """The two effects together fit better than the description."""
    entry = ENTRIES[name]
    world = world_of(entry.instrument, seed)
    made = make(entry, world, drawn(entry, world), sizes)
    study = power.load(made.case)
    steps = []
    closure = close_loop(study.model, study.measurement, draws=200, progress=steps.append)
    assert {e.effect.key for e in closure.effects} == {term.key for term in made.terms}
    assert closure.unexplained is None
    assert not any("describes the residual better" in r.reason for r in closure.rejected)
    assert steps.count("round 1: screening") == begun


@pytest.mark.campaign
def test_one_wrong_name_that_hides_another():
    """Backlash and a jump are explained by a temperature effect and a jump at another moment, each
    of which is the best name beside the other. The search must exclude both to find the true ones.
    """
    entry = ENTRIES["laser_tracker/payload_sag, backlash, cross_axis and jump of the tool"]
    world = world_of(entry.instrument, 20_074)
    sizes = [0.4946, 7.726, 8.598, 9.425]
    made = make(entry, world, drawn(entry, world), sizes, noise_seed=noise_seed(entry, 10, 20_074))
    study = power.load(made.case)
    closure = close_loop(study.model, study.measurement, draws=200)
    found = [{e.effect.key, *e.equivalent} for e in closure.effects]
    assert len(found) == 4
    assert all(any(term.key in names for names in found) for term in made.terms)
    assert closure.unexplained is None
    (jump,) = (e for e in closure.effects if e.effect.name == "jump")
    (at,) = (value for name, value, *_ in jump.parameters if name == "at")
    assert at == pytest.approx(made.terms[3].shape["at"], abs=10.0)


@pytest.mark.slow
def test_a_component_that_the_plan_hardly_determines_is_not_lost_between_large_rivals():
    """The plan determines a 50,000th part of the true component, which a roll of 500 urad or a
    cross term of 87 um explain as well. The name includes the true effect. Where the correction
    would be worse than none, the loop says so.
    """
    entry = ENTRIES["laser_frame/cross_axis"]
    world = world_of(entry.instrument, 20_078)
    made = make(entry, world, drawn(entry, world), [80.02],
                noise_seed=noise_seed(entry, 10, 20_078))  # fmt: skip
    study = power.load(made.case)
    closure = close_loop(study.model, study.measurement, check=study.check, draws=200, seed=1)
    (found,) = closure.effects
    assert made.terms[0].key in {found.effect.key, *found.equivalent}
    after, bare = (closure.errors[name].check for name in ("after", "uncompensated"))
    assert bool(closure.no_gain) == (after.value > bare.value)


@pytest.mark.campaign
def test_an_effect_of_impossible_size_is_no_rival():
    """A reversal error that the plan hardly determines would explain backlash with more than 256
    times its expected size. Its prior counts in full, and it refutes no other name.
    """
    entry = ENTRIES["laser_frame/backlash"]
    world = world_of(entry.instrument, 20_080)
    made = make(entry, world, drawn(entry, world), [2.073],
                noise_seed=noise_seed(entry, 3, 20_080))  # fmt: skip
    study = power.load(made.case)
    closure = close_loop(study.model, study.measurement, draws=200)
    (found,) = closure.effects
    assert made.terms[0].key in {found.effect.key, *found.equivalent}
    assert closure.unexplained is None
