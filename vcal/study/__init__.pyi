from .csv_table import Table, read_header, read_table, write_table
from .study import Study, load_study

__all__ = ["Study", "Table", "load_study", "read_header", "read_table", "write_table"]
