"""Study folders: a study file and its tables, read, checked, built and written.

`study` reads a folder into a `Study`; `settings` declares the keys of the study file, `csv_table`
and `tables` the columns of its tables; `plugins` loads effects and instruments of a user's own, and
`design` the table ``[design]``. Every mistake of a user raises `StudyError` with the file, the
place, what was found, what was expected and what to do. Uses the loop, design and everything below;
`plots`, `report`, `reproduce` and `cli` stand on it.
"""

from lazy_loader import attach_stub

# Named in `__init__.pyi`, and imported where it is used: a report is read back without the loop.
__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
