"""Several data sets in one study: false alarms, right names, and sets that do not fit one machine.

A tracker and a ball array measure one machine of the declared family (or the tracker measures it
twice, at other temperatures of its scales; or the two measure two machines), by the independent
numpy generator of the tests, alpha = 1 % for the whole loop, 500 null draws.

    python benchmarks/several.py --sets 40 --jobs 2 --minutes 60
    python benchmarks/several.py --summary

The first appends a line per set to results/several.jsonl and leaves out those that are there, the
second makes results/several.json from the lines.
"""

import argparse
import dataclasses
import json
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from power import ALPHA, DRAWS, FIRST_SEED, append, commit_of, in_parallel, known, limits_in
from power_summary import outcome

HERE = Path(__file__).resolve().parent
LINES = HERE / "results" / "several.jsonl"
RESULT = HERE / "results" / "several.json"
LIMITS = HERE / "results" / "power.jsonl"
MULTIPLE = 5.0
"""Size of an effect in detection limits of the tracker, or of the ball array, by itself."""
NOTHING = ("clean", "clean, measured twice", "clean, cut in two")
OF_THE_MACHINE = ("backlash", "angular_reversal", "thermal_tilt", "screw_cyclic", "cross_axis")
OF_ONE = (("laser_tracker", "station_drift"), ("ball_array", "ball_error"))
NAMES = {"laser_tracker": "tracker", "ball_array": "balls"}
TWO = "two machines"


def cases() -> Iterator[str]:
    yield from NOTHING
    yield from OF_THE_MACHINE
    yield from (f"{name} of {NAMES[at]}" for at, name in OF_ONE)
    yield TWO


def made(case: str, seed: int, limits: dict) -> tuple[dict, list[list[str]]] | None:
    """The cases of the oracle by name of the data set, and the true names; None where the limit of
    the effect at its instrument is not known.
    """
    from power_cases import ENTRIES, drawn, make, world_of

    from joint import at_temperatures

    world = world_of("laser_tracker", seed)

    def of(at: str, sized=(), sizes=(), entry: str = "clean", world=world):
        return make(ENTRIES[f"{at}/{entry}"], world, sized, sizes)

    if case == TWO:
        other = dataclasses.replace(world, seed=seed + 1000)
        return {
            "tracker": of("laser_tracker").case,
            "balls": of("ball_array", world=other).case,
        }, []
    if case == "clean":
        return {"tracker": of("laser_tracker").case, "balls": of("ball_array").case}, []
    if case in NOTHING:
        first = of("laser_tracker").case
        if case == "clean, cut in two":
            middle = len(first.data["t_s"]) // 2
            return {"early": _rows(first, slice(None, middle)),
                    "late": _rows(first, slice(middle, None))}, []  # fmt: skip
        rng = np.random.default_rng([seed, 7])
        return {"cold": first, "warm": at_temperatures(first, rng.uniform(22, 28, 3), [], seed)}, []
    at, name = "laser_tracker", case
    for instrument, one in OF_ONE:
        if case == f"{one} of {NAMES[instrument]}":
            at, name = instrument, one
    entry = ENTRIES[f"{at}/{name}"]
    limit = limits.get((at, name, False, seed), math.inf)
    if not math.isfinite(limit):
        return None
    sized, found, keys = drawn(entry, world), {}, []
    for instrument, data_set in NAMES.items():
        if name in OF_THE_MACHINE or instrument == at:
            it = of(instrument, sized, [MULTIPLE * limit], name)
            keys += [term.key for term in it.terms]
        else:
            it = of(instrument)
        found[data_set] = it.case
    (key,) = set(keys)
    if name not in OF_THE_MACHINE:
        kind, _, place = key.partition(" ")
        key = f"{kind} {NAMES[at]} {place}".strip()
    return found, [[key]]


def _rows(case, which: slice):
    """Some of the readings of a tracker, as a case."""
    return dataclasses.replace(case, data={k: np.asarray(v)[which] for k, v in case.data.items()})


def one_set(case: str, seed: int, limits: dict) -> dict | None:
    """Make a study of two data sets and close the loop on it; None where the size is not known."""
    import vcal
    from joint import write_joint
    from vcal.loop.notes import data_set_consistency

    start = time.perf_counter()
    line: dict = {"case": case, "seed": seed}
    wanted = made(case, seed, limits)
    if wanted is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        study = vcal.load_study(write_joint(Path(folder) / "joint", wanted[0]) / "setup.toml")
    closure = vcal.close_loop(
        study.model, study.measurement, check=study.check, alpha=ALPHA, draws=DRAWS, seed=seed
    )
    room = len(study.model.entries) + 16
    line |= {
        "truth": wanted[1],
        "verdict": closure.verdict,
        "found": [
            {"key": e.effect.key, "status": e.status, "equivalent": e.equivalent}
            for e in closure.effects
        ],
        "data_set_consistency": bool(data_set_consistency(closure.before, closure.after, room)),
        "rms": {k: float(f"{e.check.value:.4g}") for k, e in closure.errors.items() if e.check},
    }
    return line | {"seconds": round(time.perf_counter() - start, 2)}


def work(options: argparse.Namespace) -> None:
    import vcal

    vcal.enable_float64()
    end = time.monotonic() + 60 * options.minutes
    limits = limits_in(known(LIMITS))
    done = {(line["case"], line["seed"]) for line in known(LINES)}
    commit = commit_of(HERE.parent)
    for seed in range(FIRST_SEED, FIRST_SEED + options.sets):
        for place, case in enumerate(cases()):
            if (case, seed) in done or (seed + place) % options.jobs != options.part:
                continue
            if time.monotonic() > end:
                return
            line = one_set(case, seed, limits)
            if line is None:
                continue
            append(LINES, line | {"commit": commit})
            print(case, seed, line["verdict"], [f["key"] for f in line.get("found", [])],
                  line.get("data_set_consistency"), line.get("seconds"), flush=True)  # fmt: skip


def summary(lines: Sequence[dict]) -> dict:
    """Sets, outcomes and contradictions told, by case."""
    rows = []
    for case in cases():
        mine = [line for line in lines if line["case"] == case]
        counts: dict[str, int] = {}
        for line in mine:
            counts[outcome(line)] = counts.get(outcome(line), 0) + 1
        told = sum(line["data_set_consistency"] for line in mine)
        rows.append(
            {"case": case, "sets": len(mine), "outcomes": counts, "data_set_consistency": told}
        )
    return {"rows": rows, "commits": sorted({line["commit"] for line in lines})}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=20, help="of every case")
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--summary", action="store_true", help="make several.json from the lines")
    parser.add_argument("--part", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.summary:
        RESULT.write_text(json.dumps(summary(known(LINES)), indent=1) + "\n", encoding="utf-8")
        return
    if options.part is not None:
        work(options)
        return
    in_parallel(__file__, options.jobs)


if __name__ == "__main__":
    main()
