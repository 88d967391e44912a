"""The laser frame's Monte Carlo: evaluation beam by beam, cycles, second device, better places."""

import itertools
import json

import numpy as np
import pytest
from numpy.polynomial import legendre

import vcal.reproduce.laser_frame.results as computing
from vcal import Model, predict
from vcal.design import covariance, expanded
from vcal.errors import StudyError
from vcal.model.simulate import draw, prepare
from vcal.reproduce import reproduction
from vcal.reproduce.laser_frame import better as search
from vcal.reproduce.laser_frame.better import Better, Step, segments_along
from vcal.reproduce.laser_frame.budget import point_budget, point_parts, point_u
from vcal.reproduce.laser_frame.cycles import cycles, influences, under_conditions
from vcal.reproduce.laser_frame.defined import Asked, places
from vcal.reproduce.laser_frame.recipe import (
    PRINTED,
    Lever,
    distance,
    exchanged,
    largest,
    recipe,
    variants,
)
from vcal.reproduce.laser_frame.setting import (
    DEGREES,
    LEGS,
    SQUARENESSES,
    STRAIGHTNESSES,
    THIRTEEN,
    TRAVEL,
    Layout,
    ReadingNoise,
    errors,
    frame_setup,
    sizes,
)
from vcal.reproduce.laser_frame.verification import verification

LEVER = Lever.seen()


def ideal(layout, names):
    """Readings per coefficient of some errors, and the names of the coefficients."""
    chain, instrument, plan = frame_setup(layout)
    model = Model(chain, instrument, (errors(chain, names, sizes()),))
    step = 1e-2 * np.eye(len(model.entries))
    both = [np.asarray(predict(model, plan, s) - predict(model, plan, -s)) for s in step]
    return model, np.stack([b.ravel() / 2e-2 for b in both], 1)


# --- what a budget says of a point ---


@pytest.mark.parametrize(("place", "path"), [(0.0, 0.1), (1.3, 1.5), (-0.4, 0.7)])
def test_the_parts_are_those_of_the_budget(place, path):
    found = point_budget(place, path)
    named = dict(zip(found.source.labels, found.contribution[0], strict=True))
    parts = {k: float(v) for k, v in point_parts(place, path).items()}
    for name, u in parts.items():
        assert named.get(name, 0.0) == pytest.approx(u, rel=1e-9)
    assert float(point_u(place, path)) == pytest.approx(float(found.u[0]), rel=1e-9)


# --- beam by beam ---


@pytest.mark.thorough
def test_the_evaluation_gives_back_what_was_put_in():
    """Machines with one straightness, positioning error, squareness or roll, exact kinematics."""
    layout = Layout.named("planar")
    evaluation = recipe(layout.segments)
    seen = tuple(n for n in THIRTEEN if n != "EBY")  # which no planar path sees
    model, readings = ideal(layout, seen)
    found = evaluation.matrix @ readings
    at = Asked.by(evaluation)
    true = at.of(model, {"EZX": ("EAX", layout.segments[1].start[1])})
    own, columns = np.asarray(at.names), [e.parameter.name[:3] for e in model.entries]
    for name in (*STRAIGHTNESSES, "EYY", "EAX", "EA0Z", "EC0Y"):
        # Errors about X change the heights of the beams along X, and only those.
        keep = np.array([not c.startswith("EAX") or name in ("EAX", "EZX") for c in columns])
        rows = own == name
        np.testing.assert_allclose(
            found[np.ix_(rows, keep)], true[np.ix_(rows, keep)], atol=2e-3 * 1e-5
        )
    # Where the beams have other points than each other, lines between them are not quite it.
    rows = own == "EXX"
    keep = np.array([c == "EXX" for c in columns])
    np.testing.assert_allclose(found[rows][:, keep], true[rows][:, keep], atol=1e-9)


def test_a_planar_path_reads_another_roll():
    layout = Layout.named("planar")
    model, readings = ideal(layout, ("EAX", "EBY"))
    evaluation = recipe(layout.segments)
    mine = np.asarray(evaluation.names) == "EBY"
    found = np.abs(evaluation.matrix[mine] @ readings).max(0)
    names = [e.parameter.name for e in model.entries]
    assert max(f for f, n in zip(found, names, strict=True) if n.startswith("EBY")) < 1e-9
    assert max(f for f, n in zip(found, names, strict=True) if n.startswith("EAX")) > 2e-5


