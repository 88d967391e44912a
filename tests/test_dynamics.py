"""Machines that move: matrices, discretisation, control and set points against what is known."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from vcal.dynamics.bodies import GROUND, Body, Drive, Machine, Scale, Spring, ToolPoint
from vcal.dynamics.closed_loop import (
    _exponential,
    check_sampled,
    check_stable,
    controlled,
    run,
    run_circle,
    settles,
    steady,
)
from vcal.dynamics.control import Controller
from vcal.dynamics.gains import propose
from vcal.dynamics.harmonic_response import response
from vcal.dynamics.modal_analysis import check_supported, modes
from vcal.dynamics.quasi_static import compliance
from vcal.dynamics.setpoints import Limits, SetCircle, positioning
from vcal.dynamics.structure import assemble
from vcal.machine.chain import chain_from_string

NONE = jnp.zeros(3)


def one_slide(mass=600.0, inertia=60.0, h=0.2, lever=-0.42, loss=0.0, half=0.25, **springs):
    """A slide along Z on four carriages, pushed h beside its centre of gravity along X."""
    stiffness = jnp.array([4e8, 4e8, 0.0])
    carriages = [
        Spring("carriages", "Z", GROUND, "Z", jnp.array([x, 0.0, z]), stiffness, NONE, NONE)
        for x in (-half, half)
        for z in (-half, half)
    ]
    return Machine(
        chain_from_string("w b Z t"),
        (Body("Z", "Z", mass, inertia * jnp.eye(3), NONE),),
        tuple(carriages),
        (Drive("Z", "Z", GROUND, "Z", jnp.array([h, 0.0, 0.0]), None, 0.0),),
        (Scale("Z", "Z", GROUND, "Z", NONE),),
        ToolPoint("Z", GROUND, "Z", jnp.array([0.0, 0.0, lever])),
        loss,
    )


def screw_slide(mass=300.0, motor=120.0, screw=1.5e8, loss=2e-4):
    """A slide along Z that a screw pushes through its centre of gravity."""
    given = one_slide(mass=mass, h=0.0, loss=loss)
    drive = Drive("Z", "Z", GROUND, "Z", NONE, screw, motor)
    return dataclasses.replace(given, drives=(drive,))


# --- statics and modes ---------------------------------------------------------------------------


@pytest.mark.parametrize("h, lever", [(0.2, -0.42), (-0.1, 0.3), (0.0, 0.5)])
@pytest.mark.thorough
def test_crosstalk_of_one_slide(h, lever):
    """E = -m h L / k_phi across, with k_phi = sum of k r^2, and no in-talk at the scale."""
    found = np.asarray(compliance(assemble(one_slide(h=h, lever=lever))))
    k_phi = 4 * 4e8 * 0.25**2
    np.testing.assert_allclose(found[0, 0], -600.0 * h * lever / k_phi, rtol=1e-10, atol=1e-20)
    np.testing.assert_allclose(found[1:, 0], 0.0, atol=1e-18)


def test_intalk_of_a_tool_beside_the_scale():
    """A tool l across from the scale turns with the slide: m h l / k_phi along the axis."""
    given = one_slide()
    end = dataclasses.replace(given.tool_point, point=jnp.array([0.3, 0.0, 0.0]))
    found = np.asarray(compliance(assemble(dataclasses.replace(given, tool_point=end))))
    np.testing.assert_allclose(found[2, 0], 600.0 * 0.2 * 0.3 / 1e8, rtol=1e-10)


def test_static_deflection():
    s = assemble(one_slide())
    weight = np.array([600.0 * 9.81, 0.0, 0.0, 0.0, 0.0, 0.0])
    held = np.asarray(s.stiffness) + 1e9 * np.asarray(s.force) @ np.asarray(s.force).T
    sag = np.asarray(s.tool) @ np.linalg.solve(held, weight)
    np.testing.assert_allclose(sag[0], 600.0 * 9.81 / 1.6e9, rtol=1e-9)


def test_modes_of_two_masses():
    """Slide and motor on a screw that is free to move: omega^2 = k (1/m1 + 1/m2)."""
    found = modes(assemble(screw_slide()), rigid=True)
    free = np.sqrt(1.5e8 * (1 / 300 + 1 / 120)) / (2 * np.pi)
    assert np.abs(found.hz - free).min() < 1e-9 * free
    k = int(np.argmin(np.abs(found.hz - free)))
    np.testing.assert_allclose(found.damping[k], 2e-4 * 2 * np.pi * free / 2, rtol=1e-9)
    # In the others the carriages bend: about all three axes, and along X and Y.
    others = [0.0, *[np.sqrt(1e8 / 60)] * 3, *[np.sqrt(1.6e9 / 300)] * 2]
    kept = np.delete(2 * np.pi * found.hz, k)
    np.testing.assert_allclose(kept, others, rtol=1e-9, atol=1e-3)


@pytest.mark.thorough
def test_matrices_depend_on_the_position():
    """The carriages of an upper slide move with it over the lower one."""
    lower = one_slide().bodies[0]
    chain = chain_from_string("w b X Z t")
    upper = Body("X", "X", 100.0, jnp.eye(3), jnp.array([0.0, 0.0, 0.3]))
    at = jnp.array([0.0, 0.0, 0.2])
    spring = Spring("carriages", "X", "Z", "X", at, jnp.array([0.0, 1e8, 2e8]), NONE, NONE)
    # Z carries X here: from the bed Z comes first.
    chain = chain_from_string("w b Z X t")
    machine = Machine(
        chain,
        (lower, upper),
        (*one_slide().springs, spring),
        (
            Drive("Z", "Z", GROUND, "Z", NONE, None, 0.0),
            Drive("X", "X", "Z", "X", at, None, 0.0),
        ),
        (Scale("Z", "Z", GROUND, "Z", NONE), Scale("X", "X", "Z", "X", at)),
        ToolPoint("X", GROUND, "X", at),
        0.0,
    )
    here, there = (assemble(machine, jnp.array([0.0, x])) for x in (0.0, 0.25))
    assert machine.axes == ("Z", "X")
    # Seen from the lower slide, the spring along Z has got a lever of 0.25 m about Y.
    turned = np.asarray(there.stiffness - here.stiffness)[4, 4]
    np.testing.assert_allclose(turned, 2e8 * 0.25**2, rtol=1e-9)
    np.testing.assert_allclose(here.mass, there.mass)


def test_a_body_without_support():
    with pytest.raises(ValueError, match="body Z: found no support about"):
        given = one_slide()
        check_supported(assemble(dataclasses.replace(given, springs=given.springs[:1])), ["Z"])
    check_supported(assemble(one_slide()), ["Z"])


# --- time ----------------------------------------------------------------------------------------


def loop_of(machine, T=1e-3, delay=0.0, Kv=40.0, w=120.0, Tn=0.05, f=0.0):
    s = assemble(machine)
    c = Controller.of(s, position_gain=Kv, bandwidth=w, integral_time=Tn, feed_forward=f,
                      delay=delay, sample_time=T)  # fmt: skip
    return s, c, controlled(s, c)


@pytest.mark.thorough
def test_energy_is_kept_without_damping_and_control():
    s, _, loop = loop_of(screw_slide(loss=0.0), w=1e-30)
    state = np.zeros(loop.transition.shape[0])
    n = s.size
    state[:n] = 1e-5 * np.random.default_rng(0).standard_normal(n)

    def energy(x):
        q, v = x[:n], 1e3 * x[n : 2 * n]
        return 0.5 * v @ np.asarray(s.mass) @ v + 0.5 * q @ np.asarray(s.stiffness) @ q

    before = energy(state)
    for _ in range(2000):
        state = np.asarray(loop.transition) @ state
    np.testing.assert_allclose(energy(state), before, rtol=1e-9)


@pytest.mark.parametrize("Tn", [0.05, 1e9])
@pytest.mark.thorough
def test_step_of_a_rigid_mass(Tn):
    """PPI on a rigid mass, by a matrix of three states written down by hand."""
    T, Kv, w, m = 1e-3, 40.0, 120.0, 600.0
    _, _, loop = loop_of(one_slide(h=0.0), T=T, Kv=Kv, w=w, Tn=Tn)
    n = 300
    asked = np.full((n, 1), 1e-3)
    found = run(loop, asked, 0 * asked)
    x = v = i = 0.0
    for k in range(n):
        np.testing.assert_allclose(found.scale[k, 0], x, rtol=1e-9, atol=1e-15)
        e = Kv * (1e-3 - x) - v
        force = m * w * (e + i)
        np.testing.assert_allclose(found.acceleration[k, 0], force / m, rtol=1e-9, atol=1e-12)
        x, v, i = x + v * T + force / m * T**2 / 2, v + force / m * T, i + T / Tn * e


@pytest.mark.slow
def test_step_in_the_limit_of_fast_samples():
    """x'' = w (Kv (1 - x) - x'), the second-order system of a P-P cascade."""
    Kv, w = 40.0, 120.0
    _, _, loop = loop_of(one_slide(h=0.0), T=2e-5, Kv=Kv, w=w, Tn=1e9)
    n = 5000
    found = np.asarray(run(loop, np.ones((n, 1)), np.zeros((n, 1))).scale[:, 0])
    t = 2e-5 * np.arange(n)
    omega, decay = np.sqrt(w * Kv - w**2 / 4), w / 2
    expected = 1 - np.exp(-decay * t) * (np.cos(omega * t) + decay / omega * np.sin(omega * t))
    np.testing.assert_allclose(found, expected, atol=2e-3)


@pytest.mark.parametrize("delay", [0.0, 0.3e-3, 1.0e-3, 1.6e-3])
def test_against_an_independent_integrator(delay):
    """Plant by scipy between the instants at which the force changes; controller by hand."""
    T, Kv, w, Tn, f = 1e-3, 40.0, 100.0, 0.05, 0.4
    machine = dataclasses.replace(one_slide(loss=3e-4), drives=screw_slide().drives)
    s, _, loop = loop_of(machine, T=T, delay=delay, Kv=Kv, w=w, Tn=Tn, f=f)
    profile = positioning(0.002, Limits(0.5, 10.0, 250.0))
    n = 40
    asked = profile(T * np.arange(n))
    found = run(loop, asked[:, :1], asked[:, 1:2])
    M, D, K, B = (np.asarray(m) for m in (s.mass, s.damping, s.stiffness, s.force))
    size, inverse = s.size, np.linalg.inv(M)

    def flow(t, y, force):
        q, v = y[:size], y[size:]
        return np.r_[v, inverse @ (B[:, 0] * force - D @ v - K @ q)]

    y, integral, forces = np.zeros(2 * size), 0.0, {}
    moved = float(s.moved_mass[0])
    for k in range(n):
        np.testing.assert_allclose(np.asarray(found.tool[k]), np.asarray(s.tool) @ y[:size],
                                   rtol=1e-6, atol=1e-12)  # fmt: skip
        z, v = float((s.scale @ y[:size])[0]), float((s.pace @ y[size:])[0])
        e = Kv * (asked[k, 0] - z) + f * asked[k, 1] - v
        forces[k] = moved * w * (e + integral)
        integral += T / Tn * e
        # The force of sample j acts from j T + delay on.
        ends = sorted({0.0, T, *(x for j in forces for x in [(j - k) * T + delay] if 0 < x < T)})
        for a, b in zip(ends[:-1], ends[1:], strict=True):
            acting = [j for j in forces if j * T + delay <= k * T + a + 1e-12]
            force = forces[max(acting)] if acting else 0.0
            y = solve_ivp(flow, (a, b), y, args=(force,), method="DOP853", rtol=1e-11,
                          atol=1e-16).y[:, -1]  # fmt: skip


def test_circles_settle():
    """The steady state is what is left of a circle that begins at rest."""
    _, _, loop = loop_of(one_slide(loss=1e-3), T=1e-3)
    omega = 45.0
    t = 1e-3 * np.arange(3000)
    z = 0.002 * np.sin(omega * t)
    found = run(loop, z[:, None], (0.002 * omega * np.cos(omega * t))[:, None])
    settled = run_circle(loop, jnp.array([-0.002j]), omega, t)
    for name in ("scale", "velocity", "acceleration", "tool", "error"):
        whole, end = np.asarray(getattr(settled, name)), np.asarray(getattr(found, name))[-200:]
        np.testing.assert_allclose(end, whole[-200:], atol=1e-9 * np.abs(whole).max())
    # Velocity and acceleration are those of the motion; the acceleration jumps with the force, of
    # which the mean over a sample belongs to the middle of it.
    amplitude = np.abs(np.asarray(steady(loop, omega))[:, 0] @ np.asarray(loop.scale)[0])
    assert np.abs(settled.velocity).max() == pytest.approx(0.002 * omega * amplitude, rel=1e-2)
    assert np.abs(settled.acceleration).max() == pytest.approx(
        0.002 * omega**2 * amplitude, rel=0.1
    )


@pytest.mark.parametrize(
    "delay", [0.3e-3, *(pytest.param(d, marks=pytest.mark.thorough) for d in (0.0, 1.0e-3, 1.6e-3))]
)
@pytest.mark.thorough
def test_sampled_frequency_response(delay):
    """The sum over the harmonics of the sampling is the steady state of the exact matrices."""
    given = one_slide(loss=3e-4)
    screw = dataclasses.replace(given.drives[0], stiffness=1.5e8, motor_mass=120.0)
    machine = dataclasses.replace(given, drives=(screw,))
    s, c, loop = loop_of(machine, delay=delay, f=0.4)
    quick = jax.jit(response, static_argnums=3)
    for omega in (5.0, 48.5, 200.0):
        states = np.asarray(steady(loop, omega))
        exact = np.asarray(loop.scale) @ states, np.asarray(loop.structural) @ states
        for aliases, digits in ((1, 1e-4), (30, 1e-7), (1000, 1e-9)):
            found = quick(s, c, omega, aliases)
            for a, b in zip(found, exact, strict=True):
                np.testing.assert_allclose(a, b, atol=digits * np.abs(b).max())


@pytest.mark.thorough
def test_derivative_of_the_sampled_frequency_response():
    def read(p):
        given = screw_slide(mass=300.0 * p[0], loss=3e-4 * p[1])
        stiff = [dataclasses.replace(k, stiffness=k.stiffness * p[2]) for k in given.springs]
        s = assemble(dataclasses.replace(given, springs=tuple(stiff)))
        c = Controller.of(s, position_gain=40.0, bandwidth=120.0, integral_time=0.05,
                          delay=0.3e-3 * p[3])  # fmt: skip
        scale, error = response(s, c, 48.5 * p[4])
        return jnp.concatenate([scale.ravel(), 1e3 * error.ravel()])

    at = jnp.ones(5)
    slope = np.asarray(jax.jit(jax.jacfwd(read))(at))
    quick = jax.jit(read)
    for i in range(5):
        d = [(quick(at.at[i].add(h)) - quick(at.at[i].add(-h))) / (2 * h) for h in (2e-3, 1e-3)]
        np.testing.assert_allclose((4 * d[1] - d[0]) / 3, slope[:, i],
                                   atol=1e-7 * np.abs(slope[:, i]).max())  # fmt: skip


def test_slow_circles_bend_as_the_compliance_says():
    machine = one_slide(loss=1e-4)
    s, _, loop = loop_of(machine, T=1e-3)
    omega = 2.0
    t = np.linspace(0.0, np.pi, 200)
    found = run_circle(loop, jnp.array([0.1 + 0.0j]), omega, t)
    a = -(omega**2) * np.asarray(found.scale[:, 0])
    E = np.linalg.lstsq(a[:, None], np.asarray(found.error), rcond=None)[0][0]
    np.testing.assert_allclose(E, np.asarray(compliance(s))[:, 0], rtol=2e-3, atol=1e-12)


@pytest.mark.thorough
def test_gradient_through_a_circle():
    """Stiffness, mass, place of the drive, gain and delay, through one full turn in time."""
    t = 1e-3 * np.arange(140)
    z, v = 0.002 * np.sin(45.0 * t)[:, None], 0.09 * np.cos(45.0 * t)[:, None]

    @jax.jit
    def misfit(p):
        given = one_slide(mass=600.0 * p[0], h=0.2 * p[1], loss=1e-3 * p[2])
        stiff = [dataclasses.replace(k, stiffness=k.stiffness * p[3]) for k in given.springs]
        s = assemble(dataclasses.replace(given, springs=tuple(stiff)))
        c = Controller.of(s, position_gain=40.0 * p[4], bandwidth=120.0, integral_time=0.05,
                          delay=0.3e-3 * p[5])  # fmt: skip
        found = run(controlled(s, c), z, v)
        return 1e12 * (found.error**2).sum() + 1e6 * ((found.scale - z) ** 2).sum()

    at = jnp.ones(6)
    slope = np.asarray(jax.jacfwd(misfit)(at))
    np.testing.assert_allclose(np.asarray(jax.grad(misfit)(at)), slope, rtol=1e-8)
    for i in range(6):
        steps = [1e-3, 5e-4]
        d = [float(misfit(at.at[i].add(h)) - misfit(at.at[i].add(-h))) / (2 * h) for h in steps]
        assert (4 * d[1] - d[0]) / 3 == pytest.approx(slope[i], rel=1e-6)


def test_an_unstable_loop():
    _, _, loop = loop_of(screw_slide(), T=1e-3, Kv=400.0, w=900.0)
    with pytest.raises(ValueError, match=r"unstable loop, growing .* mostly in axis Z") as error:
        check_stable(loop)
    assert "damping" not in str(error.value)
    assert not settles(loop)
    # No circle settles in it; a program that has the loop for its argument cannot tell.
    circle = jnp.array([1e-3 + 0.0j]), 30.0, jnp.arange(3.0)
    with pytest.raises(ValueError, match="unstable loop"):
        run_circle(loop, *circle)
    with pytest.raises(ValueError, match="unstable loop"):
        jax.jit(lambda phasor: run_circle(loop, phasor, *circle[1:]).scale)(circle[0])
    assert np.isfinite(jax.jit(run_circle)(loop, *circle).scale).all()


@pytest.mark.parametrize(
    ("loss", "factors"), [(2e-4, (1, 30, 1e3, 1e5, 1e7)), (0.0, (1, 1e3, 1e5, 1e6, 1e8))]
)
def test_what_is_too_fast_for_the_sample_time_is_told(loss, factors):
    """Either the motion over one sample is that of scipy's exponential, or it is refused."""
    told = []
    for factor in factors:
        machine = screw_slide(loss=loss)
        springs = tuple(
            dataclasses.replace(spring, stiffness=factor * spring.stiffness)
            for spring in machine.springs
        )
        s, c, loop = loop_of(dataclasses.replace(machine, springs=springs), T=1e-3)
        n = s.size
        flow = np.zeros((2 * n, 2 * n))
        flow[:n, n:] = np.eye(n)
        inverse = np.linalg.inv(np.asarray(s.mass))
        flow[n:] = -inverse @ np.hstack([np.asarray(s.stiffness), np.asarray(s.damping)])
        scale = np.diag(np.repeat([1.0, 1e-3], n))  # velocities in units of 1000 rad/s
        expected = scale @ expm(flow * 1e-3) @ np.linalg.inv(scale)
        rest = np.asarray(_exponential(scale @ flow @ np.linalg.inv(scale) * 1e-3))
        try:
            check_sampled(s, 1e-3)
        except ValueError as error:
            assert "far too stiff for the sample time" in str(error)
            with pytest.raises(ValueError, match="far too stiff for the sample time"):
                check_stable(loop, s)
            told.append(factor)
        else:
            np.testing.assert_allclose(rest, expected, atol=1e-7)
    assert factors[0] not in told and factors[-1] in told


def test_how_fast_an_unstable_loop_grows():
    """A pole at exp(s T) is twofold after log(2) / s."""
    _, _, loop = loop_of(screw_slide(), T=1e-3)
    for within in (2e-3, 300.0):
        poles = 2.0 ** (1e-3 / within) * np.eye(loop.transition.shape[0])
        with pytest.raises(ValueError, match=f"growing twofold within {within:g} s"):
            check_stable(dataclasses.replace(loop, transition=poles))
    with pytest.raises(ValueError, match="without decay"):
        check_stable(dataclasses.replace(loop, transition=poles / poles[0, 0]))


def test_a_loop_without_damping():
    """No gain makes a delayed loop stable then: the message says what does."""
    for Kv, w in ((40.0, 150.0), (1.0, 3.0)):
        s, _, loop = loop_of(screw_slide(loss=0.0), T=1e-3, delay=1e-3, Kv=Kv, w=w, Tn=1.0)
        with pytest.raises(ValueError, match="declare the damping of the springs, which have none"):
            check_stable(loop, s)
    with pytest.raises(ValueError, match="found no bandwidth .*; declare the damping"):
        propose(s, delay=1e-3, sample_time=1e-3)
    damped, _, loop = loop_of(screw_slide(), T=1e-3, Kv=400.0, w=900.0)
    with pytest.raises(ValueError, match="; lower position_gain"):
        check_stable(loop, damped)


@pytest.mark.thorough
def test_settles_agrees_with_the_poles():
    """On both sides of the gain at which the largest pole leaves the unit circle."""
    s = assemble(screw_slide())
    c = propose(s, sample_time=0.5e-3, delay=0.5e-3)
    sides = []
    for factor in np.geomspace(0.5, 8.0, 25):
        loop = controlled(s, dataclasses.replace(c, velocity_gain=factor * c.velocity_gain))
        inside = np.abs(np.linalg.eigvals(np.asarray(loop.transition))).max() < 1.0
        assert bool(settles(loop)) == inside
        sides.append(inside)
    assert sides[0] and not sides[-1]


@pytest.mark.parametrize("delay", [0.0, 0.5e-3])
def test_proposed_gains_settle(delay):
    s = assemble(screw_slide(loss=1e-3))
    c = propose(s, sample_time=0.5e-3, delay=delay)
    loop = controlled(s, c)
    assert settles(loop)
    check_stable(loop)
    check_stable(controlled(s, dataclasses.replace(c, velocity_gain=1.9 * c.velocity_gain)))
    n = 4000
    end = run(loop, np.full((n, 1), 1e-3), np.zeros((n, 1)))
    assert float(end.scale[-1, 0]) == pytest.approx(1e-3, rel=1e-4)
    assert float(end.scale.max()) < 1.5e-3


# --- set points ----------------------------------------------------------------------------------


def test_positioning_of_the_publication():
    """20 mm, 30 m/min, 10 m/s^2, 250 m/s^3 is limited by jerk alone: (S J^2 / 2)^(1/3)."""
    profile = positioning(0.02, Limits(0.5, 10.0, 250.0))
    assert profile.peak_acceleration == pytest.approx((0.02 * 250.0**2 / 2) ** (1 / 3), rel=1e-12)
    assert profile.peak_acceleration == pytest.approx(8.55, rel=1e-3)
    assert profile.peak_velocity == pytest.approx(0.292, abs=5e-4)
    steps = np.diff(profile.times)
    np.testing.assert_allclose(steps[steps > 1e-12], 34.2e-3, atol=5e-5)


@pytest.mark.parametrize("seed", range(12))
def test_profiles_keep_to_their_limits(seed):
    rng = np.random.default_rng(seed)
    length = rng.choice([-1, 1]) * 10 ** rng.uniform(-4, 0.5)
    limits = Limits(*(10 ** rng.uniform(low, high) for low, high in ((-2, 0.3), (-1, 1.3), (0, 3))))
    profile = positioning(length, limits)
    t = np.unique([np.linspace(*ends, 2001) for ends in itertools.pairwise(profile.times)])
    s, v, a = profile(t).T
    assert s[-1] == pytest.approx(length, rel=1e-9) and abs(v[-1]) < 1e-9 and abs(a[-1]) < 1e-9
    most = [np.abs(x).max() for x in (v, a)]
    assert most[0] <= limits.velocity * (1 + 1e-9)
    assert most[1] <= limits.acceleration * (1 + 1e-9)
    # Each is the integral of the next one.
    for whole, rate in ((s, v), (v, a)):
        summed = np.r_[0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))]
        np.testing.assert_allclose(summed, whole, atol=2e-5 * np.abs(whole).max())
    # Nothing faster: some limit is reached at any time.
    reached = (np.abs(v) > (1 - 1e-6) * limits.velocity) | (
        np.abs(a) > (1 - 1e-6) * limits.acceleration
    )
    jerk = np.abs(np.gradient(a, t)) > 0.5 * limits.jerk
    assert (reached | jerk)[5:-5].mean() > 0.99


