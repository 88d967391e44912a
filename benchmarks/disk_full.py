"""A disk that is full from every write on, for every command that writes.

Each command runs once in a folder that holds its earlier result, and its writes are counted. Then
it runs again for every one of them, and the disk is full from that write on. Each time these must
hold: one message that names the file, exit code 2, the verdict printed where there is one, the
earlier files as they were, and no temporary file left. At the end the command runs with room again.

The searches of `loop` and `design` are computed once: they write nothing.

    python benchmarks/disk_full.py
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

from records import parser_of, write

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from typer.testing import CliRunner  # noqa: E402

import vcal.cli.design  # noqa: E402
import vcal.study.close_study  # noqa: E402
from full_disk import full_disk  # noqa: E402
from vcal.cli import app  # noqa: E402

_FEW = ["--set", "loop.draws=100", "--set", 'loop.effects=["backlash","scale_growth"]']


def run(words: list[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command in this process."""
    result = CliRunner().invoke(app, words)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        return -1, result.stdout, repr(result.exception)
    return result.exit_code, result.stdout, result.stderr


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder, or the file itself."""
    if folder.is_file():
        return {"": folder.read_bytes()}
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def commands(work: Path) -> dict[str, tuple[list[str], bool, str]]:
    """Words of the commands without their output; whether there is an earlier one; the beginning
    of the verdict.
    """
    study, report = str(work / "study"), str(work / "first-report")
    return {
        "init": (["init"], False, ""),
        "simulate": (["simulate", study, "--out"], False, ""),
        "check": (["check", study, "--out"], True, "can be used"),
        "effects": (["effects", "backlash", "--out"], True, ""),
        "loop": (["loop", study, *_FEW, "--out"], True, "The declared model"),
        "uncertainty": (["uncertainty", study, "--draws", "20", "--out"], True, "This plan"),
        "design": (["design", str(work / "balls"), "--set", "design.steps=2",
                    "--set", "design.starts=1", "--out"], True, "The"),
        "compensate": (["compensate", report, "--to", "csv", "--out"], True, ""),
        "certificate": (["certificate", report, "--draft", "--out"], False, ""),
    }  # fmt: skip


def every_write(name: str, words: list[str], earlier: bool, verdict: str, home: Path) -> dict:
    """Run a command for every one of its writes; what did not hold, in words."""
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir()
    out, bad = home / "out", []
    if earlier:
        code, _, said = run([*words, str(out)])
        if code:
            raise SystemExit(f"{name}: {said}")
    before = contents(out) if earlier else {}
    kept = shutil.copytree(out, home.parent / f"{name}-kept") if earlier else None
    with full_disk(home) as disk:
        code, *_, said = run([*words, str(out)])
    if code:
        raise SystemExit(f"{name}: {said}")
    for number in range(1, disk.count + 1):
        shutil.rmtree(home)
        home.mkdir()
        if kept is not None:
            shutil.copytree(kept, out)
        with full_disk(home, number) as found:
            code, shown, said = run([*words, str(out)])
        what = []
        if not found.failed:
            break
        if code == 0:  # another way was open, as of a link that becomes a copy
            what += [] if contents(out).keys() >= before.keys() else ["files are missing"]
        else:
            what += [] if code == 2 else [f"exit code {code}"]
            what += [] if said.count("\n") == 1 and str(out) in said else [f"message {said!r}"]
            what += [] if (contents(out) if out.exists() else {}) == before else ["other files"]
            what += [] if verdict in shown else ["no verdict"]
        left = [path.name for path in home.iterdir() if path != out]
        what += [f"left {left}"] if left else []
        if what:
            bad.append({"write": number, "of": found.failed.replace(str(home), ""), "bad": what})
            print(name, bad[-1], flush=True)
    if not earlier and out.exists():
        shutil.rmtree(out) if out.is_dir() else out.unlink()
    code, *_ = run([*words, str(out)])
    print(f"{name}: {disk.count} writes, {len(bad)} bad; with room again: {code}", flush=True)
    return {"command": name, "writes": disk.count, "bad": bad, "next_run": code}


def main() -> None:
    """Count the writes of every command and fill the disk at each."""
    parser = parser_of(__doc__, "disk_full")
    parser.add_argument("--only", help="Names of commands, separated by commas.")
    options = parser.parse_args()
    os.environ["VCAL_NO_CACHE"] = "1"
    close, closed = vcal.study.close_study.close_loop, []

    def once(*arguments, **keys):
        if not closed:
            closed.append(close(*arguments, **keys))
        return closed[0]

    vcal.study.close_study.close_loop = once
    optimise, optimised = vcal.cli.design.optimise, []

    def designed(*arguments, **keys):
        if not optimised:
            optimised.append(optimise(*arguments, **keys))
        return optimised[0]

    vcal.cli.design.optimise = designed
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary).resolve()
        for kind, folder in (("laser_tracker", "study"), ("ball_array", "balls")):
            run(["init", str(work / folder), "--instrument", kind])
        chosen = commands(work)
        if options.only:
            chosen = {name: chosen[name] for name in options.only.split(",")}
        if {"compensate", "certificate"} & chosen.keys():
            run(["loop", str(work / "study"), *_FEW, "--out", str(work / "first-report")])
        rows = [every_write(name, *one, work / "home") for name, one in chosen.items()]
    write(options.out, {"writes": sum(row["writes"] for row in rows), "rows": rows})
    if any(row["bad"] or row["next_run"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