def test_a_path_in_space_has_no_such_evaluation():
    with pytest.raises(ValueError, match="least squares instead"):
        recipe(Layout.named("3d").segments)


@pytest.mark.slow
def test_table_four():
    first, *others = variants()
    assert first.exchanged <= 0.12 < first.as_printed
    assert first.as_printed == pytest.approx(0.41, abs=0.01)
    assert distance(PRINTED, PRINTED) == 0.0
    assert distance({n: 2.0 * v for n, v in PRINTED.items()}, PRINTED) == pytest.approx(np.log(2.0))
    assert exchanged()["EXZ"] == PRINTED["EZY"] and exchanged()["EYZ"] == PRINTED["EYZ"]
    half = next(v for v in others if v.name == "noise × 1")
    for name in THIRTEEN:
        assert half.U[name] == pytest.approx(0.5 * first.U[name], rel=1e-12)
    # EXX by hand: eleven and seven readings, u of each, half of the difference.
    layout = Layout.named("planar")
    u = layout.u()[:, 0]
    by_hand = 0.5 * np.sqrt((u[18:29] ** 2).sum() / 121.0 + (u[:7] ** 2).sum() / 49.0)
    assert first.U["EXX"] == pytest.approx(2e6 * by_hand, rel=1e-9)


# --- cycles ---


def oracle(layout):
    """U of the thirteen in um: the linear model written out in numpy, least squares."""
    low, high = (np.array([TRAVEL[c][i] for c in "XYZ"]) for i in (0, 1))
    q = layout.position
    x, y, z = q.T
    unit = (2.0 * q - low - high) / (high - low)
    columns, names = [], []
    zero = np.zeros(len(q))

    def add(name, *displacement):
        columns.append(np.stack(displacement, 1))
        names.append(name)

    for name in THIRTEEN:
        if name in SQUARENESSES:
            tilt = {"EA0Z": (zero, -z, zero), "EB0Z": (z, zero, zero), "EC0Y": (-y, zero, zero)}
            add(name, *tilt[name])
            continue
        for degree in DEGREES[name]:
            f = legendre.legval(unit[:, "XYZ".index(name[2])], [0.0] * degree + [1.0])
            if name == "EAX":
                add(f"{name}.P{degree}", zero, -z * f, y * f)
            elif name == "EBY":
                add(f"{name}.P{degree}", z * f, zero, zero)
            else:
                add(f"{name}.P{degree}", *(f if c == name[1] else zero for c in "XYZ"))
    for axis in np.eye(3):
        add("pose", *np.tile(axis, (len(q), 1)).T)
        add("pose", *np.cross(axis, q - 0.5 * (low + high)).T)
    J = np.stack(columns, -1)
    rows, start = [], 0
    u = layout.u()
    for one, s in zip(layout.segments, layout.shares, strict=True):
        here = slice(start, start + len(s))
        for j, c in enumerate(one.across):
            rows.append(J[here, c] / u[here, j, None])
        start += len(s)
    J = np.concatenate(rows)
    norm = np.linalg.norm(J, axis=0)
    C = np.linalg.inv((J / norm).T @ (J / norm)) / np.outer(norm, norm)
    chain, instrument, _ = frame_setup(layout)
    model = Model(chain, instrument, (errors(chain, THIRTEEN, dict.fromkeys(THIRTEEN, 1.0)),))
    assert [e.parameter.name for e in model.entries] == names[:-6]
    D = Asked.usual().of(model)
    C = C[: D.shape[1], : D.shape[1]]
    return largest(Asked.usual().names, 2.0 * np.sqrt(np.einsum("qk,kl,ql->q", D, C, D)), LEVER)


@pytest.mark.thorough
def test_least_squares_against_numpy():
    layout = Layout.named("3d")
    found, _ = search._U(layout)
    assert found == pytest.approx(oracle(layout), rel=2e-3)


@pytest.fixture(scope="module")
def planar():
    return cycles("planar", "none", "thirteen with prior", draws=4000, seed=2)


