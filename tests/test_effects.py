"""Every effect against finite differences, and against the oracle's effect of the same name."""

import dataclasses
import functools
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from known import PLANS, Known, know_all
from known_files import write_frame
from oracle import (
    arm_frames,
    arm_points,
    euler_xyz,
    make_case,
    tool_point,
    tracker_readings,
    write_study,
)
from oracle.effects import (
    ball_positions,
    gravity_lever,
    gravity_torque,
    joint_angles,
    joint_tilts,
    stretched_reach,
)
from vcal import CATALOGUE, effects, load_study, predict
from vcal.cli.start_studies import example
from vcal.demo import STARTS, starts
from vcal.effects import Setup, wind_up
from vcal.effects.arm import gravity_moments
from vcal.effects.reversal import Repeatability
from vcal.identification.fit import shape_step
from vcal.identification.linearised import linearised_terms
from vcal.instruments.arm_table import moves
from vcal.machine.chain import chain_from_string
from vcal.machine.plan import Plan
from vcal.machine.ports import PortLayout
from vcal.model.declared_noise import declared_whitener
from vcal.model.forward import observe_with_jacobian, port_values, tool_points
from vcal.study.study import declared_model


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> dict[str, Known]:
    return know_all(tmp_path_factory.mktemp("known"))


@pytest.fixture(scope="module")
def frame(tmp_path_factory):
    """What `Known` has, for a laser frame with every column that its effects need."""
    study = load_study(write_frame(tmp_path_factory.mktemp("frame") / "study", growth=0.0, runs=1))
    rows = np.arange(study.plan.rows)
    more = {"T_gradient_z_K_per_m": np.cos(rows), "psd_u_mm": np.sin(rows), "psd_v_mm": 0.1 * rows}
    more["payload_kg"] = 20.0 + 3.0 * np.sin(2.0 * rows)
    plan = Plan(
        study.plan.axes,
        study.plan.position,
        {**study.plan.covariates, **more},
        study.plan.groups,
    )
    model = study.model
    return SimpleNamespace(
        chain=study.chain,
        instrument=study.instrument,
        plan=plan,
        model=model,
        theta=0.5 * np.ones(len(model.entries)),
        setup=Setup(model.chain, model.layout, plan, model.effects),
    )


@pytest.fixture(scope="module")
def lifted():
    """The same for an arm on a column, with a probe of position and orientation."""
    model, plan = declared_model(STARTS / "pose_probe")
    plan = plan.take(np.arange(0, plan.rows, 4))
    return SimpleNamespace(
        chain=model.chain,
        instrument=model.instrument,
        plan=plan,
        model=model,
        theta=0.5 * np.ones(len(model.entries)),
        setup=Setup(model.chain, model.layout, plan, model.effects),
    )


@pytest.fixture(scope="module")
def r_test():
    """The same for an R-test: circles."""
    model, plan = declared_model(STARTS / "r_test")
    plan = plan.take(np.arange(0, plan.rows, 4))
    (crosstalk,) = CATALOGUE["acceleration_crosstalk"].candidates(model.setup(plan))
    return SimpleNamespace(
        chain=model.chain,
        instrument=model.instrument,
        plan=plan,
        model=model,
        theta=0.5 * np.ones(len(model.entries)),
        setup=Setup(model.chain, model.layout, plan, (*model.effects, crosstalk)),
    )


@pytest.fixture(scope="module")
def touched(known):
    """The ball array with what a probe and a spindle want to know."""
    it = known["ball_array"]
    rows = np.arange(it.plan.rows)
    more = {"approach_rad": 2.4 * rows, "speed_rpm": 6000.0 * ((rows > 20) & (rows < 80))}
    plan = Plan(it.plan.axes, it.plan.position, {**it.plan.covariates, **more}, it.plan.groups)
    return SimpleNamespace(
        chain=it.chain,
        instrument=it.instrument,
        plan=plan,
        model=it.model,
        theta=it.theta,
        setup=Setup(it.chain, it.model.layout, plan, it.model.effects, it.instrument.artefact),
    )


OF_EVERY_FORM = {"backlash", "jump", "range_scale", "screw_cyclic", "thermal_tilt", "warm_up"}
"""An effect of each form: of a direction, a moment, the instrument, a shape parameter that moves, a
covariate, the time."""
OF_AN_ARM = [
    name
    for name, kind in CATALOGUE.items()
    if kind.__module__ in ("vcal.effects.arm", "vcal.effects.wind_up")
]
"""Effects of gravity and of gears, whose responses are programs of JAX."""


@functools.cache
def shown(name):
    """The same for the bundled study on which an effect is shown, with the columns that it needs,
    and the effect; for an effect that none of the small studies has.
    """
    effect, setup = example(CATALOGUE[name])
    models = (declared_model(STARTS / kind)[0] for kind in starts())
    model = next(m for m in models if m.layout == setup.layout)
    return SimpleNamespace(
        chain=model.chain,
        instrument=model.instrument,
        plan=setup.plan,
        model=model,
        theta=0.5 * np.ones(len(model.entries)),
        setup=setup,
    ), effect


IN_ORDER = """
    acceleration_crosstalk jerk_crosstalk snap_crosstalk joint_compliance bearing_compliance
    joint_error_motion readback_lag scale_growth thermal_offset thermal_tilt
    squareness_temperature warm_up drift ball_error artefact_bending artefact_expansion
    cross_axis joint_coupling tool_offset screw_cyclic gear_ripple scale_interpolation
    gear_harmonic jump geometric_order head_expansion frame_expansion frame_growth refraction
    psd_linearity head_temperature tool_interface filter_refraction psd_resolution servo_lag
    probe_lobing probe_matrix repeatability backlash lateral_reversal angular_reversal
    reversal_spike stribeck_friction coulomb_friction payload_sag spindle_growth range_scale
    encoder_eccentricity tracker_axes station_drift station_settling gear_wind_up
""".split()
"""Effects in the order of the catalogue. It decides ties of candidates, and must not change."""


