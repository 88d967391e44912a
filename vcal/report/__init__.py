"""The report of closing the loop: a page to read, a record for programs, tables, pictures."""

from .compensation import compensation_csv, effects_csv, error_motion_tables
from .record import SCHEMA, record
from .write import check_folder, write_report

__all__ = [
    "SCHEMA",
    "check_folder",
    "compensation_csv",
    "effects_csv",
    "error_motion_tables",
    "record",
    "write_report",
]
