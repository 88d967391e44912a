"""R-test: circles, the instrument, its effects and evaluations, on data written by plain numpy."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import vcal
from oracle import PLANES, measure_circles
from vcal import Measurement, close_loop, load_study, predict
from vcal.dynamics import measured_phasors
from vcal.dynamics.ellipse_evaluation import evaluate, even_ellipse
from vcal.effects.base import Fitted
from vcal.effects.registry import load_effects
from vcal.effects.reversal import ReversalSpike
from vcal.errors import StudyError
from vcal.identification.identify import identify
from vcal.instruments.several import DataSet, several
from vcal.loop.empirical import Changing, Harmonic
from vcal.loop.residuals.dependence import dependence
from vcal.loop.residuals.vibration import vibration
from vcal.machine.circles import fit_circle
from vcal.plots import changing_sizes
from vcal.report.loop.own_effect import own_effect
from vcal.study import write_table
from vcal.study.simulated import write_simulated

E = np.array([[0.9, 0.1, -1.55], [0.05, 0.6, 0.3], [-0.4, 0.2, 1.1]])
"""um s^2/m."""
SETUP = """
[instrument]
kind = "r_test"
radius_mm = 2.0
external_sigma_um = 0.25
internal_sigma_um = 0.02
"""
LEVELS = (0.5, 1.0, 2.0, 3.0, 4.5)


def circles(*, planes=PLANES, levels=LEVELS, matrix=E, seed=0, noise=1.0, spike=None, late=0.0,
            grating=None, others=(), **more):  # fmt: skip
    """Columns of the data of an R-test by the oracle: `spike` is the size (um) and the decay (mm)
    of quadrant peaks; `late` (s) by how much the clock of the probes is behind; `grating` the
    amplitude (um) and the period (um) of the error of the scale of X; `others` further effects.
    """
    effects = [{"effect": "acceleration_crosstalk", "matrix_um_s2_per_m": matrix}, *others]
    if late:
        effects.append({"effect": "servo_lag", "T": late})
    if grating is not None:
        size, period = grating
        effects.append(
            {
                "effect": "scale_interpolation",
                "axis": "X",
                "amplitude_um": size,
                "period_um": period,
            }
        )
    if spike is not None:
        effects.append({"effect": "reversal_spike", "size_um": spike[0], "decay_mm": spike[1]})
    rng = np.random.default_rng(seed)
    return measure_circles(effects, rng, planes=planes, levels=levels, noise_factor=noise, **more)


def write(folder, table, more=""):
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / "data.csv", table)
    (folder / "setup.toml").write_text(SETUP + more, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return load_study(write(tmp_path_factory.mktemp("r_test") / "study", circles()))


def fitted(study, *effects):
    return identify(study.model.with_effects(*effects), study.measurement)


def crosstalk(fit):
    """Matrix and standard uncertainties, um s^2/m."""
    rows = {p.name: (v, u) for (_, p), v, u in zip(*_entries(fit), strict=True)}
    values, u = (
        np.array([[rows[f"matrix_{i}{j}"][k] for j in "XYZ"] for i in "XYZ"]) for k in (0, 1)
    )
    return values, u


def _entries(fit):
    entries = [(e.key, e.parameter) for e in fit.model.entries]
    step = np.array([p.step / p.si for _, p in entries])
    u = np.sqrt(np.diag(fit.covariance))[: len(entries)]
    return entries, np.asarray(fit.theta)[: len(entries)] * step, u * step


def bend(chain):
    return vcal.CATALOGUE["acceleration_crosstalk"](axes=chain.axes)


# --- circles -------------------------------------------------------------------------------------


@pytest.mark.parametrize("turns", [1.0, 1.7])
def test_a_circle_is_found(turns):
    t = np.linspace(0.0, 2 * np.pi * turns / 40.0, 90)
    x = np.column_stack([3 + 2 * np.cos(40 * t + 0.3), 1.9 * np.sin(40 * t + 0.3), 0 * t + 7])
    found = fit_circle(t, 1e-3 * x)
    assert found.omega == pytest.approx(40.0, rel=1e-11)
    np.testing.assert_allclose(found.amplitude, [2e-3, 1.9e-3, 0], atol=1e-14)
    np.testing.assert_allclose(found.position(t), 1e-3 * x, atol=1e-14)
    v, a = (np.gradient(1e-3 * x, t, axis=0), found.acceleration(t))
    np.testing.assert_allclose(found.velocity(t)[3:-3], v[3:-3], atol=5e-3 * np.abs(v).max())
    np.testing.assert_allclose(a, -(40.0**2) * 1e-3 * (x - [3, 0, 7]), atol=1e-10)


def test_way_since_the_reversal():
    """Against the way added up in small steps."""
    t = np.linspace(0.0, 3 * 2 * np.pi / 30.0, 60001)
    x = np.column_stack([2e-3 * np.cos(30 * t + 1.1), 2e-3 * np.sin(30 * t + 1.1), 0 * t])
    found = fit_circle(t[::50], x[::50]).since_reversal(t)
    for axis in (0, 1):
        step = np.diff(x[:, axis], prepend=x[0, axis])
        way, last, since = 0.0, 0.0, []
        for d in step:
            way = abs(d) if d * last < 0 else way + abs(d)
            last = d or last
            since.append(way)
        # Where it turns within a step, either end of the way is right.
        later = (t > 2 * np.pi / 30) & (np.array(since) < 0.99999 * 4e-3)
        np.testing.assert_allclose(found[later, axis], np.array(since)[later], atol=1e-7)
    np.testing.assert_allclose(found[:, 2], 2e-3, atol=1e-9)  # at rest


def test_no_circle():
    t = np.linspace(0.0, 1.0, 50)
    with pytest.raises(ValueError, match="one axis that moves at most"):
        fit_circle(t, np.column_stack([np.cos(9 * t), 0 * t, 0 * t]))
    with pytest.raises(ValueError, match="found 4 rows"):
        fit_circle(t[:4], np.zeros((4, 3)))


# --- the matrix ----------------------------------------------------------------------------------


def test_the_matrix_is_identified(study):
    """Against plain least squares in numpy, run by run."""
    found, u = crosstalk(fitted(study, bend(study.chain)))
    plan = study.plan
    a = np.column_stack([plan.covariate(f"a_{c}") for c in "XYZ"])
    runs = (np.asarray(plan.groups["run"])[:, None] == np.arange(30)) * 1.0
    columns = np.column_stack([a, runs])
    apart = np.asarray(study.measurement.readings) - np.asarray(plan.position)
    expected = 1e6 * np.linalg.lstsq(columns, apart, rcond=None)[0][:3].T
    # The prior of 1 um s^2/m draws by a few parts in a hundred thousand.
    np.testing.assert_allclose(found, expected, atol=1e-4)
    spread = 0.2508 * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns))[:3])
    np.testing.assert_allclose(u, np.tile(spread, (3, 1)), rtol=1e-3)
    assert (np.abs(found - E) < 4 * u).all()


def test_the_amplitude_trap(tmp_path):
    """A closed loop that makes circles of 0.8 of the radius: nominal accelerations are too large,
    and the matrix comes out by that factor too small.
    """
    table = circles(ratio=lambda omega: 1.0 - 8e-5 * omega**2, levels=(4.5,), noise=0.0)
    right, wrong = (
        crosstalk(fitted(s := load_study(write(tmp_path / name, table, more)), bend(s.chain)))[0]
        for name, more in (("actual", ""), ("nominal", 'acceleration = "nominal"\n'))
    )
    ratio = 1.0 - 8e-5 * 4.5 / 2e-3
    np.testing.assert_allclose(right, E, atol=2e-4)
    np.testing.assert_allclose(wrong, ratio * E, atol=2e-4)


@pytest.mark.campaign
def test_uncertainty_of_the_device(tmp_path):
    """Errors of the probes do not average out: circles of one acceleration cannot tell them from
    the machine, those of several can.
    """
    skew = 1e-6 * np.array([[300.0, -200, 100], [50, -400, 150], [-250, 100, 200]])
    us = []
    for levels in ((4.5,), LEVELS):
        table = circles(levels=levels, skew=skew)
        s = load_study(write(tmp_path / f"{len(levels)}", table, "external_u_um = 1.4\n"))
        found, u = crosstalk(fitted(s, bend(s.chain)))
        assert (np.abs(found - E) < 3.5 * u).all()
        us.append(u)
    # u_S = 1.4 um / 3 mm of the position, -omega^2 of which is the acceleration.
    prior = 1.4e-6 / 3e-3 / (4.5 / 2e-3) * 1e6
    np.testing.assert_allclose(us[0], prior / np.hypot(1.0, prior), rtol=2e-2)
    assert us[1].max() < 0.1 * us[0].min()
    # Taken for noise alone the same data are far outside their uncertainty.
    s = load_study(write(tmp_path / "trusting", circles(levels=(4.5,), skew=skew)))
    found, u = crosstalk(fitted(s, bend(s.chain)))
    assert (np.abs(found - E) / u).max() > 20


def test_both_evaluations(study):
    """The publication's plane and ellipse, and the fit of everything."""
    found = evaluate(study.measurement, study.instrument)
    assert found.runs.shape == (30, 3, 3)
    np.testing.assert_allclose(found.mean, E, atol=0.05)
    # Every circle shows two elements of cross-talk and two of in-talk.
    assert (np.isfinite(found.runs).sum((1, 2)) == 4).all()
    spread = found.dispersion()
    assert list(spread) == list(LEVELS)
    # Noise over acceleration: nine times larger at 0.5 than at 4.5 m/s^2.
    assert spread[0.5] / spread[4.5] == pytest.approx(9.0, rel=0.6)
    clean = circles(noise=0.0)
    read = dataclasses.replace(study).instrument.measured(clean)
    exact = evaluate(Measurement(study.instrument.plan(study.chain, clean), read), study.instrument)
    np.testing.assert_allclose(exact.mean, E, atol=2e-3)