def test_circles_of_the_publication():
    """r = 2 mm at 4.7 m/s^2: 48.5 rad/s; at 5 m/s^2 about 8 Hz."""
    assert SetCircle("ZX", 1, 2e-3, 4.7).omega == pytest.approx(48.5, abs=0.05)
    assert SetCircle("ZX", 1, 2e-3, 5.0).omega / (2 * np.pi) == pytest.approx(8.0, abs=0.05)
    found = SetCircle("ZX", -1, 2e-3, 4.7).phasor(("X", "Y", "Z"))
    np.testing.assert_allclose(found, [2e-3j, 0, 2e-3])


def test_mistakes():
    with pytest.raises(ValueError, match="found a feed of 0.1 m/s, expected at most 0.05"):
        SetCircle("XY", 1, 2e-3, 5.0).check(Limits(velocity=0.05))
    with pytest.raises(ValueError, match="found an acceleration of 5 m/s"):
        SetCircle("XY", 1, 2e-3, 5.0).check(Limits(acceleration=4.0))
    with pytest.raises(ValueError, match="plane: found 'XX'"):
        SetCircle("XX", 1, 2e-3, 5.0).phasor(("X", "Y", "Z"))
    with pytest.raises(ValueError, match="found length = 0 m"):
        positioning(0.0, Limits(1.0, 1.0, 1.0))
    for length in (np.nan, np.inf):
        with pytest.raises(ValueError, match="expected a length .* all of them finite"):
            positioning(length, Limits(1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="found the sense 2, expected 1 or -1"):
        SetCircle("XY", 2, 2e-3, 5.0)
    with pytest.raises(ValueError, match="a radius of 0 mm"):
        SetCircle("XY", 1, 0.0, 5.0)


@pytest.mark.parametrize(
    ("position", "velocity"), [((5, 3), (5, 3)), ((5,), (5,)), ((5, 1), (4, 1)), ((5, 1), (5, 2))]
)
def test_set_points_of_another_shape(position, velocity):
    _, _, loop = loop_of(screw_slide())
    with pytest.raises(ValueError, match=r"expected \(n, 1\) of both, .* each of Z; correct"):
        run(loop, np.zeros(position), np.zeros(velocity))
    assert run(loop, np.zeros((0, 1)), np.zeros((0, 1))).scale.shape == (0, 1)


@pytest.mark.thorough
def test_places_and_circles_of_another_number_of_axes():
    """Also in a program: shapes are known there."""
    machine = screw_slide()
    for places in (np.zeros(3), np.zeros((1, 1)), np.zeros(())):
        with pytest.raises(ValueError, match=r"positions: found .* expected \(1,\), one for each"):
            assemble(machine, places)
    with pytest.raises(ValueError, match="positions: found"):
        jax.vmap(lambda q: assemble(machine, q).mass)(jnp.zeros((4, 3)))
    assert jax.vmap(lambda q: assemble(machine, q).mass)(jnp.zeros((4, 1))).shape[0] == 4
    _, _, loop = loop_of(machine)
    with pytest.raises(ValueError, match=r"phasor: found .* expected \(1,\), one number for each"):
        run_circle(loop, jnp.array([1e-3, 0.0]), 30.0, np.arange(5) * 1e-3)


@pytest.mark.parametrize("delay", [-0.5e-3, 2.0e-3, 2.6e-3])
def test_delays_that_no_loop_has(delay):
    """Forces of more than two samples are not kept: the loop would be another one."""
    s = assemble(screw_slide())
    with pytest.raises(ValueError, match="a delay of .* less than two sample times"):
        propose(s, delay=delay, sample_time=1e-3)
    c = Controller.of(s, position_gain=40.0, bandwidth=120.0, integral_time=0.05, delay=1.5e-3)
    with pytest.raises(ValueError, match="at a sample time of 0.5 ms"):
        dataclasses.replace(c, sample_time=0.5e-3)
