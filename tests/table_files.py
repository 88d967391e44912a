"""Tables as other programs write them: text, XLSX, ODS and parquet, made without vcal."""

import datetime
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

Columns = Mapping[str, Sequence]


def cell(value: object, decimal: str = ".", thousands: str = "") -> str:
    """A number with all its digits, or a text as it is."""
    if isinstance(value, str):
        return value
    number = float(value)  # type: ignore[arg-type]
    text = f"{number:.0f}" if number.is_integer() else repr(number)
    if "e" in text:
        text = f"{number:.25f}".rstrip("0")
    sign, digits = ("-", text[1:]) if text.startswith("-") else ("", text)
    whole, point, part = digits.partition(".")
    if thousands:
        groups = []
        while len(whole) > 3:
            whole, last = whole[:-3], whole[-3:]
            groups.insert(0, last)
        whole = thousands.join([whole, *groups])
    return sign + whole + (decimal + part if point else "")


def rows_of(columns: Columns, units: Sequence[str] = (), **marks: str) -> list[list[str]]:
    """Header, units row where there is one, and rows of cells."""
    rows = [[cell(v, **marks) for v in row] for row in zip(*columns.values(), strict=True)]
    return [list(columns), *([list(units)] if units else []), *rows]


def text(
    columns: Columns, mark: str = ",", units: Sequence[str] = (), end: str = "\n", **marks: str
) -> str:
    """A table of text; cells that hold the mark are quoted."""
    return "".join(
        mark.join(f'"{c}"' if mark in c else c for c in row) + end
        for row in rows_of(columns, units, **marks)
    )


def fixed(columns: Columns, width: int = 26) -> str:
    """A table of right-aligned columns of one width."""
    return "".join("".join(c.rjust(width) for c in r) + "\n" for r in rows_of(columns))


