"""Signals at random moments of six commands: all are honoured, and nothing is lost.

Every command runs once without a signal, which gives its duration, and then again and again in the
same folder with a Ctrl-C or SIGTERM at a random moment. Each time these must hold: the process
ends within two seconds, with exit code 130 or 143 and one message; the folder holds the earlier
report or a new one, whole; no temporary file is left. At the end every command runs once more.

A quarter of the processes are started as by a user. The others are forked off after the imports,
which would take most of the time of a small study. Moments before the first line of vcal, while
Python starts, and after the last one are not counted: the system ends the process then. Needs
Linux.

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
import traceback
from pathlib import Path

from records import parser_of, write

from vcal.cli import interruption
from vcal.cli import main as main_of_vcal
from vcal.cli.session import import_modules

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


class Started:
    """A command that runs, and listens to Ctrl-C whatever this process does."""

    def __init__(self, words: list[str], out: Path, forked: bool):
        self.output = tempfile.TemporaryFile()  # noqa: SIM115
        words = [*words, str(out)]
        if forked:
            ours, theirs = os.pipe()
            self._process, self.pid = None, os.fork()
            if self.pid == 0:
                self._run(words, theirs)
            os.close(theirs)
            os.read(ours, 1)  # it listens to signals now
            os.close(ours)
        else:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "vcal", *words],
                stdout=subprocess.DEVNULL,
                stderr=self.output,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            )
            self.pid = self._process.pid

    def _run(self, words: list[str], listens: int) -> None:
        listen = interruption.listen

        def say_so() -> None:
            listen()
            os.write(listens, b"1")

        interruption.listen = say_so
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for number, to in ((1, os.open(os.devnull, os.O_WRONLY)), (2, self.output.fileno())):
                os.dup2(to, number)
            sys.argv = ["vcal", *words]
            main_of_vcal()
        except SystemExit as stop:
            os._exit(stop.code if isinstance(stop.code, int) else 1)
        except BaseException:
            traceback.print_exc()
        os._exit(1)

    def ended(self) -> bool:
        """Whether it has ended."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def wait(self) -> tuple[int, str]:
        """Exit code, or minus the number of a signal, and the messages."""
        if self._process is None:
            code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        else:
            code = self._process.wait()
        self.output.seek(0)
        text = self.output.read().decode()
        self.output.close()
        return code, text


def is_leaving(pid: int) -> bool:
    """Whether the system is taking a process apart already (flag PF_EXITING of Linux), which takes
    some ms: no signal reaches it then.
    """
    stat = Path(f"/proc/{pid}/stat").read_text()
    return bool(int(stat.rpartition(")")[2].split()[6]) & 0x4)


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


def one(
    name: str, words: list[str], work: Path, moment: random.Random, took: float, forked: bool
) -> dict:
    """Send one signal to a command, and say what became of it."""
    out = work / f"{name}-out"
    if name == "simulate":  # it takes no folder of an earlier one
        out = work / f"{name}-{moment.randrange(10**9)}"
    before = sums(out) if out.exists() else {}
    number = moment.choice([signal.SIGINT, signal.SIGTERM])
    first = 0.0 if forked else _STARTED_S
    at = moment.uniform(first, max(took, 2 * _STARTED_S))
    process = Started(words, out, forked)
    time.sleep(at)
    if process.ended():
        process.wait()
        return {"command": name, "late": True}
    sent = time.perf_counter()
    os.kill(process.pid, number)
    was_over = is_leaving(process.pid)
    code, told = process.wait()
    if was_over and code == 0:
        return {"command": name, "late": True}
    seconds = time.perf_counter() - sent
    after = sums(out) if out.exists() else {}
    if code == -number and after != before and is_whole(out):
        return {"command": name, "late": True}  # Python shuts down: all results are written
    left = [p.name for p in work.iterdir() if p.name.startswith(f".{out.name}")]
    ended = code in (128 + number, -number)
    return {
        "command": name,
        "forked": forked,
        "signal": signal.Signals(number).name,
        "at_s": round(at, 2),
        "of_s": round(took, 2),
        "seconds": round(seconds, 3),
        "code": code,
        "honoured": ended,
        "in_time": seconds <= _LIMIT_S,
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
    import_modules()
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        os.environ["XDG_CACHE_HOME"] = str(work / "cache")
        for kind, folder in (("laser_tracker", "study"), ("ball_array", "balls")):
            code, said = Started(["init", "--instrument", kind], work / folder, True).wait()
            if code:
                raise SystemExit(said)
        chosen = commands(work)
        if options.only:
            chosen = {name: chosen[name] for name in options.only.split(",")}
        begun = time.perf_counter()
        code, said = Started(["check"], work / "study", False).wait()
        imports = time.perf_counter() - begun
        took = {}
        for name, words in chosen.items():
            for again in (False, True):  # the first one compiles its programs
                out = work / f"{name}-{'again' * (again and name == 'simulate')}out"
                begun = time.perf_counter()
                code, said = Started(words, out, True).wait()
                took[name, True] = time.perf_counter() - begun
                if code:
                    raise SystemExit(f"{name} failed: {said}")
            took[name, False] = imports + took[name, True]
            print(f"{name}: {took[name, False]:.1f} s, {took[name, True]:.1f} s", flush=True)
        while len(rows) < options.signals:
            name = list(chosen)[len(rows) % len(chosen)]
            forked = len(rows) // len(chosen) % 4 != 0
            row = one(name, chosen[name], work, moment, took[name, forked], forked)
            if "late" in row:  # it was faster than the first time
                took[name, forked] *= 0.95
                continue
            rows.append(row)
            bad = row["left"] or not all(row[k] for k in ("honoured", "in_time", "told", "whole"))
            print(("BAD " if bad else "") + json.dumps(row), flush=True)
        after = {}
        for name, words in chosen.items():
            out = work / f"{name}-{'once-more' * (name == 'simulate')}out"
            after[name] = Started(words, out, False).wait()[0]
    keys = ("honoured", "in_time", "told", "whole")
    counts = {key: sum(row[key] for row in rows) for key in keys}
    counts["nothing left"] = sum(not row["left"] for row in rows)
    slowest = max(row["seconds"] for row in rows)
    load = [round(value, 1) for value in os.getloadavg()]
    print(f"{len(rows)} signals: {counts}; slowest {slowest:.2f} s; next runs {after}")
    write(
        options.out,
        {
            "signals": len(rows), **counts, "slowest_s": slowest, "load_average": load,
            "next_runs": after,
            "rows": [{k: v for k, v in row.items() if k != "message"} for row in rows],
        },
    )  # fmt: skip
    if min(counts.values()) < len(rows) or any(after.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
