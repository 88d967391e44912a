"""Decisions by JCGM 106, and the distribution of the largest volumetric error behind them."""

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from scipy.stats import ks_2samp, norm

import vcal
from identified import exact_points, identified
from oracle import align, write_study
from report_schema import SCHEMA
from vcal.compensation.stored import machine_from, machine_record
from vcal.compensation.volume import working_volume
from vcal.compensation.volumetric_error import VolumetricError, points_per_axis, volumetric_error
from vcal.machine.chain import chain_from_string
from vcal.numerics.conformity import Draws, Requirement, Tolerance, decide
from vcal.report.loop.decision import (
    acceptance_section,
    chance,
    decided,
    volumetric_record,
    volumetric_tiles,
)
from vcal.study.statements import AcceptanceSettings

COUNT = 200_000


def judged(values, upper, *rule, **rules):
    return decide(Draws(values), Requirement(Tolerance(upper=upper), *rule, **rules))


def normal(y, u, count=COUNT):
    """Values of a normal distribution, evenly in probability."""
    return y + u * norm.ppf((np.arange(count) + 0.5) / count)


# --- JCGM 106 ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("y", "u", "limit", "printed"),
    [
        (-5.47, 0.05, -5.40, 0.92),  # 7.3.3, example 1: breakdown voltage of a Zener diode, V
        (-509.7, 8.6, -490.0, 0.99),  # example 2: burst strength of a container, kPa, a lower limit
    ],
)
def test_conformance_probabilities_that_are_printed(y, u, limit, printed):
    found = judged(normal(y, u), limit)
    assert found.probability == pytest.approx(norm.cdf((limit - y) / u), abs=1e-5)
    assert round(found.probability, 2) == printed
    assert (found.estimate, found.u) == (pytest.approx(y), pytest.approx(u, rel=1e-4))


@pytest.mark.parametrize(
    ("probability", "z"), [(0.80, 0.84), (0.90, 1.28), (0.95, 1.64), (0.99, 2.33), (0.999, 3.09)]
)
def test_guard_bands_are_those_of_table_1(probability, z):
    found = judged(normal(12.0, 2.0), 20.0, 1.0 - probability)
    assert round(found.guard_band[1] / 2.0, 2) == z
    assert found.guard_band[1] == pytest.approx(2.0 * norm.ppf(probability), rel=2e-3)
    assert found.acceptance[1] == pytest.approx(20.0 - found.guard_band[1])
    assert found.rejection[1] == pytest.approx(20.0 + found.guard_band[1], rel=1e-3)


@pytest.mark.parametrize("skewed", [False, True])
def test_a_decision_by_probability_is_that_by_limits(skewed):
    random = np.random.default_rng(5)
    seen = set()
    for _ in range(200):
        values = random.normal(size=(500, 8))
        values = np.abs(values).max(1) if skewed else values[:, 0]
        values = values * random.uniform(0.2, 3.0) + random.uniform(0.0, 12.0)
        found = judged(values, 6.0, 0.05)
        by_limits = (
            "conforms" if found.estimate <= found.acceptance[1]
            else "does_not_conform" if found.estimate > found.rejection[1]
            else "undecided"
        )  # fmt: skip
        assert found.verdict == by_limits
        seen.add(found.verdict)
    assert seen == {"conforms", "does_not_conform", "undecided"}


def test_simple_acceptance_compares_the_estimate():
    for y, verdict in ((5.9, "conforms"), (6.1, "does_not_conform")):
        found = judged(normal(y, 1.0, 1000), 6.0, rule="simple")
        assert (found.verdict, found.guard_band[1], found.acceptance[1]) == (verdict, 0.0, 6.0)
    with pytest.raises(ValueError, match="found 1 values, expected two"):
        judged(np.ones(1), 1.0)


def test_a_probability_is_stated_no_finer_than_its_draws():
    low, high, middle = (judged(normal(y, 1.0, 1000), 0.0) for y in (9, -9, 0))
    assert [chance(one) for one in (low, high, middle)] == ["below 0.3 %", "above 99.7 %", "50.0 %"]
    assert middle.u_probability == pytest.approx(np.sqrt(0.25 / 1000))


# --- the largest error ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return identified(tmp_path_factory.mktemp("acceptance") / "study")


@pytest.fixture(scope="module")
def error(known):
    return volumetric_error(known[1], draws=1500, seed=4)


