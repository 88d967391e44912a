"""Error at the tool of machines behind a running LinuxCNC, against what `vcal verify` foretells.

Machines with a thermal tilt or backlash are drawn, measured and identified. What vcal writes for
LinuxCNC is loaded into a controller without a screen, which drives to 220 points in both
directions; half-way the temperatures rise by 5 K. The positions of its motors are put through the
true machine. Each machine is one draw of what is foretold, so their ratios scatter; the mean square
over the machines does not.

    python benchmarks/linuxcnc.py --sets 6
    python benchmarks/linuxcnc.py --summary

The first command needs LinuxCNC and takes two minutes a machine and format. It appends one line per
drive to lines/linuxcnc.jsonl; the second makes results/linuxcnc.json from the lines.
"""

import argparse
import math
import sys
from pathlib import Path

import numpy as np
from records import campaign, campaign_parser, make_sets

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

KINDS = ("thermal_tilt", "backlash")
FORMATS = ("linuxcnc", "linuxcnc-screw")
FIRST_SEED = 45_000
COUNT_M = 1.01e-7
"""Most by which the motors may differ from what vcal says they do: a count of the offsets."""


def one_drive(kind: str, name: str, seed: int) -> dict:
    """Errors of one machine behind a controller."""
    from controlled_machines import driven_to, measured

    true, machine = measured(kind, seed)
    found = driven_to(true, machine, name, seed)
    line = {"kind": kind, "format": name, "seed": seed, "points": len(found.moved)}
    line |= {"foretold_um": found.foretold.mean, "u_um": found.foretold.u}
    line |= {f"{when}_um": value for when, value in found.rms_um.items()}
    return line | {"as_said": bool(np.abs(found.moved - found.applied).max() <= COUNT_M)}


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the drives."""
    seeds = range(options.first_seed, options.first_seed + options.sets)
    jobs = ((kind, name, seed) for seed in seeds for kind in KINDS for name in FORMATS)
    make_sets(options, jobs, ("kind", "format", "seed"), one_drive)


def summary(lines: list[dict]) -> dict:
    """Root mean squares over the machines, by kind and format."""
    rows = []
    for kind in KINDS:
        for name in FORMATS:
            mine = [x for x in lines if (x["kind"], x["format"]) == (kind, name)]
            if not mine:
                continue
            rms = {k: math.sqrt(np.mean([x[f"{k}_um"] ** 2 for x in mine]))
                   for k in ("before", "after", "foretold")}  # fmt: skip
            ratios = [x["after_um"] / x["foretold_um"] for x in mine]
            z = [(x["after_um"] - x["foretold_um"]) / x["u_um"] for x in mine]
            row = {"kind": kind, "format": name, "machines": len(mine)}
            row |= {f"{k}_um": round(v, 3) for k, v in rms.items()}
            row |= {"after_over_foretold": round(rms["after"] / rms["foretold"], 3)}
            row |= {"largest_ratio": round(max(ratios), 3), "largest_z": round(max(z), 2)}
            rows.append(row | {"as_said": sum(x["as_said"] for x in mine)})
            print(row)
    return {"drives": rows}


def main() -> None:
    """Drive the machines, or summarise the drives."""
    parser = campaign_parser(__doc__, "linuxcnc", FIRST_SEED)
    parser.set_defaults(sets=6)
    campaign(__file__, parser.parse_args(), work, summary)


if __name__ == "__main__":
    main()
