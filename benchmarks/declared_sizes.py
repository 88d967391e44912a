"""Families declared too small or too large: false names, and whether the misfit is reported.

The machines and instruments are those of the clean entries of power.py. The prior standard
deviations of all error motions and location errors are a third of the true ones, three times as
large, or right.

    python benchmarks/declared_sizes.py --sets 20 --jobs 2 --minutes 60
    python benchmarks/declared_sizes.py --summary

The first command appends one line per set to lines/declared_sizes.jsonl and skips the sets that are
there. The second makes results/declared_sizes.json from the lines.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch

from power import ALPHA, DRAWS, FIRST_SEED, load
from records import campaign, campaign_parser, make_sets, share

FACTORS = (1.0 / 3.0, 3.0, 1.0)
INSTRUMENTS = ("laser_tracker", "ball_array", "laser_frame", "reflectors")
"""Those of studies that declare a family."""


def one_set(case: str, factor: float, seed: int) -> dict:
    """Close the loop on a clean set with the sizes of its family multiplied by `factor`."""
    from power_cases import ENTRIES, make, world_of

    import vcal
    from vcal.effects.geometric import GeometricErrors
    from vcal.identification.family_sizes import with_sizes

    start = time.perf_counter()
    entry = ENTRIES[case]
    study = load(make(entry, world_of(entry.instrument, seed), [], []).case)
    family = next(e for e in study.model.effects if isinstance(e, GeometricErrors))
    names = [*(m.name for m in family.motions), *(e.name for e in family.locations)]
    closure = vcal.close_loop(
        with_sizes(study.model, dict.fromkeys(names, factor)),
        study.measurement,
        check=study.check,
        alpha=ALPHA,
        draws=DRAWS,
        seed=seed,
    )
    sizes = closure.sizes
    errors = {}
    for stage, its in closure.errors.items():
        rms = its.heldout if its.check is None else its.check
        errors[stage] = [float(f"{rms.value:.5g}"), float(f"{rms.u:.3g}")]
    return {
        "case": case, "factor": round(factor, 4), "seed": seed, "verdict": closure.verdict,
        "found": [[e.effect.key, e.status] for e in closure.effects],
        "said": sizes is not None,
        "used": sizes is not None and sizes.used,
        "factors": {} if sizes is None else {k: round(v, 2) for k, v in sizes.factors.items()},
        "rms": errors,
        "seconds": round(time.perf_counter() - start, 2),
    }  # fmt: skip


def jobs(sets: range, patterns: Sequence[str]) -> Iterator[tuple[str, float, int]]:
    """Every set, seed by seed."""
    names = [f"{at}/clean" for at in INSTRUMENTS]
    names = [name for name in names if any(fnmatch(name, p) for p in patterns)]
    yield from ((name, round(f, 4), seed) for seed in sets for f in FACTORS for name in names)


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the sets."""

    def made(case: str, factor: float, seed: int) -> dict:
        try:
            return one_set(case, factor, seed)
        except Exception as error:  # a set that fails is a finding, and must not end the campaign
            return {"case": case, "factor": factor, "seed": seed, "verdict": "failed",
                    "found": [], "said": False, "used": False, "why": repr(error)}  # fmt: skip

    sets = range(options.first_seed, options.first_seed + options.sets)
    make_sets(options, jobs(sets, options.cases), ("case", "factor", "seed"), made)


def summed(lines: Sequence[dict]) -> dict:
    """Shares of false names and of reported misfits, by factor and by instrument."""
    rows = []
    for factor in (round(f, 4) for f in FACTORS):
        for case in ["all", *sorted({line["case"] for line in lines})]:
            part = [
                line for line in lines if line["factor"] == factor and case in ("all", line["case"])
            ]
            if not part:
                continue
            named = sum(any(status == "named" for _, status in one["found"]) for one in part)
            any_ = sum(bool(one["found"]) or one["verdict"] == "unexplained" for one in part)
            row = {
                "factor": factor, "case": case, "false names": share(named, len(part)),
                "anything": share(any_, len(part)),
                "misfit said": share(sum(one["said"] for one in part), len(part)),
                "failed": sum(one["verdict"] == "failed" for one in part),
            }  # fmt: skip
            rows.append(row)
            print(row)
    return {"rows": rows}


def main() -> None:
    """Run the campaign in single-threaded processes, or summarise it."""
    options = campaign_parser(__doc__, "declared_sizes", FIRST_SEED).parse_args()
    campaign(__file__, options, work, summed)


if __name__ == "__main__":
    main()