def test_every_effect_is_found_in_its_order():
    """Of the modules in the folder, none of which is listed anywhere; new ones may come between."""
    assert [name for name in CATALOGUE if name in IN_ORDER] == IN_ORDER
    modules = {kind.__module__ for name, kind in CATALOGUE.items() if name in IN_ORDER}
    assert modules <= {
        f"vcal.effects.{path.stem}" for path in Path(effects.__file__).parent.iterdir()
    }


# --- derivatives ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in OF_EVERY_FORM else pytest.mark.thorough) for n in CATALOGUE],
)
@pytest.mark.slow
def test_effect_columns_against_finite_differences(name, known, frame, r_test, touched, lifted):
    """Terms times port Jacobian: the derivative of `predict`, shape parameters included."""
    tested = 0
    for it in (*known.values(), frame, r_test, touched, lifted):
        if tested > 1 or (it in (r_test, touched, lifted) and tested):
            continue
        found = list(CATALOGUE[name].candidates(it.setup))
        found = [e for e in found if it.plan.has(*e.needs) and e.kind == "systematic"]
        for effect in found[:: max(1, len(found) // 2)]:
            _check_columns(it, effect)
            tested += 1
    if not tested and CATALOGUE[name].kind == "systematic":
        _check_columns(*shown(name))


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.thorough if n in OF_AN_ARM else ()) for n in CATALOGUE],
)
def test_response_by_numpy_and_by_jax(name, known, frame, r_test, touched, lifted):
    """Of numbers numpy's, with nothing to compile; of arrays of JAX the same, but for what sines of
    many turns round. On two instruments that have such effects: their plans differ in numbers only.
    """
    tested, seen = 0, 0
    for it in (*known.values(), frame, r_test, touched, lifted):
        if it is lifted and tested or seen == 2:
            continue
        plan = jax.tree.map(np.asarray, it.plan)
        effects = list(CATALOGUE[name].candidates(dataclasses.replace(it.setup, plan=plan)))
        effects = [effect for effect in effects if plan.has(*effect.needs)]
        for effect in effects[:: max(1, len(effects) // 2)]:
            tested += _check_response(name, effect, plan)
        seen += bool(effects)
    if not tested and CATALOGUE[name].kind == "systematic":
        it, effect = shown(name)
        assert _check_response(name, effect, jax.tree.map(np.asarray, it.plan))


def _check_response(name, effect, plan) -> int:
    shape = {k: grid[len(grid) // 2] for k, grid in effect.scan(plan).items()}
    plain = effect.response(plan, shape)
    same = effect.response(jax.tree.map(jnp.asarray, plan), shape)
    assert plain.keys() == same.keys()
    for key, column in plain.items():
        assert name in OF_AN_ARM or not isinstance(column, jax.Array), key
        scale = float(np.max(np.abs(column))) or 1.0
        np.testing.assert_allclose(column, same[key], rtol=1e-12, atol=1e-11 * scale)
    return len(plain)


def _check_columns(it: Known, effect) -> None:
    model, first = it.model.with_effects(effect), len(it.theta)
    theta = np.concatenate([it.theta, 1.0 + np.arange(len(effect.amplitudes))])
    grids = effect.scan(it.plan)
    # Between two points of the scan; near its fine end, where phases turn fastest.
    shape = {k: float(0.4 * v[-2] + 0.6 * v[-1]) for k, v in grids.items()}
    shapes = {len(it.model.effects): shape}
    terms = linearised_terms(model, it.plan, shapes, theta)
    ports = port_values(terms, np.pad(theta, (0, 9)), len(model.layout))
    _, by_port = observe_with_jacobian(
        it.chain, it.instrument, it.plan.position, it.instrument.rows(it.plan), ports
    )
    by_term = np.asarray(by_port)[:, :, terms.port] * np.asarray(terms.values)[:, None, :]
    moving = [p for p in effect.shapes if p.moves]
    assert terms.parameter.max() == len(theta) + len(moving) - 1
    for k in range(first, len(theta) + len(moving)):
        column = by_term[:, :, terms.parameter == k].sum(2)
        ends = []
        for sign in (1.0, -1.0):
            if k < len(theta):
                ends.append(predict(model, it.plan, theta + sign * np.eye(len(theta))[k], shapes))
            else:
                p = moving[k - len(theta)]
                moved = shape[p.name] + sign * 1e-3 * shape_step(p, shape[p.name], grids)
                ends.append(
                    predict(model, it.plan, theta, {len(it.model.effects): shape | {p.name: moved}})
                )
        slope = np.asarray(ends[0] - ends[1]) / (2.0 if k < len(theta) else 2e-3)
        assert np.abs(slope).max() > 0, effect.key
        np.testing.assert_allclose(column, slope, rtol=0, atol=2e-5 * np.abs(slope).max() + 1e-15)


def test_response_that_names_nothing_is_refused(known):
    """A port or an amplitude that does not exist, as a user's own effect may name it."""
    it = known["laser_tracker"]
    good = it.effect("backlash:Y:size_um=1")
    with pytest.raises(ValueError, match="no port named 'EYV'"):
        it.readings(dataclasses.replace(good, port="EYV"))

    class Wrong(type(good)):
        def response(self, plan, shape):
            return {("EYY", "sise"): np.ones(plan.rows)}

    wrong = Wrong(port="EYY", unit="um", placement="Y")
    with pytest.raises(ValueError, match="amplitude 'sise', but its amplitudes are size"):
        it.readings(wrong)


# --- effects against the oracle ------------------------------------------------------------------

SINE, COSINE = 6 * np.cos(0.7), 6 * np.sin(0.7)
ON_MACHINE = [
    ("backlash:X:size_um=12", {"axis": "X", "size_um": 12}),
    ("backlash:Y:size_um=-9", {"axis": "Y", "size_um": -9}),
    ("lateral_reversal:X:size_EZX_um=7", {"axis": "X", "component": "Z", "size_um": 7}),
    ("lateral_reversal:Z:size_EXZ_um=7", {"axis": "Z", "component": "X", "size_um": 7}),
    ("angular_reversal:X:size_EBX_urad=8", {"axis": "X", "component": "B", "size_urad": 8}),
    ("scale_growth:X:alpha_um_per_m_K=11", {"axis": "X", "ppm_per_K": 11}),
    ("scale_growth:Y:alpha_um_per_m_K=11", {"axis": "Y", "ppm_per_K": 11}),
    ("squareness_temperature:X:k_EYX_urad_per_K=5",
     {"axis": "X", "component": "Y", "urad_per_K": 5}),
    ("thermal_offset:X:k_EYX_um_per_K=5", {"axis": "X", "component": "Y", "um_per_K": 5}),
    ("thermal_tilt:Y:k_EAY_urad_per_K=40", {"axis": "Y", "component": "A", "urad_per_K": 40}),
    ("warm_up:Z:size_EXZ_um=10,tau_h=0.1",
     {"axis": "Z", "component": "X", "size_um": 10, "tau_h": 0.1}),
    ("drift:Y:rate_EAY_urad_per_h=90", {"axis": "Y", "component": "A", "urad_per_h": 90}),
    (f"screw_cyclic:X:sine_um={SINE},cosine_um={COSINE},pitch_mm=20",
     {"axis": "X", "amplitude_um": 6, "pitch_mm": 20, "phase": 0.7}),
    ("cross_axis:Y:EZY_y_x_um=8", {"axis": "Y", "other": "X", "component": "Z", "size_um": 8}),
    ("cross_axis:Y:EZY_y2_x_um=8",
     {"axis": "Y", "other": "X", "component": "Z", "size_um": 8, "powers": (2, 1)}),
    ("cross_axis:X:EBX_x_z2_urad=8",
     {"axis": "X", "other": "Z", "component": "B", "size_urad": 8, "powers": (1, 2)}),
    ("tool_offset:X_um=30,Y_um=-20,Z_um=10", {"vector": [30e-6, -20e-6, 10e-6]}),
]  # fmt: skip
ON_TRACKER = [
    ("range_scale:offset_um=3,scale_um_per_m=5", {"offset_um": 3, "ppm": 5}),
    (f"encoder_eccentricity:azimuth:sine_urad={SINE},cosine_urad={COSINE}",
     {"amplitude_urad": 6, "phase": 0.7}),
    ("tracker_axes:tilt_urad=8,collimation_urad=-5", {"tilt_urad": 8, "collimation_urad": -5}),
]  # fmt: skip


def from_start(run):
    """The run with times from its first reading, where vcal's effects of time start."""
    return dataclasses.replace(run, t=run.t - run.t[0])


@pytest.mark.parametrize(("text", "keys"), [*ON_MACHINE, *ON_TRACKER])
def test_effect_on_a_tracker_is_the_oracles(text, keys, known):
    it = known["laser_tracker"]
    case, effect = it.case, {"effect": text.split(":")[0]} | keys
    run = from_start(case.run)
    p = tool_point(case.machine, run, [effect])
    expected = tracker_readings(case.tracker, p, run.t, [effect])
    got, without = it.readings(it.effect(text)), it.readings()
    assert np.abs(got - without).max() > 1e-6
    # Errors of the tracker are evaluated at the nominal angles, 1e-4 off: 3e-9 at most.
    tolerance = 3e-9 if (text, keys) in ON_TRACKER else 2e-12
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("text", "keys"), ON_MACHINE)
def test_effect_on_a_ball_array_is_the_oracles(text, keys, known):
    it = known["ball_array"]
    effect, run = {"effect": text.split(":")[0]} | keys, from_start(it.case.run)
    machine = it.case.machine
    expected = tool_point(machine, run, [effect]) - tool_point(machine, run)
    got = it.readings(it.effect(text)) - it.readings()
    assert np.abs(expected).max() > 1e-6
    np.testing.assert_allclose(got, expected, rtol=0, atol=2e-12)


def test_spindle_growth_against_an_integration(touched):
    """tau g' = n / n_max - g by small steps, the speed of every row until the next."""
    (effect,) = CATALOGUE["spindle_growth"].candidates(touched.setup)
    t, n = (np.asarray(touched.plan.covariate(name)) for name in ("t", "speed_rpm"))
    tau = 0.2 * np.ptp(t)
    g, grown = 0.0, []
    for i in range(len(t)):
        grown.append(g)
        if i + 1 < len(t):
            steps = 400
            for _ in range(steps):
                g += (t[i + 1] - t[i]) / steps / tau * (n[i] / 6000.0 - g)
    response = effect.response(touched.plan, {"tau": np.asarray(tau)})
    np.testing.assert_allclose(response["tool.Z", "size"], grown, atol=2e-4)
    assert 0.3 < max(grown) < 1.0 and grown[-1] < max(grown)
    # Some of the rows know the whole history.
    few = touched.plan.take(np.arange(50, 90, 7))
    again = effect.response(few, {"tau": np.asarray(tau)})["tool.Z", "size"]
    np.testing.assert_allclose(again, np.asarray(grown)[50:90:7], atol=2e-4)


def test_what_warms_up_had_not_begun_before(touched):
    """Check points may be older than the data: exp(-t / tau) would be anything there."""
    effect = next(iter(CATALOGUE["warm_up"].candidates(touched.setup)))
    start, tau = effect.start, 180.0
    times = start + np.array([-7200.0, -1.0, 0.0, tau, 7200.0])
    plan = Plan(touched.plan.axes, np.asarray(touched.plan.position)[:5], {"t": times})
    (response,) = effect.response(plan, {"tau": np.asarray(tau)}).values()
    np.testing.assert_allclose(response, [0.0, 0.0, 0.0, 1.0 - np.exp(-1.0), 1.0], atol=1e-12)


def test_the_beam_points_from_the_lowest_number_to_the_highest(touched):
    """Supports are shares of its length from there, whatever the order of the balls."""
    device = touched.model.instrument
    back = dataclasses.replace(device, centres=device.centres[::-1], numbers=device.numbers[::-1])
    (direction, along), (turned, there) = device.beam(), back.beam()
    np.testing.assert_allclose(direction, turned, atol=1e-12)
    np.testing.assert_allclose(along, there[::-1], atol=1e-12)
    ends = device.centres[[np.argmin(device.numbers), np.argmax(device.numbers)]]
    assert np.diff(ends @ direction)[0] > 0.0


def test_three_lobes(touched):
    (effect,) = CATALOGUE["probe_lobing"].candidates(touched.setup)
    phi = np.asarray(touched.plan.covariate("approach_rad"))
    found = effect.response(touched.plan, {})
    for name, size in (("radius", 1.0), ("sine3", np.sin(3 * phi)), ("cosine3", np.cos(3 * phi))):
        np.testing.assert_allclose(found["tool.X", name], size * np.cos(phi), atol=1e-12)
        np.testing.assert_allclose(found["tool.Y", name], size * np.sin(phi), atol=1e-12)


def test_gratings_are_looked_for_on_short_ways_only(r_test, known):
    """4 mm are 40 periods of 100 um; 500 mm are too many of any."""
    found = list(CATALOGUE["scale_interpolation"].candidates(r_test.setup))
    assert [e.placement for e in found] == ["X", "Y", "Z"]
    np.testing.assert_allclose(found[0].scan(r_test.plan)["period"], [1e-5, 2e-5, 4e-5, 1e-4, 2e-4])
    x = np.asarray(r_test.plan.x("X"))
    wave = found[0].response(r_test.plan, {"period": np.asarray(2e-5)})
    np.testing.assert_allclose(wave["EXX", "sine"], np.sin(2 * np.pi * x / 2e-5), atol=1e-9)
    assert not list(CATALOGUE["scale_interpolation"].candidates(known["laser_tracker"].setup))


@pytest.mark.parametrize("text", ["w b X Y Z t", "w X b Y Z t", "w Y X b Z t", "w X Y Z b t"])
@pytest.mark.thorough
def test_a_lagging_axis_is_where_its_command_was(text, known):
    """T earlier, by the forward kinematics of the machine without the effect."""
    it = known["laser_tracker"]
    chain = chain_from_string(text, tool_offset_m=(0.03, -0.02, -0.15))
    t = np.linspace(0.0, 6.0, 7)
    q, v = (np.stack([f(t), f(2.0 * t), f(3.0 * t)], 1) for f in (np.sin, np.cos))
    plan = Plan(("X", "Y", "Z"), q, {f"v_{a}": v[:, i] for i, a in enumerate("XYZ")})
    found = list(CATALOGUE["servo_lag"].candidates(Setup(chain, it.model.layout, plan)))
    assert [e.placement for e in found] == ["", "X", "Y", "Z"]
    still = np.zeros((len(t), len(it.model.layout)))
    for effect in found:
        late = np.array([effect.placement in ("", axis) for axis in "XYZ"])
        ports = still.copy()
        for (port, _), column in effect.response(plan, {}).items():
            ports[:, it.model.layout.index(port)] += 1e-3 * column
        got, expected = tool_points(chain, q, ports), tool_points(chain, q - 1e-3 * v * late, still)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-15)
        assert np.abs(expected - tool_points(chain, q, still)).max() > 0.9e-3


def test_jump_and_station_drift_are_the_oracles(known):
    it = known["laser_tracker"]
    case, run = it.case, from_start(it.case.run)
    at = float(run.t[40] + it.case.run.t[0] + 0.1)
    got = it.readings(it.effect(f"jump:tool:X_um=20,Y_um=0,Z_um=-15,at_s={at}"))
    jumps = [
        {"effect": "jump", "axis": "Z", "component": c, "size_um": size, "t0": at}
        for c, size in (("X", 20), ("Z", -15))
    ]
    expected = tracker_readings(case.tracker, tool_point(case.machine, case.run, jumps))
    # In the tool's frame, that is, behind the rotation of Z: the product of two errors apart.
    np.testing.assert_allclose(got, expected, rtol=0, atol=5e-9)
    assert np.abs(got - it.readings()).max(1).argmax() > 40
    rates = {"X": 300, "Y": -200, "Z": 100, "A": 90, "B": 50, "C": -70}
    keys = ",".join(
        f"rate_{c}_{'um' if c in 'XYZ' else 'urad'}_per_h={v}" for c, v in rates.items()
    )
    got = it.readings(it.effect(f"station_drift:{keys}"))
    per_s = 1e-6 * np.array(list(rates.values())) / 3600
    own = euler_xyz(case.tracker.euler) @ per_s[3:]  # the oracle turns about the machine's axes
    drift = {"effect": "station_drift", "translation": per_s[:3], "rotation": own}
    expected = tracker_readings(case.tracker, tool_point(case.machine, run), run.t, [drift])
    # vcal adds the rotation vectors of the station and of its drift, 0.4 mrad and 8 urad here.
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9)
    assert np.abs(got - it.readings()).max() > 1e-5


def test_a_stand_that_settles_is_a_drift_of_the_machine_the_other_way(known):
    it = known["laser_tracker"]
    setup = it.setup
    found = {e.placement: e for e in CATALOGUE["station_settling"].candidates(setup)}
    assert list(found) == list("XYZABC")
    whole = next(iter(CATALOGUE["station_drift"].candidates(setup)))
    for c, effect in found.items():
        response = effect.response(it.plan, {})
        assert list(response) == [(f"frame.{c}", f"rate_{c}")]
        expected = whole.response(it.plan, {})[f"frame.{c}", f"rate_{c}"]
        np.testing.assert_array_equal(response[f"frame.{c}", f"rate_{c}"], expected)
    sinking = it.readings(it.effect("station_settling:Z:rate_Z_um_per_h=-40"))
    rising = it.readings(it.effect("drift:Z:component=EZZ,rate_EZZ_um_per_h=40"))
    assert np.abs(sinking - it.readings()).max() > 1e-6
    # In the frame of Z, which errors of the axes have turned by some 50 urad.
    np.testing.assert_allclose(sinking, rising, rtol=0, atol=5e-9)


def test_pitches_of_a_screw_by_the_travel_and_the_places(known, r_test):
    """Down to 4 mm and both ends, a quarter of the travel where the geometry is fitted; where it is
    not, and the axis stood closely, all that was seen twice in a period.
    """
    it = known["laser_tracker"]
    (screw,) = (e for e in CATALOGUE["screw_cyclic"].candidates(it.setup) if e.placement == "X")
    pitches, travel = screw.scan(it.plan)["pitch"], np.ptp(it.plan.x("X"))
    assert pitches[0] == pytest.approx(travel / 4) and pitches[-2] <= 4e-3 < pitches[-3]
    assert (np.diff(1 / pitches) * travel).max() == pytest.approx(0.25)
    (screw, *_) = CATALOGUE["screw_cyclic"].candidates(r_test.setup)
    pitches, places = screw.scan(r_test.plan)["pitch"], np.unique(r_test.plan.x("X"))
    assert pitches[0] == pytest.approx(np.ptp(places))
    shortest = max(2.5e-4, 2 * np.diff(places).max())
    assert pitches[-2] <= shortest < pitches[-3] < 1e-3


def test_artefact_effects_are_the_oracles(known):
    it = known["ball_array"]
    balls, run = it.case.balls, it.case.run

    def expected(*effects):
        """Ball centres with effects."""
        supports = it.instrument.supports
        its = balls.balls, run, balls.rotation, balls.origin
        return ball_positions(*its, effects, supports)

    for text, effect in [
        ("ball_error:ball 4:X_um=10,Y_um=-20,Z_um=30",
         {"effect": "ball_error", "ball": 4, "vector": [10e-6, -20e-6, 30e-6]}),
        ("artefact_expansion:alpha_um_per_m_K=8", {"effect": "artefact_expansion", "ppm_per_K": 8}),
    ]:  # fmt: skip
        moved = it.readings() - it.readings(it.effect(text))
        np.testing.assert_allclose(moved, expected(effect) - expected(), rtol=0, atol=1e-12)
        assert np.abs(moved).max() > 0.3e-6
    # The oracle lets the beam sag along -Z. vcal knows that, and a sag across the beam, which is
    # the same where it lies level and as long everywhere. Its beam is the line through the zigzag
    # of the balls, not the X axis: 2 %.
    sag = expected({"effect": "artefact_bending", "size_um": 10}) - expected()
    assert np.abs(sag).max() > 3e-6
    down, across = (
        it.readings() - it.readings(it.effect(f"artefact_bending:{key}=10"))
        for key in ("sag_down_um", "sag_um")
    )
    np.testing.assert_allclose(down, sag, rtol=0, atol=0.3e-6)
    level = np.abs(it.plan.covariate("tilt")) < 0.05
    assert 0.3 < level.mean() < 0.7
    np.testing.assert_allclose(across[level], sag[level], rtol=0, atol=0.3e-6)
    lengths = np.linalg.norm(across, axis=1), np.linalg.norm(sag, axis=1)
    np.testing.assert_allclose(*lengths, rtol=0, atol=0.3e-6)
    assert np.abs(across - sag)[~level].max() > 1e-6


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("backlash:J3:size_urad=300", {"joint": 2, "size_urad": 300}),
        (f"gear_harmonic:J2:sine3_urad={SINE},cosine3_urad={COSINE}",
         {"joint": 1, "order": 3, "amplitude_urad": 6, "phase": 0.7}),
        ("joint_coupling:J6:k_J5_urad_per_rad=1000", {"joint": 5, "other": 4, "coefficient": 1e-3}),
        (f"gear_ripple:J3:sine_urad={SINE},cosine_urad={COSINE},pitch_deg=1.8",
         {"joint": 2, "pitch_deg": 1.8, "amplitude_urad": 6, "phase": 0.7}),
    ],
)  # fmt: skip
def test_effect_on_an_arm_is_the_oracles(text, keys, known):
    """On a nominal arm: a joint's offset and its constant errors turn in a different order."""
    it = known["reflectors"]
    effect, plan = {"effect": text.split(":")[0]} | keys, it.case.arm_run
    nominal = dataclasses.replace(it.case.arm, translation=None, rotation=None)
    own = arm_points(nominal, joint_angles(nominal, plan.q, plan.t, [effect]), it.instrument.points)
    expected = (own - it.instrument.station) @ it.instrument.orientation
    zero = np.zeros(len(it.theta))
    got = it.readings(it.effect(text), theta=zero).reshape(expected.shape)
    # Into the first pose vcal knows of no move.
    np.testing.assert_allclose(got[1:], expected[1:], rtol=0, atol=1e-12)
    assert np.abs(got - it.readings(theta=zero).reshape(got.shape)).max() > 1e-6


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("back", [False, True])
def test_an_axis_that_wobbles_is_the_oracles(order, back, known):
    """Vectors across the axis that turn with n times the joint, and a wave along it."""
    if back and order == 1:
        return  # a constant error of the link before
    it = known["reflectors"]
    name, way = ("_back", -1.0) if back else ("", 1.0)
    text = (
        f"joint_error_motion:J3:cosine{order}_radial{name}_um=9,sine{order}_tilt{name}_urad=40,"
        f"sine{order}_axial_um=5"
    )
    q, nominal = (
        it.case.arm_run.q,
        dataclasses.replace(it.case.arm, translation=None, rotation=None),
    )
    moved, turned = np.zeros((2, *q.shape, 3))
    wave = order * q[:, 2]
    moved[:, 2] = 1e-6 * np.stack([9 * np.cos(wave), 9 * way * np.sin(wave), 5 * np.sin(wave)], 1)
    turned[:, 2, :2] = 40e-6 * np.stack([-way * np.sin(wave), np.cos(wave)], 1)
    frames, origins = arm_frames(nominal, q, moved, turned)
    own = origins[:, -1, None] + np.einsum("nij,kj->nki", frames[:, -1], it.instrument.points)
    expected = (own - it.instrument.station) @ it.instrument.orientation
    got = it.readings(it.effect(text), theta=np.zeros(len(it.theta))).reshape(expected.shape)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9)
    still = it.readings(theta=np.zeros(len(it.theta))).reshape(expected.shape)
    assert np.abs(got - still).max() > 1e-5


