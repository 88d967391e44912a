"""Many studies closed by one worker and by two: time, and nothing lost.

The studies are start studies of several instruments, measured by machines of their own (`vcal
simulate` with a seed each, half of them with an effect that is not declared); one of them is
broken. `vcal loop STUDY...` closes them with one worker and with two; then, on the first of them
and the broken one, with two workers of which one is killed in the middle; then the command itself
is killed and repeated. Every command starts with an empty cache of compiled programs of its own.
All reports must say the same but for times. Needs Linux.

    python benchmarks/fleet.py --studies 200
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from records import parser_of, write

KINDS = ("laser_tracker", "interferometer", "double_ball_bar", "ball_array")
"""Instruments of the studies, in turn."""
EFFECT = {
    "laser_tracker": "backlash:Y:size_um=6",
    "interferometer": "",
    "double_ball_bar": "backlash:X:size_um=4",
    "ball_array": "scale_growth:X:alpha_um_per_m_K=8",
}
"""What every second machine of an instrument has and its study does not declare."""
TIMES = ("seconds", "command", "sha256")
"""Keys of a report that say how it was made, and the hashes of its files."""
SINGLE = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def vcal(words: list[str], cache: Path, **options: Any) -> subprocess.Popen:
    """Start a command of vcal with one thread in each of its processes."""
    environment = dict(os.environ, XDG_CACHE_HOME=str(cache), **dict.fromkeys(SINGLE, "1"))
    environment["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    return subprocess.Popen(
        [sys.executable, "-m", "vcal", *words],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **options,
    )


def make_studies(number: int, work: Path) -> list[Path]:
    """The studies, of which one is broken."""
    made = []
    for kind in KINDS:
        finished(vcal(["init", str(work / f"start-{kind}"), "--instrument", kind], work / "cache"))
    for i in range(number):
        kind = KINDS[i % len(KINDS)]
        folder = work / "studies" / f"{kind}-{i:03d}"
        words = ["simulate", str(work / f"start-{kind}"), "--out", str(folder), "--seed", str(i)]
        if (i // len(KINDS)) % 2 and EFFECT[kind]:
            words += ["--with", EFFECT[kind]]
        finished(vcal(words, work / "cache"))
        made.append(folder)
    (made[number // 2] / "data.csv").write_text("x_mm,y_mm\n1,two\n")
    return made


def finished(process: subprocess.Popen, *codes: int) -> str:
    """What a process told when it has ended; it must end with 0 or one of `codes`."""
    told = process.communicate()[1]
    if process.returncode not in (0, *codes):
        raise SystemExit(f"{process.args} ended with {process.returncode}: {told[-500:]}")
    return told


def reports(out: Path) -> dict[str, Any]:
    """The reports of a fleet by the name of their study, without times."""

    def still(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: still(v) for k, v in value.items() if k not in TIMES}
        return [still(v) for v in value] if isinstance(value, list) else value

    return {
        path.parent.name: still(json.loads(path.read_text(encoding="utf-8")))
        for path in sorted((out / "reports").glob("*/report.json"))
    }


def children(pid: int) -> list[int]:
    """The child processes of a process that run Python."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            if int(fields[1]) == pid:
                found.append(int(path.parent.name))
    return sorted(found)


def done(out: Path) -> int:
    """Number of reports that are written."""
    return len(list((out / "reports").glob("*/report.json")))


def closed(studies: list[Path], work: Path, name: str, workers: int, kill: str = "") -> dict:
    """Close the loop on all studies, kill a worker or the command halfway, and measure."""
    out = work / name
    words = ["loop", *map(str, studies), "--out", str(out), "--workers", str(workers)]
    begun, killed = time.perf_counter(), 0
    process = vcal(words, work / f"cache-{name}")
    while kill and process.poll() is None and not killed:
        time.sleep(0.2)
        if done(out) > len(studies) / 2:
            if kill == "worker":
                killed = children(process.pid)[-1]
                os.kill(killed, signal.SIGKILL)
            else:
                killed = process.pid
                os.killpg(killed, signal.SIGKILL)
    told = finished(process, 2, *([-signal.SIGKILL] if kill == "command" else []))
    after = done(out)
    if kill == "command":
        told = finished(vcal(words, work / f"cache-{name}"), 2)
    return {
        "workers": workers,
        "killed": kill if killed else "",
        "wall_s": time.perf_counter() - begun,
        "reports_when_killed": after if kill == "command" else None,
        "reports": done(out),
        "told": told.splitlines()[-1][:200] if told else "",
    }


def main() -> None:
    """Make the studies and close the loop on them in four ways."""
    parser = parser_of(__doc__, "fleet")
    parser.add_argument("--studies", type=int, default=200)
    parser.add_argument("--killed", type=int, default=40, help="studies of the last two ways")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        studies = make_studies(options.studies, work)
        rows: list[dict] = []
        first: dict[str, Any] = {}
        broken = studies[len(studies) // 2]
        few = [*studies[: options.killed], broken]
        for name, workers, kill, some in (
            ("one", 1, "", studies),
            ("two", 2, "", studies),
            ("killed", 2, "worker", few),
            ("again", 2, "command", few),
        ):
            row = {"studies": len(some), **closed(some, work, name, workers, kill)}
            found = reports(work / name)
            first = first or found
            row["same"] = sum(first.get(key) == value for key, value in found.items())
            row["lost"] = len(some) - 1 - len(found)
            row["verdicts"] = dict(Counter(one["verdict"] for one in found.values()))
            rows.append(row)
            print(row, flush=True)
            speed_up = rows[0]["wall_s"] / rows[1]["wall_s"] if len(rows) > 1 else None
            record = {"studies": len(studies), "cores": os.cpu_count(), "speed_up": speed_up}
            write(options.out, record | {"rows": rows})


if __name__ == "__main__":
    main()