@pytest.fixture(scope="module")
def three():
    return cycles("3d", "thirteen", "thirteen", draws=4000, seed=2)


@pytest.fixture(scope="module")
def compared():
    return verification(300, 4)


@pytest.mark.campaign
def test_cycles_give_the_closed_form(planar, three):
    first = variants()[0]
    assert planar.campaign.failed == 0
    # 4000 draws: a standard deviation to 1.1 %, the largest of several a little more.
    for name in THIRTEEN:
        assert planar.by_beams[name] == pytest.approx(first.U[name], rel=0.05)
    expected, tool = search._U(Layout.named("3d"))
    for name in THIRTEEN:
        assert three.identified[name] == pytest.approx(expected[name], rel=0.06)
    assert three.tool.max() == pytest.approx(tool, rel=0.06)
    assert three.by_beams is None and three.tool.shape == (len(places()), 3)


# --- influences ---


@pytest.mark.thorough
def test_influences_as_effects_have_the_sizes_of_the_budget():
    """Standard deviation of single readings, influence by influence, over many runs."""
    import jax

    layout = Layout.named("3d")
    chain, instrument, plan = frame_setup(layout, sigma_m=0.0)
    plan = under_conditions(plan, layout)
    every = influences(layout, factor=1.0)
    upper = np.flatnonzero(np.asarray(plan.groups["segment"]) == 4)[0]  # along X, reads Y and Z
    place = np.array(layout.segments[4].psd_range) * -1e3
    way = 0.5 * (LEGS["X"] - 0.184) + LEGS["X"] + 2 * LEGS["Y"] + LEGS["Z"]
    parts = {k: float(v) for k, v in point_parts(place[1], way).items()}
    groups = {
        "refraction in the filter": ("refraction",),
        "resolution": ("resolution",),
        "head: coefficient of expansion": ("head alpha",),
        "head: sensor and measuring chain": ("head sensor", "head chain"),
        "tool interface": ("tool interface",),
        "deflection of the beam": ("deflection",),
        "diode and measuring chain": ("psd repeatability", "psd linearity"),
    }
    assert len(every) == 8 and set(groups) < set(every)
    for name, own in groups.items():
        simulator = prepare(Model(chain, instrument, every[name]), plan)
        keys = jax.random.split(jax.random.key(5), 4000)
        readings = np.asarray(jax.vmap(lambda k, s=simulator: draw(s, k).readings)(keys))
        expected = np.sqrt(sum(parts[p] ** 2 for p in own))
        assert 1e6 * readings[:, upper, 1].std() == pytest.approx(expected, rel=0.06), name


# --- second device ---


@pytest.mark.campaign
def test_second_device_and_reversals(compared):
    found = compared
    assert len(found.agreements) == 10
    # 30 600 normalised errors: 95.4 % of them, and a little scatter.
    assert found.agreeing == pytest.approx(0.954, abs=0.01)
    for one in found.agreements:
        assert one.rmse.mean() == pytest.approx(one.expected, rel=0.08)
        # Both devices saw the manipulation.
        assert np.abs(one.frame.mean(0) - one.manipulated).max() < 0.5
        assert one.inside == pytest.approx((np.abs(one.difference) <= 3.0).mean())
    for r in found.reversals:
        assert abs(r.identified - r.true) < 3.5 * r.u
        assert abs(r.by_difference - r.true) < 1.5


# --- better places ---


def test_paths_turn_at_every_corner():
    corners = ((0, 1, 0), (0, 0, 0), (1, 0, 0), (1, 0, 1))
    beams = segments_along(corners, (5, 6, 7))
    assert [s.axis for s in beams] == ["Y", "X", "Z"]
    assert [s.psd for s in beams] == ["vertical", "vertical", "horizontal"]
    for one, other in itertools.pairwise(beams):
        assert one.end == other.start


