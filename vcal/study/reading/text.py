"""Tables of text: encodings, separators, comments, and a fast path for plain numbers."""

import csv
import io
import re
from collections.abc import Iterator

import numpy as np

from .formats import TableFormat
from .grid import Cells, Grid, grid_of_rows, number, unreadable

SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
"""Separators of cells that are found without being declared, with their names."""
PLAIN = "text in UTF-8, separated by commas"
"""A file as vcal writes it itself."""
_NAMES = {**SEPARATORS, " ": "blanks", "|": "vertical bars", "fixed": "fixed widths"}
_SEP = re.compile(r'"?sep=.."?|"?sep=."?', re.IGNORECASE)
_FAST = 1_000_000
"""Characters from which the fast path is worth its own code."""
_LIMIT = 10_000_000
"""Longest cell, so that an unclosed quotation mark does not stop at 131072 characters."""


def read_text(data: bytes, name: str, form: TableFormat) -> Grid:
    """The grid of a file of text; raises `StudyError` where it is not a table."""
    text, encoding = _decoded(data, name, form)
    text = _without_preamble(text, form)
    mark = form.delimiter or ("fixed" if form.widths else _separator(text))
    said = _NAMES.get(mark, repr(mark))
    kind = f"text in {encoding}, separated by {said}"
    if mark == "fixed":
        kind = f"text in {encoding}, columns of fixed width"
    fast = _fast(text, name, form, mark) if len(text) >= _FAST else None
    if fast is not None:
        fast.kind = kind + fast.kind
        return fast
    try:
        rows = [(line, row) for line, row in _rows(text, mark, form) if any(c.strip() for c in row)]
    except csv.Error as error:
        raise unreadable(name, str(error)) from error
    return grid_of_rows(name, kind, rows, form, said)


def _decoded(data: bytes, name: str, form: TableFormat) -> tuple[str, str]:
    """The text with ``\\n`` at the ends of lines, and the name of its encoding.

    Without a declaration, a byte order mark decides; then zero bytes in every second place are
    UTF-16, valid UTF-8 is UTF-8, and anything else is Windows-1252, or Latin-1 where that has no
    such character. These rules need no guess, as a library for unknown encodings would.
    """
    encoding, text = form.encoding, None
    if encoding == "auto":
        encoding, text = _encoding(data)
    try:
        text = data.decode(encoding) if text is None else text
    except UnicodeError as error:
        do = "correct the key encoding" if form.encoding != "auto" else "save it in UTF-8"
        raise unreadable(name, f"{encoding}: {error}", do) from error
    text = text.removeprefix("\ufeff")
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    if "\0" in text or (
        text and not text.isspace() and not re.search("[0-9A-Za-z]", text[:10_000])
    ):
        raise unreadable(
            name,
            f"{encoding}: zero bytes, or no letter or digit",
            "save it in UTF-8, or declare its encoding",
        )
    return text, {"utf-8-sig": "UTF-8", "cp1252": "Windows-1252", "latin-1": "Latin-1"}.get(
        encoding, encoding.upper()
    )


