"""Machines under their controllers: simulated seconds per second, and campaigns of R-tests.

    python benchmarks/dynamics.py

The machine of `vcal reproduce acceleration` (57 states, sampled at 4 kHz) over the 20 mm
positioning: by vcal, exactly discretised, and by scipy's integrators on the same model, restarted
whenever a force changes, with the controllers in numpy. The same with friction in all guideways.
Then machines measured by thirty circles each, simulated sample by sample and identified.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
from records import parser_of, timed, write
from scipy.integrate import solve_ivp

import vcal
from vcal.dynamics import Noise, applied, assemble, campaign, circle_set, controlled, run
from vcal.dynamics.bodies import Friction
from vcal.dynamics.friction import Rubbing, rubbing, run_with_friction
from vcal.reproduce.acceleration.measured import MATRIX_U
from vcal.reproduce.acceleration.setting import (
    EXTERNAL_UM,
    INTERNAL_UM,
    LEVELS,
    RADIUS_M,
    SAMPLES,
    UNKNOWNS,
    described,
    move,
)

MANY = 64
TOLERANCE = 1e-6
"""Relative, of scipy's integrators; the absolute one is a millionth of the smallest state."""


def by_scipy(structure, controller, asked: np.ndarray, method: str, rub: Rubbing | None = None):
    """Tool points at the samples (n, 3), m, by an integrator of scipy."""
    M, D, K, B = (
        np.asarray(m)
        for m in (structure.mass, structure.damping, structure.stiffness, structure.force)
    )
    scale, pace, tool = (np.asarray(m) for m in (structure.scale, structure.pace, structure.tool))
    n, axes, T, delay = len(M), B.shape[1], controller.sample_time, float(controller.delay)
    Kv, Kp, Tn, f = (
        np.asarray(m)
        for m in (
            controller.position_gain,
            controller.velocity_gain,
            controller.integral_time,
            controller.feed_forward,
        )
    )
    by_q, by_v, by_force = (np.linalg.solve(M, m) for m in (-K, -D, B))
    bristles = 0
    if rub is not None:
        rows, Fc, Fs, ws, s, s1, c = (np.asarray(m) for m in jax.tree.leaves(rub))
        by_rub, bristles = np.linalg.solve(M, -rows.T), len(Fc)

    def flow(_, y, force):
        q, v = y[:n], y[n : 2 * n]
        a = by_q @ q + by_v @ v + by_force @ force
        if not bristles:
            return np.concatenate([v, a])
        w, z = rows @ v, y[2 * n :]
        rate = w - s * np.abs(w) * z / (Fc + (Fs - Fc) * np.exp(-((w / ws) ** 2)))
        return np.concatenate([v, a + by_rub @ (s * z + s1 * rate + c * w), rate])

    y, integral, late = np.zeros(2 * n + bristles), np.zeros(axes), int(delay // T)
    forces, found = [np.zeros(axes)] * (late + 1), []
    for r in asked:
        found.append(tool @ y[:n])
        e = Kv * (r[:axes] - scale @ y[:n]) + f * r[axes:] - pace @ y[n : 2 * n]
        forces.append(Kp * (e + integral))
        integral = integral + T / Tn * e
        part = delay - late * T
        for h, force in ((part, forces[-2 - late]), (T - part, forces[-1 - late])):
            if h > 0.0:
                y = solve_ivp(
                    flow, (0.0, h), y, method, args=(force,), rtol=TOLERANCE, atol=1e-12
                ).y[:, -1]
    return np.array(found)


def simulations(repeats: int) -> list[dict]:
    """Rows of the same move by every method, without and with friction."""
    machine, controller, _ = described()
    T = controller.sample_time
    t = T * np.arange(600)
    s, v, _ = move()(t).T
    along = np.array([0.0, 0.0, 1.0])
    asked = np.outer(s, along), np.outer(v, along)
    both = np.concatenate(asked, axis=1)
    structure = assemble(machine)
    rows = []

    def row(name: str, model: str, cold: float, warm: float, tool, simulated: float = 1.0) -> None:
        first = next((r for r in rows if r["model"] == model), None)
        tool = np.asarray(tool)
        rows.append(
            {
                "model": model,
                "way": name,
                "cold_s": cold,
                "warm_s": warm,
                "simulated_s": simulated * len(t) * T,
                "off_nm": 0.0 if first is None else 1e9 * float(np.abs(tool - first["tool"]).max()),
                "tool": tool,
            }
        )
        print({k: x for k, x in rows[-1].items() if k != "tool"}, flush=True)

    whole = jax.jit(lambda m, c: run(controlled(assemble(m), c), *asked).tool)
    cold, warm, tool = timed(lambda: whole(machine, controller), repeats)
    row("vcal, assembly and discretisation included", "linear", cold, warm, tool)
    loop = jax.jit(controlled)(structure, controller)
    alone = jax.jit(lambda loop: run(loop, *asked).tool)
    cold, warm, tool = timed(lambda: alone(loop), repeats)
    row("vcal, discretised before", "linear", cold, warm, tool)
    z = 0.3 * np.random.default_rng(0).standard_normal((MANY, len(UNKNOWNS)))
    z[0] = 0.0
    many = jax.jit(jax.vmap(lambda z: whole(*applied(UNKNOWNS, machine, controller, z))))
    cold, warm, tool = timed(lambda: many(jnp.asarray(z)), repeats)
    row(f"vcal, {MANY} machines at once", "linear", cold, warm, tool[0], MANY)
    for method in ("DOP853", "LSODA"):
        cold, warm, tool = timed(lambda m=method: by_scipy(structure, controller, both, m), 0)
        row(f"scipy, {method}", "linear", cold, warm, tool)

    friction = tuple(
        Friction(d.axis, d.link, d.point, 150.0, 200.0, 2e-3, 5e-6, 500.0) for d in machine.drives
    )
    rough = dataclasses.replace(machine, friction=friction)
    cold, warm, tool = timed(
        lambda: run_with_friction(rough, controller, *asked, tolerance=TOLERANCE).tool, repeats
    )
    row("vcal (diffrax)", "friction", cold, warm, tool)
    rub = rubbing(rough, structure)
    for method in ("DOP853", "LSODA"):
        cold, warm, tool = timed(lambda m=method: by_scipy(structure, controller, both, m, rub), 0)
        row(f"scipy, {method}", "friction", cold, warm, tool)
    return [{k: x for k, x in r.items() if k != "tool"} for r in rows]


def campaigns(draws: int) -> list[dict]:
    """Rows of a campaign of machines that are measured and identified, cold and warm."""
    machine, controller, _ = described()
    found = []
    for name in ("cold", "warm"):
        start = time.perf_counter()
        done = campaign(
            machine,
            controller,
            UNKNOWNS,
            circle_set(RADIUS_M, LEVELS),
            Noise(1e-6 * INTERNAL_UM, 1e-6 * EXTERNAL_UM, SAMPLES),
            draws=draws,
            seed=0,
            matrix_u=MATRIX_U,
        )
        found.append(
            {
                "run": name,
                "machines": draws,
                "circles": 6 * len(LEVELS),
                "wall_s": time.perf_counter() - start,
                "stable": int(done.stable.sum()),
                "converged": int(done.converged.sum()),
                "sd_of_pulls": float(done.pulls.std()),
                "within_U": float((np.abs(done.pulls) < 2.0).mean()),
            }
        )
        print(found[-1], flush=True)
    return found


def main() -> None:
    """Run everything and keep the times."""
    parser = parser_of(__doc__, "dynamics")
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    vcal.enable_float64()
    record = {
        "device": jax.devices()[0].device_kind,
        "campaigns": campaigns(options.draws),
        "simulations": simulations(options.repeats),
    }
    write(options.out, record)


if __name__ == "__main__":
    main()
