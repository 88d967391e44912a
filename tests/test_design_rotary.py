"""Points of a laser tracker on a machine with rotary axes; what has no space for such machines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vcal
from conftest import TRACKER, write_csv
from designing import design, run, slopes, strict, task_of
from test_rotary import AXES, SETUP, point
from vcal.design import covariance
from vcal.design.optimiser import Compiled
from vcal.design.spaces.laser_tracker import work_space
from vcal.machine.chain import chain_from_string

pytestmark = pytest.mark.usefixtures("kept_programs")

FAMILY = "\n[model.geometric]\n" + SETUP.partition("[model.geometric]")[2] + "smoothness = 2.0\n"


@pytest.fixture(scope="module")
def few_points(tmp_path_factory):
    """Sixteen points of a trunnion table and a tracker that stands on it."""
    folder = tmp_path_factory.mktemp("turned") / "tracker"
    folder.mkdir()
    text = SETUP.partition("[instrument]")[0] + TRACKER + FAMILY
    (folder / "setup.toml").write_text(text, encoding="utf-8")
    low, high = [-150, -150, 0, -40, 20], [150, 150, 200, 40, 300]
    position = np.random.default_rng(1).uniform(low, high, (16, 5)).round(3)
    names = [f"{c}_mm" for c in "xyz"] + ["a_deg", "c_deg"]
    write_csv(folder / "data.csv", dict(zip(names, position.T, strict=True)))
    return folder


@pytest.mark.campaign
def test_points_with_rotary_axes_by_the_whole_covariance(few_points):
    """Against the engine's own derivatives, and lines of sight from plain matrices."""
    study, task = task_of(few_points)
    space, compiled = task.space, Compiled(task)
    assert len(space.start) == 16 * 5
    np.testing.assert_allclose(
        space.placed(jnp.asarray(space.start)).position, study.plan.position, atol=1e-12
    )
    z = np.clip(space.scattered(jax.random.key(3)), 0.05, 0.95)
    placed = space.placed(jnp.asarray(z))
    plan = space.plan(placed)
    assert plan.axes == tuple(AXES)
    v = np.array([point(q, np.zeros((5, 6))) for q in np.asarray(plan.position)])
    r = np.linalg.norm(v - [-0.9, 0.3, 0.7], axis=1)
    np.testing.assert_allclose(plan.covariate("range"), r, atol=1e-12)
    k = len(task.families[0].model.entries)
    C = np.asarray(covariance(study.model, plan))[:k, :k]
    (found,) = compiled.covariances(placed, jnp.ones(16))
    scale = np.sqrt(np.diag(C))
    size = np.outer(scale, scale)
    np.testing.assert_allclose(found / size, C / size, atol=1e-6)

    way = np.random.default_rng(6).standard_normal(len(z)) * 0.05
    slope, found = slopes(compiled.smooth, z, way)
    assert slope == pytest.approx(found, rel=1e-6)


@pytest.mark.campaign
def test_the_folder_is_a_study(few_points, tmp_path):
    out = tmp_path / "out"
    design(few_points, out)
    found = strict(out / "result.json")
    assert found["designed"]["criterion"] < 0.95 * found["nominal"]["criterion"]
    assert "can be used" in run("check", out).output
    run("simulate", out, "--out", tmp_path / "made")
    made = vcal.load_study(tmp_path / "made")
    assert made.measurement is not None and made.plan.rows == 16


def test_where_the_tool_gets():
    """A head that swivels reaches further than its linear axes; a linear machine its travel."""
    travel = {axis: (-0.3, 0.5) for axis in "XYZ"}
    offset = (0.01, 0.02, -0.15)
    low, high = work_space(chain_from_string("w X b Y Z t", travel, offset))
    np.testing.assert_allclose([low, high], np.add.outer([-0.3, 0.5], offset), atol=1e-15)
    head = travel | {"B": (-np.pi / 2, np.pi / 2)}
    it = chain_from_string("w b X Y Z B t", head, (0.0, 0.0, -0.15), {"B": (0.0, 0.0, 0.1)})
    low, high = work_space(it)
    np.testing.assert_allclose(low, [-0.55, -0.3, -0.45], atol=1e-12)
    np.testing.assert_allclose(high, [0.75, 0.5, 0.6], atol=1e-12)


@pytest.mark.thorough
def test_a_station_in_the_way_is_refused(few_points, tmp_path):
    room = ("design.station=true", "design.station_low_mm=[-500,-500,-100]",
            "design.station_high_mm=[0,0,300]")  # fmt: skip
    sets = [part for text in room for part in ("--set", text)]
    message = design(few_points, tmp_path / "out", *sets, code=2).stderr
    assert "key design.station_low_mm" in message and "work space" in message
