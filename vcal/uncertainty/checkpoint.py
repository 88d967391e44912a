"""Checkpoints of a campaign in a folder, from which a killed run can resume.

A checkpoint writes what is new since the last one. `values-*.part` holds the kept values of the
draws in between, `counts-*.part` by how much the counts in bins have grown, and `campaign.state`
the rest of the summary, which is small. Where the parts of counts together are larger than all
counts, the next part holds all counts in their place. Each file is complete or absent: it is
written under another name, flushed to the disk and renamed. The state names the parts that belong
to it, and is written after them.

A file starts with one line: a SHA-256 and a JSON header, which identifies the campaign and lists
the arrays. The arrays follow; their SHA-256 is in the header. One process at a time uses a folder,
which it locks.
"""

import contextlib
import hashlib
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StudyError
from ..files import FileLock, naming

STATE = "campaign.state"
LOCK = "campaign.lock"
_FORMAT = 2
_PART = re.compile(r"(values|counts)-\d+-\d+\.part")
_COUNTS = ".counts"
"""End of the names of arrays of counts, which only grow."""
_WIDTHS = (np.uint8, np.uint16, np.uint32)
UNWRITTEN = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError,
             RecursionError, MemoryError)  # fmt: skip
"""What reading a file raises that vcal did not write, although its checksums are right."""
_REMEDY = "delete the folder to start again, or choose another"


@dataclass(frozen=True)
class Held:
    """The state of a campaign in a folder."""

    arrays: dict[str, np.ndarray]
    kept: list[np.ndarray]
    """Values of the first draws, one array (n, k) per part."""