def test_a_joint_that_slips_is_the_oracles(tmp_path):
    it = Known("reflectors", tmp_path, recording=("t_s",))
    run = it.case.arm_run
    at = 0.5 * float(run.t[30] + run.t[31])
    told = {"effect": "jump", "joint": 1, "size_urad": 80, "t0_s": at}
    nominal = dataclasses.replace(it.case.arm, translation=None, rotation=None)
    own = arm_points(nominal, joint_angles(nominal, run.q, run.t, [told]), it.instrument.points)
    expected = (own - it.instrument.station) @ it.instrument.orientation
    zero = np.zeros(len(it.theta))
    got = it.readings(it.effect(f"jump:J2:size_urad=80,at_s={at}"), theta=zero)
    np.testing.assert_allclose(got.reshape(expected.shape), expected, rtol=0, atol=1e-12)
    still = it.readings(theta=zero)
    np.testing.assert_array_equal((got == still).all(1), run.t < at)


def test_a_joint_that_stands_keeps_the_way_it_came():
    """The move into the first pose and into one after a gap is unknown."""
    pose = np.array([3, 4, 5, 6, 8, 9, 10])
    angle = np.array([[0.0, 5], [10, 5], [10, 5], [4, 5], [4, 6], [4, 2], [7, 2]])
    way = [[0, 0], [1, 0], [1, 0], [-1, 0], [0, 0], [0, -1], [1, -1]]
    move = [[0, 0], [10, 0], [0, 0], [-6, 0], [0, 0], [0, -4], [3, 0]]
    for order in (np.arange(7), np.arange(7)[::-1], np.array([4, 0, 6, 2, 5, 1, 3])):
        own, rows = pose[order], angle[order]
        expected = np.array([move, way])[:, order]
        for found in (moves(rows, own), jax.jit(lambda q, own=own: moves(q, own))(rows)):
            np.testing.assert_array_equal(found, expected)


