"""How often the loop names an effect in measurements where nothing is missing.

Machines are drawn from the declared family and measured by the independent numpy generator of the
tests (exact rotations, nothing shared with vcal), at the declared noise and at 1.1 times that.

    python benchmarks/false_alarms.py --sets 200 --out benchmarks/results/false_alarms.json
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
INSTRUMENTS = ("laser_tracker", "ball_array")
CHAINS = ("w X b Y Z t", "w Y b X Z t", "w b X Y Z t")


def run(instrument: str, noise: float, seeds: range) -> None:
    """Close the loop on one clean set per seed; one JSON line per set on standard output."""
    sys.path.insert(0, str(HERE.parent / "tests"))
    import vcal
    from oracle import make_case, write_study

    vcal.enable_float64()
    for seed in seeds:
        case = make_case(instrument, CHAINS[seed % len(CHAINS)], seed=seed, noise_factor=noise)
        with tempfile.TemporaryDirectory() as folder:
            write_study(Path(folder), case)
            study = vcal.load_study(Path(folder) / "setup.toml")
        start = time.perf_counter()
        closure = vcal.close_loop(study.model, study.measurement, check=study.check, seed=seed)
        line = {
            "instrument": instrument,
            "noise": noise,
            "seed": seed,
            "verdict": closure.verdict,
            "effects": [effect.effect.key for effect in closure.effects],
            "p_value": closure.screenings[0].p_value,
            "check_um": closure.errors["after"].check.value,
            "chi2_per_dof": closure.errors["before"].chi2_per_dof,
            "seconds": time.perf_counter() - start,
        }
        print(json.dumps(line), flush=True)


def summary(lines: list[dict]) -> list[dict]:
    """Share of sets with a name, and with anything but *nothing missing*, per column."""
    table = []
    for instrument in INSTRUMENTS:
        for noise in sorted({line["noise"] for line in lines}):
            part = [x for x in lines if (x["instrument"], x["noise"]) == (instrument, noise)]
            if not part:
                continue
            n = len(part)
            table.append(
                {
                    "instrument": instrument,
                    "noise": noise,
                    "sets": n,
                    "named_percent": 100.0 * sum(bool(x["effects"]) for x in part) / n,
                    "unexplained_percent": 100.0
                    * sum(x["verdict"] == "unexplained" for x in part)
                    / n,
                    "p_below_alpha_percent": 100.0 * sum(x["p_value"] <= 0.01 for x in part) / n,
                    "seconds_median": sorted(x["seconds"] for x in part)[n // 2],
                }
            )
    return table


def main() -> None:
    """Run the campaign in one single-threaded process per instrument and noise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=10_000)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "false_alarms.json")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--part", nargs=2, metavar=("INSTRUMENT", "NOISE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.sets)
    if options.part:
        run(options.part[0], float(options.part[1]), seeds)
        return
    environment = dict(
        os.environ,
        OPENBLAS_NUM_THREADS="1",
        OMP_NUM_THREADS="1",
        XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    )
    waiting = [(i, n) for n in ("1.0", "1.1") for i in INSTRUMENTS]
    running: list[subprocess.Popen] = []
    lines: list[dict] = []
    while waiting or running:
        while waiting and len(running) < options.jobs:
            command = [sys.executable, __file__, "--sets", str(options.sets)]
            command += ["--first-seed", str(options.first_seed), "--part", *waiting.pop(0)]
            running.append(
                subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
            )
        process = running.pop(0)
        output, _ = process.communicate()
        if process.returncode:
            raise SystemExit(f"a part of the campaign failed with exit code {process.returncode}")
        lines += [json.loads(line) for line in output.splitlines()]
    table = summary(lines)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"summary": table, "sets": lines}, indent=1) + "\n")
    for row in table:
        print(row)


if __name__ == "__main__":
    main()
