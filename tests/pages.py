"""The code blocks of a page of the documentation, run in order as a reader would.

    ```sh, ```python    run, in one folder and one namespace per page
    ```text             directly below one of them: what it prints. A line `...` stands for any
                        lines; numbers may differ in their last digits.
    ```toml             has to be TOML; a whole study file has keys that vcal takes

An HTML comment on the lines before a block says more:

    <!-- file: study/setup.toml -->    the block is written to this file instead of being run
    <!-- slow -->                      once on a page: it runs with the slow tests
    <!-- thorough -->                  once on a page: it runs before a release

and a comment that begins with a line `<!-- sh` or `<!-- python` is a block that readers do not see.

    python tests/pages.py PAGE ...     runs pages and brings the text blocks in them up to date
"""

import ast
import contextlib
import io
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import command_server

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
RUN = ("sh", "python")
_FENCE = re.compile(r"^(?P<in> *)(?P<marks>`{3,}|~{3,})(?P<info>[^\n`]*)$")
_FILE = re.compile(r"<!-- file: (?P<path>\S+) -->\s*\Z")
_HIDDEN = re.compile(rf"<!-- ({'|'.join(RUN)})")
_TIERS = ("slow", "thorough")
_NUMBER = re.compile(r"[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_WITHIN = 0.02
"""Part by which a printed number may differ from one machine to another; or by two in its last
place."""


class Block(NamedTuple):
    """A fenced block."""

    kind: str
    text: str
    line: int
    """Of the page, from 0, where its text begins."""
    file: str = ""
    """Where it is written to instead of being run."""
    follows: bool = False
    """Whether nothing stands between it and the block before."""


class PageError(AssertionError):
    """A block that does not do what the page says."""


def pages() -> list[Path]:
    """All pages that are written by hand, and the README."""
    made = [NOTEBOOKS / "reference" / name for name in ("api", "effects")]
    found = (p for p in NOTEBOOKS.rglob("*.md") if not any(one in p.parents for one in made))
    return [*sorted(found), ROOT / "README.md"]


def blocks(page: Path) -> list[Block]:
    """The blocks of a page, also those in notes and tabs."""
    lines = page.read_text(encoding="utf-8").split("\n")
    found = list(_blocks(lines, 0))
    if page.name == "README.md":  # its commands are run by .ci/run as printed
        found = [one for one in found if one.kind != "sh"]
    return found


def tier(page: Path) -> str:
    """The marker of the tests with which a page runs; empty where it runs by default."""
    text = page.read_text(encoding="utf-8")
    return next((name for name in _TIERS if f"<!-- {name} -->" in text), "")


def _blocks(lines: list[str], first: int) -> Iterator[Block]:
    between: list[str] = []
    began, i = False, 0
    while i < len(lines):
        hidden = _HIDDEN.fullmatch(lines[i].strip())
        fence = _FENCE.match(lines[i])
        if not hidden and not fence:
            between.append(lines[i])
            i += 1
            continue
        closed = "-->" if hidden else fence["marks"]  # type: ignore[index]
        margin = 0 if hidden else len(fence["in"])  # type: ignore[index]
        end = next((k for k in range(i + 1, len(lines)) if _closes(lines[k], closed)), None)
        if end is None:
            raise PageError(f"line {first + i + 1}: found no end of the block, expected {closed}")
        body = [line[margin:] for line in lines[i + 1 : end]]
        info = hidden[1] if hidden else fence["info"].strip()  # type: ignore[index]
        directive = re.fullmatch(r"\{([\w-]+)\} *(.*)", info)
        if directive and directive[1] not in ("code-block", "code"):
            yield from _blocks(body, first + i + 1)
        else:
            said = "\n".join(between).strip()
            file = _FILE.search(said)
            kind = directive[2] if directive else info
            text = "\n".join(body) + "\n"
            path = file["path"] if file else ""
            yield Block(kind, text, first + i + 1, path, began and not said)
            began = True
        between = []
        i = end + 1


def _closes(line: str, marks: str) -> bool:
    line = line.strip()
    return line.startswith(marks) and not line.strip(marks[0] if marks != "-->" else "->")


def run(page: Path, folder: Path, environment: Mapping[str, str] | None = None) -> list[str]:
    """Run the blocks of a page in `folder`; what each block printed, empty for what is not run.

    Raises `PageError` for a shell block that fails, and what a block of Python raises.
    """
    variables = {**os.environ, "COLUMNS": "80", "MPLBACKEND": "Agg", **(environment or {})}
    paths = [_parent_of_vcal(), variables.get("PYTHONPATH", "")]
    variables["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    commands = _commands(folder.with_name(f"{folder.name}-commands"), variables)
    variables["PATH"] = os.pathsep.join([commands, variables["PATH"]])
    space: dict[str, Any] = {"__name__": "__main__"}
    with contextlib.chdir(folder):
        return [_run(page, block, space, variables) for block in blocks(page)]


def _run(page: Path, block: Block, space: dict[str, Any], variables: Mapping[str, str]) -> str:
    place = f"{page.name}, line {block.line + 1}"
    if block.kind == "toml":
        _check_toml(block, place)
    if block.file:
        path = Path(block.file)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.text, encoding="utf-8")
        return ""
    if block.kind == "python":
        tree = ast.increment_lineno(ast.parse(block.text), block.line)
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(tree, str(page), "exec"), space)
        return printed.getvalue()
    if block.kind == "sh":
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block.text],
            env=variables,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode:
            raise PageError(f"{place}: exit code {done.returncode}\n{block.text}\n{done.stdout}")
        return done.stdout
    return ""


