"""How often a stated uncertainty is right: what is said of a named effect within its U (k = 2).

For a handful of effects machines are drawn and measured by the independent numpy generator of the
tests, the loop is closed on each, and what it says of the effect is compared with what was put in.
With `--data`, the same of the R-tests beside the checkout, whose truth is told.

    python benchmarks/within_u.py --sets 200 --jobs 2 --data ../shared/data

keeps a line per set in results/within_u.jsonl, leaves out those that are there, and sums them up in
results/within_u.json.
"""

import argparse
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from power import append, commit_of, forget_programs, in_parallel, known, load
from power_cases import CHAINS
from scipy.stats import binomtest, chi2

HERE = Path(__file__).resolve().parent
LINES = HERE / "results" / "within_u.jsonl"
FIRST_SEED = 30_000
MATRIX = [[0.9, 0.1, -1.55], [0.05, 0.6, 0.3], [-0.4, 0.2, 1.1]]
CROSSTALK = {"matrix_um_s2_per_m": MATRIX}
"""[i][j]: along i for an acceleration of axis j."""

Drawn = tuple[dict[str, Any], dict[str, float]]
"""An effect for the oracle, and the parameters that the loop should find, in the loop's units."""


def _matrix(rng: np.random.Generator) -> Drawn:
    matrix = rng.standard_normal((3, 3))
    truth = {f"matrix_{a}{b}": matrix[i, j] for i, a in enumerate("XYZ") for j, b in
             enumerate("XYZ")}  # fmt: skip
    return {"effect": "acceleration_crosstalk", "matrix_um_s2_per_m": matrix}, truth


def _spike(_: np.random.Generator) -> Drawn:
    sizes = {"size_um": 3.5, "decay_mm": 0.06}
    return {"effect": "reversal_spike", **sizes}, {"size": 3.5, "decay": 0.06}


def _backlash(_: np.random.Generator) -> Drawn:
    return {"effect": "backlash", "axis": "Y", "size_um": 12.0}, {"size": 12.0}


def _screw(rng: np.random.Generator) -> Drawn:
    phase, pitch = rng.uniform(-math.pi, math.pi), rng.uniform(10.0, 25.0)
    effect = {"effect": "screw_cyclic", "axis": "X", "amplitude_um": 6.0}
    truth = {"sine": 6.0 * math.cos(phase), "cosine": 6.0 * math.sin(phase), "pitch": pitch}
    return effect | {"pitch_mm": pitch, "phase": phase}, truth


def _growth(_: np.random.Generator) -> Drawn:
    return {"effect": "scale_growth", "axis": "X", "um_per_m_K": 11.0}, {"alpha": 11.0}


def _tilt(_: np.random.Generator) -> Drawn:
    effect = {"effect": "thermal_tilt", "axis": "Y", "component": "A", "urad_per_K": 40.0}
    return effect, {"k_EAY": 40.0}


def _head(_: np.random.Generator) -> Drawn:
    return {"effect": "head_expansion", "um_per_K": 1.0}, {"k": 1.0}