@pytest.mark.thorough
def test_the_bound_of_a_path_is_below_what_gradient_reaches():
    edges = search._Edges()
    start = Layout.named("3d")
    bound = edges.bound(search._corners(start.segments), 51)
    assert sum(bound.shares) == pytest.approx(51.0)
    step = search.refine("places", start)
    assert bound.bound < step.largest < 0.85 * search.judge("evenly", start).largest
    for one, s in zip(step.layout.segments, step.layout.shares, strict=True):
        assert s.min() >= -1e-9 and s.max() <= 1.0 + 1e-9
        assert np.diff(s).min() * one.length > search.GAP_M - 1e-8
    # By the same model written out in numpy.
    assert step.U == pytest.approx(oracle(step.layout), rel=2e-3)
    with pytest.raises(ValueError, match="undetermined"):
        edges.bound(search._corners(Layout.named("planar").segments), 51)


@pytest.mark.campaign
def test_the_slopes_of_the_search_against_finite_differences():
    layout = Layout.named("3d")
    model, plan, _, functionals, _ = search._fitted(layout)
    rng = np.random.default_rng(1)
    shares = [np.clip(s + 0.01 * rng.standard_normal(len(s)), 0.0, 1.0) for s in layout.shares]

    def U(shift):
        moved = [s.copy() for s in shares]
        moved[2][4] += shift
        there = Layout(layout.segments, tuple(moved))
        noisy = model.with_effects(ReadingNoise(there.u()))
        return np.asarray(
            expanded(functionals, covariance(noisy, plan.with_position(there.position)))
        )

    seen = {}

    def stop(criteria, start, low, high, *, slopes, **_):
        z = np.concatenate(shares)
        seen["value"], seen["slope"] = criteria(z), slopes(z)[:, 7 + 11 + 4]
        raise StopIteration

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "minimax", stop)
        with pytest.raises(StopIteration):
            search.refine("", layout)
    h = 1e-4
    by_difference = (8.0 * (U(h) - U(-h)) - (U(2 * h) - U(-2 * h))) / (12.0 * h)
    np.testing.assert_allclose(seen["value"], U(0.0), rtol=1e-9)
    scale = np.abs(by_difference).max()
    np.testing.assert_allclose(seen["slope"], by_difference, rtol=1e-6, atol=1e-7 * scale)


# --- the folder ---


@pytest.mark.campaign
def test_the_folder(planar, three, compared, tmp_path, monkeypatch):
    """With one real campaign per path for all of them, and layouts that are judged, not refined."""
    start = Layout.named("3d")
    bound = search._Edges().bound(search._corners(start.segments), 51)
    judged = search.judge("as published", start)
    steps = tuple(
        Step(name, start, judged.U, judged.tool) for name in ("as published", "a", "b", "c")
    )

    def campaign(layout, machine, fitted, *, draws, seed, effects=None):
        del machine, fitted, effects
        assert (draws, seed) == (300, 1)
        return planar if layout == "planar" else three

    monkeypatch.setattr(computing, "cycles", campaign)
    monkeypatch.setattr(computing, "verification", lambda repeats, seed: compared)
    monkeypatch.setattr(
        computing,
        "better",
        lambda progress: Better(steps, steps[-1], (bound,), (bound,), (192, 384)),
    )
    out, said = tmp_path / "out", []
    frame = reproduction("laser-frame")
    page = frame.run(out, 300, 1, said.append)
    assert page == out / "index.html" and len(said) == len(set(said)) > 10
    record = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert record["name"] == "laser-frame" and (record["draws"], record["seed"]) == (300, 1)
    assert {p.name for p in out.iterdir()} == set(record["files"])
    rows = {row["quantity"]: row for row in record["table"]}
    assert rows["expanded (k = 2), largest"]["seed"] == 2.26
    assert rows["U of EAX"]["seed"] == 8.2
    assert rows["U of EAX"]["vcal"] == planar.by_beams["EAX"]
    assert rows["rms of ln(vcal / printed), EXZ and EZY exchanged"]["vcal"] <= 0.12
    assert len(record["budget"]) == 36
    text = page.read_text(encoding="utf-8")
    assert "nan" not in text.split("<main>")[1].split("data:image")[0]
    assert text.count("<figure") == 7
    with pytest.raises(StudyError, match="expected at least 200 draws"):
        frame.run(out, 20, 1, print)
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(StudyError, match=r"found other files \(mine.txt"):
        frame.run(tmp_path, 300, 1, print)