def _check_toml(block: Block, place: str) -> None:
    """Refuse what is not TOML, and a whole study file with a key that vcal does not take."""
    try:
        tree = tomllib.loads(block.text)
    except tomllib.TOMLDecodeError as error:
        raise PageError(f"{place}: found no TOML: {error}") from error
    if "machine" in tree and ("instrument" in tree or isinstance(tree.get("data"), list)):
        from vcal.study.folder import Folder
        from vcal.study.settings import validate

        folder = Path(block.file).parent if block.file else Path()
        validate(tree, place, {}, Folder(folder, trust=True))


def differences(page: Path, printed: list[str]) -> list[str]:
    """Where a page says another output than its blocks have, in words."""
    found, every = [], blocks(page)
    for before, said, output in zip(every, every[1:], printed, strict=False):
        shown = said.kind == "text" and said.follows and before.kind in RUN and not before.file
        if shown and not alike(said.text, output):
            found.append(
                f"{page.name}, line {said.line + 1}: the page shows\n{said.text}\n"
                f"but the block above it prints\n{output}"
            )
    return found


def alike(said: str, printed: str) -> bool:
    """Whether a text is what was printed, up to the last digits of its numbers."""
    parts = [_words(part) for part in re.split(r"^ *\.\.\. *$", said, flags=re.MULTILINE)]
    words = _words(printed)
    if len(parts) == 1:
        return _same(parts[0], words)
    first, *middle, last = parts
    if not _same(first, words[: len(first)]):
        return False
    at = len(first)
    for part in middle:
        ends = range(at, len(words) - len(part) + 1)
        found = next((k for k in ends if _same(part, words[k : k + len(part)])), None)
        if found is None:
            return False
        at = found + len(part)
    return len(words) - len(last) >= at and _same(last, words[len(words) - len(last) :])


def _words(text: str) -> list[str]:
    return text.split()


def _same(said: list[str], printed: list[str]) -> bool:
    return len(said) == len(printed) and all(map(_same_word, said, printed))


def _same_word(said: str, printed: str) -> bool:
    if said == printed:
        return True
    if _NUMBER.sub("#", said) != _NUMBER.sub("#", printed):
        return False
    return all(map(_near, _NUMBER.findall(said), _NUMBER.findall(printed)))


def _near(said: str, printed: str) -> bool:
    a, b = (float(text.replace("−", "-")) for text in (said, printed))
    places = len(said.partition("e")[0].partition(".")[2])
    last = 10.0**-places if "e" not in said and places else 0.0
    return abs(a - b) <= max(_WITHIN * abs(a) if places or "e" in said else 0.0, 2.0 * last)


def _commands(folder: Path, variables: Mapping[str, str]) -> str:
    """A folder with the command `vcal` of the vcal that is tested, and the Python that tests it."""
    folder.mkdir(exist_ok=True)
    start = f'#!/bin/sh\nexec "{sys.executable}"{{}} "$@"\n'
    vcal = command_server.client(variables) or start.format(" -m vcal")
    scripts = {"vcal": vcal, "python": start.format(""), "python3": start.format("")}
    for name, script in scripts.items():
        path = folder / name
        path.write_text(script, encoding="utf-8")
        path.chmod(0o755)
    return str(folder)


def _parent_of_vcal() -> str:
    import vcal

    return str(Path(vcal.__file__).resolve().parents[1])


def update(page: Path, printed: list[str]) -> bool:
    """Put what blocks print into the text blocks below them, where it differs; those with a line
    `...` are left as they are. Whether anything changed.
    """
    lines, every, changed = page.read_text(encoding="utf-8").split("\n"), blocks(page), False
    shown = list(zip(every, every[1:], printed, strict=False))
    for before, said, output in reversed(shown):
        if said.kind != "text" or not said.follows or before.kind not in RUN or before.file:
            continue
        if alike(said.text, output) or re.search(r"^ *\.\.\. *$", said.text, re.MULTILINE):
            continue
        count = said.text.count("\n") - (said.text == "\n")
        new = [line.rstrip() for line in output.rstrip("\n").split("\n")]
        lines[said.line : said.line + count] = new
        changed = True
    if changed:
        page.write_text("\n".join(lines), encoding="utf-8")
    return changed


def main(arguments: list[str]) -> int:
    """Run pages, bring them up to date, and print what still differs."""
    import tempfile
    import time

    import jax

    sys.path.insert(0, str(ROOT))
    jax.config.update("jax_enable_x64", True)
    status = 0
    for name in arguments:
        page, began = Path(name).resolve(), time.perf_counter()
        with tempfile.TemporaryDirectory() as parent:
            folder = Path(parent) / "page"
            folder.mkdir()
            printed = run(page, folder)
        updated = " updated," if update(page, printed) else ""
        print(f"{name}:{updated} {time.perf_counter() - began:.0f} s")
        for words in differences(page, printed):
            print(words)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