@dataclass(frozen=True)
class Sized:
    """An effect of known size on an instrument."""

    instrument: str
    key: str
    """What the loop should name."""
    draw: Callable[[np.random.Generator], Drawn]
    plan: Mapping[str, Any] = field(default_factory=dict)
    declared: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of an effect that is there and declared, by their keys."""

    @property
    def name(self) -> str:
        return f"{self.instrument}: {self.key}"


CASES = (
    Sized("r_test", "acceleration_crosstalk", _matrix, {"samples": 240}),
    Sized("r_test", "reversal_spike", _spike, {"samples": 240}, CROSSTALK),
    Sized("laser_tracker", "backlash Y", _backlash),
    Sized("laser_tracker", "screw_cyclic X", _screw),
    Sized("ball_array", "scale_growth X", _growth),
    Sized("ball_array", "thermal_tilt Y", _tilt),
    Sized("laser_frame", "head_expansion", _head),
)
MEASURED = (
    ("practice/08_rtest_crosstalk", "acceleration_crosstalk"),
    ("practice/09_rtest_reversal", "reversal_spike"),
)


def compared(closure, key: str, truth: Mapping[str, float]) -> dict:
    """Of what the loop says of an effect, (value - truth) / u of every parameter, and their joint
    distance d' C^-1 d with the posterior's correlations; `found` alone where it is not named.
    """
    found = [e.effect.key for e in closure.effects]
    line: dict[str, Any] = {"found": found}
    if key not in found:
        return line
    told = {name: (value, u) for name, value, _, u in closure.effects[found.index(key)].parameters}
    pulls = {name: (told[name][0] - true) / told[name][1] for name, true in truth.items()}
    fit = closure.after
    places = {p.name: i for i, (effect, p) in enumerate(fit.entries) if effect == key}
    rows = [places[name] for name in truth]
    shared = fit.covariance[np.ix_(rows, rows)]
    sd = np.sqrt(np.diag(shared))
    off = np.array(list(pulls.values()))
    line["pulls"] = {name: round(float(pull), 4) for name, pull in pulls.items()}
    line["distance"] = round(float(off @ np.linalg.solve(shared / np.outer(sd, sd), off)), 3)
    return line


def one_set(case: Sized, seed: int) -> dict:
    """Draw, measure, close the loop, compare."""
    import vcal
    from oracle import make_case

    effect, truth = case.draw(np.random.default_rng([seed, 1]))
    declared = {"effect": "acceleration_crosstalk", **case.declared} if case.declared else None
    rows = [{"name": "acceleration_crosstalk", **case.declared}] if case.declared else []
    effects = [effect] if declared is None else [declared, effect]
    chain = CHAINS[seed % 3]
    study = load(make_case(case.instrument, chain, seed, effects, plan=case.plan, declared=rows))
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, seed=seed)
    return {"case": case.name, "seed": seed, **compared(closure, case.key, truth)}


def jobs(sets: int, patterns: Sequence[str]) -> Iterator[tuple[Sized, int]]:
    """Every set, seed by seed."""
    cases = [case for case in CASES if any(fnmatch(case.name, p) for p in patterns)]
    yield from ((case, seed) for seed in range(FIRST_SEED, FIRST_SEED + sets) for case in cases)


def work(options: argparse.Namespace, part: int) -> None:
    """Every `jobs`-th of the sets that are not there yet."""
    import vcal

    vcal.enable_float64()
    done = {(line["case"], line["seed"]) for line in known(options.lines)}
    commit = commit_of(HERE.parent)
    for number, (case, seed) in enumerate(jobs(options.sets, options.cases)):
        if number % options.jobs != part or (case.name, seed) in done:
            continue
        line = one_set(case, seed)
        append(options.lines, line | {"commit": commit})
        forget_programs()
        print(line, flush=True)


def measured(data: Path) -> dict[str, dict]:
    """The same of data sets of one draw, by their folder."""
    import vcal

    vcal.enable_float64()
    found = {}
    for folder, key in MEASURED:
        study = vcal.load_study(data / folder / "setup.toml")
        (put_in,) = json.loads((data / folder / "truth.json").read_text())["undeclared"]
        truth = {"size": put_in.get("size_um"), "decay": put_in.get("decay_mm")}
        if "matrix_um_s2_per_m" in put_in:
            its = put_in["matrix_um_s2_per_m"]
            truth = {f"matrix_{a}{b}": its[i][j] for i, a in enumerate("XYZ") for j, b in
                     enumerate("XYZ")}  # fmt: skip
        closure = vcal.close_loop(study.model, study.measurement, check=study.check)
        line = compared(closure, key, truth)
        line["chance"] = float(chi2.sf(line["distance"], len(truth)))
        found[Path(folder).name] = line
    return found


def share(k: int, n: int) -> list[float]:
    """k of n with the 95 % interval of Clopper and Pearson."""
    low, high = binomtest(k, n).proportion_ci()
    return [k, n, float(low), float(high)]


def summed(lines: list[dict]) -> list[dict]:
    """Shares by case."""
    rows = []
    for case in CASES:
        its = [line for line in lines if line["case"] == case.name]
        named = [line for line in its if "pulls" in line]
        if not named:
            continue
        pulls = np.array([list(line["pulls"].values()) for line in named])
        distance = np.array([line["distance"] for line in named])
        inside = int((np.abs(pulls) <= 2.0).sum())
        beyond = int((chi2.sf(distance, pulls.shape[1]) < 0.05).sum())
        rows.append(
            {
                "case": case.name,
                "sets": len(its),
                "named": len(named),
                "parameters": list(named[0]["pulls"]),
                "within_U": share(inside, pulls.size),
                "sd_of_pulls": float(pulls.std()),
                "mean_of_pulls": pulls.mean(0).round(3).tolist(),
                "jointly_beyond_5_percent": share(beyond, len(named)),
                "largest_distance": float(distance.max()),
            }
        )
    return rows


def main() -> None:
    """Run the campaign in single-threaded processes, then sum it up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=["*"], help="patterns such as 'r_test*'")
    parser.add_argument("--sets", type=int, default=200, help="of every case")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--data", type=Path, help="folder with the practice data")
    parser.add_argument("--lines", type=Path, default=LINES)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "within_u.json")
    parser.add_argument("--part", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part is not None:
        work(options, options.part)
        return
    in_parallel(__file__, options.jobs)
    lines = known(options.lines)
    record = {
        "commits": sorted({line["commit"] for line in lines}),
        "cases": summed(lines),
        "measured": measured(options.data) if options.data else {},
    }
    options.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
