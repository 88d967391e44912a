"""One tracker table as sixty programs would write it: each is read right, or refused with the right
cause."""

import datetime
import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from conftest import MACHINE, TRACKER
from table_files import fixed, ods, rows_of, text, tracker, xlsx
from vcal.errors import StudyError
from vcal.study.csv_table import Table
from vcal.study.declared_chain import build_chain
from vcal.study.folder import Folder
from vcal.study.settings import table_formats, validate
from vcal.study.tables import run_table
from vcal.study.toml_file import read_setup

TRUE = tracker()
START = datetime.datetime(2025, 3, 29, 23, 58, 30)
INCH, DEG = 25.4, np.pi / 180.0


def read(folder: Path, keys: str = "") -> Table:
    """The table of a tracker study with these lines below ``[data]``."""
    setup = folder / "setup.toml"
    setup.write_text(f"{MACHINE}{TRACKER}\n[data]\n{keys}\n", encoding="utf-8")
    raw, given = read_setup(setup)
    root = Folder(folder)
    settings = validate(raw, "setup.toml", given, root)
    root.formats.update(table_formats(settings, "setup.toml"))
    chain = build_chain(settings.machine, "setup.toml", root)
    name = settings.data.table
    return run_table(name, settings.instrument, chain, root, "setup.toml", "")[0]


def check_true(table: Table, columns: Mapping[str, np.ndarray] = TRUE) -> None:
    for name, values in columns.items():
        np.testing.assert_allclose(table[name], values, rtol=1e-12, atol=1e-300, err_msg=name)


def renamed(new: Mapping[str, str], **replaced) -> dict:
    """The true table with other names, and with other values by the old names."""
    return {new.get(name, name): replaced.get(name, values) for name, values in TRUE.items()}


def without(*names: str) -> dict[str, np.ndarray]:
    return {name: values for name, values in TRUE.items() if name not in names}


def stamps(pattern: str | None = None) -> list[str]:
    """The times as dates, of ISO 8601 without a pattern."""
    times = [START + datetime.timedelta(seconds=float(t)) for t in TRUE["t_s"]]
    return [t.isoformat() if pattern is None else t.strftime(pattern) for t in times]


def dms(radians: float) -> str:
    """Degrees, minutes and seconds with twelve digits of the seconds."""
    total = abs(radians) / DEG
    d = int(total)
    m = int((total - d) * 60.0)
    s = ((total - d) * 60.0 - m) * 60.0
    return f"{'-' if radians < 0.0 else ''}{d}°{m:02d}'{s:.12f}\""


SHORT = {
    "point": "No",
    "x_mm": "X",
    "y_mm": "Y",
    "z_mm": "Z",
    "range_mm": "D",
    "azimuth_rad": "Hz",
    "elevation_rad": "V",
}
NAMED = {
    "x_mm": "X",
    "y_mm": "Y",
    "z_mm": "Z",
    "range_mm": "Range",
    "azimuth_rad": "Azimuth",
    "elevation_rad": "Elevation",
}
UNITS = ["-", "mm", "mm", "mm", "", "s", "°C", "°C", "mm", "rad", "rad"]
MAP = """
[data.columns]
point = "No"
x_mm = "X"
y_mm = "Y"
z_mm = "Z"
range_mm = "D"
azimuth_rad = "Hz"
elevation_rad = "V"
"""
ROTATED = {"x_mm": "X pos", "z_mm": "Height"}
ROTATED_MAP = """
[data.columns]
x_mm = { from = "X pos", unit = "inch", sign = -1, offset = 2000.0 }
z_mm = { from = "Height", unit = "m", offset = 100 }
"""
FIXED_NAMES = {name: name for name in TRUE}


