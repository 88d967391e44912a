"""Several data sets in one study: false alarms, right names, and sets that do not fit one machine.

A tracker and a ball array measure one machine of the declared family (or the tracker measures it
twice, at other temperatures of its scales; or the two measure two machines), by the independent
numpy generator of the tests, alpha = 1 % for the whole loop, 500 null draws.

    python benchmarks/several.py --sets 20 --jobs 2 --minutes 60
    python benchmarks/several.py --summary

The first command appends one line per set to lines/several.jsonl and skips the sets that are there.
The second makes results/several.json from the lines.
"""

import argparse
import dataclasses
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from power import ALPHA, DRAWS, FIRST_SEED, known_limit
from power_summary import counted
from records import campaign, campaign_parser, make_sets

MULTIPLE = 5.0
"""Size of an effect in detection limits of the tracker alone, or of the ball array alone."""
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
    """The cases of the oracle by name of the data set, and the true names; None where the plan does
    not detect the effect.
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
    sized, found, keys = drawn(entry, world), {}, []
    limit = known_limit(limits, entry, world, sized[0], entry.kinds[0])
    if not math.isfinite(limit):
        return None
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
    """A case with some of the readings of a tracker."""
    return dataclasses.replace(case, data={k: np.asarray(v)[which] for k, v in case.data.items()})


def one_set(case: str, seed: int, limits: dict) -> dict | None:
    """Make a study of two data sets and close the loop on it; None where no set can be made."""
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
        "contradiction": bool(data_set_consistency(closure.before, closure.after, room)),
        "rms": {k: float(f"{e.check.value:.4g}") for k, e in closure.errors.items() if e.check},
    }
    return line | {"seconds": round(time.perf_counter() - start, 2)}


def jobs(sets: range, patterns: Sequence[str]) -> Iterator[tuple[str, int]]:
    """Every set, seed by seed."""
    names = [name for name in cases() if any(fnmatch(name, p) for p in patterns)]
    yield from ((name, seed) for seed in sets for name in names)


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the sets."""
    limits: dict = {}
    sets = range(options.first_seed, options.first_seed + options.sets)
    make_sets(options, jobs(sets, options.cases), ("case", "seed"),
              lambda case, seed: one_set(case, seed, limits))  # fmt: skip


def summed(lines: Sequence[dict]) -> dict:
    """Sets, outcomes and reported contradictions, by case."""
    rows = []
    for case in cases():
        mine = [line for line in lines if line["case"] == case]
        contradictions = sum(line["contradiction"] for line in mine)
        rows.append({"case": case, "sets": len(mine), "outcomes": counted(mine),
                     "contradiction": contradictions})  # fmt: skip
    return {"rows": rows}


def main() -> None:
    """Run the campaign in single-threaded processes, or summarise it."""
    options = campaign_parser(__doc__, "several", FIRST_SEED).parse_args()
    campaign(__file__, options, work, summed)


if __name__ == "__main__":
    main()