def test_the_largest_error_has_the_distribution_of_exact_kinematics(known, error):
    case, machine, root = known
    use = working_volume(machine, 7)
    q = use.position
    nominal = machine.nominal(q)
    random = np.random.default_rng(77)
    (effect,) = machine.effects
    sizes = []
    for _ in range(250):
        theta = machine.theta + root @ random.normal(size=len(machine.theta))
        points = exact_points(case, effect, theta, q)
        left = 1e6 * np.linalg.norm(align(points, nominal) - nominal, axis=1)
        sizes.append((np.sqrt((left**2).mean()), left.max()))
    for drawn, oracle in zip(error.before, np.array(sizes).T, strict=True):
        assert ks_2samp(drawn, oracle).pvalue > 1e-3
        assert drawn.mean() == pytest.approx(oracle.mean(), rel=0.02)
    # As does the probability to conform with a tolerance inside the distribution.
    tolerance = float(np.quantile(error.before.largest, 0.8))
    p = judged(error.before.largest, tolerance).probability
    share = np.mean([largest <= tolerance for _, largest in sizes])
    assert abs(p - share) < 4.0 * np.sqrt(p * (1.0 - p) * (1.0 / 250 + 1.0 / 1500))


def test_compensation_leaves_what_is_not_known(known, error):
    """With a mean of zero, the distribution before compensation is that after it."""
    _, machine, _ = known
    centred = volumetric_error(replace(machine, theta=0.0 * machine.theta), draws=1500, seed=4)
    for one, other in zip(error.after, centred.before, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.02, atol=0.05)
    assert error.after.largest.mean() < 0.5 * error.before.largest.mean()
    assert error.positions == 343


@pytest.mark.parametrize(("text", "expected"), [("w X b Y Z t", 7), ("w C A b X Y Z t", 3)])
def test_the_grid_has_few_positions(known, text, expected):
    rotary = {axis: (0, 0, 0) for axis in "AC" if axis in text}
    chain = chain_from_string(text, {a: (0, 0.5) for a in "XYZ"}, rotary_m=rotary)
    volume = np.tile([0.0, 0.5], (len(chain.axes), 1))
    other = replace(known[1], chain=chain, volume=volume)
    assert points_per_axis(other) == expected


# --- what is said --------------------------------------------------------------------------------


def asked(machine, **keys):
    given = AcceptanceSettings(**{"volumetric_um": 20.0, "draws": 400, **keys})
    return replace(machine, about={"acceptance": given.model_dump()})


def test_page_and_record_state_the_decision(known):
    _, machine, _ = known
    one = machine_from(json.loads(json.dumps(machine_record(asked(machine, risk_percent=10)))))
    found = decided(one)
    assert found is not None
    record = volumetric_record(found)
    for key, content in record.items():
        jsonschema.validate(content, {**SCHEMA["properties"][key], "$defs": SCHEMA["$defs"]})
    before, after = (record["acceptance"][stage] for stage in ("before", "after"))
    assert before["verdict"] == "does_not_conform"
    assert before["estimate_um"] == record["volumetric_error"]["before"]["largest_um"]
    assert record["acceptance"]["risk"] == 0.1
    assert after["acceptance_limit_um"] == pytest.approx(20.0 - after["guard_band_um"])
    (section,) = acceptance_section(found)
    assert "at most 20 µm" in section.title and "10 %" in section.paragraphs[0]
    assert [row[0] for row in section.tables[0].rows] == ["as it is", "after compensation"]
    assert "With a tolerance of 20 µm: as it is, the machine does not conform" in found.sentence
    tiles = volumetric_tiles(found)
    assert [tile.name for tile in tiles][1] == "Acceptance, tolerance 20 µm"
    assert "does not conform" in tiles[1].note
    # Without a gain, nothing is said about a compensation.
    worse = decided(replace(one, no_gain="It rises."))
    assert worse is not None and "compensation does not reduce the error" in worse.sentence
    assert "after compensation" not in worse.sentence
    assert len(acceptance_section(worse)[0].tables[0].rows) == 1


def test_without_a_tolerance_only_the_sizes_are_stated(known):
    found = decided(known[1])
    assert found is not None and isinstance(found.error, VolumetricError)
    assert found.verdict == "" and "With a tolerance" not in found.sentence
    assert set(volumetric_record(found)) == {"volumetric_error"}
    assert acceptance_section(found) == [] and len(volumetric_tiles(found)) == 1
    nothing = replace(known[1], theta=np.zeros(0), effects=(), shapes=())
    assert decided(nothing) is None and volumetric_record(None) == {}


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("[acceptance]\nvolumetric_um = -3", "acceptance.volumetric_um"),
        ("[acceptance]\nrisk_percent = 5", "acceptance.volumetric_um"),
        ("[acceptance]\nvolumetric_um = 3\nrisk_percent = 0.2", "draws = 2000 with risk_percent"),
        ("[measurement]\ndate = '14.3.2026'", "found date = '14.3.2026', expected year, month"),
        ("[certificate.customer]\ncountry = 'Germany'", "certificate.customer.country"),
    ],
)
def test_mistakes_in_what_is_stated(known, tmp_path, lines, said):
    folder = write_study(tmp_path / "study", known[0])
    setup = folder / "setup.toml"
    setup.write_text(f"{setup.read_text()}\n{lines}\n", encoding="utf-8")
    with pytest.raises(vcal.StudyError) as caught:
        vcal.load_study(folder)
    assert said in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
