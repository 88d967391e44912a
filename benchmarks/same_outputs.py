"""Whether two versions of vcal give the same numbers: every command, byte for byte.

    python benchmarks/same_outputs.py make OUT          # with the vcal of the working directory
    python benchmarks/same_outputs.py compare OLD NEW   # exit code 1 where a number differs

`make` runs the demo, the six start studies, the practice data and the arm (where `../shared/data`
is there), `vcal uncertainty`, `vcal design --next` and the four reproductions, and keeps their
records and tables. `compare` walks through both. Numbers have to be the same to the last digit.
Texts may be reworded: they are listed. Run times, dates and versions are left out.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

STARTS = (
    "ball_array", "interferometer", "laser_frame", "laser_tracker", "r_test", "reflectors",
    "static_r_test",
)  # fmt: skip
REPRODUCTIONS = {
    "acceleration": 20,
    "artefact-design": 100,
    "laser-frame": 200,
    "tracker-verification": 200,
}
"""Draws of each: fewer than by default, as this asks for the same numbers, not for good ones."""
KEPT = ("report.json", "result.json", "compensation.csv", "effects.csv", "data.csv")
VOLATILE = {
    "seconds", "time", "sha256", "created", "written", "versions", "command", "date", "made"
}  # fmt: skip
SHARED = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"


def vcal(*arguments: str | Path) -> None:
    """Run a command of vcal; raises where it fails."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "vcal", *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: exit {done.returncode}\n{done.stdout}{done.stderr}")


def cases(work: Path, shared: Path) -> dict[str, list[list[str | Path]]]:
    """The commands of every case; the last one writes into the folder `work / name`."""
    found: dict[str, list[list[str | Path]]] = {"demo": [["demo", "--out", work / "demo"]]}
    for kind in STARTS:
        study = work / f"study_{kind}"
        found[f"start_{kind}"] = [
            ["init", study, "--instrument", kind],
            ["loop", study, "--out", work / f"start_{kind}"],
        ]
    plan = work / "study_uncertainty"
    found["uncertainty"] = [
        ["init", plan, "--instrument", "laser_tracker"],
        ["uncertainty", plan, "--out", work / "uncertainty", "--draws", "3000", "--seed", "4"],
    ]
    plan = work / "study_design"
    found["design_next"] = [
        ["init", plan, "--instrument", "laser_tracker"],
        ["design", plan, "--next", "--out", work / "design_next", "--seed", "1"],
    ]
    for name, draws in REPRODUCTIONS.items():
        out = work / f"reproduce_{name}"
        found[out.name] = [["reproduce", name, "--out", out, "--draws", str(draws)]]
    folders = sorted((shared / "practice").glob("*/setup.toml"))
    for setup in [*folders, *(shared / "real").glob("irb120/setup.toml")]:
        name = f"{setup.parent.parent.name}_{setup.parent.name}"
        found[name] = [["loop", setup, "--out", work / name]]
    return found


def make(out: Path, shared: Path, only: str) -> None:
    """Run every case and keep its records and tables in `out`."""
    with tempfile.TemporaryDirectory() as work, ThreadPoolExecutor(2) as pool:

        def run(name: str, commands: list[list[str | Path]]) -> None:
            if (out / name).is_dir():
                return
            for arguments in commands:
                vcal(*arguments)
            (out / name).mkdir(parents=True)
            for kept in KEPT:
                if (source := Path(work) / name / kept).is_file():
                    shutil.copy(source, out / name)
            print(name, flush=True)

        wanted = {k: v for k, v in cases(Path(work), shared).items() if only in k}
        list(pool.map(run, wanted, wanted.values()))


def differences(old: object, new: object, place: str = ""):
    """Every (kind, place, old, new) in which two records differ; kind: number, text or shape."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new} - VOLATILE):
            if key not in old or key not in new:
                yield "shape", f"{place}.{key}", key in old, key in new
            else:
                yield from differences(old[key], new[key], f"{place}.{key}")
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield "shape", place, len(old), len(new)
        for i, (a, b) in enumerate(zip(old, new, strict=False)):
            yield from differences(a, b, f"{place}[{i}]")
    elif isinstance(old, str) and isinstance(new, str):
        if old != new:
            yield "text", place, old, new
    elif old != new or type(old) is not type(new):
        yield "number", place, old, new


def compare(old: Path, new: Path) -> int:
    """Print what differs; returns how many numbers, keys and files do."""
    wrong, reworded, same = 0, set(), 0
    files = {p.relative_to(root) for root in (old, new) for p in root.rglob("*") if p.is_file()}
    for name in sorted(files):
        if not (old / name).is_file() or not (new / name).is_file():
            print(f"{name}: only in {old if (old / name).is_file() else new}")
            wrong += 1
            continue
        before, after = (old / name).read_bytes(), (new / name).read_bytes()
        if before == after:
            same += 1
        elif name.suffix == ".json":
            for kind, place, a, b in differences(json.loads(before), json.loads(after)):
                if kind == "text":
                    reworded.add((str(a), str(b)))
                else:
                    wrong += 1
                    print(f"{name}: {kind} {place}: {a!r} -> {b!r}")
        else:
            wrong += 1
            print(f"{name}: differs")
    print(f"{len(files)} files, {same} the same byte for byte, {wrong} differences")
    for a, b in sorted(reworded):
        print(f"  reworded: {a}\n        ->  {b}")
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("action", choices=("make", "compare"))
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--only", default="", help="cases with this in their name")
    given = parser.parse_args()
    if given.action == "make":
        make(given.folders[0], given.shared, given.only)
    else:
        sys.exit(1 if compare(*given.folders) else 0)
