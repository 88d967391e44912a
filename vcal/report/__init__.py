"""Reports: a page to read, a record for programs, tables, pictures."""

from .compensation import compensation_csv, effects_csv, error_motion_tables
from .geometry import GeometricTest, geometric_tests
from .picture import Picture
from .record import SCHEMA, record
from .sheet import Badge, Section, Table, Tile, sheet
from .uncertainty import DRAWS, check_virtual_folder, write_virtual
from .uncertainty_record import VIRTUAL_SCHEMA, sentence, virtual_record
from .write import check_folder, write_report

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
