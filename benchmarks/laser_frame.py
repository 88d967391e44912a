"""Seconds of the laser frame's Monte Carlo campaigns, cold and warm, and their results.

    python benchmarks/laser_frame.py

Cold is the first campaign of the process, with compilation. Warm is the median of further ones,
each of which compiles its own program, from the cache of compiled programs where there is one.
"""

import jax
from records import parser_of, timed, write

import vcal
from vcal.reproduce.laser_frame.cycles import cycles
from vcal.reproduce.laser_frame.recipe import distance, exchanged

CASES = {
    "planar, noise": ("planar", "none", "thirteen with prior"),
    "planar, all 21 errors": ("planar", "all", "thirteen with prior"),
    "3d, all 21 errors, all fitted": ("3d", "all", "all with prior"),
}


def main() -> None:
    """Run every case and write the times."""
    parser = parser_of(__doc__, "laser_frame")
    parser.add_argument("--draws", type=int, default=30_000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    vcal.enable_float64()
    results = []
    for name, (path, machine, fitted) in CASES.items():
        cold, warm, found = timed(
            lambda case=(path, machine, fitted): cycles(*case, draws=options.draws, seed=0),
            options.repeats,
        )
        row = {
            "case": name,
            "cycles": options.draws,
            "cold_s": cold,
            "warm_s": warm,
            "failed": found.campaign.failed,
            "rms_ln_ratio": distance(found.by_beams, exchanged())
            if found.by_beams and machine == "none"
            else None,
        }
        results.append(row)
        print(row, flush=True)
    write(options.out, {"device": jax.devices()[0].device_kind, "rows": results})


if __name__ == "__main__":
    main()
