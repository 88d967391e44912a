from .formats import FORMATS, Format, Results
from .formats.compensation_csv import compensation_csv
from .formats.effects_csv import effects_csv
from .html.picture import Picture
from .html.sheet import Badge, Section, Table, Tile, sheet
from .loop.record import SCHEMA, record
from .loop.write import check_folder, write_report
from .uncertainty.record import UNCERTAINTY_SCHEMA, sentence
from .uncertainty.write import DRAWS, check_uncertainty_folder, write_uncertainty

__all__ = [
    "DRAWS",
    "FORMATS",
    "SCHEMA",
    "UNCERTAINTY_SCHEMA",
    "Badge",
    "Format",
    "Picture",
    "Results",
    "Section",
    "Table",
    "Tile",
    "check_folder",
    "check_uncertainty_folder",
    "compensation_csv",
    "effects_csv",
    "record",
    "sentence",
    "sheet",
    "write_report",
    "write_uncertainty",
]