@dataclass(frozen=True)
class Variant:
    """What is in the file, what the study says about it, and what comes of it."""

    content: str | bytes | Callable[[Path], None]
    keys: str = ""
    refused: tuple[str, ...] = ()
    """Parts of the message; empty where the table is read."""
    missing: tuple[str, ...] = ()
    """Columns that the file does not have."""
    needs: str = ""
    """Package without which the file cannot be read."""

    def write(self, folder: Path) -> None:
        if callable(self.content):
            self.content(folder)
        elif isinstance(self.content, bytes):
            (folder / "data.csv").write_bytes(self.content)
        else:
            (folder / "data.csv").write_bytes(self.content.encode("utf-8"))


def book(write: Callable, name: str, sheets: Mapping[str, list]) -> Callable[[Path], None]:
    return lambda folder: write(folder / name, sheets)


def values(columns: Mapping, units: list[str] | None = None) -> list[list]:
    """Header and rows of numbers, as a spreadsheet holds them."""
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    return [list(columns), *([units] if units else []), *rows]


def parquet(folder: Path, columns: Mapping) -> None:
    import pyarrow
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table(dict(columns)), folder / "run.parquet")


def openpyxl_dates(folder: Path) -> None:
    import openpyxl

    made = openpyxl.Workbook()
    sheet = made.active
    assert sheet is not None
    when = [START + datetime.timedelta(seconds=float(t)) for t in TRUE["t_s"]]
    for row in values(renamed({"t_s": "time"}, t_s=when)):
        sheet.append(row)
    made.save(folder / "run.xlsx")


CALAMINE, ARROW = "python_calamine", "pyarrow"
GERMAN = text(TRUE, ";", decimal=",")
PLAIN = text(TRUE)
FEET = {"range_mm": TRUE["range_mm"] / 304.8}
CELSIUS = {n: TRUE[n] * 1.8 + 32.0 for n in ("T_x_degC", "T_air_degC")}
KELVIN = {n: TRUE[n] + 273.15 for n in ("T_x_degC", "T_air_degC")}
SERIAL = [(START - datetime.datetime(1899, 12, 30)).total_seconds() / 86400 + t / 86400
          for t in TRUE["t_s"]]  # fmt: skip
BRACKETS = {
    "x_mm": "X [mm]",
    "y_mm": "Y (mm)",
    "z_mm": "Z / mm",
    "t_s": "t [s]",
    "T_x_degC": "T_x [°C]",
    "T_air_degC": "T_air [°C]",
    "range_mm": "Range [mm]",
    "azimuth_rad": "Azimuth (rad)",
    "elevation_rad": "Elevation, rad",
}