def test_backlash_of_joints_that_stand_is_the_oracles(known):
    it = known["reflectors"]
    q = np.array(it.case.arm_run.q)
    q[5:9, 2], q[20:22, 2] = q[4, 2], q[19, 2]
    angles = {f"q{j + 1}_cmd_deg": np.rad2deg(column) for j, column in enumerate(q.T)}
    plan = it.study.instrument.plan(it.chain, {"pose": np.arange(len(q)), **angles})
    effect = it.effect("backlash:J3:size_urad=300")
    (column,) = effect.response(plan, {}).values()
    nominal = dataclasses.replace(it.case.arm, translation=None, rotation=None)
    told = {"effect": "backlash", "joint": 2, "size_urad": 300}
    expected = (joint_angles(nominal, q, it.case.arm_run.t, [told]) - q)[:, 2]
    np.testing.assert_allclose(300e-6 * np.asarray(column)[1:], expected[1:], atol=1e-12)
    assert np.abs(expected).min() > 149e-6


def test_joint_compliance_spans_the_oracles_torque(known):
    it = known["reflectors"]
    arm, q = it.case.arm, it.case.arm_run.q
    nominal = dataclasses.replace(arm, translation=None, rotation=None)
    for j, joint in enumerate(it.chain.axes):
        levers = gravity_moments(it.chain, q, joint)[:, :, 2]
        for centre, columns in (
            ([0, 0, 0], [-3]),
            ([0.05, 0, 0], [-3, -2]),
            ([0, 0.05, 0], [-3, -1]),
        ):
            torque = gravity_torque(nominal, q, j, 1 / 9.81, np.array(centre))
            np.testing.assert_allclose(levers[:, columns].sum(1), torque, rtol=0, atol=1e-13)
    # A mass at every frame behind the joint, seen through the patterns that are kept.
    effect, both = (
        e for e in CATALOGUE["joint_compliance"].candidates(it.setup) if e.placement == "J2"
    )
    (bearing,) = (
        e for e in CATALOGUE["bearing_compliance"].candidates(it.setup) if e.placement == "J2"
    )
    apart = {**effect.response(it.plan, {}), **bearing.response(it.plan, {})}
    together = both.response(it.plan, {})
    assert apart.keys() == together.keys()
    assert all((apart[key] == together[key]).all() for key in apart)
    weights = effect.torsion.weights
    assert (weights.max(0) == np.abs(weights).max(0)).all()  # a sign that does not hang on rounding
    response = effect.response(it.plan, {})
    assert {port for port, _ in response} == {"ECJ2"}
    columns = np.column_stack([*response.values(), np.ones(it.plan.rows)])
    _, origins = arm_frames(nominal, q)
    for k in range(2, 7):
        frames = arm_frames(nominal, q)[0]
        moment = np.cross(origins[:, k] - origins[:, 1], [0.0, 0.0, -1.0])
        torque = np.sum(frames[:, 1, :, 2] * moment, axis=1)
        left = torque - columns @ np.linalg.lstsq(columns, torque, rcond=None)[0]
        assert np.linalg.norm(left) < 0.02 * np.linalg.norm(torque - torque.mean())