def test_planes_that_are_missing(tmp_path):
    s = load_study(write(tmp_path / "two", circles(planes=("XY", "ZX"))))
    with pytest.raises(ValueError, match=r"found circles in XY, XZ, expected some in XY, YZ and"):
        evaluate(s.measurement, s.instrument)


def test_an_even_ellipse():
    angle = np.linspace(0, 6, 40)
    points = np.column_stack([5 + 2 * np.cos(angle), -3 + 1.5 * np.sin(angle)])
    np.testing.assert_allclose(even_ellipse(points), [2.0, 1.5], rtol=1e-10)
    with pytest.raises(ValueError, match="lie on no ellipse"):
        even_ellipse(np.column_stack([np.cosh(angle), np.sinh(angle)]))


# --- the loop ------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_loop_names_the_matrix(study):
    found = close_loop(study.model, study.measurement)
    assert found.verdict == "named" and [e.effect.key for e in found.effects] == [
        "acceleration_crosstalk"
    ]
    values = {name: (v, u) for name, v, _, u in found.effects[0].parameters}
    for i, j in np.ndindex(3, 3):
        v, u = values[f"matrix_{'XYZ'[i]}{'XYZ'[j]}"]
        assert abs(v - E[i, j]) < 4 * u


@pytest.mark.thorough
def test_what_a_missing_plane_leaves_open_is_told(tmp_path):
    """Nothing accelerates along Z: its column of the matrix is what was believed before."""
    s = load_study(write(tmp_path / "one", circles(planes=("XY",))))
    found = close_loop(s.model, s.measurement)
    assert [e.effect.key for e in found.effects] == ["acceleration_crosstalk"]
    (note,) = (n for n in found.notes if "poorly determine" in n)
    assert "determine matrix_XZ, matrix_YZ, matrix_ZZ; the values" in note


