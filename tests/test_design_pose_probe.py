"""Poses of an arm with a pose probe made better, against the covariance of the written plan."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vcal
from designing import slopes, task_of
from vcal.cli.start_studies import write_start
from vcal.design import covariance
from vcal.design.optimiser import Compiled, optimise

pytestmark = pytest.mark.usefixtures("kept_programs")

SHARED = (
    "instrument.correlation=[[1,0,0,0,0,0],[0,1,0,0,0,0.5],[0,0,1,0,-0.5,0],"
    "[0,0,0,1,0,0],[0,0,-0.5,0,1,0],[0,0.5,0,0,0,1]]"
)


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """Sixteen poses of the start study."""
    folder = tmp_path_factory.mktemp("given") / "arm"
    write_start("pose_probe", folder)
    lines = (folder / "data.csv").read_text(encoding="utf-8").splitlines()
    (folder / "data.csv").write_text("\n".join(lines[:17]) + "\n", encoding="utf-8")
    return folder


def test_the_plan_as_it_is_is_where_the_search_starts(few):
    study, task = task_of(few)
    start = task.space.placed(jnp.asarray(task.space.start))
    np.testing.assert_allclose(start.position, study.plan.position, atol=1e-12)
    assert len(task.space.start) == 16 * 7 and task.space.group == "pose"


def test_a_traced_orientation_is_that_of_numpy(few):
    study, _ = task_of(few)
    traced = jax.jit(lambda q: study.instrument.rows(study.plan.with_position(q)))
    expected = study.instrument.rows(study.plan)
    np.testing.assert_allclose(traced(study.plan.position), expected, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("options", [(), (SHARED,)])
def test_the_covariance_is_that_of_the_whole_model(few, options):
    """All unknowns at once, as an identification has them; with noise that readings share too."""
    study, task = task_of(few, *options)
    space, compiled = task.space, Compiled(task)
    placed = space.placed(jnp.asarray(space.scattered(jax.random.key(1))))
    (found,) = compiled.covariances(placed, jnp.ones(16))
    k = len(task.families[0].model.entries)
    plan = study.plan.with_position(np.asarray(placed.position))
    names = [e.key for e in study.model.entries]
    own = [i for i, name in enumerate(names) if name == "geometric"]
    assert len(own) == k
    expected = np.asarray(covariance(study.model, plan))[np.ix_(own, own)]
    scale = np.sqrt(np.diag(expected))
    size = np.outer(scale, scale)
    np.testing.assert_allclose(np.asarray(found) / size, expected / size, atol=1e-6)


@pytest.mark.campaign
def test_gradient_against_finite_differences(few):
    _, task = task_of(few, "design.goal=determinant")
    space, compiled = task.space, Compiled(task)
    z = np.clip(space.scattered(jax.random.key(1)), 0.05, 0.95)
    way = np.random.default_rng(6).standard_normal(len(z)) * 0.02
    slope, found = slopes(compiled.smooth, z, way)
    assert slope == pytest.approx(found, rel=1e-6)


@pytest.mark.campaign
def test_a_design_is_no_worse_than_its_start(few):
    _, task = task_of(few, SHARED)
    done = optimise(task, seed=0, starts=1, steps=3)
    assert done.after.criterion < done.before.criterion
    assert isinstance(done.task.space.plan(done.best), vcal.Plan)
