"""Valid studies: what is built from them, overrides, and the data beside the checkout."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from vcal.effects import CATALOGUE
from vcal.errors import StudyError
from vcal.identification.identify import identify
from vcal.instruments import INSTRUMENTS
from vcal.loop.weighing.cross_validation import log_predictive_density
from vcal.study import load_study, read_table, write_table

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
PRACTICE = sorted((DATA / "practice").glob("[01][0-9]_*"))
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason="no measurement data beside the checkout (shared/data)"
)
OWN_EFFECT = '''
import jax.numpy as jnp

from vcal.effects.base import Effect
from vcal.machine.parameters import Parameter


class Wobble(Effect):
    """A wobble of X."""

    name = "wobble"

    @property
    def parameters(self):
        return (Parameter("size", "um", sigma=5.0),)

    @property
    def needs(self):
        return ("T_air",)

    def response(self, plan, shape):
        return {("EZX", "size"): jnp.sin(plan.x("X"))}

    @classmethod
    def candidates(cls, setup):
        yield cls(placement="X")
'''


def append(folder: Path, text: str, file: str = "setup.toml") -> None:
    with open(folder / file, "a", encoding="utf-8") as f:
        f.write(text)


# --- what is built -------------------------------------------------------------------------------


def test_tracker_study_is_built(small_tracker_study):
    study = load_study(small_tracker_study / "setup.toml")
    assert study.name == "small"
    assert study.folder == small_tracker_study
    assert study.chain.axes == ("X", "Y", "Z")
    np.testing.assert_allclose(study.chain.joint("X").travel, [0.0, 2.0])
    np.testing.assert_allclose(study.chain.tool_offset, [0.0, 0.0, -0.15])
    assert study.measurement.readings.shape == (48, 3)
    assert study.plan.has("dir_X", "t", "T_X", "T_air", "range")
    assert study.check.tool_point.shape == (5, 3)
    assert [e.key for e in study.model.effects] == ["geometric", "station"]
    files = ("setup.toml", "data.csv", "errors.csv", "check.csv")
    assert study.hashes == {
        f: hashlib.sha256((small_tracker_study / f).read_bytes()).hexdigest() for f in files
    }
    assert study.as_dict["instrument"]["range_sigma_um"] == 1.3
    assert study.options.alpha == 0.01
    assert study.options.effects is None


def test_fourier_prior_is_that_of_uniform_coefficients(small_tracker_study):
    geometric = load_study(small_tracker_study).model.effects[0]
    sigma = {p.name: p.sigma for p in geometric.parameters}
    assert sigma["EXX.a1"] == pytest.approx(20.0 / np.sqrt(3.0))
    assert sigma["ECZ.b2"] == pytest.approx(3.0 / np.sqrt(3.0))
    assert sigma["EC0Y"] == pytest.approx(40.0 / np.sqrt(3.0))
    assert "EXX.a0" not in sigma  # amplitude 0: left out
    assert len(sigma) == 18 * 5 + 3


def test_ball_study_is_built(small_ball_study):
    study = load_study(small_ball_study)
    assert study.measurement.readings.shape == (24, 3)
    keys = [e.key for e in study.model.effects]
    assert keys == ["geometric", "artefact_pose", "ball_calibration"]
    assert "artefact.csv" in study.hashes
    # The started poses bring the balls to where they were found.
    centres, rotation, origin = study.instrument.rows(study.plan)
    tool = np.asarray(study.plan.position) + study.chain.tool_offset
    ball = origin + np.einsum("nij,nj->ni", rotation, centres)
    assert np.abs(tool - ball).max() < 5e-6


def test_balls_found_again_in_their_pose_count_as_often(small_ball_study):
    """Forth and back: the same readings twice are as good as one of 1 / sqrt(2) times the noise."""
    once = load_study(small_ball_study, [f"instrument.probe_sigma_um={0.7 / 2**0.5!r}"])
    data = small_ball_study / "data.csv"
    head, *rows = (line.split(",") for line in data.read_text(encoding="utf-8").splitlines())
    back = [list(row) for row in [*rows, *reversed(rows)]]
    for i, row in enumerate(back):
        row[head.index("t_s")] = str(10 * i)
    data.write_text("\n".join(map(",".join, [head, *back])) + "\n", encoding="utf-8")
    twice = load_study(small_ball_study)
    assert twice.measurement.readings.shape == (48, 3)
    one, both = (identify(study.model, study.measurement) for study in (once, twice))
    np.testing.assert_allclose(both.theta, one.theta, rtol=0, atol=1e-4)
    np.testing.assert_allclose(both.covariance, one.covariance, rtol=1e-4, atol=1e-6)


def test_arm_study_is_built_and_overridden(small_arm_study):
    study = load_study(small_arm_study)
    assert study.chain.axes == ("J1", "J2", "J3")
    np.testing.assert_allclose(study.chain.joint("J1").travel, np.deg2rad([-170, 170]))
    assert not np.isfinite(study.chain.joint("J2").travel).any()
    assert study.measurement.readings.shape == (16, 9)
    assert [e.key for e in study.model.effects] == ["geometric", "station", "tool_points"]
    read = load_study(small_arm_study, ["instrument.joints=read"])
    np.testing.assert_allclose(study.plan.position, np.stack(commanded(study), 1))
    np.testing.assert_allclose(
        read.plan.position, np.stack([read.plan.covariate(f"read_J{j}") for j in (1, 2, 3)], 1)
    )
    assert np.abs(read.plan.position - study.plan.position).max() > 1e-7


def commanded(study):
    return [study.plan.covariate(f"commanded_J{j}") for j in (1, 2, 3)]


@pytest.mark.campaign
@pytest.mark.parametrize("backwards", [True, False])
def test_the_poses_of_an_arm_may_stand_in_any_order(small_arm_study, backwards):
    """Their numbers tell which move led to which, and which of them were the last."""
    study = load_study(small_arm_study)
    data = small_arm_study / "data.csv"
    header, *rows = data.read_text(encoding="utf-8").splitlines()
    order = np.arange(16)[::-1] if backwards else np.random.default_rng(1).permutation(16)
    data.write_text("\n".join([header, *(rows[i] for i in order)]), encoding="utf-8")
    other = load_study(small_arm_study)
    assert set(other.plan.covariates) == set(study.plan.covariates)
    for name, values in study.plan.covariates.items():
        np.testing.assert_array_equal(other.plan.covariate(name), np.asarray(values)[order])
    (held, apart), (own, _) = other.instrument.folds(other.plan), study.instrument.folds(study.plan)
    np.testing.assert_array_equal(own, np.where(np.arange(16) < 13, -1, 0))
    np.testing.assert_array_equal(held, own[order])
    assert apart is True
    read = other.measurement.readings
    np.testing.assert_allclose(read, study.measurement.readings[order], rtol=0, atol=1e-9)
    told = [log_predictive_density(identify(s.model, s.measurement)) for s in (study, other)]
    sums = [[one.deviance[one.folds == fold].sum() for fold in range(4)] for one in told]
    assert min(map(abs, sums[0])) > 0
    np.testing.assert_allclose(sums[1], sums[0], rtol=0, atol=1e-3)


def test_smooth_family(small_tracker_study):
    setup = small_tracker_study / "setup.toml"
    text = setup.read_text(encoding="utf-8").split("[model.geometric]")[0]
    sizes = "translation_um = 10\nrotation_urad = 15\nsquareness_urad = 30\n"
    setup.write_text(text + '[model.geometric]\nfamily = "smooth"\n' + sizes, encoding="utf-8")
    study = load_study(setup)
    geometric = study.model.effects[0]
    assert len(geometric.motions) == 18
    assert [e.name for e in geometric.locations] == ["EC0Y", "EB0Z", "EA0Z"]
    sigma = {p.name: p.sigma for p in geometric.parameters}
    assert sigma["EXX.k0"] == pytest.approx(10.0)
    assert sigma["EAX.k0"] == pytest.approx(15.0)
    assert sigma["EC0Y"] == pytest.approx(30.0)
    smoother = load_study(setup, {"model.geometric.smoothness": 2.0}).model.effects[0]
    assert len(smoother.parameters) < len(geometric.parameters)


def test_no_geometric_table_means_no_geometric_effect(small_tracker_study):
    setup = small_tracker_study / "setup.toml"
    text = setup.read_text(encoding="utf-8").split("[model.geometric]")[0]
    setup.write_text(text, encoding="utf-8")
    assert [e.key for e in load_study(setup).model.effects] == ["station"]


def test_table_without_readings_is_a_plan(small_tracker_study):
    table = read_table(small_tracker_study / "data.csv", [])
    readings = ("range_mm", "azimuth_rad", "elevation_rad")
    write_table(
        small_tracker_study / "data.csv", {k: v for k, v in table.items() if k not in readings}
    )
    study = load_study(small_tracker_study)
    assert study.measurement is None
    assert study.plan.rows == 48


def test_further_columns(small_tracker_study):
    data = small_tracker_study / "data.csv"
    lines = data.read_text(encoding="utf-8").splitlines()
    lines = [lines[0] + ",load_kg,remark"] + [
        f"{line},{i},fine" for i, line in enumerate(lines[1:])
    ]
    data.write_text("\ufeff" + "\r\n".join(lines) + "\r\n\r\n", encoding="utf-8")
    plan = load_study(small_tracker_study).plan
    np.testing.assert_array_equal(plan.covariate("load_kg"), np.arange(48))
    assert not plan.has("remark")


@pytest.mark.parametrize("mark", [";", "\t"])
def test_tables_of_spreadsheets_with_decimal_commas(small_tracker_study, mark):
    data = small_tracker_study / "data.csv"
    expected = read_table(data, [])
    text = data.read_text(encoding="utf-8").replace(",", mark).replace(".", ",")
    data.write_text("\ufeff" + text.replace("\n", "\r\n"), encoding="utf-8", newline="")
    found = read_table(data, [])
    assert list(found) == list(expected) and mark in data.read_text(encoding="utf-8")
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)
    assert load_study(small_tracker_study).plan.rows == 48


def test_tables_survive_a_round_trip(tmp_path):
    columns = {"run": np.array([0, 1]), "x_mm": np.array([1.0 / 3.0, -1e-7])}
    write_table(tmp_path / "t.csv", columns)
    assert (tmp_path / "t.csv").read_text() == "run,x_mm\n0,0.3333333333\n1,-1e-07\n"
    table = read_table(tmp_path / "t.csv", [])
    np.testing.assert_allclose(table["x_mm"], columns["x_mm"], rtol=1e-9)
    with pytest.raises(ValueError, match="found .* expected one length"):
        write_table(tmp_path / "t.csv", {"a": np.zeros(2), "b": np.zeros(3)})


# --- declared effects ----------------------------------------------------------------------------


def declared(folder: Path, text: str):
    append(folder, "\n[[model.effect]]\n" + text)
    return load_study(folder).model.effects[-1]


@pytest.mark.parametrize(
    ("text", "key", "given"),
    [
        ('name = "backlash"\nplacement = "Y"\nsize_um = 3', "backlash Y", ("size", 3.0, 0.0)),
        (
            'name = "backlash"\nplacement = "Y"\nsize_um = 3\nsize_um_sigma = 1',
            "backlash Y",
            ("size", 3.0, 1.0),
        ),
        (
            'name = "backlash"\nplacement = "Y"\nsize_um_sigma = inf',
            "backlash Y",
            ("size", 0.0, np.inf),
        ),
        (
            'name = "scale_growth"\nplacement = "X"\nalpha_um_per_m_K = 11.5',
            "scale_growth X",
            ("alpha", 11.5, 0.0),
        ),
        (
            'name = "thermal_tilt"\nplacement = "Y"\ncomponent = "EAY"\nk_urad_per_K = 40',
            "thermal_tilt Y",
            ("k_EAY", 40.0, 0.0),
        ),
        (
            'name = "thermal_tilt"\nplacement = "Y"\nk_EBY_urad_per_K = 40',
            "thermal_tilt Y",
            ("k_EBY", 40.0, 0.0),
        ),
        (
            'name = "screw_cyclic"\nplacement = "X"\nsine_um = 6\ncosine_um = 0\npitch_mm = 20',
            "screw_cyclic X",
            ("pitch", 20.0, 0.0),
        ),
        ('name = "tool_offset"\nX_um = 5', "tool_offset", ("X", 5.0, 0.0)),
    ],
)
def test_declared_values(small_tracker_study, text, key, given):
    effect = declared(small_tracker_study, text)
    assert effect.key == key
    assert given in effect.given


def test_declared_without_values_keeps_the_catalogue_s_prior(small_tracker_study):
    effect = declared(small_tracker_study, 'name = "backlash"\nplacement = "Z"')
    assert effect.given == ()
    assert effect.amplitudes[0].sigma == 10.0


def test_selected_by_a_field(small_arm_study):
    text = 'name = "gear_harmonic"\nplacement = "J2"\norder = 3\nsine3_urad = 20'
    effect = declared(small_arm_study, text)
    assert effect.order == 3


def test_own_effects(small_tracker_study):
    (small_tracker_study / "own.py").write_text(OWN_EFFECT, encoding="utf-8")
    append(
        small_tracker_study,
        '\n[loop]\nseed = 3\neffects = ["wobble", "backlash"]\n[model]\neffects_file = "own.py"\n'
        '[[model.effect]]\nname = "wobble"\nsize_um = 2\n',
    )
    study = load_study(small_tracker_study, trust=True)
    assert "wobble" in study.catalogue
    assert "own.py" in study.hashes
    assert study.model.effects[-1].given == (("size", 2.0, 0.0),)
    assert study.options.effects == ("wobble", "backlash")


def test_own_effects_stay_with_their_study(small_tracker_study):
    own = OWN_EFFECT.replace("class Wobble", "@register\nclass Wobble")
    own = "from vcal.effects.registry import register\n" + own
    (small_tracker_study / "own.py").write_text(own, encoding="utf-8")
    append(small_tracker_study, '\n[model]\neffects_file = "own.py"\n')
    for _ in range(2):
        assert "wobble" in load_study(small_tracker_study, trust=True).catalogue
        assert "wobble" not in CATALOGUE


# --- overrides -----------------------------------------------------------------------------------


def test_overrides(small_tracker_study):
    study = load_study(
        small_tracker_study,
        ["name=another", "loop.seed = 7", "instrument.station_mm=[-900, 300, 701]"],
    )
    assert study.name == "another"
    assert study.options.seed == 7
    assert study.instrument.station[2] == pytest.approx(0.701)
    assert load_study(small_tracker_study, {"loop.alpha": "0.05"}).options.alpha == 0.05


# --- data beside the checkout --------------------------------------------------------------------


@needs_data
@pytest.mark.practice
@pytest.mark.parametrize("folder", PRACTICE, ids=lambda p: p.name)
@pytest.mark.slow
def test_practice(folder):
    kind = "".join(
        line.split('"')[1]
        for line in (folder / "setup.toml").read_text().splitlines()
        if line.startswith("kind")
    )
    if kind not in INSTRUMENTS:
        with pytest.raises(StudyError, match=f"setup.toml, key instrument.kind: .*'{kind}'"):
            load_study(folder / "setup.toml")
        return
    study = load_study(folder / "setup.toml")
    assert study.measurement.rows == study.plan.rows
    assert np.isfinite(study.measurement.readings).all()


@pytest.mark.thorough
@needs_data
@pytest.mark.practice
@pytest.mark.parametrize("joints", ["commanded", "read"])
def test_irb120(joints):
    study = load_study(DATA / "real" / "irb120" / "setup.toml", [f"instrument.joints={joints}"])
    assert study.measurement.readings.shape == (785, 9)
    assert study.instrument.joints == joints
    assert study.check is None
