"""Time and memory of the loop as measurements grow: points, poses, data sets, samples.

Every study is written by the numpy generator of the tests, with one effect that is not declared,
and runs in a process of its own with one thread: CPU seconds of reading it and of `close_loop`
(with the programs of a small study compiled before), and the peak of the whole process. Needs a
POSIX system.

    python benchmarks/growth.py
"""

import argparse
import dataclasses
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from records import HERE, parser_of, write

sys.path.insert(0, str(HERE.parent / "tests"))

POINTS = {504: (7, 6, 6), 2_016: (12, 12, 7), 20_412: (27, 21, 18), 204_624: (58, 42, 42)}
"""Grid of a tracker plan, measured in both directions, by its number of rows."""
CASES = (
    *(("points", n) for n in POINTS),
    ("poses", 12),
    ("poses", 48),
    ("data sets", 1),
    ("data sets", 8),
    ("samples", 1_000_020),
    ("samples", 6_000),
)
BACKLASH = {"effect": "backlash", "axis": "X", "size_um": 6}
GROWTH = {"effect": "scale_growth", "axis": "X", "coefficient_um_per_m_K": 8}
LAG = {"effect": "servo_lag", "axis": "X", "T_ms": 0.03}
RUNS = 30
"""Runs of an R-test of the generator."""
TURNS = 10
SINGLE = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def made(kind: str, number: int, folder: Path) -> Path:
    """The folder of a study of that size."""
    import numpy as np

    from joint import write_joint
    from oracle import make_case, write_study
    from oracle.plans import BEAMS

    if kind == "poses":
        poses = (BEAMS * 8)[:number]
        return write_study(folder, make_case("ball_array", seed=5, effects=[GROWTH],
                                             plan={"poses": poses}))  # fmt: skip
    if kind == "samples":
        # At least 20 samples per turn: a smaller number has fewer turns.
        samples = number // RUNS
        plan = {"samples": samples, "turns": float(TURNS if samples >= 20 * TURNS else 1)}
        return write_study(folder, make_case("r_test", seed=7, effects=[LAG], plan=plan))
    shape = POINTS[number if kind == "points" else 504]
    case = make_case("laser_tracker", seed=5, effects=[BACKLASH], plan={"shape": shape})
    if kind == "points" or number == 1:
        return write_study(folder, case)
    cuts = np.linspace(0, len(case.data["t_s"]), number + 1).astype(int)
    parts = {
        f"part{i}": dataclasses.replace(
            case, data={name: v[cuts[i] : cuts[i + 1]] for name, v in case.data.items()}
        )
        for i in range(number)
    }
    return write_joint(folder / "joint", parts)


def measured(kind: str, number: int) -> dict[str, Any]:
    """Time and memory of one case in this process."""
    import vcal

    def cpu() -> float:
        used = resource.getrusage(resource.RUSAGE_SELF)
        return used.ru_utime + used.ru_stime

    vcal.enable_float64()
    with tempfile.TemporaryDirectory() as scratch:
        small = {"points": 504, "poses": 12, "data sets": number, "samples": 1_800}[kind]
        study = vcal.load_study(made(kind, small, Path(scratch) / "small"))
        vcal.close_loop(study.model, study.measurement, check=study.check)
        folder = made(kind, number, Path(scratch) / "own")
        peak_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        wall, begun = time.perf_counter(), cpu()
        study = vcal.load_study(folder)
        read = cpu()
        closure = vcal.close_loop(study.model, study.measurement, check=study.check)
        ended = cpu()
        return {
            "kind": kind,
            "number": number,
            "rows": study.plan.rows,
            "read_cpu_s": read - begun,
            "loop_cpu_s": ended - read,
            "wall_s": time.perf_counter() - wall,
            "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
            "peak_before_mib": peak_before,
            "named": [effect.effect.key for effect in closure.effects],
        }


def main() -> None:
    """Run every case in a process of its own."""
    parser = parser_of(__doc__, "growth")
    parser.add_argument("--cases", nargs="+", help="names such as points or samples")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measured(options.one[0], int(options.one[1]))))
        return
    environment = dict(os.environ, **dict.fromkeys(SINGLE, "1"))
    environment["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    rows: list[dict[str, Any]] = []
    for kind, number in CASES:
        if options.cases and kind not in options.cases:
            continue
        command = [sys.executable, __file__, "--one", kind, str(number)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{kind} {number} failed: {done.stderr[-1000:]}")
        row = json.loads(done.stdout.splitlines()[-1])
        same = [one for one in rows if one["kind"] == kind and one["rows"] < row["rows"]]
        if same:
            grown = row["rows"] / same[-1]["rows"]
            more = row["loop_cpu_s"] / same[-1]["loop_cpu_s"]
            row["exponent"] = math.log(more) / math.log(grown)
        rows.append(row)
        print(row, flush=True)
        write(options.out, {"cores": os.cpu_count(), "rows": rows})


if __name__ == "__main__":
    main()
