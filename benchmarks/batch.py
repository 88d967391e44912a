"""Identification inside Monte Carlo: time per draw of several methods on the same problem.

A tracker verification with 735 readings and 63 parameters (18 error motions of three functions,
three squareness errors, the station), machines drawn from the prior. The methods: scipy with a
numpy residual and finite differences; scipy with a compiled residual and Jacobian; optimistix
mapped over draws; vcal. The lower bounds ("floor"): the forward model with noise, and one matrix
product with noise.

    python benchmarks/batch.py

On a machine with a GPU the same command runs there; scipy stays on the host.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from records import parser_of, write
from scipy.optimize import least_squares

import vcal
from vcal.effects.geometric import ErrorMotion, GeometricErrors, LocationError
from vcal.identification.batch import identify_one, prepare_batch
from vcal.instruments.laser_tracker import LaserTracker
from vcal.machine.chain import chain_from_string
from vcal.machine.error_functions import Fourier
from vcal.machine.plan import Plan
from vcal.model.forward import Model
from vcal.model.simulate import draw, prepare
from vcal.numerics.normal_draws import standard_normal
from vcal.numerics.spatial import euler_xyz
from vcal.uncertainty import ParameterErrors, monte_carlo
from vcal.uncertainty.campaign import TOGETHER, side_by_side

PART = 125


def problem() -> tuple[Model, Plan]:
    """The model and the plan."""
    travel = {"X": (0.0, 3.0), "Y": (0.0, 1.5), "Z": (0.0, 1.2)}
    chain = chain_from_string("w X b Y Z t", travel, (0.05, 0.02, -0.3))
    motions = tuple(
        ErrorMotion(f"E{c}{a}", a, Fourier(travel[a], 0.0, 15e-6, [(1.0, 8e-6, 8e-6)]))
        for a in "XYZ"
        for c in "XYZABC"
    )
    square = tuple(LocationError.of(chain, n, 20e-6) for n in ("EC0Y", "EB0Z", "EA0Z"))
    tracker = LaserTracker(
        station=np.array([4.5, -1.2, 0.3]),
        orientation=np.asarray(euler_xyz(jnp.array([6e-4, 6e-4, 1.04]))),
        range_sigma=4e-6,
        range_sigma_per_m=0.8e-6,
        angle_sigma=5e-6,
    )
    axes = [np.linspace(0.1, 2.9, 7), np.linspace(0.1, 1.4, 7), np.linspace(0.1, 1.1, 5)]
    position = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    plan = Plan(("X", "Y", "Z"), position, {})
    errors = GeometricErrors(motions=motions, locations=square)
    return Model(chain, tracker, (errors, *tracker.effects(plan))), plan


class NumpyResidual:
    """The same residual in plain numpy, as written by hand for `scipy`."""

    def __init__(self, model: Model, plan: Plan, root_precision: np.ndarray, sigma: np.ndarray):
        terms = model.terms(plan)
        self.values, self.port = np.asarray(terms.values), np.asarray(terms.port)
        self.parameter, self.size = np.asarray(terms.parameter), len(model.layout)
        self.q, self.offset = plan.position, np.asarray(model.chain.tool_offset)
        self.tracker, self.root, self.sigma = model.instrument, root_precision, sigma
        self.scatter = np.zeros((len(self.port), self.size))
        self.scatter[np.arange(len(self.port)), self.port] = 1.0

    def readings(self, theta: np.ndarray) -> np.ndarray:
        """Range, azimuth, elevation of every row (n, 3)."""
        ports = (self.values * theta[self.parameter]) @ self.scatter
        x, y, z, tool, frame = (ports[:, 6 * i : 6 * i + 6] for i in range(5))
        along = np.eye(3)
        r = turn(y[:, 3:])
        t = self.q[:, 1:2] * along[1] + y[:, :3]
        t = t + apply(r, self.q[:, 2:] * along[2] + z[:, :3])
        r = r @ turn(z[:, 3:])
        t = t + apply(r, self.offset + tool[:, :3])
        p = apply(turn(x[:, 3:]).swapaxes(1, 2), t + self.q[:, :1] * along[0] - x[:, :3])
        r = np.asarray(self.tracker.orientation) @ turn(frame[:, 3:])
        v = apply(r.swapaxes(1, 2), p - np.asarray(self.tracker.station) - frame[:, :3])
        length = np.linalg.norm(v, axis=1)
        return np.stack([length, np.arctan2(v[:, 1], v[:, 0]), np.arcsin(v[:, 2] / length)], 1)

    def __call__(self, theta: np.ndarray, readings: np.ndarray) -> np.ndarray:
        off = (readings - self.readings(theta)) / self.sigma
        return np.concatenate([off.ravel(), self.root * theta])


def turn(v: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3)."""
    angle = np.linalg.norm(v, axis=1)[:, None, None]
    k = np.zeros((len(v), 3, 3))
    k[:, 2, 1], k[:, 0, 2], k[:, 1, 0] = v.T
    k -= k.swapaxes(1, 2)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + a * k + b * (k @ k)


