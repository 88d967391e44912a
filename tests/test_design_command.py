"""`vcal design`: a plan made better, what to measure next, and mistakes."""

import re
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vcal
from designing import FREE, declare, design, run, strict, task_of
from vcal import Model
from vcal.cli.start_studies import write_start
from vcal.design import covariance, expected_rms, volumetric_gram
from vcal.design.judged import grid_points
from vcal.design.optimiser import Compiled, optimise
from vcal.design.spaces import SPACES
from vcal.report.html.folder import ReportFolder

pytestmark = pytest.mark.usefixtures("kept_programs")


@pytest.fixture(scope="module")
def designed(few_poses, tmp_path_factory):
    out = tmp_path_factory.mktemp("written") / "deep" / "design"
    return out, design(few_poses, out, *FREE)


# --- the folder ----------------------------------------------------------------------------------


@pytest.mark.campaign
def test_the_folder_is_a_study(designed, few_poses):
    out, printed = designed
    found = strict(out / "result.json")
    assert found["sentence"].count(" µm with ") == 2  # both numbers have their unit
    assert found["sentence"] in printed.output and str(out / "index.html") in printed.output
    assert sorted(found["files"]) == sorted(p.name for p in out.iterdir())
    assert {"setup.toml", "plan.csv", "artefact.csv", "places.png"} <= set(found["files"])
    page = (out / "index.html").read_text(encoding="utf-8")
    beside = set(re.findall(r'(?:src|href)="(?!data:|#)([^"]*)', page))
    assert beside == {"result.json", "plan.csv"} <= set(found["files"])
    assert found["sentence"].replace("'", "&#39;") in page
    before, after = vcal.load_study(few_poses), vcal.load_study(out)
    assert after.plan.rows == before.plan.rows
    # Rows keep their conditions, poses and balls.
    for name in ("T_air", "dir_X", "t"):
        np.testing.assert_allclose(after.plan.covariate(name), before.plan.covariate(name))
    for name in ("pose", "ball"):
        np.testing.assert_array_equal(after.plan.groups[name], before.plan.groups[name])
    # Nominal positions: the artefact fits them to the digits of the file.
    again = run("check", out).output
    assert "can be used" in again
    balls_after = after.instrument.centres
    assert np.ptp(balls_after[:, 0]) == pytest.approx(np.ptp(before.instrument.centres[:, 0]))
    assert np.diff(np.sort(balls_after[:, 0])).min() > 0.02 - 1e-9


@pytest.mark.thorough
def test_the_criterion_by_the_whole_covariance(designed):
    """The plan that was written, read again, all unknowns in one matrix."""
    out, _ = designed
    found = strict(out / "result.json")
    study = vcal.load_study(out)
    gram = volumetric_gram(study.model, grid_points(study.chain, study.plan, (4, 3, 3)))
    H = covariance(study.model, study.plan)
    for name, G in (("rms_um", gram.aligned), ("rms_raw_um", gram.raw)):
        assert found["designed"][name] == pytest.approx(1e6 * float(expected_rms(G, H)), rel=1e-4)
    assert found["designed"]["criterion"] == pytest.approx(found["designed"]["rms_um"], rel=1e-12)
    assert found["designed"]["criterion"] < found["nominal"]["criterion"]
    assert found["gain"] == pytest.approx(
        1 - found["designed"]["criterion"] / found["nominal"]["criterion"]
    )
    prior = 1e6 * np.sqrt(np.trace(gram.aligned[: len(study.model.entries)]))
    assert found["prior"]["rms_um"] == pytest.approx(prior, rel=1e-9)
    assert found["designed"]["valuation"] == pytest.approx(1 - found["designed"]["rms_um"] / prior)


