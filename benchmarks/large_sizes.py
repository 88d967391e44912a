"""Effects far larger than their prior: right names, wrong names and none.

The machines and instruments are those of power.py; the size of an effect is 10, 100 or 1000 times
the column *large* of the table in power_cases.py, which is about one prior standard deviation.

    python benchmarks/large_sizes.py --sets 4 --jobs 2 --minutes 60
    python benchmarks/large_sizes.py --summary

The first command appends one line per set to lines/large_sizes.jsonl and skips the sets that are
there. The second makes results/large_sizes.json from the lines.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch

from power import FIRST_SEED, limit_of, one_set
from power_cases import Entry
from power_summary import counted, is_of, outcome
from records import campaign, campaign_parser, make_sets, share

FACTORS = (10.0, 100.0, 1000.0)
KINDS = {
    "laser_tracker": (
        "backlash", "lateral_reversal", "scale_growth", "thermal_offset", "thermal_tilt", "warm_up",
        "drift", "jump of the tool", "jump of the frame", "station_drift", "screw_cyclic",
        "range_scale",
    ),
    "ball_array": (
        "backlash", "angular_reversal", "scale_growth", "thermal_offset", "thermal_tilt", "warm_up",
        "drift", "jump of the tool", "cross_axis", "ball_error", "artefact_bending",
        "artefact_expansion",
    ),
    "reflectors": (
        "backlash of a joint", "gear_harmonic", "gear_ripple", "gear_wind_up", "joint_coupling",
        "joint_compliance", "bearing_compliance", "jump of a joint",
    ),
}  # fmt: skip


def jobs(sets: range, patterns: Sequence[str]) -> Iterator[tuple[str, float, int]]:
    """Every set, seed by seed."""
    names = [f"{at}/{kind}" for at, kinds in KINDS.items() for kind in kinds]
    names = [name for name in names if any(fnmatch(name, p) for p in patterns)]
    yield from ((name, factor, seed) for seed in sets for factor in FACTORS for name in names)


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the sets."""
    from power_cases import ENTRIES, drawn, world_of

    def visible(entry: Entry, seed: int) -> bool:
        """Whether the plan shows the drawn effect: a tool that slips between two poses of an
        artefact does not differ from another pose.
        """
        world, (kind,) = world_of(entry.instrument, seed), entry.kinds
        return math.isfinite(limit_of(entry, world, drawn(entry, world)[0], kind))

    def made(case: str, factor: float, seed: int) -> dict:
        entry = ENTRIES[case]
        # In place of a detection limit: the size that is multiplied.
        limits = {(entry.instrument, k.name, entry.warming, seed): k.large for k in entry.kinds}
        try:
            if not visible(entry, seed):
                return {"case": case, "multiple": factor, "seed": seed, "limit": [], "truth": [],
                        "found": [], "verdict": "not detectable"}  # fmt: skip
            return one_set(entry, factor, seed, limits)
        except Exception as error:  # a set that fails is a finding, and must not end the campaign
            return {"case": case, "multiple": factor, "seed": seed, "limit": [], "truth": [],
                    "found": [], "verdict": "failed", "why": repr(error)}  # fmt: skip

    sets = range(options.first_seed, options.first_seed + options.sets)
    make_sets(options, jobs(sets, options.cases), ("case", "multiple", "seed"), made)


def is_right(line: dict) -> bool:
    """Whether the first name is right and no other name is certain: beside an effect far beyond its
    prior, the loop lists products of it with the pose as uncertain.
    """
    found, truth = line["found"], [key for key, *_ in line["truth"]]
    if not found or not any(is_of(key, found[0]) for key in truth):
        return False
    return outcome(line) != "wrong"


def summed(lines: Sequence[dict]) -> dict:
    """Right and wrong names by size, and the outcomes of every case."""
    sizes = []
    for factor in FACTORS:
        part = [
            line
            for line in lines
            if line["multiple"] == factor and line["verdict"] != "not detectable"
        ]
        if not part:
            continue
        right = sum(is_right(line) for line in part)
        wrong = sum(outcome(line) == "wrong" for line in part)
        sizes.append({"times": factor, "right": share(right, len(part)),
                      "wrong": share(wrong, len(part))})  # fmt: skip
        print(factor, counted(part))
    cases = sorted({line["case"] for line in lines})
    rows = [
        {"case": case, "outcomes": counted([line for line in lines if line["case"] == case])}
        for case in cases
    ]
    return {"sizes": sizes, "rows": rows}


def main() -> None:
    """Run the campaign in single-threaded processes, or summarise it."""
    options = campaign_parser(__doc__, "large_sizes", FIRST_SEED).parse_args()
    campaign(__file__, options, work, summed)


if __name__ == "__main__":
    main()
