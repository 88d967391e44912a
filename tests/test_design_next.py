"""`vcal design --next`: what to measure on top of what there is."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vcal
from designing import declare, design, strict, task_of
from vcal import Model
from vcal.design import covariance, expected_rms, volumetric_gram
from vcal.design.judged import grid_points
from vcal.design.next_measurement import CANDIDATES, plan_next
from vcal.design.optimiser import Compiled
from vcal.design.separation import ALPHA, Rival, Separation
from vcal.loop.outcome.closure import FoundEffect
from vcal.report.next_measurement.page import _conditions as conditions
from vcal.report.next_measurement.record import carried_over
from vcal.study.design.rivals import parse_rivals, rivals_of

pytestmark = pytest.mark.usefixtures("kept_programs")


@pytest.mark.campaign
def test_the_next_pose_is_better_than_fifty_at_random(few_poses):
    _, task = task_of(few_poses, small=("design.grid=[4,3,3]",))
    done = plan_next(task, 1, starts=2, steps=30)
    space = done.task.space
    assert space.groups == (4,) and done.drawn == CANDIDATES
    present = task.space
    ones = jnp.ones(len(present.groups))
    held = [present.information(present.nominal, j.model, ones) for j in task.families]
    compiled = Compiled(done.task, held)
    values = []
    for key in jax.random.split(jax.random.key(99), 50):
        placed = space.placed(jnp.asarray(space.scattered(key)))
        if float(space.excess(placed)) == 0.0:
            values.append(compiled.value(placed).criterion)
    assert len(values) > 10
    assert done.best.value.criterion < min(values)
    assert done.before.criterion > max(values)
    order = [c.value.criterion for c in done.candidates]
    assert order == sorted(order)


@pytest.mark.campaign
def test_the_next_pose_shares_the_balls(few_poses, tmp_path):
    """Old and new poses in one study, judged by the engine."""
    out = tmp_path / "out"
    design(few_poses, out, "--next", "--set", "design.more=2", "--set", "loop.draws=25",
           "--separate", "backlash:X", "--separate", "backlash:Y")  # fmt: skip
    found = strict(out / "result.json")
    header, *rows = (out / "plan.csv").read_text().splitlines()
    assert {line.split(",")[0] for line in rows} == {"4", "5"}
    both = declare(few_poses, tmp_path, "")
    data = (both / "data.csv").read_text().splitlines()
    assert data[0] == header
    (both / "data.csv").write_text("\n".join(data + rows) + "\n", encoding="utf-8")
    study = vcal.load_study(both)
    points = grid_points(study.chain, vcal.load_study(few_poses).plan, (4, 3, 3))
    gram = volumetric_gram(study.model, points)
    rms = 1e6 * float(expected_rms(gram.aligned, covariance(study.model, study.plan)))
    # The data's own positions are off by the machine's errors, which the design does not know.
    assert found["after"]["rms_um"] == pytest.approx(rms, rel=0.02)


def independent_lambda(model, first, second, plan):
    """lambda(first | second) by plain least squares on the readings' covariance, in numpy."""

    def columns(m):
        start = np.zeros(len(m.entries))
        steps = 1e-3 * np.eye(len(start))
        nominal = np.asarray(vcal.predict(m, plan, start))
        weight = 1.0 / np.asarray(m.instrument.noise(plan, nominal)).reshape(-1)
        moved = [
            np.asarray(vcal.predict(m, plan, h) - vcal.predict(m, plan, -h)).reshape(-1) / 2e-3
            for h in steps
        ]
        return np.stack(moved, 1) * weight[:, None]

    rest = model.with_effects(second)
    J = columns(rest)
    C = columns(Model(model.chain, model.instrument, (first,)))
    prior = np.diag([float(e.parameter.informed) for e in rest.entries])
    # Prior rows below the readings: what is left of C after the best fit.
    stacked = np.vstack([J, np.sqrt(prior)])
    target = np.vstack([C, np.zeros((len(prior), C.shape[1]))])
    left = target - stacked @ np.linalg.lstsq(stacked, target, rcond=None)[0]
    return float((left**2).sum())