def xlsx(path: Path, sheets: Mapping[str, Sequence[Sequence]]) -> None:
    """A workbook of the least parts that the standard (ECMA-376) asks for."""
    office = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    package = "http://schemas.openxmlformats.org/package/2006"
    kinds = "application/vnd.openxmlformats-officedocument.spreadsheetml"

    def one(value: object, row: int, column: int) -> str:
        at = f'r="{_letters(column)}{row}"'
        if isinstance(value, str):
            return f'<c {at} t="inlineStr"><is><t>{escape(value)}</t></is></c>' if value else ""
        return f"<c {at}><v>{float(value)!r}</v></c>"  # type: ignore[arg-type]

    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as book:
        parts = "".join(
            f'<Override PartName="/xl/worksheets/sheet{k}.xml" '
            f'ContentType="{kinds}.worksheet+xml"/>'
            for k in range(1, len(sheets) + 1)
        )
        book.writestr(
            "[Content_Types].xml",
            f'<Types xmlns="{package}/content-types"><Default Extension="rels" ContentType='
            '"application/vnd.openxmlformats-package.relationships+xml"/><Override '
            f'PartName="/xl/workbook.xml" ContentType="{kinds}.sheet.main+xml"/>{parts}</Types>',
        )
        book.writestr(
            "_rels/.rels",
            f'<Relationships xmlns="{package}/relationships"><Relationship Id="rId1" '
            f'Type="{office}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        )
        named = "".join(
            f'<sheet name="{escape(name)}" sheetId="{k}" r:id="rId{k}"/>'
            for k, name in enumerate(sheets, start=1)
        )
        book.writestr(
            "xl/workbook.xml",
            f'<workbook xmlns="{main}" xmlns:r="{office}"><sheets>{named}</sheets></workbook>',
        )
        related = "".join(
            f'<Relationship Id="rId{k}" Type="{office}/worksheet" '
            f'Target="worksheets/sheet{k}.xml"/>'
            for k in range(1, len(sheets) + 1)
        )
        book.writestr(
            "xl/_rels/workbook.xml.rels",
            f'<Relationships xmlns="{package}/relationships">{related}</Relationships>',
        )
        for k, rows in enumerate(sheets.values(), start=1):
            body = "".join(
                f'<row r="{i}">' + "".join(one(v, i, j) for j, v in enumerate(row)) + "</row>"
                for i, row in enumerate(rows, start=1)
            )
            book.writestr(
                f"xl/worksheets/sheet{k}.xml",
                f'<worksheet xmlns="{main}"><sheetData>{body}</sheetData></worksheet>',
            )


def _letters(column: int) -> str:
    found = ""
    column += 1
    while column:
        column, rest = divmod(column - 1, 26)
        found = chr(65 + rest) + found
    return found


def ods(path: Path, sheets: Mapping[str, Sequence[Sequence]]) -> None:
    """An OpenDocument spreadsheet; dates are typed as such."""
    kind = "application/vnd.oasis.opendocument.spreadsheet"
    space = "urn:oasis:names:tc:opendocument:xmlns"

    def one(value: object) -> str:
        if isinstance(value, datetime.datetime):
            stamp = value.isoformat()
            return (
                f'<table:table-cell office:value-type="date" office:date-value="{stamp}"><text:p>'
                f"{stamp}</text:p></table:table-cell>"
            )
        if isinstance(value, str):
            return (
                '<table:table-cell office:value-type="string"><text:p>'
                f"{escape(value)}</text:p></table:table-cell>"
            )
        number = repr(float(value))  # type: ignore[arg-type]
        return (
            f'<table:table-cell office:value-type="float" office:value="{number}"><text:p>'
            f"{number}</text:p></table:table-cell>"
        )

    tables = "".join(
        f'<table:table table:name="{escape(name)}">'
        + "".join(f"<table:table-row>{''.join(map(one, row))}</table:table-row>" for row in rows)
        + "</table:table>"
        for name, rows in sheets.items()
    )
    with zipfile.ZipFile(path, "w") as book:
        book.writestr("mimetype", kind, zipfile.ZIP_STORED)
        book.writestr(
            "META-INF/manifest.xml",
            f'<manifest:manifest xmlns:manifest="{space}:manifest:1.0"><manifest:file-entry '
            f'manifest:full-path="/" manifest:media-type="{kind}"/><manifest:file-entry '
            'manifest:full-path="content.xml" manifest:media-type="text/xml"/></manifest:manifest>',
        )
        book.writestr(
            "content.xml",
            f'<office:document-content xmlns:office="{space}:office:1.0" xmlns:table='
            f'"{space}:table:1.0" xmlns:text="{space}:text:1.0" office:version="1.2"><office:body>'
            f"<office:spreadsheet>{tables}</office:spreadsheet></office:body>"
            "</office:document-content>",
        )


def tracker(rows: int = 40) -> dict[str, np.ndarray]:
    """The columns of a tracker table in vcal's names and units: positions within a travel of 2000 x
    1000 x 600 mm, and readings of a station outside.
    """
    rng = np.random.default_rng(56)
    position = rng.uniform([0.0, 0.0, 0.0], [2000.0, 1000.0, 600.0], (rows, 3))
    v = position - [-2400.0, 310.0, 520.0]
    r = np.linalg.norm(v, axis=1)
    return {
        "point": np.arange(rows, dtype=float),
        "x_mm": position[:, 0],
        "y_mm": position[:, 1],
        "z_mm": position[:, 2],
        "dir_x": np.where(rng.uniform(size=rows) > 0.5, 1.0, -1.0),
        "t_s": 7.5 * np.arange(rows),
        "T_x_degC": 20.0 + rng.uniform(0.0, 2.0, rows),
        "T_air_degC": 19.0 + rng.uniform(0.0, 1.0, rows),
        "range_mm": r,
        "azimuth_rad": np.arctan2(v[:, 1], v[:, 0]),
        "elevation_rad": np.arcsin(v[:, 2] / r),
    }
