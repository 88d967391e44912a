"""Parts that several benchmarks use: result files, options, timing, campaigns of many data sets.

A campaign appends one line of JSON per data set to a file in benchmarks/lines/, which git ignores.
It skips the sets that the file holds already, so that it can be stopped, resumed and extended.
"""

import argparse
import hashlib
import json
import math
import os
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
LINES = HERE / "lines"


def parser_of(doc: str, name: str) -> argparse.ArgumentParser:
    """The options of a script whose result is results/NAME.json."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS / f"{name}.json")
    return parser


def write(path: Path, record: dict[str, Any]) -> None:
    """Write a record as JSON, a line per row of a table, with the commit that made it."""
    if not {"commit", "commits"} & record.keys():
        record = {"commit": commit_of(), **record}

    def text(value: Any) -> str:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return "[\n  " + ",\n  ".join(map(json.dumps, value)) + "\n ]"
        return json.dumps(value)

    path.parent.mkdir(parents=True, exist_ok=True)
    parts = [f" {json.dumps(key)}: {text(value)}" for key, value in record.items()]
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


def commit_of(root: Path = HERE.parent) -> str:
    """The commit of a checkout, with a + where its programs differ from it; empty without git."""
    git = ["git", "-C", str(root)]
    head = subprocess.run(
        [*git, "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=False
    )
    if head.returncode:
        return ""
    programs = ["vcal", "tests/oracle", "benchmarks/*.py"]
    same = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", *programs], check=False)
    return head.stdout.strip() + ("+" if same.returncode else "")


def commits_of(lines: Iterable[dict]) -> dict[str, int]:
    """Number of sets by the commit that made them."""
    return dict(sorted(Counter(line["commit"] for line in lines).items()))


def timed(work: Callable[[], Any], repeats: int) -> tuple[float, float, Any]:
    """Seconds of the first call, median seconds of `repeats` further calls, and the last result."""
    import jax

    seconds, found = [], None
    for _ in range(1 + repeats):
        start = time.perf_counter()
        found = jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    return seconds[0], statistics.median(seconds[1:] or seconds), found


def share(k: int, n: int) -> list[float]:
    """k, n and the 95 % interval of k/n (Clopper and Pearson)."""
    low, high = binomtest(k, n).proportion_ci()
    return [k, n, float(low), float(high)]


# --- campaigns -----------------------------------------------------------------------------------


def campaign_parser(doc: str, name: str, first_seed: int) -> argparse.ArgumentParser:
    """The options of a campaign whose lines are lines/NAME.jsonl."""
    parser = parser_of(doc, name)
    parser.add_argument("--cases", nargs="+", default=["*"], help="patterns such as 'r_test*'")
    parser.add_argument("--sets", type=int, default=20, help="seeds of every case")
    parser.add_argument("--first-seed", type=int, default=first_seed)
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--lines", type=Path, default=LINES / f"{name}.jsonl")
    parser.add_argument("--summary", action="store_true", help="only summarise the lines")
    parser.add_argument("--part", type=int, help=argparse.SUPPRESS)
    return parser


def known(path: Path) -> list[dict]:
    """The lines of a file; none where there is no file."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if line.strip()]


def append(path: Path, line: dict) -> None:
    """Append one whole line, whichever other process is writing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line, separators=(",", ":")) + "\n")


def forget_programs() -> None:
    """Drop compiled programs before the process exceeds the mappings that Linux allows."""
    import jax

    maps = Path("/proc/self/maps")
    if maps.is_file() and maps.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()


def make_sets(
    options: argparse.Namespace,
    jobs: Iterable[tuple],
    keys: Sequence[str],
    one_set: Callable[..., dict | None],
    together: Callable[..., Hashable] | None = None,
) -> None:
    """Make this process's share of the sets that are not in the file yet, until the time is over.

    A job is the values of `keys` in the line of its set, and the arguments of `one_set`; that
    returns None for a set that cannot be made. Jobs with the same value of `together` are made by
    one process; by default the jobs are dealt out in turn.
    """
    import vcal

    vcal.enable_float64()
    end = time.monotonic() + 60 * options.minutes
    done = {tuple(line[key] for key in keys) for line in known(options.lines)}
    commit = commit_of()
    for number, job in enumerate(jobs):
        mine = hash(together(*job)) if together else number
        if mine % options.jobs != options.part or job in done:
            continue
        if time.monotonic() > end:
            return
        line = one_set(*job)
        if line is None:
            continue
        append(options.lines, line | {"commit": commit})
        forget_programs()
        found = [f["key"] if isinstance(f, dict) else f for f in line.get("found", [])]
        print(*job, line.get("verdict", ""), found, line.get("seconds", ""), flush=True)


def in_parallel(script: str, jobs: int) -> None:
    """Run a script again in `jobs` single-threaded processes, each with its own --part."""
    environment = dict(
        os.environ,
        PYTHONHASHSEED="0",
        OPENBLAS_NUM_THREADS="1",
        OMP_NUM_THREADS="1",
        XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    )
    command = [sys.executable, script, *sys.argv[1:]]
    running = [
        subprocess.Popen([*command, "--part", str(part)], env=environment) for part in range(jobs)
    ]
    try:
        codes = [process.wait() for process in running]
    except KeyboardInterrupt:
        for process in running:
            process.terminate()
        raise
    if any(codes):
        raise SystemExit(f"workers ended with {codes}")


def campaign(
    script: str,
    options: argparse.Namespace,
    work: Callable[[argparse.Namespace], None],
    summed: Callable[[list[dict]], dict[str, Any]],
) -> None:
    """Run a campaign in parallel, or with --summary write the summary of its lines."""
    if options.part is not None:
        work(options)
    elif options.summary:
        lines = known(options.lines)
        if not lines:
            raise SystemExit(f"{options.lines}: no lines to summarise")
        seeds = [line["seed"] for line in lines]
        head = {
            "command": f"python benchmarks/{Path(script).name} --first-seed SEED --sets SETS",
            "sets": len(lines),
            "seeds": [min(seeds), max(seeds)],
            "lines_sha256": hashlib.sha256(options.lines.read_bytes()).hexdigest(),
            "commits": commits_of(lines),
        }
        write(options.out, {**head, **summed(lines)})
    else:
        options.lines.parent.mkdir(parents=True, exist_ok=True)
        in_parallel(script, options.jobs)
