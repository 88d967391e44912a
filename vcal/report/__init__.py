"""Reports: a page to read, a record for programs, tables, pictures."""

from ..geometry.acceptance import GeometricTest, geometric_tests
from ..geometry.error_motions import error_motion_tables
from .html.picture import Picture
from .html.sheet import Badge, Section, Table, Tile, sheet
from .loop.record import SCHEMA, record
from .loop.tables import compensation_csv, effects_csv
from .loop.write import check_folder, write_report
from .uncertainty.record import VIRTUAL_SCHEMA, sentence, virtual_record
from .uncertainty.write import DRAWS, check_virtual_folder, write_virtual

__all__ = [
    "DRAWS",
    "SCHEMA",
    "VIRTUAL_SCHEMA",
    "Badge",
    "GeometricTest",
    "Picture",
    "Section",
    "Table",
    "Tile",
    "check_folder",
    "check_virtual_folder",
    "compensation_csv",
    "effects_csv",
    "error_motion_tables",
    "geometric_tests",
    "record",
    "sentence",
    "sheet",
    "virtual_record",
    "write_report",
    "write_virtual",
]