READ = {
    # --- encodings and ends of lines
    "plain": Variant(PLAIN),
    "BOM": Variant(b"\xef\xbb\xbf" + PLAIN.encode()),
    "UTF-16 with BOM": Variant(PLAIN.encode("utf-16")),
    "UTF-16 big-endian with BOM": Variant(b"\xfe\xff" + PLAIN.encode("utf-16-be")),
    "UTF-16 without BOM": Variant(PLAIN.encode("utf-16-le")),
    "UTF-8, degree signs": Variant(text(renamed(BRACKETS), ";")),
    "Latin-1": Variant(text(renamed(BRACKETS), ";").encode("latin-1")),
    "Windows-1252": Variant(
        text({**renamed(BRACKETS), "Bemerkung": ["„gut“ – 5 €"] * 40}, ";").encode("cp1252")
    ),
    "declared encoding": Variant(
        text({**TRUE, "メモ": ["良い"] * 40}).encode("cp932"), 'encoding = "cp932"'
    ),
    "CRLF": Variant(text(TRUE, end="\r\n")),
    "CR": Variant(text(TRUE, end="\r")),
    "no end of the last line": Variant(PLAIN.rstrip("\n")),
    # --- separators
    "semicolons": Variant(text(TRUE, ";")),
    "tabs": Variant(text(TRUE, "\t")),
    "bars": Variant(text(TRUE, "|"), 'delimiter = "|"'),
    "blanks": Variant(text(TRUE, "   "), 'delimiter = " "'),
    "fixed width": Variant(fixed(TRUE), 'delimiter = "fixed"'),
    "declared widths": Variant(fixed(TRUE, 26), f"widths = {[26] * 11}"),
    "separators at the ends of lines": Variant(PLAIN.replace("\n", ",\n")),
    "blanks around the cells": Variant(PLAIN.replace(",", " , ")),
    "quoted cells": Variant('"' + PLAIN.strip().replace(",", '","').replace("\n", '"\n"') + '"\n'),
    "sep line": Variant("sep=;\n" + text(TRUE, ";")),
    # --- headers and rows
    "comments above": Variant("# tracker, serial 12\n#\n\n" + PLAIN),
    "comments between": Variant(PLAIN.replace("\n5,", "\n# station checked\n5,")),
    "header in a comment": Variant("# run of March\n# " + PLAIN),
    "another comment mark": Variant("! made by hand\n" + PLAIN, 'comment = "!"'),
    "title lines": Variant("Tracker report\nOperator: N. N.\n" + PLAIN, "header_row = 3"),
    "skipped lines": Variant("Tracker report;v2\n;;\n" + PLAIN, "skip_rows = 2"),
    "a line of descriptions": Variant(
        PLAIN.replace("\n", "\n" + ",".join(["about"] * 11) + "\n", 1), "skip_rows = [2]"
    ),
    "no header": Variant(
        PLAIN.partition("\n")[2],
        "header_row = 0\n[data.columns]\n"
        + "\n".join(f"{name} = {{ from = {k} }}" for k, name in enumerate(TRUE, start=1)),
    ),
    "units row": Variant(text(renamed(NAMED), units=UNITS)),
    "units row in brackets": Variant(
        text(renamed(SHORT), units=[f"[{u}]" if u else "" for u in UNITS]),
        MAP,
    ),
    "another order": Variant(text({name: TRUE[name] for name in reversed(TRUE)})),
    "capitals and brackets": Variant(text(renamed(BRACKETS))),
    # --- numbers
    "decimal comma": Variant(GERMAN),
    "decimal comma, tabs": Variant(text(TRUE, "\t", decimal=",")),
    "decimal comma in quoted cells": Variant(text(TRUE, ",", decimal=","), 'decimal = ","'),
    "thousands of points": Variant(
        text(TRUE, ";", decimal=",", thousands="."), 'decimal = ","\nthousands = "."'
    ),
    "thousands of commas": Variant(text(TRUE, ";", thousands=","), 'thousands = ","'),
    "thousands of blanks": Variant(text(TRUE, ";", thousands="\u202f"), 'thousands = " "'),
    "thousands of apostrophes": Variant(text(TRUE, ";", thousands="'"), 'thousands = "\'"'),
    "exponents": Variant(
        ",".join(TRUE) + "\n"
        + "\n".join(",".join(f"{v:.17E}" for v in row) for row in zip(*TRUE.values(), strict=True))
    ),  # fmt: skip
    "minus signs": Variant(PLAIN.replace(",-", ",−")),
    # --- units
    "inches": Variant(
        text(renamed({"x_mm": "x_in", "y_mm": "y_inch"}, x_mm=TRUE["x_mm"] / INCH,
                     y_mm=TRUE["y_mm"] / INCH))
    ),  # fmt: skip
    "metres": Variant(text(renamed({"range_mm": "range_m"}, range_mm=TRUE["range_mm"] / 1e3))),
    "feet": Variant(text(renamed({"range_mm": "Range [ft]"}, **FEET))),
    "micrometres": Variant(text(renamed({"z_mm": "z_µm"}, z_mm=TRUE["z_mm"] * 1e3))),
    "degrees": Variant(
        text(renamed({"azimuth_rad": "azimuth_deg"}, azimuth_rad=TRUE["azimuth_rad"] / DEG))
    ),
    "gon": Variant(
        text(
            renamed(
                {"azimuth_rad": "azimuth_gon", "elevation_rad": "elevation_gon"},
                azimuth_rad=TRUE["azimuth_rad"] * 200 / np.pi,
                elevation_rad=TRUE["elevation_rad"] * 200 / np.pi,
            )
        )
    ),
    "mrad and arcsec": Variant(
        text(
            renamed(
                {"azimuth_rad": "azimuth_mrad", "elevation_rad": "elevation_arcsec"},
                azimuth_rad=TRUE["azimuth_rad"] * 1e3,
                elevation_rad=TRUE["elevation_rad"] / DEG * 3600,
            )
        )
    ),
    "degrees, minutes, seconds": Variant(
        text(renamed({"azimuth_rad": "Hz"}, azimuth_rad=[dms(a) for a in TRUE["azimuth_rad"]]),
             ";"),
        '[data.columns]\nazimuth_rad = { from = "Hz", unit = "dms" }',
    ),  # fmt: skip
    "Fahrenheit": Variant(
        text(renamed({"T_x_degC": "T_x_degF", "T_air_degC": "T_air [°F]"}, **CELSIUS))
    ),
    "kelvin": Variant(text(renamed({"T_x_degC": "T_x_K", "T_air_degC": "T_air_K"}, **KELVIN))),
    "units row of other units": Variant(
        text(
            renamed(NAMED, x_mm=TRUE["x_mm"] / INCH, azimuth_rad=TRUE["azimuth_rad"] / DEG),
            ";",
            units=["", "in", "mm", "mm", "", "s", "°C", "°C", "mm", "deg", "rad"],
        )
    ),
    "mapped": Variant(text(renamed(SHORT)), MAP),
    "mapped with unit, sign and offset": Variant(
        text(
            renamed(
                ROTATED, x_mm=(2000.0 - TRUE["x_mm"]) / INCH, z_mm=(TRUE["z_mm"] - 100.0) / 1e3
            )
        ),
        ROTATED_MAP,
    ),
    "zenith distances": Variant(
        text(renamed({"elevation_rad": "V"},
                     elevation_rad=100.0 - TRUE["elevation_rad"] * 200 / np.pi)),
        "[data.columns]\nelevation_rad = "
        f'{{ from = "V", unit = "gon", sign = -1, offset = {np.pi / 2!r} }}',
    ),  # fmt: skip
    # --- times
    "minutes": Variant(text(renamed({"t_s": "t_min"}, t_s=TRUE["t_s"] / 60))),
    "milliseconds": Variant(text(renamed({"t_s": "t [ms]"}, t_s=TRUE["t_s"] * 1e3))),
    "ISO times in t_s": Variant(text(renamed({}, t_s=stamps()))),
    "ISO times in time": Variant(
        text(renamed({"t_s": "Time"}, t_s=stamps("%Y-%m-%d %H:%M:%S.%f")))
    ),
    "ISO times with an offset": Variant(
        text(renamed({"t_s": "timestamp"}, t_s=[f"{one}+01:00" for one in stamps()]))
    ),
    "ISO times with a decimal comma": Variant(
        text(renamed({"t_s": "time"},
                     t_s=[s.replace(".", ",") for s in stamps("%Y-%m-%dT%H:%M:%S.%f")]), ";")
    ),  # fmt: skip
    "times by a pattern": Variant(
        text(renamed({"t_s": "Zeit"}, t_s=stamps("%d.%m.%Y %H:%M:%S.%f")), ";"),
        '[data.columns]\nt_s = { from = "Zeit", format = "%d.%m.%Y %H:%M:%S.%f" }',
    ),
    "date and time in two columns": Variant(
        text({**renamed({"t_s": "Datum"}, t_s=stamps("%d.%m.%Y")),
              "Uhrzeit": stamps("%H:%M:%S.%f")}, ";"),
        '[data.columns]\nt_s = { from = ["Datum", "Uhrzeit"], format = "%d.%m.%Y %H:%M:%S.%f" }',
    ),  # fmt: skip
    "days of a spreadsheet": Variant(
        text(renamed({"t_s": "when"}, t_s=SERIAL)),
        '[data.columns]\nt_s = { from = "when", format = "excel" }',
    ),
    # --- other files
    "xlsx": Variant(
        book(xlsx, "run.xlsx", {"Sheet1": values(TRUE)}), 'file = "run.xlsx"', needs=CALAMINE
    ),
    "xlsx with a units row": Variant(
        book(xlsx, "run.xlsx", {"Sheet1": values(renamed(NAMED), UNITS)}),
        'file = "run.xlsx"',
        needs=CALAMINE,
    ),
    "xlsx, sheet by name": Variant(
        book(xlsx, "run.xlsx", {"notes": [["nothing"]], "points": values(TRUE)}),
        'file = "run.xlsx"\nsheet = "points"',
        needs=CALAMINE,
    ),
    "xlsx, sheet by number": Variant(
        book(xlsx, "run.xlsx", {"notes": [["nothing"]], "points": values(TRUE)}),
        'file = "run.xlsx"\nsheet = 2',
        needs=CALAMINE,
    ),
    "xlsx, sheet behind the name": Variant(
        book(xlsx, "run.xlsx", {"notes": [["nothing"]], "points": values(TRUE)}),
        'file = "run.xlsx#points"',
        needs=CALAMINE,
    ),
    "xlsx below a title": Variant(
        book(xlsx, "run.xlsx", {"S": [["Tracker report"], [], *values(TRUE)]}),
        'file = "run.xlsx"\nheader_row = 3',
        needs=CALAMINE,
    ),
    "xlsx named csv": Variant(
        book(xlsx, "data.csv", {"S": values(TRUE)}), needs=CALAMINE
    ),  # by its first bytes
    "xlsx with dates": Variant(openpyxl_dates, 'file = "run.xlsx"', needs="openpyxl"),
    "ods": Variant(book(ods, "run.ods", {"S": values(TRUE)}), 'file = "run.ods"', needs=CALAMINE),
    "parquet": Variant(lambda f: parquet(f, TRUE), 'file = "run.parquet"', needs=ARROW),
    "parquet with time stamps": Variant(
        lambda f: parquet(
            f,
            renamed(
                {"t_s": "time"},
                t_s=np.datetime64(START, "ns") + (TRUE["t_s"] * 1e9).astype("timedelta64[ns]"),
            ),
        ),
        'file = "run.parquet"',
        needs=ARROW,
    ),
}  # fmt: skip

