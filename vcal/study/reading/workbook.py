"""Sheets of spreadsheets: XLSX, XLS, XLSB and ODS, read by python-calamine."""

import datetime
import io
from typing import Any

from ...errors import StudyError
from ..messages import listed, refusal
from .formats import TableFormat
from .grid import Grid, grid_of_rows
from .unpacked import check_unpacked


def read_workbook(data: bytes, name: str, sheet: str | int | None, form: TableFormat) -> Grid:
    """The grid of one sheet; raises `StudyError` where there is no such sheet, or several.

    The reader is the optional extra ``tables``. Dates become texts in ISO 8601.
    """
    try:
        import python_calamine
    except ImportError as error:
        raise missing_extra(name, "a spreadsheet", "tables") from error
    check_unpacked(data, name)
    try:
        book = python_calamine.load_workbook(io.BytesIO(data))
        sheets = book.sheet_names
    except Exception as error:  # calamine raises errors of its own for every kind of file
        raise refusal(
            name,
            "file",
            f"a damaged or protected spreadsheet ({error})",
            "an XLSX or ODS file without a password",
            "save it again, or save the sheet as CSV",
        ) from error
    found = {}
    for one in [_asked(name, sheets, sheet)] if sheet is not None else sheets:
        try:
            rows = book.get_sheet_by_name(one).to_python(skip_empty_area=False)
        except Exception as error:
            raise refusal(
                name, f"sheet {one}", f"a sheet that cannot be read ({error})", "a table of cells",
                "save it again, or save the sheet as CSV",
            ) from error  # fmt: skip
        if any(cell != "" for row in rows for cell in row):
            found[one] = rows
    if not found:
        raise refusal(
            name,
            "file",
            "no cell with a value",
            "a header and rows",
            "write the table, or name another sheet",
        )
    if len(found) > 1:
        first = next(iter(found))
        raise refusal(
            name,
            "file",
            f"{len(found)} sheets with cells ({listed(found)})",
            "one sheet, or its name",
            f'declare sheet = "{first}" in the table of the study file that names this file, or '
            f'name the file as "{name}#{first}"',
        )
    ((one, cells),) = found.items()
    kind = f"spreadsheet, sheet {one!r}"
    return grid_of_rows(name, kind, _rows(cells, form), form, "")


def missing_extra(name: str, what: str, extra: str) -> StudyError:
    """The error where the package of an extra, which reads a kind of file, is not installed."""
    return refusal(
        name,
        "file",
        f"{what}, but not the package that reads it",
        f"the optional extra {extra}",
        f"run `pip install 'vcal[{extra}]'`, or save the table as CSV",
    )


def _asked(name: str, sheets: list[str], sheet: str | int) -> str:
    if isinstance(sheet, int) and 1 <= sheet <= len(sheets):
        return sheets[sheet - 1]
    if sheet in sheets:
        return str(sheet)
    raise refusal(
        name,
        "file",
        f"no sheet {sheet!r} among {listed(sheets)}",
        f"a name of one of them, or a number from 1 to {len(sheets)}",
        "correct the key sheet, or the name behind # of the file",
    )


def _rows(cells: list[list[Any]], form: TableFormat) -> list[tuple[int, list[str]]]:
    """Rows of equal length with their numbers in the sheet, without empty ones, comments and those
    to be skipped.
    """
    skipped = form.skip_rows if isinstance(form.skip_rows, tuple) else ()
    top = form.skip_rows if isinstance(form.skip_rows, int) else 0
    top = max(top, (form.header_row or 1) - 1)
    rows = []
    for i, row in enumerate(cells, start=1):
        if i <= top or i in skipped:
            continue
        texts = [_text(cell) for cell in row]
        first = next((text for text in texts if text.strip()), "")
        if not first or (form.comment and first.startswith(form.comment)):
            continue
        rows.append((i, texts))
    used = [max(k for k, text in enumerate(row, start=1) if text.strip()) for _, row in rows]
    width = max(used, default=0)
    return [(i, (row + [""] * width)[:width]) for i, row in rows]


def _text(cell: Any) -> str:
    """A cell as the text that a CSV file would hold."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, bool):
        return "TRUE" if cell else "FALSE"
    if isinstance(cell, float):
        return f"{cell:.0f}" if cell.is_integer() and abs(cell) < 1e15 else repr(cell)
    if isinstance(cell, datetime.datetime | datetime.date):
        return cell.isoformat()
    if isinstance(cell, datetime.time):
        return cell.isoformat()
    if isinstance(cell, datetime.timedelta):
        return repr(cell.total_seconds())
    return str(cell)