@pytest.mark.campaign
def test_the_folder_can_be_judged_by_monte_carlo(designed, tmp_path):
    out, _ = designed
    found = strict(out / "result.json")
    run("uncertainty", out, "--out", tmp_path / "judged", "--draws", "200")
    judged = strict(tmp_path / "judged" / "result.json")
    # Another grid, so that only about the same comes out.
    assert judged["rms_after_um"]["gum"] == pytest.approx(found["designed"]["rms_um"], rel=0.35)
    u = {m["name"]: 2 * max(m["u_gum"]) for m in judged["error_motions"]}
    told = found["designed"]["largest_U"]
    for name in ("EXX", "EYX", "EAX", "EYY", "EZZ"):
        assert told[name] == pytest.approx(u[name], rel=0.15), name
    lines = {one["name"]: 2 * one["gum"]["u"] for one in judged["straight_lines"]}
    assert lines
    for name, U in lines.items():
        assert told[name] == pytest.approx(U, rel=0.15), name


@pytest.mark.thorough
def test_worth_of_a_pose_is_that_of_a_plan_without_it(few_poses):
    _, task = task_of(few_poses)
    compiled = Compiled(task)
    worse = compiled.without_each(task.space.nominal)
    study = vcal.load_study(few_poses)
    gram = volumetric_gram(study.model, grid_points(study.chain, study.plan, (4, 3, 3)))
    whole = float(expected_rms(gram.aligned, covariance(study.model, study.plan)))
    for pose in (0, 3):
        rows = np.flatnonzero(np.asarray(study.plan.groups["pose"]) != pose)
        plan = study.plan.take(rows)
        left = dataclass_without(study.instrument, pose)
        own = {e.key for e in left.effects(plan)}
        kept = [e for e in study.model.effects if e.key not in own]
        model = Model(study.chain, left, [*kept, *left.effects(plan)])
        points = grid_points(study.chain, study.plan, (4, 3, 3))
        rest = float(expected_rms(volumetric_gram(model, points).aligned, covariance(model, plan)))
        assert worse[pose] == pytest.approx(rest / whole - 1.0, rel=1e-3)


def dataclass_without(instrument, pose):
    import dataclasses

    kept = instrument.pose_numbers != pose
    return dataclasses.replace(
        instrument,
        pose_numbers=instrument.pose_numbers[kept],
        pose_rotation=instrument.pose_rotation[kept],
        pose_origin=instrument.pose_origin[kept],
    )