@pytest.mark.thorough
def test_one_element_of_the_matrix_is_the_matrix(tmp_path):
    """Not a product of an acceleration with the way that its axis has gone since a reversal."""
    table = circles(matrix=[[0, 0, -1.5], [0, 0, 0], [0, 0, 0]], samples=40)
    s = load_study(write(tmp_path / "one", table))
    found = close_loop(s.model, s.measurement)
    assert found.verdict == "named"
    assert [e.effect.key for e in found.effects] == ["acceleration_crosstalk"]


@pytest.mark.campaign
def test_the_loop_names_what_a_mode_adds(tmp_path):
    """Against a resonance whose gain is not expanded in the angular velocity."""
    w, zeta = 2 * np.pi * 50.0, 0.05
    mode = {"effect": "resonance", "matrix_um_s2_per_m": E, "frequency": 50.0, "zeta": zeta}
    table = circles(matrix=np.zeros((3, 3)), others=[mode], samples=240)
    s = load_study(write(tmp_path / "mode", table))
    found = close_loop(s.model, s.measurement)
    parts = {e.effect.key: {n: (v, u) for n, v, _, u in e.parameters} for e in found.effects}
    assert list(parts) == ["acceleration_crosstalk", "jerk_crosstalk", "snap_crosstalk"]
    # um s^2/m, nm s^3/m, nm s^4/m
    expected = E, -1e3 * 2 * zeta / w * E, -1e3 * (1 - 4 * zeta**2) / w**2 * E
    for values, true in zip(parts.values(), expected, strict=True):
        for i, j in np.ndindex(3, 3):
            v, u = values[f"matrix_{'XYZ'[i]}{'XYZ'[j]}"]
            assert abs(v - true[i, j]) < 4 * u
    assert found.errors["after"].chi2_per_dof == pytest.approx(1.0, abs=0.04)


def test_at_one_pace_there_is_nothing_to_tell_a_mode_from_its_compliance(tmp_path):
    s = load_study(write(tmp_path / "one", circles(levels=(4.5,))))
    setup = s.model.with_effects(bend(s.chain)).setup(s.plan)
    for name in ("jerk_crosstalk", "snap_crosstalk", "probe_matrix"):
        assert not list(vcal.CATALOGUE[name].candidates(setup))


@pytest.mark.thorough
def test_the_loop_names_probes_that_are_worse_than_declared(tmp_path):
    skew = 5e-4 * np.array([[1.0, 0.2, 0.0], [0.0, 1.0, -0.3], [0.0, 0.0, 1.0]])
    table = circles(matrix=np.zeros((3, 3)), skew=skew)
    s = load_study(write(tmp_path / "probes", table))
    found = close_loop(s.model, s.measurement)
    assert found.verdict == "named"
    (one,) = found.effects
    assert one.effect.key == "probe_matrix"
    for name, v, _, u in one.parameters:
        i, j = ("XYZ".index(c) for c in name.removeprefix("S_"))
        assert abs(v - 1e6 * skew[i, j]) < 4 * u


def around(table: dict, error) -> dict:
    """The table with an error (n, 3) mm of the angle (n,) and the ways outwards and around."""
    place = np.column_stack([table[f"{c}_int_mm"] for c in "xyz"])
    place = place - 0.5 * (place.max(0) + place.min(0))
    first = np.array(["XYZ".index(plane[0]) for plane in table["plane"]])
    second, rows = (first + 1) % 3, np.arange(len(first))
    angle = np.arctan2(place[rows, second], place[rows, first])
    out, way = np.zeros_like(place), np.zeros_like(place)
    out[rows, first], out[rows, second] = np.cos(angle), np.sin(angle)
    way[rows, first], way[rows, second] = -np.sin(angle), np.cos(angle)
    moved = error(angle, out, way)
    return table | {f"{c}_ext_mm": table[f"{c}_ext_mm"] + moved[:, i] for i, c in enumerate("xyz")}


BUMPS = {
    "outwards": (3, lambda phi, out, way: 5e-4 * np.cos(3 * phi)[:, None] * out),
    "around": (5, lambda phi, out, way: 5e-4 * np.sin(5 * phi + 0.4)[:, None] * way),
    "tool.Z": (4, lambda phi, out, way: 5e-4 * np.cos(4 * phi)[:, None] * np.eye(3)[2]),
}


@pytest.mark.campaign
@pytest.mark.parametrize(
    "way",
    [pytest.param(w, marks=pytest.mark.thorough if w != "tool.Z" else ()) for w in BUMPS],
)
def test_a_circle_with_bumps_is_told_by_its_angle(tmp_path, way):
    """They were periods of a scale, or quadrant peaks."""
    order, error = BUMPS[way]
    table = around(circles(matrix=np.zeros((3, 3)), samples=40), error)
    s = load_study(write(tmp_path / "bumps", table))
    closure = close_loop(s.model, s.measurement, draws=200)
    assert closure.verdict == "unexplained" and not closure.effects
    what = closure.unexplained
    assert isinstance(what.empirical.effect, Harmonic) and what.empirical.effect.port == way
    assert what.depends_on[0] == "circle_angle"
    assert f"{order} periods per turn of an angle" in closure.sentence
    assert "(circle_angle_deg)" in closure.sentence
    (tmp_path / "own_effect.py").write_text(own_effect(closure))
    (own,) = load_effects(tmp_path / "own_effect.py")
    (effect,) = own.candidates(s.model.setup(s.measurement.plan))
    fit = identify(s.model.with_effects(effect), s.measurement)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("name", "axis"),
    [
        pytest.param("stribeck_friction", "", marks=pytest.mark.thorough),
        ("coulomb_friction", ""),
        pytest.param("coulomb_friction", "Y", marks=pytest.mark.thorough),
    ],
)
@pytest.mark.thorough
def test_friction_that_depends_on_the_speed_has_its_name(tmp_path, name, axis):
    """It was a quadrant peak without an end, or plays, lags and friction that falls, of the sign
    that friction does not have.
    """
    held = {"effect": name, "size_um": 1.5, "speed_mm_per_s": 15.0}
    held |= {"axis": axis} if axis else {}
    table = circles(matrix=np.zeros((3, 3)), others=[held], samples=120)
    s = load_study(write(tmp_path / "friction", table))
    closure = close_loop(s.model, s.measurement, draws=200)
    assert closure.verdict == "named"
    (found,) = closure.effects
    assert found.effect.key == f"{name} {axis}".strip() and found.status == "named"
    values = {name: (v, u) for name, v, _, u in found.parameters}
    assert abs(values["size"][0] - 1.5) < 3.5 * values["size"][1] < 0.2
    assert abs(values["speed"][0] - 15.0) < 3.5 * values["speed"][1] < 3.0


