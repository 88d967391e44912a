"""Machines with friction against scipy, closed forms, and the exact machine without."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vcal.dynamics import Controller, assemble, controlled, run
from vcal.dynamics.bodies import GROUND, Body, Drive, Friction, Machine, Scale, Spring, ToolPoint
from vcal.dynamics.friction import rubbing, run_with_friction
from vcal.errors import StudyError
from vcal.machine.chain import chain_from_string
from vcal.reproduce.acceleration.setting import DESCRIPTION
from vcal.study.dynamic_machine import load_machine

NONE = jnp.zeros(3)
RUB = Friction("Z", "Z", NONE, 150.0, 200.0, 2e-3, 5e-6, 800.0)
AREA = """
[[friction]]
axis = "Z"
coulomb_N = 150
stiction_N = 200
presliding_um = 5
"""


def slide(*friction):
    """600 kg along Z on four carriages, pushed beside its centre of gravity, on its own scale."""
    stiffness = jnp.array([4e8, 4e8, 0.0])
    carriages = tuple(
        Spring("carriages", "Z", GROUND, "Z", jnp.array([x, 0.0, z]), stiffness, NONE, NONE)
        for x in (-0.25, 0.25)
        for z in (-0.25, 0.25)
    )
    at = jnp.array([0.2, 0.0, 0.0])
    machine = Machine(
        chain_from_string("w b Z t"),
        (Body("Z", "Z", 600.0, 60.0 * jnp.eye(3), NONE),),
        carriages,
        (Drive("Z", "Z", GROUND, "Z", at, None, 0.0),),
        (Scale("Z", "Z", GROUND, "Z", at),),
        ToolPoint("Z", GROUND, "Z", jnp.array([0.0, 0.0, -0.4])),
        1e-3,
        friction,
    )
    return machine


def driven(machine, T=1e-3, delay=0.0):
    s = assemble(machine)
    return Controller.of(s, position_gain=40.0, bandwidth=120.0, integral_time=0.05,
                         feed_forward=0.4, delay=delay, sample_time=T)  # fmt: skip


def circle(n, omega=40.0, T=1e-3, r=2e-3):
    t = T * np.arange(n)
    return r * np.sin(omega * t)[:, None], r * omega * np.cos(omega * t)[:, None]


@pytest.mark.thorough
def test_without_any_force_it_is_the_exact_machine():
    weak = dataclasses.replace(RUB, coulomb=1e-12, stiction=1e-12, viscous=0.0)
    machine = slide(weak)
    controller = driven(machine, delay=0.3e-3)
    asked = circle(60)
    exact = run(controlled(assemble(machine), controller), *asked)
    found = run_with_friction(machine, controller, *asked, tolerance=1e-9)
    for name in ("t", "scale", "velocity", "acceleration", "tool", "error"):
        a, b = np.asarray(getattr(found, name)), np.asarray(getattr(exact, name))
        np.testing.assert_allclose(a, b, atol=1e-7 * np.abs(b).max(), err_msg=name)


@pytest.mark.parametrize(
    "delay", [0.3e-3, *(pytest.param(d, marks=pytest.mark.thorough) for d in (0.0, 1.4e-3))]
)
@pytest.mark.thorough
def test_against_an_independent_integrator(delay):
    """Radau of scipy on equations written down here, controller by hand."""
    T = 1e-3
    machine = slide(RUB)
    controller = driven(machine, T, delay)
    s = assemble(machine)
    n = 40
    asked = circle(n, omega=80.0)
    found = run_with_friction(machine, controller, *asked, tolerance=1e-10)
    M, D, K, B = (np.asarray(m) for m in (s.mass, s.damping, s.stiffness, s.force))
    size, inverse = s.size, np.linalg.inv(M)
    row = np.zeros(size)
    row[2] = 1.0  # the middle of the slide, along Z
    bristle = 150.0 / 5e-6
    damping = 1.4 * np.sqrt(bristle * 600.0)

    def flow(t, y, force):
        q, v, z = y[:size], y[size : 2 * size], y[-1]
        w = row @ v
        g = 150.0 + 50.0 * np.exp(-((w / 2e-3) ** 2))
        rate = w - bristle * abs(w) / g * z
        rub = bristle * z + damping * rate + 800.0 * w
        return np.r_[v, inverse @ (B[:, 0] * force - D @ v - K @ q - row * rub), rate]

    y, integral, forces = np.zeros(2 * size + 1), 0.0, {}
    Kp = float(controller.velocity_gain[0])
    size_um = np.abs(np.asarray(found.tool)).max(0)
    for k in range(n):
        np.testing.assert_allclose(np.asarray(found.tool[k]), np.asarray(s.tool) @ y[:size],
                                   atol=1e-6 * size_um.max())  # fmt: skip
        place, pace = float((s.scale @ y[:size])[0]), float((s.pace @ y[size : 2 * size])[0])
        e = 40.0 * (asked[0][k, 0] - place) + 0.4 * asked[1][k, 0] - pace
        forces[k] = Kp * (e + integral)
        integral += T / 0.05 * e
        ends = sorted({0.0, T, *(x for j in forces for x in [(j - k) * T + delay] if 0 < x < T)})
        for a, b in zip(ends[:-1], ends[1:], strict=True):
            acting = [j for j in forces if j * T + delay <= k * T + a + 1e-12]
            force = forces[max(acting)] if acting else 0.0
            y = solve_ivp(flow, (a, b), y, args=(force,), method="Radau", rtol=1e-9,
                          atol=1e-14).y[:, -1]  # fmt: skip


def test_sliding_and_sticking():
    """Steady sliding has a closed form; a small deflection is that of the bristles."""
    machine = slide(RUB)
    rub = rubbing(machine, assemble(machine))
    for w in (1e-4, 1e-3, 0.1):
        g = 150.0 + 50.0 * np.exp(-((w / 2e-3) ** 2))
        force, rate = rub.slide(jnp.array([w]), jnp.array([g / 3e7]))
        assert float(rate[0]) == pytest.approx(0.0, abs=1e-15)
        assert float(force[0]) == pytest.approx(g + 800.0 * w, rel=1e-12)
    force, _ = rub.slide(jnp.zeros(1), jnp.array([1e-6]))
    assert float(force[0]) == pytest.approx(30.0)


@pytest.mark.thorough
def test_quadrant_peaks():
    """After a reversal the axis sticks until its drive has built up the force the other way."""
    n, T, omega = 700, 0.5e-3, 10.0
    # A slow circle: the reversals are a quarter of a turn away from the start.
    free = slide(dataclasses.replace(RUB, coulomb=1e-9, stiction=1e-9, viscous=0.0))
    asked = circle(n, omega, T)
    lag = [
        asked[0][:, 0] - np.asarray(run_with_friction(m, driven(m, T), *asked).scale[:, 0])
        for m in (slide(RUB), free)
    ]
    extra = lag[0] - lag[1]
    reversal = int(np.pi / 2 / omega / T)
    before = np.abs(extra[reversal - 60 : reversal - 10]).mean()
    peak = extra[reversal : reversal + 120]
    # It sticks where it was: the error is that of a force that changes its sign.
    assert np.abs(peak - peak[0]).max() > 2.0 * before
    assert np.sign(extra[reversal - 20]) != np.sign(extra[reversal + 100])


@pytest.mark.thorough
def test_description(tmp_path):
    path = tmp_path / "machine.toml"
    text = DESCRIPTION.read_text(encoding="utf-8").replace("[tool_point]", AREA + "\n[tool_point]")
    path.write_text(text, encoding="utf-8")
    machine, controller, _ = load_machine(path)
    (found,) = machine.friction
    assert found.axis == "Z" and found.presliding == pytest.approx(5e-6)
    np.testing.assert_allclose(found.point, machine.drives[2].point)
    rub = rubbing(machine, assemble(machine))
    np.testing.assert_allclose(rub.rows @ assemble(machine).travel, [[0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(rub.stiffness, 3e7)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ('axis = "Z"\ncoul', 'axis = "W"\ncoul', "key friction.0.axis: found 'W'"),
        ("stiction_N = 200", "stiction_N = 100", "found 100, expected at least coulomb_N = 150"),
        ("presliding_um = 5", "presliding_um = 0", "friction.0.presliding_um"),
    ],
)
def test_mistakes(tmp_path, old, new, message):
    area = AREA.replace(old, new)
    assert area != AREA
    path = tmp_path / "machine.toml"
    text = DESCRIPTION.read_text(encoding="utf-8").replace("[tool_point]", area + "\n[tool_point]")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(StudyError) as error:
        load_machine(path)
    assert message in str(error.value)


def test_set_points_of_another_shape():
    machine = slide(RUB)
    with pytest.raises(ValueError, match=r"set points: found .* expected \(n, 1\) of both"):
        run_with_friction(machine, driven(machine), np.zeros((5, 1)), np.zeros((4, 1)))


def test_a_machine_without_friction():
    machine = slide()
    with pytest.raises(ValueError, match="found no friction"):
        run_with_friction(machine, driven(machine), *circle(3))