@pytest.mark.thorough
def test_conditions_are_told_as_columns_of_the_plan(few_points):
    study, task = task_of(few_points)
    wanted = parse_rivals(["backlash:Y", "scale_growth:Y"], study)
    done = SimpleNamespace(
        task=task,
        best=SimpleNamespace(placed=task.space.nominal),
        separation=SimpleNamespace(rivals=wanted.rivals),
    )
    rows = conditions(done, study).rows  # type: ignore[arg-type]
    assert [name for name, *_ in rows] == ["T_y_degC", "dir_y"]
    warmth = np.asarray(study.plan.covariate("T_Y"))
    assert [float(cell) for cell in rows[0][1:]] == pytest.approx(
        [warmth.min(), warmth.max()], rel=1e-3
    )


def test_what_the_last_row_tells_of_the_next_ones_is_said(few_points):
    study, task = task_of(few_points)
    best = SimpleNamespace(placed=task.space.nominal)
    alone = SimpleNamespace(task=task, best=best, separation=None)
    told = carried_over(alone, study)  # type: ignore[arg-type]
    assert told.startswith("In plan.csv dir_x, dir_y, dir_z,") and "T_y_degC" in told
    assert "x_mm" not in told.replace("dir_x", "")
    wanted = parse_rivals(["backlash:Y", "scale_growth:Y"], study)
    rivals = SimpleNamespace(rivals=wanted.rivals)
    apart = SimpleNamespace(task=task, best=best, separation=rivals)
    told = carried_over(apart, study)  # type: ignore[arg-type]
    assert "dir_x" in told and "dir_y" not in told and "T_y_degC" not in told


@pytest.mark.campaign
def test_separating_two_effects(few_points):
    study, task = task_of(few_points)
    wanted = parse_rivals(["backlash:Y", "scale_growth:Y"], study)
    separation = Separation.of(task.families[0].model, *wanted.rivals)
    done = plan_next(task, 3, separation=separation, starts=2, steps=15)
    first, second = (r.effect for r in wanted.rivals)
    plan = study.plan
    expected = (
        independent_lambda(study.model, first, second, plan),
        independent_lambda(study.model, second, first, plan),
    )
    np.testing.assert_allclose(done.separated, expected, rtol=1e-5)
    # With the new rows below the old ones.
    more = done.task.space.plan(done.best.placed)
    assert set(np.asarray(more.covariate("dir_Y")).tolist()) <= {-1.0, 1.0}
    T = np.asarray(plan.covariate("T_Y"))
    assert (np.asarray(more.covariate("T_Y")) >= T.min() - 1e-9).all()
    assert (np.asarray(more.covariate("T_Y")) <= T.max() + 1e-9).all()
    joined = vcal.Plan(
        plan.axes,
        np.concatenate([plan.position, more.position]),
        {n: np.concatenate([v, more.covariate(n)]) for n, v in plan.covariates.items()},
        {n: np.concatenate([v, more.groups[n]]) for n, v in plan.groups.items()},
    )
    after = (
        independent_lambda(study.model, first, second, joined),
        independent_lambda(study.model, second, first, joined),
    )
    np.testing.assert_allclose(done.best.lambdas, after, rtol=1e-5)
    assert done.best.lambdas.smaller > 1.2 * done.separated.smaller
    # Power of a test with one degree of freedom, by drawing it.
    rng = np.random.default_rng(0)
    size = 9.0
    drawn = (rng.standard_normal(200_000) + 3.0) ** 2
    power = separation.powers(type(done.separated)(size, size))[0]
    assert power == pytest.approx((drawn > 6.6349).mean(), abs=0.005)
    assert ALPHA == 0.01


OWN = """
import numpy as np
import vcal


class Step(vcal.Effect):
    \"\"\"Y is off by a step where it is far out.\"\"\"

    name = "far_step"

    @property
    def parameters(self):
        return (vcal.Parameter("height", "um", sigma=5.0),)

    @property
    def needs(self):
        return ("Y",)

    def response(self, plan, shape):
        return {("EYY", "height"): np.where(np.asarray(plan.x("Y")) > 0.45, 1.0, 0.0)}

    @classmethod
    def candidates(cls, setup):
        yield cls(placement="Y")
"""