@pytest.mark.parametrize("share", [0.02, 0.1, 0.4, 1.0, 1.5])
def test_gear_wind_up_is_the_departure_from_a_straight_line(share, known):
    """tanh less its chord, one half at half of the reach, over the oracle's levers."""
    it = known["reflectors"]
    arm, q = it.case.arm, it.case.arm_run.q
    found = list(CATALOGUE["gear_wind_up"].candidates(it.setup))
    # Nothing behind the others has a lever; one that only the flange has is offered once.
    assert [(e.placement, e.load) for e in found] == [
        ("J2", "arm"), ("J2", "tool"), ("J3", "arm"), ("J3", "tool"), ("J4", "arm"), ("J5", "arm")
    ]  # fmt: skip
    middle = np.tanh(0.5 / share) - 0.5 * np.tanh(1.0 / share)
    for effect in found:
        j = it.chain.axes.index(effect.placement)
        lever, reach = gravity_lever(arm, q, j, effect.load), stretched_reach(arm, j, effect.load)
        assert effect.reach == pytest.approx(reach, rel=1e-9)
        assert 0.8 * reach < np.abs(lever).max() < reach
        rest = np.tanh(lever / (share * reach)) - lever / reach * np.tanh(1.0 / share)
        response = effect.response(it.plan, {"knee": np.asarray(share * reach)})
        ((key, column),) = response.items()
        assert key == (f"EC{effect.placement}", f"size_{effect.load}")
        np.testing.assert_allclose(column, 0.5 * rest / middle, rtol=0, atol=1e-12)


