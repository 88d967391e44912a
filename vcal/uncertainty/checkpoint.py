"""Checkpoints of a campaign in a folder, from which a killed run can resume.

`campaign.state` holds the summary after the last finished chunk, `values-*.part` the kept values,
one file per chunk. Each file is complete or absent: it is written under another name, flushed to
the disk and renamed. The state names the parts that belong to it, and is written after them.

A file starts with one line: a SHA-256 and a JSON header, which identifies the campaign and lists
the arrays. The arrays follow; their SHA-256 is in the header.
"""

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

STATE = "campaign.state"
_FORMAT = 1
_PART = re.compile(r"values-\d+-\d+\.part(\.new)?")
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
        """Name and SHA-256 of every file of values that belongs to the state."""
        self._rows, self._blocks = 0, 0

    def load(self) -> Held | None:
        """The state in the folder, or None without a finished chunk.

        Files of an unfinished chunk are removed. Raises `StudyError` for a file that is missing,
        truncated or edited, or that belongs to a campaign with other settings.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / STATE
        held = self._whole(path) if path.is_file() else None
        own = {part["file"] for part in self.parts}
        for other in self.folder.iterdir():
            if _PART.fullmatch(other.name) and other.name not in own:
                other.unlink()
        return held

    def save(self, arrays: Mapping[str, np.ndarray], kept: Sequence[np.ndarray]) -> None:
        """Write the summary after a chunk, and the values that are new since the last one.

        `kept` starts with the arrays that `load` returned.
        """
        if len(kept) > self._blocks:
            fresh = np.concatenate(kept[self._blocks :])
            rows = self._rows + len(fresh)
            name = f"values-{self._rows:012d}-{rows:012d}.part"
            digest = _write(self.folder / name, self.fingerprint, {"values": fresh}, [])
            self.parts.append({"file": name, "sha256": digest})
            self._rows, self._blocks = rows, len(kept)
        _write(self.folder / STATE, self.fingerprint, arrays, self.parts)

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
        kept = []
        for part in header["parts"]:
            if not _PART.fullmatch(part["file"]):
                raise ValueError(f"a part named {part['file']!r}")
            at = self.folder / part["file"]
            if not at.is_file():
                raise StudyError(
                    f"{at}: found no such file, expected the values that {STATE} names; {_REMEDY}"
                )
            own, values = _read(at, self.fingerprint)
            if own["sha256"] != part["sha256"]:
                raise _refusal(at, "other values than were written", f"those {STATE} names")
            kept.append(values["values"])
        self.parts = header["parts"]
        self._rows, self._blocks = sum(map(len, kept)), len(kept)
        return Held(arrays, kept)


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
    with new.open("wb") as file:
        file.write(f"{hashlib.sha256(line).hexdigest()} ".encode() + line + b"\n")
        for value in contents.values():
            file.write(value.data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(new, path)
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
    """Header and arrays of a file; raises `StudyError` for a damaged file or another campaign's."""
    with path.open("rb") as file:
        checksum, _, line = file.readline().rstrip(b"\n").partition(b" ")
        if checksum != hashlib.sha256(line).hexdigest().encode():
            raise _refusal(path, "a first line without its checksum", "a whole file")
        header = json.loads(line)
        if header["format"] != _FORMAT:
            raise StudyError(
                f"{path}: found format {header['format']}, expected {_FORMAT}: the file is from "
                f"another version of vcal; {_REMEDY}"
            )
        _check_fingerprint(path, header["fingerprint"], fingerprint)
        digest, arrays = hashlib.sha256(), {}
        room = os.fstat(file.fileno()).st_size
        for name, kind, shape in header["arrays"]:
            dtype, count = np.dtype(kind), math.prod(shape)
            if dtype.kind not in "biuf" or any(n < 0 for n in shape):
                raise ValueError(f"an array of {dtype} and shape {shape}")
            if count * dtype.itemsize > room:
                raise ValueError(f"an array of {count} numbers in a file of {room} bytes")
            value = np.fromfile(file, dtype, count)
            digest.update(value.data)
            arrays[name] = value
        if file.read(1) or digest.hexdigest() != header["sha256"]:
            raise _refusal(path, "numbers that do not match their checksum", "a whole file")
    return header, {name: arrays[name].reshape(shape) for name, _, shape in header["arrays"]}


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
