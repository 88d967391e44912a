"""Cycles of the laser frame's Monte Carlo per second, cold and warm, and what they gave.

    python benchmarks/laser_frame.py --out benchmarks/results/laser_frame.json

Cold is the first campaign of the process, with compilation; warm the median of further ones, each
of which compiles its own program anew, from the cache of compiled programs where there is one.
"""

import argparse
import json
import statistics
import time
from pathlib import Path

import jax

import vcal
from vcal.reproduce.laser_frame.cycles import cycles
from vcal.reproduce.laser_frame.table_four import distance, exchanged

HERE = Path(__file__).resolve().parent
CASES = {
    "planar, noise": ("planar", "none", "thirteen with prior"),
    "planar, all 21 errors": ("planar", "all", "thirteen with prior"),
    "3d, all 21 errors, all fitted": ("3d", "all", "all with prior"),
}


def main() -> None:
    """Run every case and keep the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=30_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "laser_frame.json")
    options = parser.parse_args()
    vcal.enable_float64()
    results = []
    for name, (path, machine, fitted) in CASES.items():
        seconds = []
        for _ in range(1 + options.repeats):
            start = time.perf_counter()
            found = cycles(path, machine, fitted, draws=options.draws, seed=0)
            seconds.append(time.perf_counter() - start)
        row = {
            "case": name,
            "cycles": options.draws,
            "cold_s": seconds[0],
            "warm_s": statistics.median(seconds[1:]),
            "failed": found.campaign.failed,
            "rms_ln_ratio": distance(found.by_beams, exchanged())
            if found.by_beams and machine == "none"
            else None,
        }
        results.append(row)
        print(row, flush=True)
    device = jax.devices()[0].device_kind
    options.out.write_text(json.dumps({"device": device, "rows": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