# --- spaces --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "goal"),
    [
        pytest.param("few_poses", "volume", marks=pytest.mark.campaign),
        pytest.param("few_poses", "largest", marks=pytest.mark.campaign),
        pytest.param("few_poses", "determinant", marks=pytest.mark.campaign),
        pytest.param("few_points", "volume", marks=pytest.mark.campaign),
        pytest.param("few_points", "largest", marks=pytest.mark.thorough),
        pytest.param("few_points", "determinant", marks=pytest.mark.campaign),
    ],
)
def test_gradient_against_finite_differences(request, kind, goal):
    folder = request.getfixturevalue(kind)
    free = ("design.across_mm=[40,40]", "design.along=true", "design.spacing_mm=20")
    moves = ("design.station=true", "design.station_low_mm=[-1500,-300,300]",
             "design.station_high_mm=[-500,900,1000]")  # fmt: skip
    _, task = task_of(
        folder, f"design.goal={goal}", 'design.errors=["EXX","EBZ","EC0Y"]',
        *(free if kind == "few_poses" else moves),
    )  # fmt: skip
    space, compiled = task.space, Compiled(task)
    z = space.scattered(jax.random.key(1))
    width = space.high - space.low
    z = np.clip(z, space.low + 0.05 * width, space.high - 0.05 * width)
    way = np.random.default_rng(6).standard_normal(len(z)) * 0.1 * np.minimum(width, 1.0)

    @jax.jit
    def value(step):
        return compiled.smooth(z + step * way)

    slope = float(jax.grad(value)(0.0))
    h = 1e-3
    found = (8.0 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (12.0 * h)
    assert slope == pytest.approx(float(found), rel=1e-6)


@pytest.mark.campaign
def test_points_and_station_by_the_whole_covariance(few_points, tmp_path):
    out = tmp_path / "out"
    printed = design(
        few_points, out, "--set", "design.station=true",
        "--set", "design.station_low_mm=[-1500,-300,300]",
        "--set", "design.station_high_mm=[-500,900,1000]",
        "--set", "design.seconds_per_metre=2",
    )  # fmt: skip
    found = strict(out / "result.json")
    assert "expected rms" in printed.output.lower()
    study = vcal.load_study(out)
    assert study.measurement is None and study.plan.rows == 24
    assert not np.allclose(study.instrument.station, [-0.9, 0.3, 0.7])
    points = grid_points(study.chain, study.plan, (4, 3, 3))
    gram = volumetric_gram(study.model, points)
    rms = 1e6 * float(expected_rms(gram.aligned, covariance(study.model, study.plan)))
    assert found["designed"]["rms_um"] == pytest.approx(rms, rel=1e-6)
    assert found["designed"]["rms_um"] < found["nominal"]["rms_um"]
    way = np.linalg.norm(np.diff(np.asarray(study.plan.position), axis=0), axis=1).sum()
    assert found["designed"]["measuring_seconds"] == pytest.approx(240.0 + 2.0 * way, rel=1e-6)
    run("check", out)
    run("simulate", out, "--out", tmp_path / "made")


@pytest.mark.campaign
def test_the_largest_uncertainty(few_poses, tmp_path):
    out = tmp_path / "out"
    design(few_poses, out, "--set", "design.goal=largest", "--set", 'design.errors=["EXX", "EBY"]')
    found = strict(out / "result.json")
    for plan in ("nominal", "designed"):
        told = found[plan]["largest_U"]
        assert found[plan]["criterion"] == pytest.approx(max(told["EXX"], told["EBY"]))
    assert found["designed"]["criterion"] < found["nominal"]["criterion"]


@pytest.mark.campaign
def test_the_determinant(few_poses, tmp_path):
    out = tmp_path / "out"
    design(
        few_poses, out, "--set", "design.goal=determinant", "--set", 'design.errors=["EC0Y","EXX"]'
    )
    found = strict(out / "result.json")
    study = vcal.load_study(out)
    names = [e.parameter.name for e in study.model.entries]
    own = [i for i, n in enumerate(names) if n == "EC0Y" or n.startswith("EXX.")]
    C = np.asarray(covariance(study.model, study.plan))[np.ix_(own, own)]
    assert found["designed"]["criterion"] == pytest.approx(
        np.linalg.det(C) ** (0.5 / len(own)), rel=1e-4
    )


@pytest.mark.thorough
def test_effects_of_the_artefact_and_of_conditions_count(few_poses, tmp_path):
    """Against the engine's own derivatives, which know nothing of poses by turn and place."""
    text = '\n[[model.effect]]\nname = "artefact_expansion"\nalpha_um_per_m_K_sigma = 5\n'
    text += '[[model.effect]]\nname = "artefact_bending"\nsag_um_sigma = 5\n'
    text += '[[model.effect]]\nname = "backlash"\nplacement = "X"\n'
    text += '[[model.effect]]\nname = "scale_growth"\nplacement = "Y"\n'
    text += '[[model.effect]]\nname = "repeatability"\nplacement = "Y"\nsize_um = 2\n'
    folder = declare(few_poses, tmp_path, text)
    study, task = task_of(folder)
    assert len(study.model.random) == 1
    compiled = Compiled(task)
    space = task.space
    # Another plan than the nominal one, told as a plan: what the engine makes of it is the oracle.
    placed = space.placed(jnp.asarray(space.scattered(jax.random.key(3))))
    plan, instrument = space.plan(placed), space.instrument(placed)
    judged = task.families[0].model
    whole = Model(
        study.chain, instrument, (*judged.effects, *instrument.effects(plan), *judged.random)
    )
    k = len(judged.entries)
    C = np.asarray(covariance(whole, plan))[:k, :k]
    (own,) = compiled.covariances(placed, jnp.ones(len(space.groups)))
    scale = np.sqrt(np.diag(C))
    np.testing.assert_allclose(own / np.outer(scale, scale), C / np.outer(scale, scale), atol=2e-5)
    again = study.instrument.plan(
        study.chain, {f"{c.lower()}_mm": np.asarray(plan.x(c)) * 1e3 for c in "XYZ"}
        | {"pose": plan.groups["pose"], "ball": plan.groups["ball"]},
    )  # fmt: skip
    for name in ("gravity_x", "gravity_z", "tilt", "along_beam", "ball_x"):
        np.testing.assert_allclose(plan.covariate(name), again.covariate(name), atol=1e-9)


@pytest.mark.thorough
def test_several_families(few_poses, tmp_path):
    copy = declare(few_poses, tmp_path, "")
    text = (copy / "setup.toml").read_text(encoding="utf-8")
    text = text.replace('family = "fourier"\ntable = "errors.csv"', 'family = "smooth"\n'
        "translation_um = 8\nrotation_urad = 10\nsquareness_urad = 20")  # fmt: skip
    (copy / "other.toml").write_text(text, encoding="utf-8")
    _, own = task_of(copy)
    _, other = task_of(copy / "other.toml")
    _, both = task_of(copy, 'design.families=["other.toml"]')
    values = [Compiled(t).value(t.space.nominal).criterion for t in (own, other, both)]
    assert values[2] == pytest.approx(np.sqrt((values[0] ** 2 + values[1] ** 2) / 2), rel=1e-9)


@pytest.mark.thorough
def test_touches_that_were_left_out(few_poses, tmp_path):
    """A ball that no pose but one touched: the plan keeps its gaps, and their information."""
    copy = declare(few_poses, tmp_path, "")
    lines = (copy / "data.csv").read_text().splitlines()
    kept = [line for line in lines if line.split(",")[:2] not in (["1", "2"], ["3", "0"])]
    (copy / "data.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
    study, task = task_of(copy)
    plan = task.space.plan(task.space.nominal)
    assert plan.rows == study.plan.rows == len(lines) - 3
    np.testing.assert_array_equal(plan.groups["ball"], study.plan.groups["ball"])
    gram = volumetric_gram(study.model, grid_points(study.chain, study.plan, (4, 3, 3)))
    expected = 1e6 * float(expected_rms(gram.aligned, covariance(study.model, plan)))
    assert Compiled(task).value(task.space.nominal).aligned_um == pytest.approx(expected, rel=1e-4)


@pytest.mark.campaign
def test_an_arm(tmp_path):
    folder = tmp_path / "arm"
    write_start("reflectors", folder)
    setup = folder / "setup.toml"
    message = design(folder, tmp_path / "no", code=2).stderr
    assert "axis J3 without bounds" in message
    text = setup.read_text(encoding="utf-8")
    for line in ("a_mm = 70\nalpha_deg = -90\n", "d_mm = 302\nalpha_deg = 90\n",
                 "d_mm = 72\ntheta_deg = 180\n"):  # fmt: skip
        text = text.replace(line, f"{line}low_deg = -360\nhigh_deg = 360\n")
    bare = 'type = "revolute"\nalpha_deg = -90\n'
    text = text.replace(bare, f"{bare}low_deg = -360\nhigh_deg = 360\n")
    setup.write_text(text, encoding="utf-8")
    study, task = task_of(folder)
    compiled = Compiled(task)
    C = covariance(study.model, study.plan)
    k = len(task.families[0].model.entries)
    (own,) = compiled.covariances(task.space.nominal, jnp.ones(len(task.space.groups)))
    scale = np.sqrt(np.diag(C))[:k]
    size = np.outer(scale, scale)
    np.testing.assert_allclose(own / size, np.asarray(C)[:k, :k] / size, atol=1e-6)


@pytest.mark.campaign
def test_a_plan_has_no_loop(designed, tmp_path):
    printed = design(designed[0], tmp_path / "out", "--next").output
    assert "There are no readings yet" in printed


# --- mistakes ------------------------------------------------------------------------------------

TRUE_STATION = ("--set", "design.station=true")
EVERYTHING = ", ".join(f"E{c}{axis} = 12" for axis in "XYZ" for c in "XYZABC")
BAD = {
    "spacing": (
        ("--set", "design.along=true", "--set", "design.spacing_mm=900"),
        ["key design.spacing_mm", "900 between 8 balls", "mm long"],
    ),
    "neighbours": (
        ("--set", "design.along=true", "--set", "design.spacing_mm=71.5"),
        ["key design.spacing_mm"],
    ),
    "across": (
        ("--set", "design.across_mm=[-1,0]"),
        ["design.across_mm", "found -1", "at least 0"],
    ),
    "too close": (
        ("--set", "design.across_mm=[1,0]"),
        ["key design.across_mm.0", "from the artefact's axis"],
    ),
    "misspelled": (("--set", "design.acros_mm=[1,0]"), ["did you mean 'across_mm'?"]),
    "goal": (("--set", "design.goal=volum"), ["did you mean 'volume'?"]),
    "error": (("--set", 'design.errors=["EYXX"]'), ["key design.errors.0", "did you mean 'EYX'"]),
    "a squareness is no coefficient": (
        ("--set", 'design.errors=["EC(0X)Y"]', "--set", "design.goal=determinant"),
        ["key design.errors.0", "'EC(0X)Y' with the goal 'determinant'", "goal 'largest'"],
    ),
    "no error": (("--set", "design.errors=[]"), ["key design.errors", "at least one"]),
    "grid": (("--set", "design.grid=[1,2,3]"), ["design.grid.0", "at least 2"]),
    "starts": (("--set", "design.starts=0"), ["design.starts", "at least 1"]),
    "must see": (
        (
            "--set",
            f"design.must_see={{{EVERYTHING}}}",
            "--set",
            "design.poses=false",
        ),
        ["key design.must_see", "are not identified"],
    ),
    "unknown to see": (("--set", "design.must_see={EXQ = 2}"), ["key design.must_see.EXQ"]),
    "no file": (("--set", 'design.families=["no.toml"]'), ["no.toml", "no such file"]),
    "one rival": (("--next", "--separate", "backlash:X"), ["found 1 effect, expected two"]),
    "the same": (
        ("--next", "--separate", "backlash:X", "--separate", "backlash:X"),
        ["'backlash X' twice"],
    ),
    "no next": (("--separate", "backlash:X"), ["without --next"]),
    "misspelled rival": (
        ("--next", "--separate", "backlas:X", "--separate", "drift:X"),
        ["--separate backlas:X", "did you mean 'backlash'?"],
    ),
    "no pitch": (
        ("--next", "--separate", "screw_cyclic:X", "--separate", "backlash:X"),
        ["free shape parameter 'pitch'"],
    ),
    "not systematic": (
        ("--next", "--separate", "repeatability:X", "--separate", "backlash:X"),
        ["found a random effect"],
    ),
    "more": (("--next", "--set", "design.more=0"), ["design.more", "at least 1"]),
}


@pytest.mark.parametrize("name", BAD)
def test_mistakes(few_poses, tmp_path, name):
    options, words = BAD[name]
    out = tmp_path / "deep" / "out"
    result = design(few_poses, out, *options, code=2, small=())
    assert result.stdout == "" and "Traceback" not in result.output
    for word in words:
        assert word in result.stderr, result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_mistakes_of_a_tracker(few_points, tmp_path):
    def message(*options):
        return design(few_points, tmp_path / "out", *options, code=2).stderr

    assert "station = true without bounds" in message(*TRUE_STATION)
    low = ("--set", "design.station_low_mm=[-100,0,0]")
    assert "in x, expected the first below" in message(
        *TRUE_STATION, *low, "--set", "design.station_high_mm=[-200,1,1]"
    )
    assert "reach into the work space" in message(
        *TRUE_STATION, *low, "--set", "design.station_high_mm=[200,300,300]"
    )
    assert "unknown key 'across_mm'" in message("--set", "design.across_mm=[1,1]")


def test_an_instrument_without_a_space(tmp_path):
    write_start("laser_frame", tmp_path / "frame")
    for options in ((), ("--next",)):
        message = design(tmp_path / "frame", tmp_path / "out", *options, code=2, small=()).stderr
        assert "key instrument.kind: found 'laser_frame'" in message
        assert all(kind in message for kind in SPACES)


def test_an_artefact_that_fits_nowhere(few_poses, tmp_path):
    short = ("--set", "machine.travel_mm={X=[0,1000], Y=[0,600], Z=[0,500]}")
    copy = declare(few_poses, tmp_path, "")
    table = (copy / "artefact.csv").read_text().splitlines()
    cells = [line.split(",") for line in table[1:]]
    # One ball more, which no pose has touched, beyond all the others.
    number, x = max(int(b) for b, *_ in cells) + 1, 3e3 + float(cells[-1][1])
    far = ",".join([str(number), str(x), *cells[-1][2:]])
    (copy / "artefact.csv").write_text("\n".join([*table, far]) + "\n", encoding="utf-8")
    message = design(copy, tmp_path / "out", *short, code=2).stderr
    assert "mm long" in message and "the diagonal of the travel" in message
    assert not (tmp_path / "out").exists()


def test_families_of_another_machine(few_poses, tmp_path):
    copy = declare(few_poses, tmp_path, "")
    text = (copy / "setup.toml").read_text(encoding="utf-8")
    other = text.replace('chain = "w X b Y Z t"', 'chain = "w b X Y Z t"')
    assert other != text
    (copy / "other.toml").write_text(other, encoding="utf-8")
    message = design(copy, tmp_path / "out", "--set", 'design.families=["other.toml"]', code=2)
    assert "a study of another machine" in message.stderr


def test_bending_of_an_artefact_whose_balls_move(few_poses, tmp_path):
    text = '\n[[model.effect]]\nname = "artefact_bending"\nsag_um_sigma = 5\n'
    folder = declare(few_poses, tmp_path, text)
    message = design(folder, tmp_path / "out", *FREE, code=2).stderr
    assert "'artefact_bending', which depends on the line of the artefact" in message


def test_a_folder_with_other_things(few_poses, tmp_path):
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    assert "found other files" in design(few_poses, tmp_path, code=2).stderr
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.campaign
def test_written_twice(designed, few_poses, tmp_path):
    """An earlier design is replaced, and the same seed gives the same plan."""
    out = tmp_path / "again"
    shutil.copytree(designed[0], out)
    design(few_poses, out, *FREE)
    assert (out / "plan.csv").read_text() == (designed[0] / "plan.csv").read_text()


@pytest.mark.thorough
def test_a_plan_that_was_filled_in_is_not_replaced(designed, few_poses, tmp_path):
    """Known before the work, for another design and for the next measurement alike."""
    out = tmp_path / "again"
    shutil.copytree(designed[0], out)
    for name in ("plan.csv", "setup.toml"):
        (out / name).write_text((out / name).read_text(encoding="utf-8") + "# mine\n")
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    for options in ((), ("--next",)):
        message = design(few_poses, out, *options, code=2).stderr
        assert "found plan.csv, setup.toml, not as the earlier report left them" in message
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before


def test_a_study_made_around_the_next_measurement_is_not_replaced(few_poses, tmp_path):
    def make(work):
        (work / "plan.csv").write_text("x_mm\n", encoding="utf-8")
        (work / "result.json").write_text('{"schema": "vcal-design/1", "files": ["plan.csv"]}')
        return ["plan.csv", "result.json"]

    out = tmp_path / "next"
    ReportFolder(record="result.json", schema="vcal-design/").fill(out, make)
    (out / "setup.toml").write_text("mine", encoding="utf-8")
    message = design(few_poses, out, code=2).stderr
    assert "found setup.toml, not as the earlier report left it" in message
    assert (out / "setup.toml").read_text(encoding="utf-8") == "mine"


def test_optimise_keeps_a_plan_that_is_good(designed):
    """Where no step is made, the plan as it is comes back."""
    _, task = task_of(designed[0], "design.poses=false", 'design.across_mm=[0,0]',
                      "design.along=false")  # fmt: skip
    done = optimise(task, starts=1, steps=1)
    assert done.best is done.nominal and done.gain == 0.0 and not done.found