def test_gear_wind_up_over_its_whole_reach(known, monkeypatch):
    """Zero at both ends, odd, a step for the sharpest knee and the cubic for the softest; and the
    size says the same of a sharp one wherever the knee is.
    """
    effect = next(iter(CATALOGUE["gear_wind_up"].candidates(known["reflectors"].setup)))
    u = np.linspace(-1.0, 1.0, 40_001)
    monkeypatch.setattr(wind_up, "gravity_arms", lambda *_: effect.reach * u)
    knees = effect.reach * np.array([1e-6, 0.004, 0.02, 0.1, 0.5, 1.5, 1e3])
    (g,) = effect.response(known["reflectors"].plan, {"knee": knees[:, None]}).values()
    np.testing.assert_allclose(g[:, [0, 20_000, -1]], 0.0, atol=1e-7)
    np.testing.assert_allclose(g[:, 30_000], 0.5, rtol=1e-9)
    np.testing.assert_allclose(g, -g[:, ::-1], atol=1e-7)
    most = g[:, 20_000:].max(1)
    assert most[0] > 0.9999 and (np.diff(most[:5]) < 0.0).all() and most.min() > 0.5
    step = np.sign(u) - u
    np.testing.assert_allclose(g[0], step, atol=1e-12)
    away = np.abs(u) > 0.1
    np.testing.assert_allclose(g[1, away], step[away], atol=1e-12)
    np.testing.assert_allclose(g[-1], (u - u**3) / 0.75, atol=1e-6)


