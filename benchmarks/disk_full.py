"""A disk that is full from every write on, for every command that writes.

Each command runs in a folder that holds its earlier result. At every one of its writes a process
forks off for which the disk is full from that write on (tests/full_disk.py). Each time these must
hold: one message that names the file, exit code 2, the verdict printed where there is one, the
earlier files as they were, and no temporary file left. The command itself goes on and has to end
well, and so has another run where a fault left more files than there were before.

    python benchmarks/disk_full.py
"""

import hashlib
import json
import os
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

from records import parser_of, write

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import jax  # noqa: E402
import numpy as np  # noqa: E402
from typer.testing import CliRunner  # noqa: E402

import vcal.fleet.fleet  # noqa: E402
import vcal.study.close_study  # noqa: E402
from full_disk import EveryWrite, full_disk  # noqa: E402
from histories import write_reports  # noqa: E402
from vcal.cli import app  # noqa: E402
from vcal.compensation import FORMATS  # noqa: E402
from vcal.reproduce import REPRODUCTIONS, Reproduction  # noqa: E402
from vcal.reproduce.document import Row  # noqa: E402

_FEW = ["--set", "loop.draws=100", "--set", 'loop.effects=["backlash","scale_growth"]']
_KEPT = ("draws/", "interrupted.json")
"""What a command may leave beside the earlier files: it goes on from there."""
_SEARCHES = []
"""The searches that have ended in the present run."""


@dataclass(frozen=True)
class Command:
    """A command whose last word, its output, is still missing."""

    words: list[str]
    verdict: str = ""
    """What it says about its result; ``*``: the first line that it prints."""
    earlier: bool = True
    """Whether it may be repeated into the folder of an earlier result."""
    code: int = 0
    """Its usual exit code."""
    writes: bool = True
    name: str = "out"
    """Name of its output."""
    lines: int = 1
    """Most messages; each study of several has its own."""
    several: bool = False
    """Whether there is a report of each study below reports/, and a page that lists them, which is
    written from the start."""


