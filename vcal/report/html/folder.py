"""The folder of a report: checked before it is written, and written completely or not at all."""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import StudyError
from ...files import (
    exchange,
    link_or_copy,
    moving,
    replace_file,
    temporary_folder,
    write_file,
)
from ...study.folder import check_way
from ...study.messages import listed, refusal
from .picture import Picture

_KEPT = ".earlier"
_SUMS = "sha256"
"""Key of a record for the SHA-256 sums of all files."""
_BEFORE = "replaces_sha256"
"""Key of a record while files are replaced one by one: the sums of those of the earlier report."""
INTERRUPTED_FILE = "interrupted.json"
"""What was known when a loop was interrupted; the next report removes it."""
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
    live: bool = False
    """Whether other processes write to that folder at the same time, so that it stays where it is.
    """
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
        beside = {INTERRUPTED_FILE} if is_interrupted(out) else set()
        beside |= {self.beside} if (out / self.beside).is_dir() else set()
        others = sorted(p.name for p in out.iterdir() if p.name not in beside)
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
            stale = {*self.files(out), *files, *[INTERRUPTED_FILE] * is_interrupted(out)}
            if self.live or not _exchanged(work, out, stale, files):
                _install(work, out, files, stale, self.record)

    def write(self, work: Path, contents: Contents) -> list[str]:
        """Write the contents into the temporary folder; returns the names of all files, which the
        record lists.
        """
        # The record comes last: a folder counts as a report by it.
        drawn = [picture.file for picture in contents.pictures]
        files = [*contents.others, *drawn, *contents.texts, self.record]
        for picture in contents.pictures:
            write_file(work / picture.file, picture.data)
        for name, text in contents.texts.items():
            write_file(work / name, text)
        content = {**contents.record, "files": files}
        strict = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
        write_file(work / self.record, strict + "\n")
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
        write_file(work / self.record, _text(content))

    def _changed(self, out: Path, files: Sequence[str]) -> tuple[list[str], bool]:
        """Files to be replaced that differ from those of the earlier report, and whether that is
        known: without sums, all files that may have been edited.
        """
        content, earlier = self._content(out), self.files(out)
        sums, before = content.pop(_SUMS, None), content.pop(_BEFORE, {})
        names = dict.fromkeys(n for n in (*earlier, *self.sometimes, *files) if (out / n).is_file())
        if not isinstance(sums, Mapping):
            kept = (n for n in names if n not in earlier or not n.endswith(_NOT_EDITED))
            return [n for n in kept if n != self.record], False
        found = {n: _sum((out / n).read_bytes()) for n in names if n != self.record}
        if earlier:
            found[self.record] = _sum(_text(content).encode())
        before = before if isinstance(before, Mapping) else {}
        known = {n: (sums.get(n), before.get(n)) for n in found}
        return [n for n, value in found.items() if value not in known[n]], True


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
        replace_file(out / name, data)
        others = [one for one in content["files"] if one not in (name, path.name)]
        content["files"] = [*others, name, path.name]
        sums = {one: value for one, value in sums.items() if one != path.name}
        bare = {key: value for key, value in content.items() if key != _SUMS}
        both = {**bare, _SUMS: sums | {name: _sum(data)}}
        both[_SUMS][path.name] = _sum(_text(bare).encode())
        replace_file(path, _text(both))
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
    try:
        with temporary_folder(out, out if elsewhere else home) as work:
            yield work
    finally:
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()


def is_interrupted(out: Path) -> bool:
    """Whether a folder holds what was known when a loop was interrupted (`write_interrupted`)."""
    return str(_content_of(out / INTERRUPTED_FILE).get("schema", "")).startswith("vcal-interrupted")


def write_interrupted(out: Path, record: Mapping[str, Any]) -> None:
    """Write what is known at an interruption beside an earlier report; the next report replaces it.

    Raises `OSError` with the name of the file.
    """
    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / INTERRUPTED_FILE, _text(record))


def _exchanged(work: Path, out: Path, stale: Collection[str], files: Sequence[str]) -> bool:
    """Put the folder `work` in the place of `out` in one step, with all other files of `out`; False
    where that is not possible.

    A process that is killed leaves the earlier or the new report. It is not possible where the
    system has no such step, for a folder that is mounted, and for one in which this process is.
    """
    out = Path(os.path.realpath(out))
    if work.parent == out or Path.cwd().is_relative_to(out):
        return False
    for entry in list(work.iterdir()):
        if entry.name not in files:  # made on the way, and no part of the report
            return False
    if not out.exists():
        work.chmod(0o777 & ~_mask())
        with moving():
            os.rename(work, out)
        return True
    others = [entry for entry in sorted(out.iterdir()) if entry.name not in stale]
    try:
        for entry in others:
            link_or_copy(entry, work / entry.name)
        shutil.copystat(out, work)
        if hasattr(os, "chown"):
            with contextlib.suppress(OSError):
                os.chown(work, out.stat().st_uid, out.stat().st_gid)
    except (OSError, shutil.Error):
        return False
    return exchange(work, out)


def _mask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _install(
    work: Path, out: Path, files: Sequence[str], stale: Collection[str], record: str
) -> None:
    """Put the files from `work` into `out` one by one, and remove the other stale ones; undo
    everything on an error or interruption.

    Each file is the earlier or the new one at any time. While they are replaced, the record has
    the sums of both (`_BEFORE`), so that a folder that a killed process leaves can be replaced.
    """
    fresh = not out.exists()
    out.mkdir(exist_ok=True)
    kept = work / _KEPT
    kept.mkdir()
    content, earlier = _content_of(work / record), _content_of(out / record)
    both = {**content, _BEFORE: earlier.get(_SUMS, {})}
    others = [name for name in files if name != record]
    placed: list[str] = []
    try:
        for name in stale:
            if (out / name).is_file():
                link_or_copy(out / name, kept / name)
        write_file(kept / _BEFORE, _text(both))
        placed.append(record)
        os.replace(kept / _BEFORE, out / record)
        for name in others:
            placed.append(name)
            os.replace(work / name, out / name)
        for name in stale:
            if name not in files and (out / name).is_file():
                placed.append(name)
                (out / name).unlink()
        os.replace(work / record, out / record)
    except BaseException:
        for name in placed:
            with contextlib.suppress(OSError):
                if (kept / name).exists():
                    os.replace(kept / name, out / name)
                else:
                    (out / name).unlink()
        if fresh:
            with contextlib.suppress(OSError):
                out.rmdir()
        raise
