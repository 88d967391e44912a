"""Study folders: a study file and its tables, read, checked, built and written.

`study` reads a folder into a `Study`; `settings` declares the keys of the study file, `csv_table`
and `tables` the columns of its tables; `plugins` loads effects and instruments of a user's own, and
`design` the table ``[design]``. Every mistake of a user raises `StudyError` with the file, the
place, what was found, what was expected and what to do. Uses the loop, design and everything below;
`plots`, `report`, `reproduce` and `cli` stand on it.
"""

from .csv_table import Table, read_header, read_table, write_table
from .study import Study, load_study

__all__ = ["Study", "Table", "load_study", "read_header", "read_table", "write_table"]