CHANGES = {
    "height": lambda a: (3.0 / (1.0 + a), 0.06 + 0.0 * a),
    "length": lambda a: (3.0 + 0.0 * a, 0.06 * np.sqrt(a)),
}


@pytest.mark.campaign
@pytest.mark.parametrize("of", [*CHANGES])
def test_quadrant_peaks_that_change_with_the_acceleration(tmp_path, of):
    """What they leave was a cross-talk, probes worse than declared, and more of that."""
    parts = []
    for number, level in enumerate((0.5, 1.0, 2.0, 3.0, 4.5)):
        part = circles(
            matrix=np.zeros((3, 3)), levels=(level,), samples=80, seed=number,
            spike=CHANGES[of](np.float64(level)),
        )  # fmt: skip
        parts.append(part | {"run": part["run"] + 6 * number})
    table = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    s = load_study(write(tmp_path / of, table))
    closure = close_loop(s.model, s.measurement, draws=200)
    assert [e.effect.key for e in closure.effects] == ["reversal_spike"]
    what = closure.unexplained
    assert isinstance(what.empirical.effect, Changing)
    assert what.depends_on[0] == "a_set_m_s2"
    assert "reversal_spike that changes with a quantity (a_set_m_s2)" in closure.sentence
    # Level by level the readings say what was put in, beside what the lengths make of it.
    sizes = changing_sizes(closure.after, what.empirical)
    assert sizes.quantity == pytest.approx([0.5, 1.0, 2.0, 3.0, 4.5])
    if of == "height":
        put_in = np.array([CHANGES[of](a)[0] for a in sizes.quantity])
        assert (np.abs(sizes.size - put_in) < 3.5 * sizes.u).all() and (sizes.u < 0.1).all()
    # The effect of one's own is the description, beside the effect that was found.
    (tmp_path / "own_effect.py").write_text(own_effect(closure))
    (own,) = load_effects(tmp_path / "own_effect.py")
    plan = s.measurement.plan
    (effect,) = own.candidates(s.model.setup(plan))
    described = what.empirical
    place = len(described.fit.model.effects) - 1
    expected = described.effect.response(plan, described.fit.shapes[place])
    response = effect.response(plan, {})
    assert set(response) == set(expected)
    for key, value in expected.items():
        value = np.asarray(value)
        assert np.asarray(response[key]) == pytest.approx(value, abs=2e-3 * np.abs(value).max())


def test_what_changes_is_the_derivative_of_an_effect(study):
    """By its amplitude and by the logarithm of its decay, times the quantity."""
    plan = study.measurement.plan
    (spike, *_) = ReversalSpike.candidates(study.model.setup(plan))
    found = Fitted(spike, {"decay": 1e-4}, {"size": 2e-6})
    setup = dataclasses.replace(study.model.setup(plan), fitted=(found,))
    (changing,) = Changing.candidates(setup)
    names = [(q.name, q.logarithm) for q in changing.quantities]
    u = np.log(plan.values("a_set_m_s2"))
    u = (2.0 * u - u.max() - u.min()) / np.ptp(u)
    which = float(names.index(("a_set_m_s2", True)))
    response = changing.response(plan, {"which": which})

    def moved(step):
        shape = {"decay": 1e-4 * np.exp(0.3 * step * u)}
        return {k: v * (2e-6 + 1e-6 * step * u) for k, v in spike.response(plan, shape).items()}

    h = 1e-3
    for axis in "XYZ":
        port = f"tool.{axis}"
        first = 1e-6 * response[port, "size"] + 0.3 * response[port, "decay"]
        exact = (moved(h)[port, "size"] - moved(-h)[port, "size"]) / (2.0 * h)
        assert first == pytest.approx(exact, abs=2e-3 * np.abs(exact).max())
    grid = np.array([[which], [0.0]])
    both = changing.response(plan, {"which": grid})["tool.X", "size"]
    assert both.shape == (2, plan.rows)
    assert both[0] == pytest.approx(response["tool.X", "size"])


def test_a_row_at_a_reversal_is_on_the_side_it_came_from():
    """A play that is read at the quadrants too: whatever rounding makes of the phase there."""
    t = np.arange(121) * 2 * np.pi / (30.0 * 120)
    rng = np.random.default_rng(1)
    for sense in (1, -1):
        x = 2e-3 * np.column_stack([np.cos(30 * t), sense * np.sin(30 * t), 0 * t])
        circle = fit_circle(t, x + 2e-8 * rng.standard_normal(x.shape))
        came = np.sign(np.diff(x, axis=0))[:, :2]
        np.testing.assert_array_equal(circle.direction(t)[1:, :2], came)
        assert not circle.direction(t)[:, 2].any()
        # All of the way since the reversal before, not none since this one.
        np.testing.assert_allclose(circle.since_reversal(t)[[60, 120], 0], 4e-3, rtol=1e-4)


