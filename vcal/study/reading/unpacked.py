"""Limits of a spreadsheet, which are checked before it is unpacked: a small file can hold much."""

import io
import re
import zipfile
import zlib
from collections.abc import Iterator

from ...errors import StudyError
from ..messages import refusal

_LARGEST = 1 << 29
"""Largest size of all files in an archive together, unpacked, in bytes."""
_MOST_CELLS = 50_000_000
"""Largest number of cells of a sheet, between the first and the last one that is used."""
_TOO_LARGE = "a spreadsheet of more than 512 MiB when it is unpacked"
_PART = 1 << 20
_OVERLAP = 200
"""Bytes that are looked at again with the next part, so that nothing is missed at its edge."""
_PLACE = re.compile(rb'<(?:\w+:)?c\b[^>]*?\br="([A-Z]{1,3})(\d{1,7})"')


def check_unpacked(data: bytes, name: str) -> None:
    """Raise `StudyError` for a spreadsheet in an archive (XLSX, XLSB, ODS) that unpacks to more
    than 512 MiB, or in which a sheet of XLSX spans more than 50 million cells.

    The sizes that an archive states of itself are not relied on: its files are unpacked part by
    part and counted. Damaged archives are left to the reader, which says what is wrong.
    """
    if not data.startswith(b"PK"):
        return
    total = 0
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > _LARGEST:
                raise _refused(name, _TOO_LARGE)
            for entry in entries:
                total += _unpacked(archive, entry, name, _LARGEST - total)
    except (zipfile.BadZipFile, zlib.error, OSError, NotImplementedError, RuntimeError, EOFError):
        return


def _unpacked(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str, room: int) -> int:
    """Size of one file of an archive; its cells are counted where it is a sheet."""
    sheet = re.search(r"sheets/[^/]*\.xml$", entry.filename)
    rows, columns, size, tail = 0, 0, 0, b""
    for part in _parts(archive, entry):
        size += len(part)
        if size > room:
            raise _refused(name, _TOO_LARGE)
        text, tail = tail + part, part[-_OVERLAP:]
        if sheet:
            for letters, number in _PLACE.findall(text):
                rows, columns = max(rows, int(number)), max(columns, _number(letters))
        if sheet and rows * columns > _MOST_CELLS:
            raise _refused(name, f"a sheet that spans {rows} rows and {columns} columns")
    return size


def _parts(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Iterator[bytes]:
    """The contents of a file of an archive. They do not end where its header says, but where the
    packed data do.
    """
    entry.file_size = max(entry.file_size, _LARGEST + 4 * _PART)
    with archive.open(entry) as file:
        try:
            while part := file.read(_PART):
                yield part
        except (zipfile.BadZipFile, EOFError):  # it ends before the size given here: as it should
            return


def _number(letters: bytes) -> int:
    """The number of a column from its letters: 28 of AB."""
    found = 0
    for letter in letters:
        found = 26 * found + letter - 64
    return found


def _refused(name: str, found: str) -> StudyError:
    return refusal(
        name, "file", found, "a table of readings", "save the table as CSV, without other sheets"
    )