def run(words: list[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command in this process."""
    result = CliRunner().invoke(app, words)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        return -1, result.stdout, repr(result.exception)
    return result.exit_code, result.stdout, result.stderr


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder, or the file itself; none where there is neither."""
    if folder.is_file():
        return {"": folder.read_bytes()}
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def commands(work: Path) -> dict[str, Command]:
    """All commands that write, with small studies."""
    study, report = str(work / "study"), str(work / "first-report")
    balls = ["design", str(work / "balls"), "--set", "design.steps=2", "--set", "design.starts=1"]
    found = {
        "init": Command(["init"], earlier=False),
        "import": Command(
            ["import", str(work / "points.csv"), "--machine", "w X b Y Z t", "--tool-offset",
             "0,0,-150", "--set", "machine.travel_mm.X=[0,1000]",
             "--set", "machine.travel_mm.Y=[0,600]", "--set", "machine.travel_mm.Z=[0,500]",
             "--set", "instrument.range_sigma_um=1.5", "--set", "instrument.angle_sigma_urad=2.5",
             "--positions", str(work / "positions.csv"), "--out"],
            earlier=False,
        ),
        "simulate": Command(["simulate", study, "--out"], earlier=False),
        "check": Command(["check", study, "--out"], "*"),
        "check, refused": Command(
            ["check", study, "--set", "data.check=missing.csv", "--out"], "missing.csv", code=2
        ),
        "effects": Command(["effects", "backlash", "--out"]),
        "loop": Command(["loop", study, *_FEW, "--out"], "*"),
        "loop, two studies": Command(
            ["loop", study, str(work / "second"), *_FEW, "--again", "--out"], "up to date",
            lines=3, several=True,
        ),
        "demo": Command(["demo", "--out"], "*"),
        "uncertainty": Command(["uncertainty", study, "--draws", "20", "--out"], "*"),
        "design": Command([*balls, "--out"], "*"),
        "design --next": Command(
            ["design", study, "--next", *_FEW, "--set", "design.steps=1", "--set",
             "design.starts=1", "--out"], "*",
        ),
        "reproduce": Command(["reproduce", "little", "--out"], "The sum is 5."),
        **{
            f"compensate --to {name}": Command(["compensate", report, "--to", name, "--out"])
            for name in FORMATS
            if name != "dcc"
        },
        "compensate --nc": Command(
            ["compensate", report, "--nc", str(work / "part.ngc"), "--out"], name="out.ngc"
        ),
        "verify": Command(["verify", report, "--to", "csv", "--draws", "2"], writes=False),
        "certificate": Command(
            ["certificate", report, "--draft", "--out"], earlier=False, name="out.xml"
        ),
        "history": Command(["history", str(work / "reports"), "--out"], "*"),
    }  # fmt: skip
    return found


def prepare(work: Path) -> None:
    """Everything that the commands read."""
    for kind, folder in (("laser_tracker", "study"), ("ball_array", "balls")):
        run(["init", str(work / folder), "--instrument", kind])
    shutil.copytree(work / "study", work / "second")
    write_reports(work / "reports")
    rng = np.random.default_rng(0)
    positions = rng.uniform([0, 0, 0], [1000, 600, 500], (40, 3))
    seen = positions + [900, -350, -570] + 2e-3 * rng.standard_normal((40, 3))
    for name, head, rows in (("points", "X [mm],Y [mm],Z [mm]", seen),
                             ("positions", "x_mm,y_mm,z_mm", positions)):  # fmt: skip
        lines = [f"P{i}," + ",".join(map(repr, row.tolist())) for i, row in enumerate(rows)]
        (work / f"{name}.csv").write_text("\n".join([f"name,{head}", *lines, ""]))
    moves = [f"G1 X{100 + 5 * i} Y{60 + i} Z-{i} F900" for i in range(20)]
    (work / "part.ngc").write_text("\n".join(["G21 G90 G17", "G0 X100 Y60 Z0", *moves, "M30", ""]))


def judged(
    command: Command, disk: EveryWrite, out: Path, before: dict, found: tuple[int, str, str]
) -> list[str]:
    """What does not hold after a fault, in words."""
    code, shown, said = found
    after = contents(out)
    kept = {name: data for name, data in after.items() if not name.startswith(_KEPT)}
    left = [path.name for path in out.parent.iterdir() if path != out]
    bad = [f"left {left}"] if left else []
    if code == command.code == 0:  # another way was open, as of a link that becomes a copy
        return bad + ([] if after.keys() >= before.keys() else ["files are missing"])
    bad += [] if code == 2 else [f"exit code {code}"]
    told = said.strip().split("\n")
    right = len(told) <= command.lines and all(line.startswith("vcal: ") for line in told)
    bad += [] if right and str(out) in said else [f"message {said!r}"]
    if command.several:
        reports = [path.parent for path in out.glob("reports/*/report.json")]
        bad += [] if len(reports) == 2 else ["a report is missing"]
        names = {name: data for name, data in before.items() if name.startswith("reports/")}
        kept = {n: data for n, data in kept.items() if n.startswith("reports/")}
        for report in reports:
            own = f"reports/{report.name}/"
            same = all(kept.get(n) == data for n, data in names.items() if n.startswith(own))
            bad += [] if same or is_whole(report) else [f"{report.name} is neither old nor new"]
    else:
        bad += [] if kept == before else ["other files"]
    # While it computes there is no verdict.
    computing = disk.failed.startswith(str(out / "draws")) or (command.several and not _SEARCHES)
    return bad + ([] if command.verdict in shown or computing else ["no verdict"])


def is_whole(report: Path) -> bool:
    """Whether the files of a report are those that its record states."""
    content = json.loads((report / "report.json").read_text(encoding="utf-8"))
    sums = {n: one for n, one in content["sha256"].items() if n != "report.json"}
    found = {n: hashlib.sha256(data).hexdigest() for n, data in contents(report).items()}
    return {n: one for n, one in found.items() if n != "report.json"} == sums


def every_write(name: str, command: Command, home: Path) -> dict:
    """Run a command with a fault at every one of its writes; what did not hold, in words."""
    began = time.process_time()
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir()
    out = home / command.name
    words = [*command.words, *[str(out)] * command.writes]
    if command.earlier and command.writes:
        code, shown, said = run(words)
        if code != command.code:
            raise SystemExit(f"{name}: {said}")
        if command.verdict == "*":
            command = replace(command, verdict=shown.split("\n")[0])
    before = contents(out)
    start = home.parent / "start"
    shutil.rmtree(start, ignore_errors=True)
    shutil.copytree(home, start)

    def fault(disk: EveryWrite | None, number: int | None = None) -> dict:
        _SEARCHES.clear()
        with full_disk(home, number, disk) as used:
            found = run(words)
        if number is None and not used.forked:
            return {"code": found[0], "said": found[2]}
        more = sorted(contents(out).keys() - before.keys())
        of = used.failed.replace(str(home), "")
        found = {"of": of, "bad": judged(command, used, out, before, found), "more": more}
        if used.forked:
            used.answer(found)
        return found

    disk = EveryWrite(home)
    usual = fault(disk)
    if usual["code"] != command.code:
        raise SystemExit(f"{name}: {usual}")
    again = []
    for number in range(1, disk.count + 1):
        answer = disk.answers.get(number)
        if answer is None or answer["more"]:  # once more, in this process
            _again(start, home)
            again.append(number)
            disk.answers[number] = fault(None, number)
            if disk.answers[number]["more"] and run(words)[0] != command.code:
                disk.answers[number]["bad"].append("the next run fails")
    bad = [{"write": n, **disk.answers[n]} for n in sorted(disk.answers) if disk.answers[n]["bad"]]
    for one in bad:
        print(name, one, flush=True)
    _again(start, home)
    next_run = run(words)[0]
    row = {
        "command": name,
        "writes": disk.count,
        "bad": bad,
        "next_run": next_run == command.code,
        "cpu_s": round(time.process_time() - began, 1),
    }
    print({**row, "bad": len(bad), "again": again}, flush=True)
    return row


def _again(start: Path, home: Path) -> None:
    shutil.rmtree(home)
    shutil.copytree(start, home)


def little() -> Reproduction:
    """A campaign of one number: the published ones take minutes, and are written by the same
    code.
    """
    return Reproduction(
        name="little", summary="a sum", title="Little", publication="none", counted="draws",
        draws=5, least=2,
        compute=lambda draws, seed, progress: draws + seed,
        rows=lambda value: [Row("sum", 5.0, float(value), "um")],
        record=lambda value: {"sum": value},
        head=lambda value: (f"The sum is {value}.", []),
        texts={"All": lambda value: ":numbers"},
        shown={},
    )  # fmt: skip


def remember(module, name: str) -> None:
    """Have a function compute once for the same arguments: searches write nothing."""
    function, known = getattr(module, name), {}

    def once(*arguments, **keys):
        arrays = [np.asarray(x).tobytes() for x in jax.tree.leaves(arguments) if np.ndim(x)]
        key = hash((str(keys.get("effects")), *arrays))
        if key not in known:
            known[key] = function(*arguments, **keys)
        _SEARCHES.append(key)
        return known[key]

    setattr(module, name, once)


def main() -> None:
    """Fill the disk at every write of every command."""
    parser = parser_of(__doc__, "disk_full")
    parser.add_argument("--only", help="names of commands, separated by semicolons")
    options = parser.parse_args()
    # The processes of several studies would not have this disk.
    vcal.fleet.fleet.in_processes = lambda work, jobs, workers: (
        (i, work(job)) for i, job in enumerate(jobs)
    )
    remember(vcal.study.close_study, "close_loop")
    REPRODUCTIONS["little"] = little()
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary).resolve()
        os.environ["XDG_CACHE_HOME"] = str(work / "cache")  # no program is compiled twice
        prepare(work)
        chosen = commands(work)
        if options.only:
            chosen = {name: chosen[name] for name in options.only.split(";")}
        if any(str(work / "first-report") in one.words for one in chosen.values()):
            run(["loop", str(work / "study"), *_FEW, "--out", str(work / "first-report")])
        rows = [every_write(name, one, work / "home") for name, one in chosen.items()]
    if options.only and options.out.is_file():  # beside the others
        earlier = json.loads(options.out.read_text(encoding="utf-8"))["rows"]
        fresh = {row["command"]: row for row in rows}
        rows = [fresh.pop(row["command"], row) for row in earlier] + list(fresh.values())
    faults, bad = sum(row["writes"] for row in rows), sum(len(row["bad"]) for row in rows)
    write(options.out, {"commands": len(rows), "faults": faults, "bad": bad, "rows": rows})
    if bad or not all(row["next_run"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