@pytest.mark.campaign
def test_a_vibration_is_told_by_its_frequency_in_time(tmp_path):
    """On every circle it comes round another number of times."""
    table = circles(matrix=np.zeros((3, 3)), samples=120, seed=7)
    rng = np.random.default_rng(7)
    start = rng.uniform(0, 2 * np.pi, table["run"].max() + 1)[table["run"]]
    table["z_ext_mm"] += 5e-4 * np.sin(2 * np.pi * 37.0 * table["t_s"] + start)
    s = load_study(write(tmp_path / "swings", table))
    closure = close_loop(s.model, s.measurement, draws=200)
    found = closure.vibration
    assert found.reading == "z_ext" and found.hz == pytest.approx(37.0, abs=0.05)
    assert found.amplitude_um == pytest.approx(0.5, rel=0.1) and found.share > 0.5
    assert closure.verdict == "unexplained" and "a vibration of 37 Hz in every" in closure.sentence
    with pytest.MonkeyPatch.context() as patch:
        # a few frequencies at a time
        patch.setattr("vcal.loop.residuals.vibration._AT_ONCE", 3_000)
        assert vibration(closure.after) == found


def test_no_vibration_in_noise_or_in_what_belongs_to_the_circle(study):
    """Of twenty draws of the noise none; bumps have another frequency on circles of another pace,
    and where all have one pace, nothing tells the two apart.
    """
    plan, sigma = study.plan, study.instrument.noise(study.plan, study.measurement.readings)
    fit = fitted(study, bend(study.chain))
    around = 7.0 * plan.values("circle_angle")
    swing = np.sin(2 * np.pi * 37.0 * plan.values("t_run"))
    a_set = plan.values("a_set_m_s2")
    for seed in range(20):
        noise = sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
        assert vibration(dataclasses.replace(fit, residual=noise)) is None
    bumps = noise + 2e-6 * np.sin(around)[:, None] * [0, 0, 1]
    assert vibration(dataclasses.replace(fit, residual=bumps)) is None
    swings = noise + 1e-6 * swing[:, None] * [0, 0, 1]
    assert vibration(dataclasses.replace(fit, residual=swings)).reading == "z_ext"
    alone = (a_set == a_set[0])[:, None, None] * fit.whitener
    one = dataclasses.replace(fit, residual=swings, whitener=alone)
    assert vibration(one) is None


def test_a_vibration_of_one_data_set_is_told_with_its_name(study):
    """Beside circles without one, of other paces and lengths of their own."""
    short = study.plan.take(np.flatnonzero(study.plan.values("circle_angle") < 5.0))
    plans = {"quiet": short, "shaky": study.plan}
    instrument, plan = several({name: DataSet(study.instrument, p) for name, p in plans.items()})
    sigma = instrument.noise(plan, np.zeros((plan.rows, 3)))
    noise = sigma * np.random.default_rng(3).standard_normal(sigma.shape)
    fit = SimpleNamespace(
        measurement=SimpleNamespace(plan=plan),
        model=SimpleNamespace(instrument=instrument),
        used=np.ones(plan.rows, bool),
        residual=noise,
    )
    assert vibration(fit) is None
    swing = np.nan_to_num(np.sin(2 * np.pi * 37.0 * plan.values("shaky:t_run")))
    fit.residual = noise + 1e-6 * swing[:, None] * (np.arange(noise.shape[1]) == 2)
    found = vibration(fit)
    assert (found.data_set, found.reading) == ("shaky", "z_ext")
    assert found.hz == pytest.approx(37.0, abs=0.05) and "in z_ext of shaky" in found.words


def timed(table):
    """The same with times that go on from run to run."""
    runs = np.unique(table["run"])
    length = [np.ptp(table["t_s"][table["run"] == run]) for run in runs]
    start = np.cumsum([0.0, *(np.array(length[:-1]) + 1.0)])
    return {**table, "t_s": table["t_s"] + start[np.searchsorted(runs, table["run"])]}