def test_gear_wind_up_and_compliance_are_the_oracles(known):
    """The oracle's gear winds up by a tanh: a departure from its chord, and the chord, which is a
    joint that yields in proportion.
    """
    it = known["reflectors"]
    arm, q, t = it.case.arm, it.case.arm_run.q, it.case.arm_run.t
    nominal = dataclasses.replace(arm, translation=None, rotation=None)
    told = {"effect": "gear_wind_up", "joint": 1, "size_urad": 150, "knee_mm": 60}
    columns = gravity_moments(it.chain, q, "J2")[:, :-2, 2].mean(1)
    effect = next(iter(CATALOGUE["gear_wind_up"].candidates(it.setup)))
    (g,) = effect.response(it.plan, {"knee": np.asarray(0.06)}).values()
    both = np.column_stack([g, columns])
    turned = (joint_angles(nominal, q, t, [told]) - q)[:, 1]
    sizes, *_ = np.linalg.lstsq(both, turned, rcond=None)
    np.testing.assert_allclose(both @ sizes, turned, rtol=0, atol=1e-15)
    assert sizes[1] == pytest.approx(150e-6 * np.tanh(effect.reach / 0.06) / effect.reach)
    # What is left beside the chord is the effect alone, as the readings of a nominal arm see it.
    told |= {"departure": True}
    own = arm_points(nominal, joint_angles(nominal, q, t, [told]), it.instrument.points)
    expected = (own - it.instrument.station) @ it.instrument.orientation
    zero = np.zeros(len(it.theta))
    amount = f"size_arm_urad={1e6 * sizes[0]:.17g},knee_mm=60"
    got = it.readings(it.effect(f"gear_wind_up:J2:{amount}"), theta=zero)
    np.testing.assert_allclose(got.reshape(expected.shape), expected, rtol=0, atol=1e-12)
    assert np.abs(got - it.readings(theta=zero)).max() > 1e-5


