"""Signals at random moments of six commands: all are honoured, and nothing is lost.

Every command runs once without a signal, which gives its duration, and then again and again in the
same folder with a Ctrl-C or SIGTERM at a random moment. Each time these must hold: the process ends
within two seconds, with exit code 130 or 143 and one message; the folder holds the earlier report
or a new one, whole; no temporary file is left. At the end every command runs once more.

A moment before the first line of vcal, while Python starts, is not counted: the system ends the
process then.

    python benchmarks/signals.py --signals 200
"""

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from records import parser_of, write

_STARTED_S = 0.2
"""Time in which Python itself starts, s."""
_LIMIT_S = 2.0
_RECORDS = ("report.json", "result.json", "check.json", "effects.json", "truth.json")


def commands(work: Path) -> dict[str, list[str]]:
    """The commands, each with its output folder as the last word."""
    study = str(work / "study")
    few = ["--set", "loop.draws=100", "--set", 'loop.effects=["backlash","scale_growth"]']
    return {
        "check": ["check", study, "--out"],
        "effects": ["effects", "backlash", "--out"],
        "simulate": ["simulate", study, "--out"],
        "loop": ["loop", study, *few, "--out"],
        "uncertainty": ["uncertainty", study, "--draws", "3000", "--out"],
        "design": ["design", str(work / "balls"), "--set", "design.steps=5",
                   "--set", "design.starts=1", "--out"],
    }  # fmt: skip


def start(words: list[str], out: Path, cache: Path) -> subprocess.Popen:
    """Start a command that listens to Ctrl-C, whatever this process does."""
    usual = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)}
    return subprocess.Popen(
        [sys.executable, "-m", "vcal", *words, str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "XDG_CACHE_HOME": str(cache)},
        **usual,
    )


def sums(out: Path) -> dict[str, str]:
    """SHA-256 of every file of a report; draws of a campaign and what is known are left out."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.parent.name != "draws" and path.name != "interrupted.json"
    }


def is_whole(out: Path) -> bool:
    """Whether all files of the report are there as its record says; a simulation has its truth."""
    found = sums(out)
    for name in _RECORDS:
        if name in found:
            content = json.loads((out / name).read_text())
            stated = {k: v for k, v in content.get("sha256", {}).items() if k != name}
            return all(found.get(k) == v for k, v in stated.items())
    return False


def one(name: str, words: list[str], work: Path, moment: random.Random, took: float) -> dict:
    """Send one signal to a command, and say what became of it."""
    out = work / f"{name}-out"
    if name == "simulate":  # it takes no folder of an earlier one
        out = work / f"{name}-{moment.randrange(10**9)}"
    before = sums(out) if out.exists() else {}
    number = moment.choice([signal.SIGINT, signal.SIGTERM])
    at = moment.uniform(_STARTED_S, max(took, 2 * _STARTED_S))
    process = start(words, out, work / "cache")
    time.sleep(at)
    if process.poll() is not None:
        process.communicate()
        return {"command": name, "late": True}
    sent = time.perf_counter()
    process.send_signal(number)
    _, told = process.communicate()
    seconds = time.perf_counter() - sent
    after = sums(out) if out.exists() else {}
    left = [p.name for p in work.iterdir() if p.name.startswith(f".{out.name}")]
    ended = process.returncode in (128 + number, -number)
    return {
        "command": name,
        "signal": signal.Signals(number).name,
        "at_s": round(at, 2),
        "of_s": round(took, 2),
        "seconds": round(seconds, 3),
        "code": process.returncode,
        "honoured": ended and seconds <= _LIMIT_S,
        "told": told.count("vcal: ") == 1 and "Traceback" not in told,
        "whole": after == before or is_whole(out),
        "left": left,
        "message": told.strip()[-200:].replace(str(work), ""),
    }


def main() -> None:
    """Send the signals, in turn to every command, and count what was honoured."""
    parser = parser_of(__doc__, "signals")
    parser.add_argument("--signals", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="Names of commands, separated by commas.")
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    options = parser.parse_args()
    moment, rows = random.Random(options.seed), []
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        for kind, folder in (("laser_tracker", "study"), ("ball_array", "balls")):
            subprocess.run(
                [sys.executable, "-m", "vcal", "init", str(work / folder), "--instrument", kind],
                check=True, capture_output=True,
            )  # fmt: skip
        chosen = commands(work)
        if options.only:
            chosen = {name: chosen[name] for name in options.only.split(",")}
        took = {}
        for name, words in chosen.items():
            for _ in range(2):  # the second one finds its programs compiled
                out = work / f"{name}-out"
                if name == "simulate":
                    out = work / f"{name}-first{_}"
                begun = time.perf_counter()
                process = start(words, out, work / "cache")
                _, told = process.communicate()
                took[name] = time.perf_counter() - begun
                if process.returncode:
                    raise SystemExit(f"{name} failed: {told}")
            print(f"{name}: {took[name]:.1f} s", flush=True)
        while len(rows) < options.signals:
            name = list(chosen)[len(rows) % len(chosen)]
            row = one(name, chosen[name], work, moment, took[name])
            if "late" in row:  # it was faster than the first time
                took[name] *= 0.95
                continue
            rows.append(row)
            bad = not (row["honoured"] and row["told"] and row["whole"]) or row["left"]
            print(("BAD " if bad else "") + json.dumps(row), flush=True)
        after = {}
        for name, words in chosen.items():
            process = start(
                words, work / f"{name}-{'again' * (name == 'simulate')}out", work / "cache"
            )
            process.communicate()
            after[name] = process.returncode
    keys = ("honoured", "told", "whole")
    counts = {key: sum(row[key] for row in rows) for key in keys}
    counts["nothing left"] = sum(not row["left"] for row in rows)
    slowest = max(row["seconds"] for row in rows)
    print(f"{len(rows)} signals: {counts}; slowest {slowest:.2f} s; next runs {after}")
    write(
        options.out,
        {
            "signals": len(rows), **counts, "slowest_s": slowest, "next_runs": after,
            "rows": [{k: v for k, v in row.items() if k != "message"} for row in rows],
        },
    )  # fmt: skip
    if min(counts.values()) < len(rows) or any(after.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
