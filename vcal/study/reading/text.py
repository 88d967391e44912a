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
_PLAIN_CHARACTERS = b"0123456789+-.eE\n"
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
    encoding = form.encoding
    if encoding == "auto":
        encoding = _encoding(data)
    try:
        text = data.decode(encoding)
    except UnicodeError as error:
        do = "correct the key encoding" if form.encoding != "auto" else "save it in UTF-8"
        raise unreadable(name, f"{encoding}: {error}", do) from error
    text = text.removeprefix("\ufeff")
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    if "\0" in text or (text.strip() and not re.search("[0-9A-Za-z]", text[:10_000])):
        raise unreadable(
            name,
            f"{encoding}: zero bytes, or no letter or digit",
            "save it in UTF-8, or declare its encoding",
        )
    return text, {"utf-8-sig": "UTF-8", "cp1252": "Windows-1252", "latin-1": "Latin-1"}.get(
        encoding, encoding.upper()
    )


def _encoding(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    head = np.frombuffer(data[:4000], np.uint8)
    if len(head) > 3:
        zero = [float((head[k::2] == 0).mean()) for k in (0, 1)]
        if max(zero) > 0.4 and min(zero) < 0.1:
            return "utf-16-be" if zero[0] > zero[1] else "utf-16-le"
    try:
        data.decode("utf-8")
        return "utf-8-sig"
    except UnicodeDecodeError:
        pass
    try:
        data.decode("cp1252")
        return "cp1252"
    except UnicodeDecodeError:
        return "latin-1"


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
    """The grid of a large table that has nothing but plain numbers below its header, in one pass of
    numpy's parser; None for any other, which the general path reads and explains.
    """
    if mark not in SEPARATORS or form.thousands is not None or form.header_row == 0:
        return None
    start = len(text) - len(text.lstrip("\n"))
    end = text.find("\n", start)
    try:
        body = text[end + 1 :].strip("\n").encode("ascii")
        (cells,) = csv.reader([text[start:end]], delimiter=mark, skipinitialspace=mark != "\t")
    except (UnicodeEncodeError, ValueError, csv.Error):
        return None
    allowed, kind = _PLAIN_CHARACTERS + mark.encode(), ""
    comma = mark != "," and b"," in body
    if comma:
        if b"." in body or form.decimal == ".":
            return None
        # Commas before three digits only may separate thousands; the general path decides.
        if form.decimal is None and not re.search(rb",\d{1,2}(?!\d)|,\d{4}", body):
            return None
        body, kind = body.replace(b",", b"."), ", decimal comma"
    elif form.decimal == "," and b"." in body:
        return None
    if body.translate(None, allowed) or b"\n\n" in body:
        return None
    rows = body.count(b"\n") + 1
    try:
        values = np.loadtxt(io.BytesIO(body), delimiter=mark, ndmin=2, comments=None)
    except ValueError:
        return None
    header = tuple(" ".join(cell.split()) for cell in cells)
    wrong = values.shape != (rows, len(header)) or len({*header}) < len(header)
    if wrong or any(np.isfinite(number(cell)) for cell in header):
        return None
    line = text.count("\n", 0, end) + 2
    columns = [Cells(values=values[:, i]) for i in range(len(header))]
    return Grid(name, kind, header, columns, range(line, line + rows), form=form)
