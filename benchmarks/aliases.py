"""Screws measured at positions in equal steps: is the true pitch in the class that is named?

A machine with the geometric errors of the tests' table and a screw of one pitch is measured by the
independent numpy generator, at positions of X in equal steps and four lines along it. The loop is
closed on each set. A pitch of which the step is a whole multiple gives no wave in the readings.
Where another name is more probable, the class may stand among its alternatives.

    python benchmarks/aliases.py --jobs 2
    python benchmarks/aliases.py --summary

The first command appends one line per set to lines/aliases.jsonl and skips the sets that are there.
The second makes results/aliases.json from the lines.
"""

import argparse
import time

import numpy as np
from power import load
from records import campaign, campaign_parser, make_sets

STEPS = {40.0: 24, 47.0: 21, 50.0: 20, 60.0: 17}
"""Step of the positions of X, mm, and their number."""
PITCHES = (5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0, 19.0,
           20.0)  # fmt: skip
"""mm."""
SIZE_UM = 6.0
FIRST_SEED = 41_000
BETWEEN = 0.25
"""Periods within the travel by which a member of the class may differ from the true pitch, as its
estimate has an uncertainty: one step of the loop's scan, a hundredth of the distance of aliases."""


def one_set(step: float, pitch: float, seed: int) -> dict:
    """Make a set, close the loop on it, and look for the true pitch in the class."""
    from power_cases import make_case

    import vcal

    begun = time.perf_counter()
    rng = np.random.default_rng([seed, int(step), int(10 * pitch)])
    screw = {"effect": "screw_cyclic", "axis": "X", "amplitude_um": SIZE_UM, "pitch_mm": pitch,
             "phase": rng.uniform(-np.pi, np.pi)}  # fmt: skip
    count = STEPS[step]
    case = make_case(
        "laser_tracker",
        "w X b Y Z t",
        seed=seed + int(pitch),
        effects=[screw],
        travel=np.array([(count - 1) * step, 600.0, 500.0]) * 1e-3,
        plan={"shape": (count, 2, 2), "margin": 0.0, "jitter": 0.0},
    )
    study = load(case)
    closure = vcal.close_loop(study.model, study.measurement, check=study.check, seed=seed)
    line = {"step": step, "pitch": pitch, "seed": seed, "verdict": closure.verdict}
    line["unseen"] = bool(np.isclose(step / pitch, round(step / pitch)))
    line["found"] = [e.effect.key for e in closure.effects]
    named = [e for e in closure.effects if e.effect.key == "screw_cyclic X"]
    if named:
        (found,) = named
        value, u = next((v, u) for name, v, _, u in found.parameters if name == "pitch")
        shapes = [shape["pitch"] for shape in found.shapes] or [float(value)]
        line["status"], line["pitches"] = found.status, [float(f"{p:.5g}") for p in shapes]
        line["value"], line["u"] = float(value), float(u)
    beside = [e.shapes_of("screw_cyclic", "X") for e in closure.effects if e.status == "ambiguous"]
    line["alternative_pitches"] = [float(f"{v['pitch']:.5g}") for v in sum(beside, [])]
    check = {name: found.check for name, found in closure.errors.items()}
    line["check"] = {name: [float(f"{c.value:.5g}"), float(f"{c.u:.3g}")]
                     for name, c in check.items()}  # fmt: skip
    before, after = check["before"], check["after"]
    line["worse"] = bool(after.value > before.value + after.u)
    return line | {"seconds": round(time.perf_counter() - begun, 2)}


def true_in(line: dict, pitches: list[float]) -> bool:
    """Whether one of the pitches is the true one."""
    covered = (STEPS[line["step"]] - 1) * line["step"]
    away = (abs(1.0 / p - 1.0 / line["pitch"]) for p in pitches)
    return min(away) * covered <= BETWEEN


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the sets."""
    seeds = range(options.first_seed, options.first_seed + 100 * options.sets, 100)
    jobs = ((s, p, seed) for seed in seeds for p in PITCHES for s in STEPS)
    make_sets(options, jobs, ("step", "pitch", "seed"), one_set)


def summary(lines: list[dict]) -> dict:
    """How many of how many, for pitches that the readings show and for the others."""
    import vcal

    vcal.enable_float64()
    seen, unseen = ([x for x in lines if x["unseen"] == which] for which in (False, True))
    named = [x for x in seen if "pitches" in x]
    beside = [x for x in seen if "pitches" not in x and x["alternative_pitches"]]
    record = {
        "seen": len(seen),
        "named": len(named),
        "as_a_class": sum(len(x["pitches"]) > 1 for x in named),
        "true_in_class": sum(true_in(x, x["pitches"]) for x in named),
        "class_as_alternative": len(beside),
        "true_in_alternative": sum(true_in(x, x["alternative_pitches"]) for x in beside),
        "true_within_U": sum(abs(x["value"] - x["pitch"]) <= 2.0 * x["u"] for x in named),
        "worse_by_more_than_u": sum(x["worse"] for x in lines),
        "other_names": sum(bool(set(x["found"]) - {"screw_cyclic X"}) for x in lines),
        "unseen": len(unseen),
        "unseen_named": sum(bool(x["found"]) for x in unseen),
        "median_ratio": float(np.median([x["check"]["after"][0] / x["check"]["before"][0]
                                         for x in named])),
    }  # fmt: skip
    for name, value in record.items():
        print(name, value)
    return record


def main() -> None:
    """Run the campaign in single-threaded processes, or summarise it."""
    parser = campaign_parser(__doc__, "aliases", FIRST_SEED)
    parser.set_defaults(sets=1)
    options = parser.parse_args()
    campaign(__file__, options, work, summary)


if __name__ == "__main__":
    main()
