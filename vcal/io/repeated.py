"""Rows that are in a table of readings twice, as after a file was pasted below itself."""

from collections.abc import Collection

import numpy as np

from .messages import refusal
from .table import Table


def check_repeated(table: Table, readings: Collection[str]) -> None:
    """Raises `StudyError` for rows that say again, in every column, what an earlier one said: their
    readings would count twice, and their scatter would seem smaller than it is.

    What is measured again differs in its readings. With a coarse resolution some of it may agree
    all the same, so that nothing is refused where most of what was measured again under the same
    conditions differs.
    """
    if not readings:
        return  # every row has an index of its own
    first = _first(table, list(table))
    repeated = np.flatnonzero(first < np.arange(table.rows))
    conditions = [name for name in table if name not in readings]
    again = int((_first(table, conditions) < np.arange(table.rows)).sum())
    if len(repeated) <= again - len(repeated):
        return
    row, earlier = int(repeated[0]), int(first[repeated[0]])
    more = f", and {len(repeated) - 1} more rows that repeat one" if len(repeated) > 1 else ""
    raise refusal(
        table.name,
        table.where(row),
        f"what is in {table.where(earlier)} again, in every column{more}",
        "every reading once, as it counts twice otherwise",
        "remove the rows; where the same was really measured again, tell it apart by a column such "
        "as t_s or run",
    )


def _first(table: Table, names: Collection[str]) -> np.ndarray:
    """Of every row, the first one that is the same in these columns."""
    columns = [np.unique(table[name], return_inverse=True)[1] for name in names]
    seen: dict[bytes, int] = {}
    rows = np.column_stack(columns) if columns else np.zeros((table.rows, 1))
    return np.array([seen.setdefault(row.tobytes(), i) for i, row in enumerate(rows)])
