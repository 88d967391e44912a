"""Propagation of uncertainty through one formula of ten inputs, beside other programs.

The same model and the same inputs (six normal, four rectangular): the GUM at first order, and a
Monte Carlo of a million draws with mean, standard deviation and the 95 % interval. Every program
runs in a process of its own. Rounds of all programs follow each other, and every time is divided by
that of numpy in the same round, so that a busy machine changes the ratios little. Cold is the first
call of a process after the import, warm the median of further ones. Programs that are not installed
are left out with the reason. They may be in an environment of their own:

    python benchmarks/uncertainty_peers.py --peers /path/to/their/python
"""

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time

DRAWS = 1_000_000
NORMAL = {
    "x1": (2.0, 0.02), "x2": (3.0, 0.03), "x3": (1.5, 0.01), "x4": (0.8, 0.02),
    "x5": (0.5, 0.01), "x6": (4.0, 0.05),
}  # fmt: skip
RECTANGULAR = {"x7": (1.0, 0.1), "x8": (0.25, 0.05), "x9": (0.5, 0.1), "x10": (0.0, 0.05)}
"""Middle and half width."""
FORMULA = "x1*x2/x3 + x4*exp(-x5) + sqrt(x6)*x7 + x8*sin(x9) + x10"
TOOLS = ("numpy", "vcal", "suncal", "metrolopy", "GTC", "uncertainties")
WARM = {"gum": 15, "mc": 5}


def model(v, m):
    """The formula with the functions of a module."""
    return (
        v["x1"] * v["x2"] / v["x3"] + v["x4"] * m.exp(-v["x5"]) + m.sqrt(v["x6"]) * v["x7"]
        + v["x8"] * m.sin(v["x9"]) + v["x10"]
    )  # fmt: skip


# --- one function per program: what it computes, as (gum, mc); each gives y, u, low, high ---------


def _numpy():
    import numpy as np

    def mc():
        random = np.random.default_rng(1)
        v = {name: random.normal(*p, DRAWS) for name, p in NORMAL.items()}
        v |= {n: random.uniform(x - w, x + w, DRAWS) for n, (x, w) in RECTANGULAR.items()}
        y = model(v, np)
        return [y.mean(), y.std(ddof=1), *np.quantile(y, [0.025, 0.975])]

    return None, mc


def _vcal():
    import jax.numpy as jnp

    import vcal
    from vcal.distributions import Inputs, Normal, Uniform
    from vcal.uncertainty import propagate, propagate_distributions

    vcal.enable_float64()
    given = {n: Normal(*p) for n, p in NORMAL.items()}
    given |= {n: Uniform(x - w, x + w) for n, (x, w) in RECTANGULAR.items()}
    inputs = Inputs(given)

    def function(v):
        return model(v, jnp)

    def gum():
        found = propagate(function, inputs)
        return [found.value[0], found.u[0], *found.interval("y")]

    def mc():
        found = propagate_distributions(function, inputs, DRAWS)
        return [found.mean[0], found.u[0], *found.interval("y")]

    return gum, mc


def _suncal():
    from suncal import Model

    def made():
        made = Model(f"y = {FORMULA}")
        for name, (x, u) in NORMAL.items():
            made.var(name).measure(x).typeb(dist="normal", std=u, name="u")
        for name, (x, w) in RECTANGULAR.items():
            made.var(name).measure(x).typeb(dist="uniform", a=w, name="u")
        return made

    def result(found):
        ends = found.expand("y", conf=0.95)
        return [found.expected["y"], found.uncertainty["y"], ends.low, ends.high]

    def gum():
        found = made().calculate_gum()
        y, u = found.expected["y"], found.uncertainty["y"]
        half = found.expand("y", conf=0.95)
        half = getattr(half, "uncertainty", half)
        return [y, u, y - half, y + half]

    return gum, lambda: result(made().monte_carlo(samples=DRAWS))


def _metrolopy():
    import numpy as np
    from metrolopy import UniformDist, gummy

    def made():
        v = {name: gummy(x, u) for name, (x, u) in NORMAL.items()}
        v |= {n: gummy(UniformDist(center=x, half_width=w)) for n, (x, w) in RECTANGULAR.items()}
        return model(v, np)

    def gum():
        y = made()
        return [y.x, y.u, y.x - 1.959964 * y.u, y.x + 1.959964 * y.u]

    def mc():
        y = made()
        y.p = 0.95
        gummy.simulate([y], n=DRAWS)
        return [y.xsim, y.usim, *y.cisim]

    return gum, mc