@pytest.mark.campaign
def test_an_effect_that_cannot_be_differentiated(few_points, tmp_path, monkeypatch):
    monkeypatch.setattr("vcal.design.next_measurement.CANDIDATES", 4)
    copy = declare(few_points, tmp_path, "")
    (copy / "mine.py").write_text(OWN, encoding="utf-8")
    own = ("--set", "model.effects_file=mine.py", "--trust")
    out = tmp_path / "out"
    design(copy, out, "--next", "--separate", "far_step:Y", "--separate", "backlash:Y", *own)
    found = strict(out / "result.json")
    assert found["searched_by_gradient"] is False
    assert "none of them moved" in (out / "index.html").read_text(encoding="utf-8")
    assert found["separation"]["lambda_after"][0] > found["separation"]["lambda_before"][0]
    # As a declared effect it would have to be followed by every step of a search.
    text = (copy / "setup.toml").read_text(encoding="utf-8")
    row = '\n[[model.effect]]\nname = "far_step"\nplacement = "Y"\n'
    (copy / "setup.toml").write_text(text + row, encoding="utf-8")
    for options in ((), ("--next", "--set", "loop.max_effects=0")):
        message = design(copy, tmp_path / "other", *own, *options, code=2).stderr
        assert "whose response leaves JAX" in message


@pytest.mark.thorough
def test_sizes_of_rivals(few_points):
    study, _ = task_of(few_points)
    wanted = parse_rivals(["backlash:Y:size_um=5", "range_scale:scale_um_per_m=2"], study)
    assert wanted.rivals[0].moment == pytest.approx(0.25) and wanted.rivals[0].sized
    assert not Rival.of(vcal.CATALOGUE["backlash"](port="EYY", unit="um", placement="Y")).sized
    pitch = parse_rivals(["screw_cyclic:X:pitch_mm=10", "backlash:X"], study).rivals[0]
    assert pitch.moment.shape[0] == len(pitch.effect.amplitudes)


@pytest.mark.slow
def test_what_the_loop_left_open(few_points):
    """From a closure of which only the doubtful effect matters."""
    study, task = task_of(few_points)
    effect = vcal.CATALOGUE["scale_growth"](port="EYY", placement="Y")
    found = FoundEffect(
        effect=effect, status="ambiguous", placement="Y",
        parameters=[("alpha", 8.0, "um/(m K)", 1.0)], p_value=0.0, log_evidence=9.0, delta_bic=-9.0,
        heldout_gain=0.1, equivalent=[], alternatives=[("thermal_offset", "Y", 0.3)], separation="",
    )  # fmt: skip

    class Ended:
        verdict = "ambiguous"
        effects = [found]

    wanted = rivals_of(Ended, study, task)
    assert [r.effect.key for r in wanted.rivals] == ["scale_growth Y", "thermal_offset Y"]
    # Of three components the one that is hardest to tell from growth along Y.
    assert wanted.rivals[1].effect.port == "EYY"
    assert wanted.rivals[0].sized and wanted.rivals[0].moment == pytest.approx(0.64)
    # What is unexplained beside it takes no doubt away; a name that is certain does.
    Ended.verdict = "unexplained"
    assert rivals_of(Ended, study, task) == wanted
    Ended.effects = [dataclasses.replace(found, status="named")]
    assert rivals_of(Ended, study, task) is None


@pytest.mark.campaign
def test_the_loop_comes_first_where_there_are_readings(few_poses, tmp_path):
    out = tmp_path / "out"
    printed = design(
        few_poses, out, "--next", "--set", "loop.draws=50", "--set", 'loop.effects=["backlash"]'
    ).output
    found = strict(out / "result.json")
    assert found["why"].startswith("The loop was run on the data") and found["why"] in printed
    assert found["separation"] is None and not (out / "setup.toml").exists()
    assert found["after"]["criterion"] < found["before"]["criterion"]
    assert found["candidates"][0]["lowers_by"] == pytest.approx(
        1 - found["after"]["criterion"] / found["before"]["criterion"]
    )
