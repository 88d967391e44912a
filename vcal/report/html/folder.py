"""The folder of a report: checked before it is written, and written completely or not at all."""

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import StudyError
from ...study.folder import check_way
from ...study.messages import listed, refusal
from .picture import Picture

_KEPT = ".earlier"
_SUMS = "sha256"
"""Key of a record for the SHA-256 sums of all files."""
_NOT_EDITED = (".html", ".png", ".svg")
"""Files that nobody edits: replaced even where a record of an older vcal has no sums."""


@dataclass(frozen=True)
class Contents:
    """Everything that a report consists of."""

    record: Mapping[str, Any]
    """All results as values of JSON; `ReportFolder.write` adds the names of the files."""
    texts: Mapping[str, str]
    """Page and tables by the names of their files."""
    pictures: Sequence[Picture] = ()
    others: Sequence[str] = ()
    """Names of files that are in the temporary folder already."""


@dataclass(frozen=True)
class ReportFolder:
    """A kind of report, recognised by its record."""

    record: str
    """Name of the record, which lists all files (``files``) with their SHA-256 sums (``sha256``)
    and states its ``schema``."""
    schema: str
    """First part of the schema of such a record."""
    beside: str = ""
    """Name of a folder that may lie beside the files; empty: none."""
    sometimes: tuple[str, ...] = ()
    """Names of files that only some of these reports hold; a user's file may have such a name."""

    def check(self, out: Path, files: Sequence[str] = ()) -> None:
        """Check that such a report, with these files if they are known, may be written to `out`.

        Raises `StudyError` for a file, for a folder with other content than an earlier report of
        this kind, and for one in which the user changed a file, or made one that would be replaced.
        """
        check_way(out)
        if not out.exists():
            return
        if not out.is_dir():
            raise _refused(out, "a file", "a folder, or a name that is free", "choose another")
        others = sorted(p.name for p in out.iterdir() if p.name != self.beside or not p.is_dir())
        if others and not self.files(out):
            raise _refused(
                out,
                f"other files ({', '.join(others[:3])}, ...)",
                "an empty folder, one that holds an earlier report, or a name that is free",
                "choose another folder",
            )
        changed, known = self._changed(out, files)
        if changed:
            way = "not as" if known else "which may have been changed since"
            them = "them" if changed[1:] else "it"
            raise _refused(
                out,
                f"{listed(changed)}, {way} the earlier report left {them}",
                "only files that can be replaced without loss",
                "rename or move what is to be kept, or choose another folder",
            )

    def publish(
        self, out: Path | str, make: Callable[[Path], Contents], page: str = "index.html"
    ) -> Path:
        """Write a report into `out`, completely or not at all; returns the path of its page.

        `make` receives the temporary folder, in which all files are made before they replace those
        of an earlier report. Raises as `check` does.
        """
        self.fill(Path(out), lambda work: self.write(work, make(work)))
        return Path(out) / page

    def fill(self, out: Path, make: Callable[[Path], Sequence[str]]) -> None:
        """Have files made in a temporary folder, which `make` receives, and move those that it
        returns to `out`.

        Files of an earlier report are replaced, others stay. On failure or interruption `out`
        stays as it was. Raises as `check` does.
        """
        self.check(out)
        with _workshop(out) as work:
            files = make(work)
            self._seal(work, files)
            self.check(out, files)  # once more: making the files may have taken long
            _install(work, out, files, self.files(out))

    def write(self, work: Path, contents: Contents) -> list[str]:
        """Write the contents into the temporary folder; returns the names of all files, which the
        record lists.
        """
        # The record comes last: a folder counts as a report by it.
        drawn = [picture.file for picture in contents.pictures]
        files = [*contents.others, *drawn, *contents.texts, self.record]
        for picture in contents.pictures:
            (work / picture.file).write_bytes(picture.data)
        for name, text in contents.texts.items():
            (work / name).write_text(text, encoding="utf-8")
        content = {**contents.record, "files": files}
        strict = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
        (work / self.record).write_text(strict + "\n", encoding="utf-8")
        return files

    def files(self, out: Path) -> list[str]:
        """Names of the files of the report in a folder; none where there is no report."""
        content = self._content(out)
        try:
            names = [str(name) for name in content.get("files", [])]
        except TypeError:
            return []
        # Names only: a manipulated record must not reach outside the folder.
        others = [n for n in names if Path(n).name == n and n != self.record]
        return [self.record, *others] if content else []

    def _content(self, out: Path) -> dict[str, Any]:
        """The record in a folder; empty where there is none of this kind."""
        content = _content_of(out / self.record)
        return content if str(content.get("schema", "")).startswith(self.schema) else {}

    def _seal(self, work: Path, files: Sequence[str]) -> None:
        """Add the sums of all files to the record; its own sum is that without them."""
        content = self._content(work)
        sums = {name: _sum((work / name).read_bytes()) for name in files if name != self.record}
        content[_SUMS] = sums | {self.record: _sum(_text(content).encode())}
        (work / self.record).write_text(_text(content), encoding="utf-8")

    def _changed(self, out: Path, files: Sequence[str]) -> tuple[list[str], bool]:
        """Files to be replaced that differ from those of the earlier report, and whether that is
        known: without sums, all files that may have been edited.
        """
        content, earlier = self._content(out), self.files(out)
        sums = content.pop(_SUMS, None)
        names = dict.fromkeys(n for n in (*earlier, *self.sometimes, *files) if (out / n).is_file())
        if not isinstance(sums, Mapping):
            kept = (n for n in names if n not in earlier or not n.endswith(_NOT_EDITED))
            return [n for n in kept if n != self.record], False
        found = {n: _sum((out / n).read_bytes()) for n in names if n != self.record}
        if earlier:
            found[self.record] = _sum(_text(content).encode())
        return [n for n, value in found.items() if sums.get(n) != value], True


