"""A campaign that is killed (SIGKILL) repeatedly and resumed ends with the same numbers.

A process runs the campaign of batch.py, keeps finished blocks in a folder, and is killed at a
random moment after its first block. The next process resumes from the folder. At the end every
array of the result is compared, bit for bit, with that of an uninterrupted campaign.

    python benchmarks/interrupted.py
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from records import parser_of, write


def campaign(draws: int, folder: Path, result: Path) -> None:
    """Run or resume the campaign, print its progress, and write its numbers."""
    from batch import problem

    import vcal
    from vcal.uncertainty import ErrorMotionErrors, ParameterErrors, monte_carlo

    vcal.enable_float64()
    model, plan = problem()

    def progress(done: int, total: int | None) -> None:
        print(done, flush=True)

    done = monte_carlo(
        model,
        model,
        plan,
        draws=draws,
        quantities=[ParameterErrors(), ErrorMotionErrors(nodes=3)],
        folder=folder,
        progress=progress,
    )
    e = done.ensemble
    np.savez(result, values=e.values, mean=e.mean, u=e.u, covariance=e.covariance)


def start(draws: int, folder: Path, result: Path) -> subprocess.Popen:
    """Start a process that runs or resumes the campaign."""
    command = [sys.executable, __file__, "--draws", str(draws)]
    command += ["--campaign", str(folder), str(result)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def main() -> None:
    """Run the campaign without and with interruptions, and compare."""
    parser = parser_of(__doc__, "interrupted")
    parser.add_argument("--draws", type=int, default=200_000)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--campaign", type=Path, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.campaign:
        campaign(options.draws, *options.campaign)
        return
    moment = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        begin = time.perf_counter()
        alone = start(options.draws, work / "alone", work / "alone.npz")
        marks = [(int(line), time.perf_counter()) for line in alone.stdout or ()]
        if alone.wait() != 0:
            raise SystemExit("the uninterrupted campaign failed")
        per_draw = (marks[-1][1] - marks[0][1]) / (marks[-1][0] - marks[0][0])
        print(f"uninterrupted: {time.perf_counter() - begin:.0f} s", flush=True)
        # Each process lives long enough for about its share of the draws.
        share = per_draw * options.draws / (options.kills + 1)
        killed, files = [], work / "killed"
        for _ in range(options.kills):
            process = start(options.draws, files, work / "killed.npz")
            first = int(process.stdout.readline())  # type: ignore[union-attr]
            time.sleep(moment.uniform(0.1, 1.9) * share)
            if process.poll() is not None:
                break
            process.kill()
            last = [int(line) for line in process.stdout or ()]
            process.wait()
            killed.append({"from": first, "to": last[-1] if last else first})
            print(f"killed: {killed[-1]}", flush=True)
        process = start(options.draws, files, work / "killed.npz")
        process.communicate()
        if process.returncode != 0:
            raise SystemExit("the last campaign failed")
        one, two = np.load(work / "alone.npz"), np.load(work / "killed.npz")
        same = {name: bool(one[name].tobytes() == two[name].tobytes()) for name in one}
    print(f"{len(killed)} kills; the same bit for bit: {same}")
    write(options.out, {"draws": options.draws, "killed": killed, "same": same})
    if not all(same.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
