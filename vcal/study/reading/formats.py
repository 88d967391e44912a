"""The keys that say how a table is read: those of ``[data]`` and of ``[tables."NAME"]``."""

import codecs
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from ...bounds import Within

_Text = Annotated[str, Field(min_length=1)]
_Place = Annotated[int, Within(1, 100_000, "places count from 1, and no table is wider")]
_Lines = Annotated[int, Within(0, 1_000_000, "no table has a longer preamble")]
_MARKS = {"comma": ",", "semicolon": ";", "tab": "\t", "pipe": "|", "blank": " ", "blanks": " "}
"""Separators that may be named by a word."""


class ColumnSettings(BaseModel):
    """An entry of ``[data.columns]``: which column of the file holds a quantity, and in which unit.

    The value is ``sign * (number in the unit, converted to that in vcal's name) + offset``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    source: _Text | _Place | tuple[_Text | _Place, ...] = Field(alias="from")
    """Name of the column in the file, or its number from 1; several, such as a date and a time, are
    joined by a blank."""
    unit: _Text | None = None
    """Unit of the numbers in the file; by default that in the header or in the units row, or that
    in the name of the quantity."""
    sign: Literal[1, -1] = 1
    """-1 where the file counts the other way."""
    offset: Annotated[
        float, Within(-1e10, 1e10, "it would leave no digits to the numbers in the column")
    ] = 0.0
    """What is added at last, in the unit in the name of the quantity."""
    format: _Text | None = None
    """Of a time: ``"iso8601"``, ``"excel"`` (days since 1899-12-30) or a pattern of Python's
    `strptime`, such as ``"%d.%m.%Y %H:%M:%S"``. The first time of the study is zero."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.format is not None and (self.unit is not None or self.sign != 1):
            raise ValueError(
                "found format together with unit or sign, expected a format for times and the "
                "others for numbers; remove one of them"
            )
        if isinstance(self.source, tuple) and not self.source:
            raise ValueError("found from = [], expected at least one column; name it")
        return self

    @property
    def sources(self) -> tuple[str | int, ...]:
        """The columns of the file."""
        return self.source if isinstance(self.source, tuple) else (self.source,)


class TableFormat(BaseModel):
    """How a file is read; every key has a default that suits most files."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    sheet: _Text | _Place | None = None
    """Sheet of a spreadsheet, by its name or number from 1; may be left out where only one has
    cells. ``"FILE.xlsx#SHEET"`` as the name of a file means the same."""
    header_row: _Lines | None = None
    """Line of the file with the names of the columns, from 1; 0 where there is none, so that
    `columns` gives numbers. By default the first line that is neither empty nor a comment."""
    skip_rows: _Lines | tuple[_Place, ...] = 0
    """Number of lines at the top of the file to be skipped, or a list of single lines, from 1."""
    comment: Annotated[str, Field(max_length=8)] = "#"
    """Beginning of lines that are comments; empty where there are none."""
    decimal: Literal[".", ","] | None = None
    """Decimal mark, ``"."`` or ``","``. By default a comma counts as one where cells are separated
    by something else and no number of the file has a decimal point."""
    thousands: Literal[",", ".", " ", "'"] | None = None
    """Separator of thousands; none by default. ``" "`` stands for all kinds of blanks."""
    delimiter: Annotated[str, Field(min_length=1)] | None = None
    """Separator of the cells: one character, ``" "`` for any number of blanks, or ``"fixed"`` for
    columns of fixed width. By default a comma, semicolon or tab, whichever is in the header."""
    widths: tuple[_Place, ...] | None = None
    """Widths of the columns in characters with ``delimiter = "fixed"``; by default the columns are
    separated by blanks that stand one below the other in all lines."""
    encoding: _Text = "auto"
    """Encoding of the text: ``"auto"`` (UTF-8, UTF-16, Windows-1252 or Latin-1), or a name that
    Python knows, such as ``"cp932"``."""
    columns: dict[str, ColumnSettings] = {}
    """Quantities by the names that vcal gives them; the value is the name of a column in the file,
    or a table with `from`, `unit`, `sign`, `offset` and `format`. Columns that are not named keep
    their meaning."""

    @field_validator("columns", mode="before")
    @classmethod
    def _in_long_form(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        found = {k: {"from": one} if isinstance(one, str) else one for k, one in value.items()}
        for key, one in found.items():
            if isinstance(one, dict) and isinstance(one.get("from"), list):
                found[key] = {**one, "from": tuple(one["from"])}  # as strict validation asks for
        return found

    @field_validator("delimiter")
    @classmethod
    def _one_character(cls, value: str | None) -> str | None:
        if value is None or value == "fixed":
            return value
        mark = _MARKS.get(value, value)
        if len(mark) != 1 or mark.isalnum() or mark in "\r\n\"'.":
            raise ValueError(
                f"found {value!r}, expected one character such as ';' or '|', ' ' for blanks, or "
                "'fixed'; correct it"
            )
        return mark

    @field_validator("encoding")
    @classmethod
    def _known_encoding(cls, value: str) -> str:
        if value == "auto":
            return value
        try:
            b"".decode(codecs.lookup(value).name)
        except (LookupError, TypeError, ValueError):
            raise ValueError(
                f"found {value!r}, expected 'auto' or an encoding of text, such as 'utf-8', "
                "'utf-16', 'cp1252' or 'latin-1'; correct it"
            ) from None
        return value

    @model_validator(mode="after")
    def _marks_differ(self) -> Self:
        marks = {"decimal": self.decimal, "thousands": self.thousands, "delimiter": self.delimiter}
        given = {key: mark for key, mark in marks.items() if mark is not None}
        for key, mark in given.items():
            same = [other for other, its in given.items() if its == mark and other != key]
            # A decimal comma in quoted cells is told from the commas between them.
            if same and {key, *same} != {"decimal", "delimiter"}:
                raise ValueError(
                    f"found {mark!r} as {key} and as {same[0]}, expected different marks; correct "
                    "one of them"
                )
        if self.widths is not None and self.delimiter not in (None, "fixed"):
            raise ValueError(
                f'found widths with delimiter = {self.delimiter!r}, expected delimiter = "fixed"; '
                "remove one of them"
            )
        return self


DEFAULT = TableFormat()
"""How a file is read of which nothing is said."""
FORMAT_KEYS = tuple(TableFormat.model_fields)
"""The keys of a table that only say how its file is read."""


def plain_format(settings: Any) -> TableFormat:
    """The keys of a table of the study file that say how its file is read."""
    given = {key: getattr(settings, key) for key in FORMAT_KEYS}
    return TableFormat.model_construct(**given)