@pytest.mark.thorough
def test_a_sphere_that_slips_within_a_run_is_a_jump(tmp_path):
    """Only that run tells it: every run has a place of the sphere of its own."""
    table = timed(circles(matrix=np.zeros((3, 3)), seed=5))
    rows = np.flatnonzero(table["run"] == 4)[len(np.flatnonzero(table["run"] == 4)) // 2 :]
    table["x_ext_mm"][rows] += 2e-3
    table["z_ext_mm"][rows] -= 1e-3
    s = load_study(write(tmp_path / "slip", table))
    closure = close_loop(s.model, s.measurement, draws=200)
    (found,) = closure.effects
    assert (closure.verdict, found.effect.key) == ("named", "jump tool")
    values = {name: (value, u) for name, value, _, u in found.parameters}
    for name, true in (("X", 2.0), ("Y", 0.0), ("Z", -1.0)):
        assert abs(values[name][0] - true) < 3.5 * values[name][1]
    assert table["t_s"][rows[0] - 1] < values["at"][0] < table["t_s"][rows[0]]


@pytest.mark.parametrize("pitch_mm", [0.5, pytest.param(2.0, marks=pytest.mark.thorough)])
@pytest.mark.thorough
def test_a_scale_of_a_coarse_pitch_is_told_by_it(tmp_path, pitch_mm):
    """A magnetic scale: no screw has such a pitch, and the whole circle is two of them or eight."""
    table = circles(matrix=np.zeros((3, 3)), samples=120, seed=6)
    table["x_ext_mm"] += 5e-4 * np.sin(2 * np.pi * table["x_int_mm"] / pitch_mm + 0.3)
    s = load_study(write(tmp_path / "scale", table))
    closure = close_loop(s.model, s.measurement, draws=200)
    (found,) = closure.effects
    assert (closure.verdict, found.effect.key) == ("named", "screw_cyclic X")
    values = {name: (value, u) for name, value, _, u in found.parameters}
    assert abs(values["pitch"][0] - pitch_mm) < 3.5 * values["pitch"][1] < 0.05 * pitch_mm
    assert abs(values["sine"][0] - 0.5 * np.cos(0.3)) < 3.5 * values["sine"][1]


@pytest.mark.campaign
def test_a_drift_in_every_run_is_told_by_its_time(tmp_path):
    """It closes no circle, and looks like a play to who has nothing else."""
    drift = {"effect": "drift", "component": "Z", "um_per_s": 1.5}
    table = circles(matrix=np.zeros((3, 3)), others=[drift])
    s = load_study(write(tmp_path / "drift", table))
    closure = close_loop(s.model, s.measurement, draws=200)
    assert closure.verdict == "unexplained" and not closure.effects
    assert closure.unexplained.depends_on[0] == "t_run" and closure.unexplained.direction == "Z"
    assert "in proportion to a quantity along Z (t_run_s)" in closure.sentence


@pytest.mark.campaign
def test_more_stray_readings_than_are_left_out_are_told(tmp_path):
    """Of 8 % of the rows one coordinate is off by 20 times the noise."""
    table, rng = circles(samples=120), np.random.default_rng(3)
    rows = rng.choice(len(table["run"]), int(0.08 * len(table["run"])), replace=False)
    table["y_ext_mm"][rows] += 5e-3 * rng.choice([-1.0, 1.0], len(rows))
    s = load_study(write(tmp_path / "strays", table))
    found = close_loop(s.model, s.measurement)
    (note,) = (n for n in found.notes if "outliers at random places" in n)
    assert int(note.split(" ")[0]) == pytest.approx(len(rows), rel=0.05)


def test_what_the_place_of_the_sphere_takes_is_told_of_nothing(study):
    """A residual cannot depend on the run: an offset of every run is fitted."""
    fit = fitted(study, bend(study.chain))
    told = dependence(fit, 50, 0)
    assert {"run", "plane", "a_set_m_s2"}.isdisjoint(name for name, _ in told.single)
    assert told.p_value > 0.02


@pytest.mark.parametrize(
    "seed",
    [pytest.param(seed, marks=pytest.mark.campaign) for seed in (1, 2)],
)
def test_the_loop_names_quadrant_peaks(tmp_path, seed):
    rows = "[[model.effect]]\nname = 'acceleration_crosstalk'\n"
    rows += f"matrix_um_s2_per_m = {E.tolist()}\n"
    table = circles(samples=120, spike=(2.0, 0.1), seed=seed)
    s = load_study(write(tmp_path / "spikes", table, rows))
    found = close_loop(s.model, s.measurement)
    assert found.verdict == "named"
    (one,) = found.effects
    assert one.effect.key == "reversal_spike"
    values = {name: (v, u) for name, v, _, u in one.parameters}
    assert abs(values["size"][0] - 2.0) < 4 * values["size"][1]
    assert abs(values["decay"][0] - 0.1) < 4 * values["decay"][1]
    assert found.errors["after"].chi2_per_dof == pytest.approx(1.0, abs=0.03)
    assert found.errors["before"].chi2_per_dof > 1.2


@pytest.mark.thorough
@pytest.mark.parametrize(
    "key, name, true, more",
    [
        pytest.param("servo_lag", "T", 0.02, {"late": 2e-5}, marks=pytest.mark.campaign),
        ("scale_interpolation X", "sine", 0.2, {"grating": (0.2, 40.0)}),
    ],
)
def test_the_loop_names_clocks_and_gratings(tmp_path, key, name, true, more):
    rows = "[[model.effect]]\nname = 'acceleration_crosstalk'\n"
    rows += f"matrix_um_s2_per_m = {E.tolist()}\n"
    s = load_study(write(tmp_path / "it", circles(samples=120, seed=4, **more), rows))
    found = close_loop(s.model, s.measurement)
    assert found.verdict == "named" and [e.effect.key for e in found.effects] == [key]
    values = {n: (v, u) for n, v, _, u in found.effects[0].parameters}
    assert abs(values[name][0] - true) < 4 * values[name][1]


# --- probes --------------------------------------------------------------------------------------

NEST = np.array([[0.8, 0.0, 0.6], [-0.4, 0.69, 0.6], [-0.4, -0.69, 0.6]])


@pytest.mark.parametrize(
    ("tip", "place"), [pytest.param(None, 0.0, marks=pytest.mark.thorough), (1.5, 300.0)]
)
def test_probes_on_a_sphere(study, tmp_path, tip, place):
    """Against the contact of two spheres, found by bisection, wherever in the machine it is."""
    table = circles(levels=(4.5,), noise=0.0)
    table["x_int_mm"] = table["x_int_mm"] + place
    seen = np.column_stack([table.pop(f"{c}_ext_mm") for c in "xyz"])
    directions = NEST / np.linalg.norm(NEST, axis=1, keepdims=True)
    if tip is None:
        touched = seen @ directions.T
    else:
        touched = np.empty_like(seen)
        for k, n in enumerate(directions):
            low, high = np.full(len(seen), 5.0), np.full(len(seen), 20.0)
            for _ in range(60):
                middle = (low + high) / 2
                apart = np.linalg.norm(middle[:, None] * n - seen, axis=1) > 11.0 + tip
                low, high = np.where(apart, low, middle), np.where(apart, middle, high)
            touched[:, k] = low - (11.0 + tip)
    table |= {f"p{k + 1}_mm": touched[:, k] for k in range(3)}
    more = f"probes = {NEST.tolist()}\n" + ("" if tip is None else f"tip_radius_mm = {tip}\n")
    s = load_study(write(tmp_path / "probes", table, more))
    fit = fitted(s, bend(s.chain))
    found, _ = crosstalk(fit)
    np.testing.assert_allclose(found, E, atol=2e-3)
    left = np.asarray(s.measurement.readings) - np.asarray(predict(fit.model, s.plan, fit.theta))
    assert np.abs(left).max() < 2e-9
    for take in (evaluate, measured_phasors):
        with pytest.raises(ValueError, match="found readings of probes, expected coordinates"):
            take(s.measurement, s.instrument)


LONG = [0.0, 0.0, -200.0]
"""mm, from the spindle to the sphere."""


def probed(tmp_path, **more):
    """A study of probes along X, Y and Z with round tips, and the same with a `LONG` tool."""
    table = circles(levels=(4.5, 2.0), samples=40, **more)
    seen = np.column_stack([table.pop(f"{c}_ext_mm") for c in "xyz"])
    square = (seen**2).sum(1, keepdims=True)
    touched = seen + np.sqrt(12.5**2 - square + seen**2) - 12.5
    table |= {f"p{k + 1}_mm": touched[:, k] for k in range(3)}
    nest = f"probes = {np.eye(3).tolist()}\ntip_radius_mm = 1.5\n"
    own = '[machine]\nchain = "w X b Y Z t"\n'
    folder = write(tmp_path / "probed", table, nest + own)
    return load_study(folder), load_study(folder, {"machine.tool_offset_mm": LONG})


@pytest.mark.thorough
def test_the_sphere_is_at_the_end_of_the_tool(tmp_path):
    """However long the tool is, the probes stand about the sphere."""
    short, long = probed(tmp_path)
    one, other = (fitted(s, bend(s.chain)) for s in (short, long))
    np.testing.assert_allclose(other.theta, one.theta, rtol=1e-9, atol=1e-9)
    assert other.chi2 == pytest.approx(one.chi2, rel=1e-9)
    zero = np.zeros(len(long.model.entries))
    assert np.abs(predict(long.model, long.plan, zero)).max() < 3e-3
    out = tmp_path / "simulated"
    write_simulated(long, out)
    assert load_study(out, {"machine.tool_offset_mm": LONG}).measurement is not None


@pytest.mark.thorough
def test_the_sphere_is_at_the_end_of_the_tool_of_its_data_set(tmp_path):
    """Two R-tests of one machine, the second with a longer tool than the machine has."""
    short, long = probed(tmp_path)
    sets = {
        "short": DataSet(short.sets[0].instrument, short.plan),
        "long": DataSet(long.sets[0].instrument, long.plan, np.array(LONG) * 1e-3),
    }
    instrument, plan = several(sets)
    model = vcal.Model(short.chain, instrument, instrument.effects(plan))
    read = np.asarray(predict(model, plan, np.zeros(len(model.entries))))
    np.testing.assert_allclose(read[short.plan.rows :], read[: short.plan.rows], atol=1e-12)


# --- set points ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t | {"sense": -t["sense"]}, "run 0: found the scale of Y -?180 degrees behind"),
        (lambda t: t | {"t_s": t["t_s"] - np.pi / 2 / np.sqrt(4.5 / 2e-3)},
         "run 0: found the scale of X -90 degrees behind its set point"),
    ],
)  # fmt: skip
def test_circles_that_are_not_the_ones_asked_for(tmp_path, change, message):
    table = change(circles(levels=(4.5,)))
    s = load_study(write(tmp_path / "other", table))
    with pytest.raises(ValueError, match=message):
        measured_phasors(s.measurement, s.instrument)


