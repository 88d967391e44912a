"""The smallest sizes that are stated to be named, against simulated data.

The machines and instruments are those of power.py. For every effect, the size is the
smallest that `vcal.loop.detectable` states for the set without any effect; it is then measured
with other noise, at the pitch for which the size is stated, and the loop is closed. An effect of
that size is named with 95 %.

    python benchmarks/smallest_sizes.py --sets 60 --jobs 2 --minutes 60
    python benchmarks/smallest_sizes.py --summary

The first command appends one line per set to lines/smallest_sizes.jsonl and skips the sets that are
there. The second makes results/smallest_sizes.json from the lines.
"""

import argparse
import dataclasses
import math
import time
import zlib
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
from typing import TYPE_CHECKING

from power import ALPHA, DRAWS, FIRST_SEED, load, screened
from power_summary import is_of
from records import campaign, campaign_parser, make_sets, share

if TYPE_CHECKING:
    from power_cases import Sized, Term

    from vcal.loop.detectable import SmallestSize

KINDS = {
    "laser_tracker": ("backlash", "lateral_reversal", "angular_reversal", "scale_growth",
                      "screw_cyclic"),
    "ball_array": ("backlash", "lateral_reversal", "scale_growth"),
}  # fmt: skip


def jobs(sets: range, patterns: Sequence[str]) -> Iterator[tuple[str, int]]:
    """Every set, seed by seed."""
    names = [f"{at}/{kind}" for at, kinds in KINDS.items() for kind in kinds]
    names = [name for name in names if any(fnmatch(name, p) for p in patterns)]
    yield from ((name, seed) for seed in sets for name in names)


def one_set(case: str, seed: int) -> dict | None:
    """The stated size of the drawn effect, and what the loop finds of that size; None where no
    size is stated.
    """
    from power_cases import ENTRIES, drawn, make, world_of

    import vcal
    from vcal.identification.identify import identify
    from vcal.loop.detectable import detectable
    from vcal.loop.weighing.cross_validation import folds_of

    start = time.perf_counter()
    entry = ENTRIES[case]
    world = world_of(entry.instrument, seed)
    sized = drawn(entry, world)
    study = load(make(entry, world, sized, [0.0]).case)
    keep = ~folds_of(study.model, study.measurement)[1]  # the loop never fits the other rows
    fit = identify(study.model, study.measurement, keep=keep)
    screening = screened(study, fit, DRAWS, seed)
    seen = detectable(fit, vcal.CATALOGUE.values(), screening, alpha=ALPHA, seed=seed)
    term = sized[0](1.0)
    limits = [
        limit
        for limit in seen.limits
        if limit.effect.key == term.key
        and (not term.parameters or limit.amplitude.name in term.parameters)
    ]
    least = min(limits, key=lambda limit: limit.size, default=None)
    size = float("inf") if least is None else least.size
    line: dict = {"case": case, "seed": seed, "limit": size}
    if least is None or size == float("inf"):
        return line | {"verdict": "not stated", "named": False, "found": [], "seconds": 0.0}
    noise = zlib.crc32(f"{case} {seed}".encode())
    at_its_shape = [_at_its_shape(sized[0], least)]
    study = load(make(entry, world, at_its_shape, [size], noise_seed=noise).case)
    closure = vcal.close_loop(
        study.model, study.measurement, check=study.check, alpha=ALPHA, draws=DRAWS, seed=seed
    )
    found = [
        {"key": e.effect.key, "status": e.status, "equivalent": e.equivalent}
        for e in closure.effects
    ]
    named = any(is_of(term.key, f) and f["status"] == "named" for f in found)
    return line | {
        "verdict": closure.verdict,
        "named": named,
        "found": found,
        "seconds": round(time.perf_counter() - start, 2),
    }


def _at_its_shape(drawn: "Sized", limit: "SmallestSize") -> "Sized":
    """A drawn effect with the pitch and the phase of a limit, where it has any."""

    def sized(size: float) -> "Term":
        term = drawn(size)
        if "pitch" not in limit.shape:
            return term
        phase = {"sine": 0.0, "cosine": 0.5 * math.pi}[limit.amplitude.name]
        at = {"pitch_mm": 1e3 * limit.shape["pitch"], "phase": phase}
        return dataclasses.replace(term, effects=tuple(dict(e) | at for e in term.effects))

    return sized


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the sets."""
    sets = range(options.first_seed, options.first_seed + options.sets)
    make_sets(options, jobs(sets, options.cases), ("case", "seed"), one_set)


def summed(lines: Sequence[dict]) -> dict:
    """How often an effect of the stated size is named, by case and in all."""
    rows = []
    for case in sorted({line["case"] for line in lines}):
        part = [line for line in lines if line["case"] == case]
        stated = [line for line in part if line["verdict"] != "not stated"]
        row = {"case": case, "sets": len(part), "not_stated": len(part) - len(stated)}
        row |= {"named": share(sum(line["named"] for line in stated), len(stated))}
        rows.append(row)
        print(row)
    stated = [line for line in lines if line["verdict"] != "not stated"]
    return {"all": share(sum(line["named"] for line in stated), len(stated)), "rows": rows}


def main() -> None:
    """Run the campaign in single-threaded processes, or summarise it."""
    options = campaign_parser(__doc__, "smallest_sizes", FIRST_SEED).parse_args()
    campaign(__file__, options, work, summed)


if __name__ == "__main__":
    main()