def test_machines_with_rotary_axes_have_no_gears_that_wind_up():
    """Of their heads no effect of gravity is known, as of the joints of an arm."""
    chain = chain_from_string(
        "w b X Y Z C A t",
        tool_offset_m=(0.0, 0.0, -0.15),
        rotary_m={"C": (0.0, 0.0, 0.2), "A": (0.0, 0.0, 0.1)},
    )
    plan = Plan(chain.axes, np.random.default_rng(1).uniform(-1.0, 1.0, (20, 5)))
    setup = Setup(chain, PortLayout.of(chain.axes, ()), plan)
    for name in ("gear_wind_up", "joint_compliance", "bearing_compliance"):
        assert not list(CATALOGUE[name].candidates(setup))


@pytest.mark.parametrize("joint", range(6))
def test_bearing_compliance_is_the_oracles(joint, known):
    """A mass off the axis of the flange, as the readings of a nominal arm see it."""
    it = known["reflectors"]
    arm, q = it.case.arm, it.case.arm_run.q
    nominal = dataclasses.replace(arm, translation=None, rotation=None)
    told = {"effect": "bearing_compliance", "joint": joint, "coefficient": 1e-6 / 9.81}
    told |= {"mass": 1.0, "centre": np.array([0.05, -0.1, 0.0])}
    tilts = joint_tilts(nominal, q, [told])
    own = arm_points(nominal, q, it.instrument.points, tilts)
    expected = (own - it.instrument.station) @ it.instrument.orientation
    axis = it.chain.axes[joint]
    moments = gravity_moments(it.chain, q, axis)
    places = np.zeros(moments.shape[1])
    places[-3:] = 1.0, 1.0, -2.0
    found = 1e-6 * np.einsum("nkc,k->nc", moments, places)[:, :2]
    np.testing.assert_allclose(found, tilts[:, joint, :2], rtol=0, atol=1e-18)
    assert np.abs(tilts[:, joint, 2]).max() < 1e-18 < 1e-9 < np.abs(found).max()
    (effect,) = (
        e for e in CATALOGUE["bearing_compliance"].candidates(it.setup) if e.placement == axis
    )
    response = effect.response(it.plan, {})
    names = [p.name for p in effect.amplitudes]
    columns = [np.concatenate([response[f"E{c}{axis}", n] for c in "AB"]) for n in names]
    sizes, *_ = np.linalg.lstsq(np.column_stack(columns), found.T.ravel(), rcond=None)
    given = tuple((n, float(a) * 1e6, 0.0) for n, a in zip(names, sizes, strict=True))
    zero = np.zeros(len(it.theta))
    got = it.readings(dataclasses.replace(effect, given=given), theta=zero)
    still = it.readings(theta=zero)
    left = got.reshape(expected.shape) - expected
    # Patterns of less than a hundredth of the strongest one are left out.
    assert np.abs(left).max() < 0.02 * np.abs(got - still).max()


def test_readback_lag_of_one_is_the_command(known, tmp_path):
    case = make_case(
        "reflectors", seed=3, plan=PLANS["reflectors"], noise_factor=0.0,
        effects=[{"effect": "readback_lag", "share": 1e-3}],
    )  # fmt: skip
    folder = write_study(tmp_path / "lag", case)
    read, commanded = (
        load_study(folder, [f"instrument.joints={kind}"]) for kind in ("read", "commanded")
    )
    theta = np.zeros(len(commanded.model.entries))
    expected = predict(commanded.model, commanded.plan, theta)
    (lag,) = CATALOGUE["readback_lag"].candidates(known["reflectors"].setup)
    for share, same in ((1.0, True), (0.0, False), (-1.0, False)):
        # At the poses started from the commanded angles, with the angles that were read.
        model = commanded.model.with_effects(
            dataclasses.replace(lag, given=(("share", share, 0.0),))
        )
        off = np.abs(predict(model, read.plan, np.pad(theta, (0, 1))) - expected).max()
        assert (off < 1e-9) == same
        assert same or off > 1e-4


# --- random effects ------------------------------------------------------------------------------


@pytest.mark.thorough
def test_repeatability_widens_the_covariance(known):
    """W'W is the inverse of sigma^2 I + sum c c', c the response of each random effect."""
    it = known["laser_tracker"]
    sizes = {"X": 3.0, "Z": 5.0}
    fresh = [
        Repeatability(port=f"E{a}{a}", unit="um", placement=a, given=(("size", s, 0.0),))
        for a, s in sizes.items()
    ]
    model = it.model.with_effects(*fresh)
    assert model.entries == it.model.entries
    whitener = declared_whitener(model, it.measurement)
    got = np.linalg.inv(np.swapaxes(whitener, 1, 2) @ whitener)
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    expected = np.einsum("ni,ij->nij", sigma**2, np.eye(3))
    zero = np.zeros(len(it.theta))
    for axis, size in sizes.items():
        step = it.effect(f"backlash:{axis}:size_um=2")  # 1 um in the direction of travel
        c = size * (it.readings(step, theta=zero) - it.readings(theta=zero))
        expected += np.einsum("ni,nj->nij", c, c)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    alone = declared_whitener(it.model, it.measurement)
    np.testing.assert_allclose(np.linalg.inv(alone), np.einsum("ni,ij->nij", sigma, np.eye(3)))
    # Without a declared value, the prior's sigma.
    plain = it.model.with_effects(Repeatability(port="EXX", unit="um", placement="X"))
    one = it.model.with_effects(dataclasses.replace(fresh[0], given=(("size", 1.0, 0.0),)))
    ends = [declared_whitener(m, it.measurement) for m in (plain, one)]
    np.testing.assert_allclose(*ends)