REFUSED = {
    "no such column": Variant(
        text(renamed(SHORT)),
        MAP.replace('"D"', '"Dist"'),
        ("setup.toml, key data.columns.range_mm.from", "'Dist', no such column in data.csv"),
    ),
    "unknown unit": Variant(
        text(renamed(ROTATED)),
        ROTATED_MAP.replace("inch", "ell"),
        ("key data.columns.x_mm.unit", "'ell', an unknown unit", "a unit of length: m, cm, mm"),
    ),
    "a unit of another kind": Variant(
        text(renamed(ROTATED)),
        ROTATED_MAP.replace("inch", "degF"),
        ("key data.columns.x_mm.unit", "'degF', a unit of temperature", "a unit of length"),
    ),
    "units that contradict each other": Variant(
        text(TRUE, units=["", "inch", *UNITS[2:]]),
        "",
        ("data.csv, units row, column x_mm", "found the unit 'inch', expected mm", "data.columns"),
    ),
    "an unknown unit in the units row": Variant(
        text(renamed(SHORT), units=["", "ell", *UNITS[2:]]),
        'columns.x_mm = "X"',
        ("data.csv, units row, column X", "'ell', which vcal does not know", "a unit of length"),
    ),
    "no units at all": Variant(
        text(renamed(SHORT)), "", ("column x_mm: found no such column", "[data.columns] x_mm")
    ),
    "two columns of one quantity": Variant(
        text({**renamed({"x_mm": "x_in"}, x_mm=TRUE["x_mm"] / INCH), "X [mm]": TRUE["x_mm"]}),
        "",
        ("columns 'x_in' and 'X [mm]'", "two columns of one quantity", "one, x_mm"),
    ),
    "a title": Variant(
        "Tracker report, March\nOperator: N. N.\n" + PLAIN,
        "",
        ("header (line 1)", "which is a title above the table", "set header_row = 3"),
    ),
    "no names": Variant(
        PLAIN.partition("\n")[2], "", ("header (line 1)", "found numbers", "set header_row = 0")
    ),
    "dates of unknown order": Variant(
        text(renamed({}, t_s=stamps("%d/%m/%Y %H:%M:%S"))),
        "",
        ("row 1 (line 2), column t_s", "day and month may be exchanged", "declare the format"),
    ),
    "times that do not follow the pattern": Variant(
        text(renamed({}, t_s=stamps("%d.%m.%Y %H:%M:%S"))),
        '[data.columns]\nt_s = { from = "t_s", format = "%d.%m.%Y %H:%M" }',
        ("row 1 (line 2), column t_s", "expected a time of the form '%d.%m.%Y %H:%M'"),
    ),
    "seconds for days of a spreadsheet": Variant(
        PLAIN,
        'columns.t_s = { from = "t_s", format = "excel" }',
        ("row 1 (line 2), column t_s", "found '0'", "days since 1899-12-30"),
    ),
    "a misspelled key of the mapping": Variant(
        PLAIN,
        'columns.x_mm = { from = "x_mm", unti = "mm" }',
        ("setup.toml, key data.columns.x_mm.unti", "did you mean 'unit'?"),
    ),
    "a mapping without a column": Variant(
        PLAIN, 'columns.x_mm = { unit = "mm" }', ("key data.columns.x_mm.from", "found nothing")
    ),
    "some times with an offset": Variant(
        text(renamed({}, t_s=[one + ("Z" if i == 7 else "") for i, one in enumerate(stamps())])),
        "",
        ("row 8 (line 9), column t_s", "all with or all without an offset"),
    ),
    "a comma among points": Variant(
        text(renamed({}, y_mm=[f"{v}".replace(".", ",") if i == 3 else f"{v}"
                               for i, v in enumerate(TRUE["y_mm"])]), ";"),
        "",
        ("row 4 (line 5), column y_mm", "same decimal mark", 'declare decimal = ","'),
    ),  # fmt: skip
    "a point among declared commas": Variant(
        GERMAN.replace(",", ".", 3),
        'decimal = ","',
        ("row 1 (line 2), column x_mm", "with a decimal comma as declared"),
    ),
    "commas before three digits only": Variant(
        text({n: [f"{int(v) % 900 + 1},{i:03d}" for i, v in enumerate(c)] if n == "range_mm" else
              [f"{v:.0f}" for v in c] for n, c in TRUE.items()}, ";"),
        "",
        ("column range_mm", "commas only before three digits", 'decimal = "," or thousands = ","'),
    ),  # fmt: skip
    "thousands that are not declared": Variant(
        text(TRUE, ";", thousands="'"), "", ("column x_mm", "declare thousands = \"'\"")
    ),
    "bars that are not declared": Variant(
        text(TRUE, "|"), "", ("header (line 1)", "found one name", "declare another one as delim")
    ),
    "degrees in a column of radians": Variant(
        text(renamed({}, azimuth_rad=(TRUE["azimuth_rad"] + 1.0) / DEG)),
        "",
        ("column azimuth_rad", "from -6.283185 to 6.283185", "if the column is in", "deg or gon"),
    ),
    "kelvin in a column of Celsius": Variant(
        text(renamed({}, **KELVIN)), "", ("column T_x_degC", "from -50 to 150", "in degF or K")
    ),
    "Fahrenheit in columns of Celsius": Variant(
        text(renamed({}, **CELSIUS)),
        "",
        ("columns T_x_degC, T_air_degC", "in degF they would be", 'unit = "degF"'),
    ),
    "an unknown encoding": Variant(
        PLAIN, 'encoding = "klingon"', ("key data.encoding", "'klingon'", "'cp1252'")
    ),
    "a wrong encoding": Variant(
        text(renamed(BRACKETS), ";").encode("latin-1"),
        'encoding = "utf-8"',
        ("data.csv, file", "unreadable text", "correct the key encoding"),
    ),
    "two marks alike": Variant(
        PLAIN, 'decimal = ","\nthousands = ","', ("key data: found ',' as decimal", "thousands")
    ),
    "a binary file": Variant(
        bytes(range(256)) * 20, "", ("data.csv, file", "unreadable text", "UTF-8")
    ),
    "no sheet chosen": Variant(
        book(xlsx, "run.xlsx", {"a": values(TRUE), "b": [["x"], [1.0]]}),
        'file = "run.xlsx"',
        ("run.xlsx, file", "2 sheets with cells (a, b)", 'declare sheet = "a"'),
        needs=CALAMINE,
    ),
    "no such sheet": Variant(
        book(xlsx, "run.xlsx", {"a": values(TRUE)}),
        'file = "run.xlsx"\nsheet = "points"',
        ("run.xlsx, file", "no sheet 'points' among a"),
        needs=CALAMINE,
    ),
    "a sheet of a text": Variant(
        PLAIN, 'sheet = "points"', ("data.csv, file", "that is no spreadsheet")
    ),
    "a damaged spreadsheet": Variant(
        b"PK\x03\x04 nothing", "", ("data.csv, file", "damaged"), needs=CALAMINE
    ),
    "a damaged parquet file": Variant(
        b"PAR1 nothing", "", ("data.csv, file", "damaged"), needs=ARROW
    ),
    "file and data": Variant(
        PLAIN, 'file = "data.csv"\ndata = "data.csv"', ("key data: found file =", "remove one")
    ),
    "a unit for a plain number": Variant(
        PLAIN,
        'columns.point = { from = "point", unit = "mm" }',
        ("key data.columns.point.unit", "whose name has no unit"),
    ),
}  # fmt: skip


