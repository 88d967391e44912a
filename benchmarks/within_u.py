"""How often a stated uncertainty is right: errors of named effects within their U (k = 2).

For every effect of a list machines are drawn and measured by the independent numpy generator of the
tests, the loop is closed on each, and its estimates of the effect are compared with the true
values. For a machine measured by ranges alone from four stations, the 21 errors are compared as
well, at five positions of every axis. With `--data` the summary has the same comparison for two
R-tests beside the checkout of known truth.

    python benchmarks/within_u.py --sets 90 --jobs 2
    python benchmarks/within_u.py --summary --data ../shared/data

The first command appends one line per set to lines/within_u.jsonl and skips the sets that are
there. The second makes results/within_u.json from the lines.
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
from power import load
from power_cases import CHAINS
from records import campaign, campaign_parser, make_sets, share
from scipy.stats import chi2

FIRST_SEED = 30_000
MATRIX = [[0.9, 0.1, -1.55], [0.05, 0.6, 0.3], [-0.4, 0.2, 1.1]]
CROSSTALK = {"matrix_um_s2_per_m": MATRIX}
"""[i][j]: displacement along i per acceleration of axis j."""

GEOMETRY = "21 errors"
"""The case that compares the errors of a machine from which nothing is missing."""
NODES = 5
"""Positions of every axis at which they are compared."""

Drawn = tuple[dict[str, Any], dict[str, float]]
"""An effect for the oracle, and its true parameters in the units of the loop."""


def _elements(matrix) -> dict[str, float]:
    return {f"matrix_{a}{b}": matrix[i][j] for i, a in enumerate("XYZ") for j, b in
            enumerate("XYZ")}  # fmt: skip


def _matrix(rng: np.random.Generator) -> Drawn:
    matrix = rng.standard_normal((3, 3))
    return {"effect": "acceleration_crosstalk", "matrix_um_s2_per_m": matrix}, _elements(matrix)


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


def _mismatch(_: np.random.Generator) -> Drawn:
    return {"effect": "servo_lag", "axis": "X", "T_ms": 0.05}, {"T": 0.05}


def _pitch(rng: np.random.Generator) -> Drawn:
    effect, truth = _screw(rng)
    size = 2.0 / effect["amplitude_um"]
    grown = {name: size * truth[name] for name in ("sine", "cosine")}
    return effect | {"amplitude_um": 2.0}, truth | grown


def _nothing(_: np.random.Generator) -> Drawn:
    return {}, {}


def _head(_: np.random.Generator) -> Drawn:
    return {"effect": "head_expansion", "um_per_K": 1.0}, {"k": 1.0}


@dataclass(frozen=True)
class Sized:
    """An effect of known size on an instrument."""

    instrument: str
    key: str
    """The right name."""
    draw: Callable[[np.random.Generator], Drawn]
    plan: Mapping[str, Any] = field(default_factory=dict)
    declared: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of `acceleration_crosstalk` where it is present and declared."""

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
    Sized("multilateration", "backlash Y", _backlash),
    Sized("multilateration", GEOMETRY, _nothing),
    Sized("interferometer", "scale_growth X", _growth, {"cycles": True}),
    Sized("double_ball_bar", "screw_cyclic X", _pitch),
    Sized("double_ball_bar", "servo_lag X", _mismatch),
    Sized("touch_probe", "screw_cyclic X", _pitch),
)
MEASURED = (
    ("practice/08_rtest_crosstalk", "acceleration_crosstalk"),
    ("practice/09_rtest_reversal", "reversal_spike"),
)


def compared(closure, key: str, truth: Mapping[str, float]) -> dict:
    """The errors of the loop's estimates of an effect: (value - truth) / u of every parameter, and
    the joint distance d' C^-1 d with the correlations of the posterior; `found` alone where the
    effect is not named.
    """
    found = [e.effect.key for e in closure.effects]
    line: dict[str, Any] = {"found": found}
    if key not in found:
        return line
    stated = {name: (v, u) for name, v, _, u in closure.effects[found.index(key)].parameters}
    pulls = {name: (stated[name][0] - true) / stated[name][1] for name, true in truth.items()}
    fit = closure.after
    places = {p.name: i for i, (effect, p) in enumerate(fit.entries) if effect == key}
    rows = [places[name] for name in truth]
    shared = fit.covariance[np.ix_(rows, rows)]
    sd = np.sqrt(np.diag(shared))
    off = np.array(list(pulls.values()))
    line["pulls"] = {name: round(float(pull), 4) for name, pull in pulls.items()}
    line["distance"] = round(float(off @ np.linalg.solve(shared / np.outer(sd, sd), off)), 3)
    return line