def _GTC():
    import GTC

    def gum():
        v = {name: GTC.ureal(x, u) for name, (x, u) in NORMAL.items()}
        v |= {n: GTC.ureal(x, GTC.type_b.uniform(w)) for n, (x, w) in RECTANGULAR.items()}
        y = model(v, GTC)
        x, u = GTC.value(y), GTC.uncertainty(y)
        k = GTC.reporting.k_factor(GTC.dof(y))
        return [x, u, x - k * u, x + k * u]

    return gum, None


def _uncertainties():
    from uncertainties import ufloat, umath

    def gum():
        v = {name: ufloat(x, u) for name, (x, u) in NORMAL.items()}
        v |= {n: ufloat(x, w / 3.0**0.5) for n, (x, w) in RECTANGULAR.items()}
        y = model(v, umath)
        return [y.n, y.s, y.n - 1.959964 * y.s, y.n + 1.959964 * y.s]

    return gum, None


# --- measuring -----------------------------------------------------------------------------------


def one(tool: str) -> dict:
    """Times of one program in this process."""
    begun, busy = time.perf_counter(), time.process_time()
    try:
        works = dict(zip(("gum", "mc"), globals()[f"_{tool}"](), strict=True))
    except ImportError as error:
        return {"absent": str(error)}
    found: dict = {
        "import_s": time.perf_counter() - begun,
        "import_cpu_s": time.process_time() - busy,
    }
    for name, work in works.items():
        if work is None:
            continue
        wall, cpu = [], []
        for _ in range(1 + WARM[name]):
            start, used = time.perf_counter(), time.process_time()
            result = work()
            wall.append(time.perf_counter() - start)
            cpu.append(time.process_time() - used)
        found[name] = {
            "first_s": wall[0],
            "first_cpu_s": cpu[0],
            "warm_s": statistics.median(wall[1:]),
            "warm_cpu_s": statistics.median(cpu[1:]),
            "result": [float(x) for x in result],
        }
    return found


def measured(python: str, tool: str, cache: str) -> dict:
    """The same in a process of its own, with an empty cache of compiled programs."""
    environment = dict(os.environ, XDG_CACHE_HOME=cache)
    done = subprocess.run(
        [python, __file__, "--one", tool],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    if done.returncode:
        return {"absent": done.stderr.strip().splitlines()[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def ratios(rounds: list[dict], tool: str, work: str) -> dict:
    """Medians over the rounds: seconds, and times of numpy's Monte Carlo in the same round."""
    found: dict = {}
    for key in ("first_s", "first_cpu_s", "warm_s", "warm_cpu_s"):
        own = [r[tool][work][key] for r in rounds]
        base = [r["numpy"]["mc"][key] for r in rounds]
        found[key] = round(statistics.median(own), 6)
        if work == "mc":
            name = key.removesuffix("_s") + "_of_numpy"
            found[name] = round(statistics.median(a / b for a, b in zip(own, base, strict=True)), 3)
    found["result"] = rounds[-1][tool][work]["result"]
    return found


def main() -> None:
    """Measure all programs and write the record."""
    from records import parser_of, write

    parser = parser_of(__doc__ or "", "uncertainty_peers")
    parser.add_argument("--peers", default=sys.executable, help="python with the other programs")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    rounds: list[dict] = []
    for _ in range(options.rounds):
        rounds.append({})
        for tool in TOOLS:
            python = sys.executable if tool in ("numpy", "vcal") else options.peers
            with tempfile.TemporaryDirectory() as cache:
                rounds[-1][tool] = measured(python, tool, cache)
            print(tool, rounds[-1][tool], flush=True)
    rows, absent = [], {}
    for tool in TOOLS:
        if "absent" in rounds[-1][tool]:
            absent[tool] = rounds[-1][tool]["absent"]
            continue
        for work in ("gum", "mc"):
            if work in rounds[-1][tool]:
                rows.append({"tool": tool, "work": work, **ratios(rounds, tool, work)})
    y, u = next(r["result"] for r in rows if r["tool"] == "numpy")[:2]
    apart = {
        f"{r['tool']} {r['work']}": [
            round(abs(r["result"][0] - y) / u, 4), round(abs(r["result"][1] / u - 1.0), 4)
        ]
        for r in rows
    }  # fmt: skip
    record = {
        "command": "python benchmarks/uncertainty_peers.py --peers PYTHON",
        "machine": f"{os.cpu_count()} cores, Python {platform.python_version()}",
        "load": [round(x, 1) for x in os.getloadavg()],
        "draws": DRAWS,
        "rounds": options.rounds,
        "absent": absent,
        "agreement": apart,
        "rows": rows,
    }
    write(options.out, record)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(one(sys.argv[2])))
    else:
        main()