def _encoding(data: bytes) -> tuple[str, str | None]:
    """The encoding, and the text where that had to be decoded to find it."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16", None
    head = np.frombuffer(data[:4000], np.uint8)
    if len(head) > 3:
        zero = [float((head[k::2] == 0).mean()) for k in (0, 1)]
        if max(zero) > 0.4 and min(zero) < 0.1:
            return ("utf-16-be" if zero[0] > zero[1] else "utf-16-le"), None
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return encoding, data.decode(encoding)
        except UnicodeDecodeError:
            pass
    return "latin-1", None


def _without_preamble(text: str, form: TableFormat) -> str:
    """The text with empty lines in place of everything that is not the table, so that lines keep
    their numbers.

    Left out are lines to be skipped, those above a declared header, ``sep=;`` as spreadsheets write
    it, empty lines and comments. Where numbers follow, the last comment with as many cells is the
    header, as some programs write ``# x y z``.
    """
    skipped = form.skip_rows if isinstance(form.skip_rows, tuple) else ()
    top = form.skip_rows if isinstance(form.skip_rows, int) else 0
    top = max(top, (form.header_row or 1) - 1)
    if skipped or (form.comment and f"\n{form.comment}" in text):
        lines, below = text.split("\n"), False
        for i, line in enumerate(lines):
            comment = bool(form.comment) and line.lstrip().startswith(form.comment)
            # Comments above the table are looked at later, as one may be the header.
            if i + 1 in skipped or (comment and below):
                lines[i] = ""
            below = below or (i >= top and not comment and bool(lines[i].strip()))
            below = below or form.header_row == i + 1
        text = "\n".join(lines)
    place, line, comments = 0, 0, []
    while place < len(text):
        end = text.find("\n", place)
        end = len(text) if end < 0 else end
        one, line = text[place:end].strip(), line + 1
        comment = bool(form.comment) and one.startswith(form.comment)
        if comment and form.header_row == line:
            return "\n" * (line - 1) + text[place:end].replace(form.comment, "", 1) + text[end:]
        if not (line <= top or not one or _SEP.fullmatch(one) or comment):
            break
        if comment and line > top:
            comments.append((line, one.removeprefix(form.comment).strip()))
        place = end + 1
    text = "\n" * line + text[place:] if place >= len(text) else "\n" * (line - 1) + text[place:]
    named = _commented_header(text, comments, form)
    if named is not None:
        at, cells = named
        text = "\n" * (at - 1) + cells + "\n" * (line - at) + text.lstrip("\n")
    return text


def _commented_header(
    text: str, comments: list[tuple[int, str]], form: TableFormat
) -> tuple[int, str] | None:
    """The line and text of a header in a comment."""
    if not comments or form.header_row == 0:
        return None
    head = text.lstrip("\n").split("\n", 1)[0]
    at, said = comments[-1]
    for mark in [form.delimiter] if form.delimiter else [*SEPARATORS]:
        if mark == "fixed":
            return None
        cells, names = (one.split(None if mark == " " else mark) for one in (head, said))
        plain = [cell.strip().replace(",", ".") for cell in cells]
        if len(cells) == len(names) > 1 and all(np.isfinite(number(cell)) for cell in plain):
            if not any(np.isfinite(number(one)) for one in names):
                return at, said
    return None


def _separator(text: str) -> str:
    """The separator that header and next line have equally often, outside quotation marks; or the
    first one in the header.
    """
    lines = iter(text.lstrip("\n").split("\n", 50))
    two = [re.sub(r'"[^"]*"', "", line) for line in lines if line.strip()][:2]
    if not two:
        return ","
    counts = {mark: [line.count(mark) for line in two] for mark in SEPARATORS}
    alike = [mark for mark, count in counts.items() if count[0] and count[0] == count[-1]]
    there = [mark for mark, count in counts.items() if count[0]]
    return next(iter([*alike, *there]), ",")


def _rows(text: str, mark: str, form: TableFormat) -> Iterator[tuple[int, list[str]]]:
    if mark == "fixed":
        yield from _fixed(text, form)
    elif mark == " ":
        for i, line in enumerate(text.split("\n")):
            yield i + 1, [cell.strip('"') for cell in re.findall(r'"[^"]*"|\S+', line)]
    else:
        csv.field_size_limit(_LIMIT)
        reader = csv.reader(
            io.StringIO(text, newline=""), delimiter=mark, skipinitialspace=mark != "\t"
        )
        for row in reader:
            yield reader.line_num, row


def _fixed(text: str, form: TableFormat) -> Iterator[tuple[int, list[str]]]:
    """Cells of columns of fixed width: declared, or between blanks that stand below each other."""
    lines = [line.expandtabs() for line in text.split("\n")]
    if form.widths:
        ends = np.cumsum(form.widths).tolist()
    else:
        width = max(map(len, lines), default=0)
        used = np.zeros(width + 1, bool)
        for line in lines:
            if line.strip():
                codes = np.frombuffer(line.encode("utf-32-le"), np.uint32)
                used[: len(codes)] |= codes != ord(" ")
        # A column begins where a used place follows a place that is blank in all lines.
        starts = np.flatnonzero(used & ~np.r_[False, used[:-1]])
        ends = [*starts[1:].tolist(), width]
    begins = [0, *ends[:-1]]
    for i, line in enumerate(lines):
        cells = [line[a:b].strip() for a, b in zip(begins, ends, strict=True)]
        if line[ends[-1] if ends else 0 :].strip():
            cells.append(line[ends[-1] :].strip())
        yield i + 1, cells if line.strip() else []


def _fast(text: str, name: str, form: TableFormat, mark: str) -> Grid | None:
    """The grid of a large table without quotation marks, read by numpy's parser in one pass for all
    columns of numbers; None for any other, which the general path reads and explains.
    """
    if mark not in SEPARATORS or form.thousands is not None or form.header_row == 0:
        return None
    start = len(text) - len(text.lstrip("\n"))
    end = text.find("\n", start)
    body = text[end + 1 :].strip("\n")
    if not body.isascii() or '"' in body or "\n\n" in body or end < 0:
        return None
    try:
        (cells,) = csv.reader([text[start:end]], delimiter=mark, skipinitialspace=mark != "\t")
    except (ValueError, csv.Error):
        return None
    header, kind = tuple(" ".join(cell.split()) for cell in cells), ""
    if mark != "," and "," in body:
        # Commas before three digits only may separate thousands; the general path decides.
        clear = form.decimal or re.search(r"\d,\d{1,2}(?!\d)|\d,\d{4}|(?<!\d)0,\d", body)
        if "." in body or form.decimal == "." or not clear:
            return None
        body, kind = body.replace(",", "."), ", decimal comma"
    elif form.decimal == "," and "." in body:
        return None
    codes = np.frombuffer(body.encode("ascii"), np.uint8)
    ends = np.flatnonzero(codes == ord("\n"))
    starts, ends = np.r_[0, ends + 1], np.r_[ends, len(codes)]
    marks = np.flatnonzero(codes == ord(mark))
    if len(header) < 2 or len(marks) != len(starts) * (len(header) - 1):
        return None
    marks = marks.reshape(len(starts), -1)
    if (marks[:, 0] < starts).any() or (marks[:, -1] >= ends).any() or len({*header}) < len(header):
        return None
    first = body[: ends[0]].split(mark)
    numeric = [i for i, cell in enumerate(first) if np.isfinite(number(cell))]
    if not numeric or any(np.isfinite(number(cell)) for cell in header):
        return None
    columns: dict[int, Cells] = {}
    try:
        rows = body.split("\n")  # numpy reads a list a fifth faster than a stream
        values = _parsed(rows, mark, numeric, float)
        columns |= {i: Cells(values=values[:, k]) for k, i in enumerate(numeric)}
        for i in {*range(len(header))} - {*numeric}:
            columns[i] = Cells(_parsed(rows, mark, [i], str)[:, 0].tolist())
    except ValueError:
        return None
    line = text.count("\n", 0, end) + 2
    lines = range(line, line + len(starts))
    return Grid(name, kind, header, [columns[i] for i in range(len(header))], lines, form=form)


def _parsed(rows: list[str], mark: str, columns: list[int], kind: type) -> np.ndarray:
    """Columns of rows of text as numbers or texts (n, k)."""
    return np.loadtxt(rows, dtype=kind, delimiter=mark, usecols=columns, ndmin=2, comments=None)