def geometry(closure, machine) -> dict:
    """The same for all error motions at `NODES` positions of every axis, and for the squareness
    errors, against those of the machine of the oracle.
    """
    from oracle.kinematics import AXES, COMPONENTS, SQUARENESS, error_motions
    from vcal.geometry.error_motions import error_motion_tables

    line: dict[str, Any] = {"found": [e.effect.key for e in closure.effects], "pulls": {}}
    for table in error_motion_tables(closure.after, NODES):
        if table.name in SQUARENESS:
            true = np.array([machine.squareness[SQUARENESS.index(table.name)]])
        else:
            component, axis = COMPONENTS.index(table.name[1]), AXES.index(table.axis)
            q = np.zeros((NODES, 3))
            q[:, axis] = 1e-3 * table.position
            motions = np.concatenate(error_motions(machine, q), axis=2)
            true = motions[:, axis, component]
        # An error that the family does not have at a position, such as a slope at its middle, is
        # known there.
        unknown = table.u > 0.0
        pulls = (table.value - 1e6 * true)[unknown] / table.u[unknown]
        line["pulls"] |= {f"{table.name}.{k}": round(float(v), 4) for k, v in enumerate(pulls)}
    return line


def one_set(name: str, seed: int) -> dict:
    """Draw a machine, measure it, close the loop, and compare."""
    import vcal
    from oracle import make_case

    (case,) = (case for case in CASES if case.name == name)
    effect, truth = case.draw(np.random.default_rng([seed, 1]))
    declared = {"effect": "acceleration_crosstalk", **case.declared} if case.declared else None
    rows = [{"name": "acceleration_crosstalk", **case.declared}] if case.declared else []
    effects = [effect] if declared is None else [declared, effect]
    effects = [one for one in effects if one]
    chain = CHAINS[seed % 3]
    made = make_case(case.instrument, chain, seed, effects, plan=case.plan, declared=rows)
    study = load(made)
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, seed=seed)
    line = {"case": case.name, "seed": seed}
    if case.key == GEOMETRY:
        return line | geometry(closure, made.machine)
    return line | compared(closure, case.key, truth)


def jobs(sets: range, patterns: Sequence[str]) -> Iterator[tuple[str, int]]:
    """Every set, seed by seed."""
    names = [case.name for case in CASES if any(fnmatch(case.name, p) for p in patterns)]
    yield from ((name, seed) for seed in sets for name in names)


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the sets."""
    sets = range(options.first_seed, options.first_seed + options.sets)
    make_sets(options, jobs(sets, options.cases), ("case", "seed"), one_set)


def measured(data: Path) -> dict[str, dict]:
    """The same comparison for two measurements of known truth, by the name of their folder."""
    import vcal

    vcal.enable_float64()
    found = {}
    for folder, key in MEASURED:
        study = vcal.load_study(data / folder / "setup.toml")
        (put_in,) = json.loads((data / folder / "truth.json").read_text())["undeclared"]
        truth = {"size": put_in.get("size_um"), "decay": put_in.get("decay_mm")}
        if "matrix_um_s2_per_m" in put_in:
            truth = _elements(put_in["matrix_um_s2_per_m"])
        closure = vcal.close_loop(study.model, study.measurement, check=study.check)
        line = compared(closure, key, truth)
        line["chance"] = float(chi2.sf(line["distance"], len(truth)))
        found[Path(folder).name] = line
    return found


def together(inside: np.ndarray) -> list[float]:
    """k, n and the 95 % interval of k/n for values (sets, values) of which those of one set depend
    on each other: from the scatter of the shares of the sets.
    """
    of_set = inside.mean(1)
    half = 1.96 * float(of_set.std(ddof=1)) / math.sqrt(len(of_set))
    middle = float(of_set.mean())
    return [int(inside.sum()), inside.size, max(middle - half, 0.0), min(middle + half, 1.0)]


def summed(lines: list[dict]) -> list[dict]:
    """Shares by case, of the sets in which the effect is named."""
    rows = []
    for case in CASES:
        its = [line for line in lines if line["case"] == case.name]
        named = [line for line in its if "pulls" in line]
        if not named:
            continue
        pulls = np.array([list(line["pulls"].values()) for line in named])
        inside = np.abs(pulls) <= 2.0
        errors = case.key == GEOMETRY
        row = {
            "case": case.name,
            "sets": len(its),
            "named": len(named),
            "parameters": list(named[0]["pulls"]),
            "within_U": together(inside) if errors else share(int(inside.sum()), pulls.size),
            "sd_of_pulls": float(pulls.std()),
            "mean_of_pulls": pulls.mean(0).round(3).tolist(),
        }
        if not errors:  # errors at many positions have no covariance of full rank
            distance = np.array([line["distance"] for line in named])
            beyond = int((chi2.sf(distance, pulls.shape[1]) < 0.05).sum())
            row["jointly_beyond_5_percent"] = share(beyond, len(named))
            row["largest_distance"] = float(distance.max())
        rows.append(row)
    return rows


def main() -> None:
    """Run the campaign in single-threaded processes, or summarise it."""
    parser = campaign_parser(__doc__, "within_u", FIRST_SEED)
    parser.add_argument("--data", type=Path, help="folder with the practice data")
    options = parser.parse_args()
    campaign(__file__, options, work, lambda lines: {
        "cases": summed(lines), "measured": measured(options.data) if options.data else {},
    })  # fmt: skip


if __name__ == "__main__":
    main()