class Checkpoint:
    """The folder of one campaign, identified by its fingerprint, that is, its settings by name."""

    def __init__(self, folder: Path, fingerprint: Mapping[str, Any]):
        self.folder = folder
        self.fingerprint = json.loads(json.dumps(fingerprint))
        self.parts: list[dict[str, Any]] = []
        """Name and SHA-256 of every part that belongs to the state."""
        self._rows, self._blocks, self._saves = 0, 0, 0
        self._counted: dict[str, np.ndarray] = {}
        """All counts as of the last checkpoint."""
        self._grown = 0
        """Bytes of the parts of counts."""
        self._lock: FileLock | None = None

    def load(self) -> Held | None:
        """Lock the folder and return the state in it, or None without a finished chunk.

        Files of an unfinished chunk are removed. Raises `StudyError` for a file that is missing,
        truncated or edited, or that belongs to a campaign with other settings, and where another
        process uses the folder.
        """
        with naming(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        try:
            self._lock = FileLock(self.folder / LOCK)
        except BlockingIOError:
            raise StudyError(
                f"{self.folder}: found another process that runs this campaign, expected one at a "
                "time; wait until it ends, or choose another folder"
            ) from None
        path = self.folder / STATE
        try:
            held = self._whole(path) if path.is_file() else None
        except BaseException:
            self.release()
            raise
        self._remove_others()
        return held

    def release(self) -> None:
        """Let other processes use the folder."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def save(self, arrays: Mapping[str, np.ndarray], kept: Sequence[np.ndarray]) -> None:
        """Write the summary after a chunk: what is new since the last one.

        `kept` starts with the arrays that `load` returned.
        """
        parts = list(self.parts)
        if len(kept) > self._blocks:
            fresh = np.concatenate(kept[self._blocks :])
            rows = self._rows + len(fresh)
            name = f"values-{self._rows:012d}-{rows:012d}.part"
            digest = _write(self.folder / name, self.fingerprint, {"values": fresh}, [])
            parts.append({"file": name, "sha256": digest})
        counts = {name: value for name, value in arrays.items() if name.endswith(_COUNTS)}
        whole = sum(value.nbytes for value in counts.values())
        grown = self._grown
        if counts:
            anew = grown > whole
            if anew:
                parts, grown = [part for part in parts if not _is_counts(part)], 0
            increments = self._increments({} if anew else self._counted, counts)
            name = f"counts-{self._saves:012d}-{int(arrays['draws']):012d}.part"
            digest = _write(self.folder / name, self.fingerprint, increments, [])
            parts.append({"file": name, "sha256": digest})
            grown += sum(value.nbytes for value in increments.values())
        rest = {name: value for name, value in arrays.items() if name not in counts}
        _write(self.folder / STATE, self.fingerprint, rest, parts)
        obsolete = any(part not in parts for part in self.parts)
        self.parts, self._grown, self._saves = parts, grown, self._saves + 1
        self._rows, self._blocks = sum(map(len, kept)), len(kept)
        for name, value in counts.items():
            if name in self._counted:
                np.copyto(self._counted[name], value)
            else:
                self._counted[name] = value.copy()
        if obsolete:
            self._remove_others()

    def _increments(
        self, before: Mapping[str, np.ndarray], counts: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """By how much counts have grown: all cells, or those that have, whichever is shorter."""
        found = {}
        for name, value in counts.items():
            more = value if name not in before else value - before[name]
            most = int(more.max(initial=0))
            width = next(w for w in _WIDTHS if most <= np.iinfo(w).max)
            more = more.astype(width)
            at = np.flatnonzero(more)
            if len(at) * (4 + more.itemsize) < more.nbytes:
                found[f"{name}|at"] = at.astype(np.uint32)
                found[f"{name}|more"] = more.reshape(-1)[at]
                found[f"{name}|shape"] = np.array(value.shape, np.int64)
            else:
                found[f"{name}|all"] = more
        return found

    def _remove_others(self) -> None:
        """Remove parts that do not belong to the state, and files that were not finished."""
        own = {part["file"] for part in self.parts}
        for other in self.folder.iterdir():
            name = other.name.removesuffix(".new")
            if _PART.fullmatch(name) and other.name not in own or other.name == f"{STATE}.new":
                with contextlib.suppress(OSError):
                    other.unlink()

    def _whole(self, path: Path) -> Held:
        """The state in a file. A checksum can be made anew for any contents, so that contents which
        vcal does not write are refused wherever they are seen to be such.
        """
        try:
            return self._load(path)
        except StudyError:
            raise
        except UNWRITTEN as error:
            raise unwritten(path, error) from error

    def _load(self, path: Path) -> Held:
        header, arrays = _read(path, self.fingerprint)
        kept, counted = [], {}
        for part in header["parts"]:
            if not _PART.fullmatch(part["file"]):
                raise ValueError(f"a part named {part['file']!r}")
            at = self.folder / part["file"]
            if not at.is_file():
                raise StudyError(
                    f"{at}: found no such file, expected a part that {STATE} names; {_REMEDY}"
                )
            own, values = _read(at, self.fingerprint)
            if own["sha256"] != part["sha256"]:
                raise _refusal(at, "other values than were written", f"those {STATE} names")
            if _is_counts(part):
                self._grown += sum(value.nbytes for value in values.values())
                _add(counted, values, at)
                self._saves = max(self._saves, int(part["file"].split("-")[1]) + 1)
            else:
                kept.append(values["values"])
        self.parts, self._counted = header["parts"], counted
        self._rows, self._blocks = sum(map(len, kept)), len(kept)
        return Held(arrays | {name: value.copy() for name, value in counted.items()}, kept)


def _is_counts(part: Mapping[str, Any]) -> bool:
    return part["file"].startswith("counts-")


def _add(counted: dict[str, np.ndarray], grown: Mapping[str, np.ndarray], path: Path) -> None:
    """Add what counts have grown by."""
    try:
        for key, more in grown.items():
            name, _, what = key.rpartition("|")
            if what == "all":
                counted.setdefault(name, np.zeros(more.shape, np.uint32))
                counted[name] += more
            elif what == "more":
                shape = tuple(grown[f"{name}|shape"].tolist())
                counted.setdefault(name, np.zeros(shape, np.uint32))
                counted[name].reshape(-1)[grown[f"{name}|at"]] += more
    except (KeyError, IndexError, ValueError, MemoryError) as error:
        raise _refusal(path, "counts that do not fit the others", "a whole file") from error


def _write(
    path: Path,
    fingerprint: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    parts: Sequence[Mapping[str, Any]],
) -> str:
    """Write a file atomically; returns the SHA-256 of its arrays."""
    contents = {name: np.ascontiguousarray(value).reshape(-1) for name, value in arrays.items()}
    digest = hashlib.sha256()
    for value in contents.values():
        digest.update(value.data)
    header = {
        "format": _FORMAT,
        "fingerprint": fingerprint,
        "parts": parts,
        "arrays": [[name, v.dtype.str, arrays[name].shape] for name, v in contents.items()],
        "sha256": digest.hexdigest(),
    }
    line = json.dumps(header).encode()
    new = path.with_name(path.name + ".new")
    try:
        with naming(path), new.open("wb") as file:
            file.write(f"{hashlib.sha256(line).hexdigest()} ".encode() + line + b"\n")
            for value in contents.values():
                file.write(value.data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, path)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink()
        raise
    if os.name != "nt":  # there, folders cannot be opened
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # flushes the new name, too, before anything refers to it
        finally:
            os.close(folder)
    return digest.hexdigest()


def _read(
    path: Path, fingerprint: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file; raises `StudyError` for a damaged file or another campaign's.

    A checksum does not say who wrote a file: whatever its header states is checked.
    """
    try:
        with path.open("rb") as file:
            checksum, _, line = file.readline().rstrip(b"\n").partition(b" ")
            if checksum != hashlib.sha256(line).hexdigest().encode():
                raise _refusal(path, "a first line without its checksum", "a whole file")
            header = json.loads(line)
            if header["format"] != _FORMAT:
                raise StudyError(
                    f"{path}: found format {header['format']!r}, expected {_FORMAT}: the file is "
                    f"from another version of vcal; {_REMEDY}"
                )
            _check_fingerprint(path, header["fingerprint"], fingerprint)
            digest, arrays = hashlib.sha256(), {}
            left = path.stat().st_size - file.tell()
            for name, kind, shape in header["arrays"]:
                dtype = np.dtype(str(kind))
                count = math.prod(int(n) for n in shape)
                left -= count * dtype.itemsize
                if dtype.kind not in "biuf" or min(shape, default=0) < 0 or left < 0:
                    raise _refusal(path, f"no such array as {name!r}", "a whole file")
                value = np.fromfile(file, dtype, count)
                digest.update(value.data)
                arrays[str(name)] = value.reshape([int(n) for n in shape])
            if left or digest.hexdigest() != header["sha256"]:
                raise _refusal(path, "numbers that do not match their checksum", "a whole file")
            if not all(isinstance(part["file"], str) for part in header["parts"]):
                raise _refusal(path, "parts without names", "a whole file")
    except StudyError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise _refusal(path, "a header of another form", "a whole file") from error
    return header, arrays


def _check_fingerprint(path: Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    for name in sorted(found.keys() | expected.keys()):
        if found.get(name) != expected.get(name):
            raise StudyError(
                f"{path}: belongs to another campaign: found {name} = {found.get(name)!r}, "
                f"expected {expected.get(name)!r}; {_REMEDY}"
            )


def unwritten(path: Path, error: Exception) -> StudyError:
    """The error for a file with the right checksums whose contents vcal does not write."""
    return _refusal(path, f"what vcal does not write ({error})", "the state of a campaign")


def _refusal(path: Path, found: str, expected: str) -> StudyError:
    return StudyError(
        f"{path}: found {found}, expected {expected}: the file was cut or edited; {_REMEDY}"
    )