def add_file(out: Path, name: str, data: bytes) -> None:
    """Add a file to the report in a folder, whose record lists it from then on.

    A later report in the same folder replaces or removes it, as all files of this one. Raises
    `StudyError` where the folder holds no report, and where it holds another file of this name.
    """
    for path in sorted(out.glob("*.json")):
        content = _content_of(path)
        sums = content.get(_SUMS)
        if not isinstance(sums, dict) or path.name not in content.get("files", []):
            continue
        if (out / name).exists() and name not in content["files"]:
            expected = "no file of that name, or that of an earlier report"
            raise _refused(out, f"{name}, which is no part of the report", expected, "rename it")
        (out / name).write_bytes(data)
        others = [one for one in content["files"] if one not in (name, path.name)]
        content["files"] = [*others, name, path.name]
        sums = {one: value for one, value in sums.items() if one != path.name}
        bare = {key: value for key, value in content.items() if key != _SUMS}
        both = {**bare, _SUMS: sums | {name: _sum(data)}}
        both[_SUMS][path.name] = _sum(_text(bare).encode())
        fresh = path.with_name(f".{path.name}.fresh")
        fresh.write_text(_text(both), encoding="utf-8")
        os.replace(fresh, path)
        return
    raise _refused(out, "no report", "the folder of a report", "write the report first")


def _content_of(path: Path) -> dict[str, Any]:
    """A record; empty where the file is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return content if isinstance(content, dict) else {}
    except (OSError, ValueError, RecursionError):
        return {}


def _refused(out: Path, found: str, expected: str, action: str) -> StudyError:
    return refusal(str(out), "output folder", found, expected, action)


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _text(content: Mapping[str, Any]) -> str:
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


@contextlib.contextmanager
def _workshop(out: Path) -> Iterator[Path]:
    """A temporary folder on the file system of `out`; removed afterwards, as are parents of `out`
    that had to be made and are still empty.
    """
    made = [p for p in out.absolute().parents if not p.exists()]
    home = out.absolute().parent
    home.mkdir(parents=True, exist_ok=True)
    elsewhere = out.is_dir() and (
        out.stat().st_dev != home.stat().st_dev or not os.access(home, os.W_OK)
    )
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out if elsewhere else home))
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()


def _install(work: Path, out: Path, files: Sequence[str], earlier: Sequence[str]) -> None:
    """Move the files from `work` to `out`, those of an earlier report aside; undo everything on
    an error or interruption.
    """
    fresh = not out.exists()
    out.mkdir(exist_ok=True)
    kept = work / _KEPT
    kept.mkdir()
    stale = list(dict.fromkeys([*earlier, *files]))
    aside, placed = [], []
    try:
        for name in stale:
            if (out / name).is_file():
                aside.append(name)
                os.replace(out / name, kept / name)
        for name in files:
            placed.append(name)
            os.replace(work / name, out / name)
    except BaseException:
        for name in placed:
            with contextlib.suppress(OSError):
                os.replace(out / name, work / name)
        for name in aside:
            with contextlib.suppress(OSError):
                os.replace(kept / name, out / name)
        if fresh:
            with contextlib.suppress(OSError):
                out.rmdir()
        raise