def apply(r: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) times vectors (n, 3)."""
    return np.einsum("nij,nj->ni", r, v)


def per_draw(function, draws: int, part: int, repeats: int) -> float:
    """Best wall time per draw, s: parts of the draws on as many threads as there are cores."""
    index = [np.arange(i, i + part, dtype=np.uint32) for i in range(0, draws, part)]
    workers = (os.cpu_count() or 1) if jax.default_backend() == "cpu" else 1

    def run(rows):
        return jax.block_until_ready(function(rows))

    run(index[0])
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(run, index))
        times.append(time.perf_counter() - begin)
    return min(times) / draws


def timings(host_draws: int, draws: int, repeats: int) -> dict:
    """Seconds per draw of every method, and their largest differences."""
    model, plan = problem()
    simulator, batch = prepare(model, plan), prepare_batch(model, plan)
    key = jax.random.key(0)
    accelerator = jax.default_backend() != "cpu"
    part = draws if accelerator else PART

    def made(i):
        return draw(simulator, jax.random.fold_in(key, i))

    def ours(i):
        return identify_one(batch, made(i).readings).theta

    def mapped(solver, steps):
        def one(i):
            readings, start = made(i).readings, jnp.zeros(len(batch.root_precision))
            return optx.least_squares(
                batch.residual, solver, start, readings, max_steps=steps, throw=False
            ).value

        return jax.jit(jax.vmap(one))

    class Rows(dict):
        """Prints every row at once, because some take minutes."""

        def __setitem__(self, name: str, seconds: float) -> None:
            super().__setitem__(name, seconds)
            print(f"{name:45s} {1e3 * seconds:9.4f} ms", flush=True)

    rows = Rows()
    # scipy, one draw after the other
    readings = np.asarray(jax.jit(jax.vmap(lambda i: made(i).readings))(np.arange(64)))
    root = np.asarray(batch.root_precision)
    plain = NumpyResidual(model, plan, root, np.asarray(simulator.sigma))
    zero = np.zeros(len(root))
    np.testing.assert_allclose(plain.readings(zero), np.asarray(batch.nominal), atol=1e-13)
    begin = time.perf_counter()
    by_hand = [least_squares(plain, zero, args=(y,), method="lm").x for y in readings[:host_draws]]
    rows["scipy, numpy residual, finite differences"] = (time.perf_counter() - begin) / host_draws
    residual = jax.jit(lambda t, y: batch.residual(t, y))
    slope = jax.jit(jax.jacfwd(batch.dense_residual))
    residual(zero, readings[0]), slope(zero, readings[0])

    def tight(y, start, tolerance=1e-15):
        return least_squares(
            lambda t: np.asarray(residual(t, y)),
            start,
            lambda t: np.asarray(slope(t, y)),
            method="lm",
            ftol=tolerance,
            xtol=tolerance,
            gtol=tolerance,
        )

    begin = time.perf_counter()
    for y in readings[:host_draws]:
        tight(y, zero, 1e-8)
    rows["scipy, compiled residual and Jacobian"] = (time.perf_counter() - begin) / host_draws
    # mapped and batched
    few = 256 if accelerator else 16
    damped = optx.LevenbergMarquardt(1e-4, 1e-4)
    rows["optimistix LevenbergMarquardt, mapped"] = per_draw(mapped(damped, 30), few, few, 1)
    newton = optx.GaussNewton(1e-4, 1e-4, linear_solver=lx.QR())
    rows["optimistix GaussNewton, mapped"] = per_draw(mapped(newton, 30), few, few, 1)
    floor = jax.jit(jax.vmap(lambda i: made(i).readings))
    program = jax.jit(side_by_side(ours, 0 if accelerator else TOGETHER))
    rows["vcal"] = per_draw(program, draws, part, repeats)
    rows["floor: forward model and noise"] = per_draw(floor, draws, part, repeats)
    rows["vcal, again"] = per_draw(program, draws, part, repeats)
    shape = simulator.sigma.shape

    def product(i):
        noise = standard_normal(jax.random.fold_in(key, i), shape)
        return batch.gain @ noise.reshape(-1)

    rows["floor: one matrix product and noise"] = per_draw(
        jax.jit(jax.vmap(product)), draws, part, repeats
    )
    # agreement with tightly converged solutions by MINPACK's Levenberg-Marquardt
    found = np.asarray(jax.jit(jax.vmap(ours))(np.arange(64)))
    best = np.array([tight(y, x).x for y, x in zip(readings, found, strict=True)])
    curvature = np.linalg.inv(np.asarray(batch.inverse))
    apart = np.sqrt(np.einsum("bi,ij,bj->b", found - best, curvature, found - best))
    hand = np.array(by_hand) - best[: len(by_hand)]
    return {
        "readings": int(np.prod(shape)),
        "parameters": len(root),
        "seconds_per_draw": rows,
        "largest_distance_posterior_sd": float(apart.max()),
        "largest_distance_of_scipy_posterior_sd": float(
            np.sqrt(np.einsum("bi,ij,bj->b", hand, curvature, hand)).max()
        ),
    }


def memory(draws: int) -> dict:
    """Peak memory (MiB) and wall time of a campaign, in this process."""
    model, plan = problem()
    begin = time.perf_counter()
    done = monte_carlo(model, model, plan, draws=draws, quantities=[ParameterErrors()])
    return {
        "draws": done.ensemble.draws,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "wall_s": time.perf_counter() - begin,
        "quantiles": done.ensemble.kept,
        "retried": done.retried,
    }


def main() -> None:
    """Print the table, and the memory of campaigns of growing length."""
    parser = parser_of(__doc__, "batch")
    parser.add_argument("--host-draws", type=int, default=10)
    parser.add_argument("--draws", type=int, default=4000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--campaigns", type=int, nargs="*", default=[100_000, 1_000_000])
    parser.add_argument("--campaign", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    vcal.enable_float64()
    if options.campaign:
        print(json.dumps(memory(options.campaign)))
        return
    result = timings(options.host_draws, options.draws, options.repeats)
    times = result["seconds_per_draw"]
    for name, seconds in times.items():
        print(f"{name:45s} {1e3 * seconds:9.4f} ms  {seconds / times['vcal']:9.1f}", flush=True)
    print(f"vcal / (forward model and noise): {ratio(times):.2f}")
    print(f"distance to tight solutions: {result['largest_distance_posterior_sd']:.1e}")
    result["campaigns"] = []
    for draws in options.campaigns:
        # A process of its own, so that its peak memory is its own.
        command = [sys.executable, __file__, "--campaign", str(draws)]
        output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        result["campaigns"].append(json.loads(output.splitlines()[-1]))
        print(result["campaigns"][-1], flush=True)
    result["machine"] = {
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
    }
    write(options.out, result)


def ratio(times: dict[str, float]) -> float:
    """Time of vcal over that of the forward model with noise; vcal is timed before and after it."""
    ours = 0.5 * (times["vcal"] + times["vcal, again"])
    return ours / times["floor: forward model and noise"]


if __name__ == "__main__":
    main()