def test_scales_of_undeclared_noise(study):
    silent = dataclasses.replace(study.instrument, internal_sigma=0.0)
    with pytest.raises(ValueError, match="found no internal_sigma_um"):
        measured_phasors(study.measurement, silent)


def test_an_axis_that_gives_way_is_at_rest(tmp_path):
    """A held axis that the others push by some micrometres."""
    table = circles(levels=(4.5,), planes=("XY",))
    push = 5e-3 * np.cos(np.sqrt(4.5 / 2e-3) * table["t_s"])
    pushed = table | {c: table[c] + push for c in ("z_int_mm", "z_ext_mm")}
    one, other = (load_study(write(tmp_path / n, t)) for n, t in (("a", table), ("b", pushed)))
    assert (np.asarray(other.plan.covariate("a_Z")) == 0.0).all()
    # Both readings have it.
    np.testing.assert_allclose(other.measurement.readings, one.measurement.readings, atol=1e-10)


# --- files ---------------------------------------------------------------------------------------


def test_there_and_back(study):
    table = study.instrument.to_table(study.plan, study.measurement.readings)
    again = study.instrument.plan(study.chain, table)
    np.testing.assert_allclose(again.position, study.plan.position, atol=1e-15)
    for name in ("a_X", "v_Y", "dir_Z", "since_X", "t_run", "sense"):
        np.testing.assert_allclose(again.covariate(name), study.plan.covariate(name), atol=1e-8)
    read = study.instrument.measured(table)
    np.testing.assert_allclose(read, study.measurement.readings, atol=1e-13)