def wanting(variant: Variant) -> None:
    if variant.needs and importlib.util.find_spec(variant.needs) is None:
        pytest.skip(f"needs {variant.needs}, of the extra tables")


def test_there_are_sixty_variants():
    assert len(READ) >= 60 and len(READ) + len(REFUSED) >= 90


@pytest.mark.parametrize("name", READ)
def test_a_variant_is_read(tmp_path, name):
    wanting(READ[name])
    READ[name].write(tmp_path)
    table = read(tmp_path, READ[name].keys)
    check_true(table, without(*READ[name].missing))
    assert table.rows == 40 and not table.blank.any()


@pytest.mark.parametrize("name", REFUSED)
def test_a_variant_is_refused_with_its_cause(tmp_path, name):
    wanting(REFUSED[name])
    REFUSED[name].write(tmp_path)
    with pytest.raises(StudyError) as caught:
        read(tmp_path, REFUSED[name].keys)
    message = str(caught.value)
    assert ": found " in message and ", expected " in message and "; " in message, message
    for part in REFUSED[name].refused:
        assert part in message, f"{part!r} is not in: {message}"


def test_rows_have_the_numbers_of_the_file(tmp_path):
    """Below a title, comments and a units row."""
    rows = rows_of(renamed(SHORT, range_mm=[*TRUE["range_mm"][:-1], "lost"]), UNITS)
    lines = ["Report", "# by me", *(";".join(row) for row in rows)]
    (tmp_path / "data.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(StudyError, match=r"data\.csv, row 40 \(line 44\), column range_mm"):
        read(tmp_path, "header_row = 3\n" + MAP)