def test_readings_do_not_hold_the_noise_of_the_positions(study):
    """What the scales read beside the circle is in the internal and in the external reading."""
    table = circles()
    moved = dict(table)
    shake = 1e-3 * np.random.default_rng(5).standard_normal(len(table["t_s"]))
    shake -= np.bincount(table["run"], shake)[table["run"]] / 60
    for name in ("z_int_mm", "z_ext_mm"):
        moved[name] = table[name] + shake
    one, other = (study.instrument.measured(t) for t in (table, moved))
    # Of a shake of 1 um what looks like a circle of its own, a share of about sqrt(2 / 60).
    assert np.sqrt(((one - other)[:, 2] ** 2).mean()) < 2e-7


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t | {"t_s": t["t_s"] * 0 + 1.0},
         r"^data.csv, row 2 \(line 3\), run 0, column t_s: found 1 after 1, exp"),
        (lambda t: t | {"plane": np.where(t["run"] == 3, "UV", t["plane"])}, "found 'UV', exp"),
        (lambda t: t | {"plane": np.where(t["run"] == 3, "ZX", t["plane"])},
         r"^data.csv, row \d+ \(line \d+\), run 3, column plane: found ZX, while Y, Z move, exp"),
        (lambda t: {k: v * 4 if k.endswith("int_mm") else v for k, v in t.items()},
         r"run 0: found a circle of 8 mm, expected about radius_mm = 2"),
        (lambda t: t | {"t_s": 1e3 * t["t_s"]},
         r"run 0, column a_set_m_s2: found 4.5, while the axes travel 2 mm at .*4.5e-06 m/s"),
        (lambda t: t | {"a_set_m_s2": 0 * t["t_s"] + 1.0}, r"column a_set_m_s2: found 1, while"),
        (lambda t: t | {"x_ext_mm": t["x_ext_mm"] + 2.5}, r"column x_ext_mm: found 4.* to 3;"),
        (lambda t: t | {"sense": np.where(t["run"] == 3, 0, t["sense"])},
         r"run 3, column sense: found 0, expected 1 or -1; enter the sense"),
        (lambda t: t | {"sense": np.where(np.arange(len(t["run"])) == 5, -1, t["sense"])},
         r"row 6 \(line 7\), run 0, column sense: found -1 after 1, expected one setting in a run"),
        (lambda t: t | {"a_set_m_s2": t["a_set_m_s2"] + (np.arange(len(t["run"])) == 5)},
         r"row 6 \(line 7\), run 0, column a_set_m_s2: found 5.5 after 4.5, expected one setting"),
        (lambda t: {k: v * 1e-3 if k.endswith("ext_mm") else v for k, v in t.items()},
         r"columns x_ext_mm, y_ext_mm, z_ext_mm: found .* with metres turned into millimetres"),
        (lambda t: t | {"y_ext_mm": 1e-3 * t["y_ext_mm"]},
         r"^data.csv, row \d+ \(line \d+\), column y_ext_mm: found y_ext_mm -?0.001.* mm from the "
         r"mean of run \d, where the axes are -?1.9.*; they do with metres turned into mill"),
        (lambda t: t | {"z_ext_mm": -t["z_ext_mm"]}, "with the other sign in z_ext_mm: compare"),
        (lambda t: t | {"x_ext_mm": t["y_ext_mm"], "y_ext_mm": t["x_ext_mm"]},
         "with the columns in the order y_ext_mm, x_ext_mm, z_ext_mm: compare"),
    ],
)  # fmt: skip
def test_mistakes_in_the_data(tmp_path, change, message):
    with pytest.raises(StudyError, match=message):
        load_study(write(tmp_path / "bad", change(circles(levels=(4.5,)))))


def test_a_sense_that_is_not_that_of_the_motion(tmp_path):
    """Which way is 1 may differ from file to file, not from run to run."""
    table = circles()
    other = table | {"sense": -table["sense"]}
    assert load_study(write(tmp_path / "other", other)).plan.rows == len(table["run"])
    wrong = table | {"sense": np.where(table["run"] == 7, -table["sense"], table["sense"])}
    with pytest.raises(StudyError, match=r"run 7, column sense: found 1, the other way round than"):
        load_study(write(tmp_path / "wrong", wrong))


def test_the_same_readings_as_another_run(tmp_path):
    table = circles(levels=(4.5,))
    twice = {n: np.concatenate([v, v]) for n, v in table.items()}
    twice["run"] = np.concatenate([table["run"], table["run"] + 100])
    with pytest.raises(
        StudyError, match=r"row 361 \(line 362\), run 100: found all readings of run 0"
    ):
        load_study(write(tmp_path / "twice", twice))


def test_a_circle_seen_too_seldom(tmp_path):
    """Nine rows in five turns are four turns the other way round."""
    with pytest.raises(StudyError, match=r"run 0: found 2.25 rows per turn, expected 3 at least"):
        load_study(write(tmp_path / "few", circles(turns=5.0, samples=9, levels=(4.5,))))


def test_two_paces_in_one_run(tmp_path):
    slow, fast = (circles(levels=(a,), planes=("XY",)) for a in (2.0, 4.5))
    ends = {int(k): slow["t_s"][slow["run"] == k].max() for k in np.unique(slow["run"])}
    after = fast["t_s"] + [ends[int(k)] for k in fast["run"]]
    joined = {n: np.concatenate([slow[n], fast[n]]) for n in slow}
    joined |= {"t_s": np.concatenate([slow["t_s"], after]), "a_set_m_s2": 0 * joined["t_s"] + 3.0}
    order = np.lexsort([joined["t_s"], joined["run"]])
    table = {n: v[order] for n, v in joined.items()}
    with pytest.raises(
        StudyError, match=r"run 0: found positions .* mm \(rms\) from the best-fitting"
    ):
        load_study(write(tmp_path / "two", table))


def test_less_than_a_turn(tmp_path):
    with pytest.raises(StudyError, match=r"run 0: found 0.70 of a turn, expected a whole one"):
        load_study(write(tmp_path / "short", circles(turns=0.7, levels=(4.5,))))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("probes = [[1, 0, 0], [0, 1, 0], [1, 1, 0]]\n", "three that do not lie in one plane"),
        ("range_mm = 1.5\n", r"column x_ext_mm: found .* expected a number from -1.5 to 1.5"),
        ("acceleration = 'set'\n", "instrument.acceleration"),
    ],
)
def test_mistakes_in_the_study_file(tmp_path, more, message):
    with pytest.raises(StudyError, match=message):
        load_study(write(tmp_path / "bad", circles(levels=(4.5,)), more))
