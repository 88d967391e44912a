"""Columns of a table without readings that were meant to be readings: it would pass for a plan."""

import os
import re
from collections.abc import Collection, Sequence

import numpy as np

from ..instruments.base import TableInstrument
from ..machine.plan import Plan
from .csv_table import Table
from .messages import listed, refusal

_UNITS = frozenset(
    "nm um mm cm m km in inch inches mil rad mrad urad deg degree degrees grad gon arcmin arcsec "
    "arcs micron microns".split()
)
_LONG = 5
"""Letters that a name has at least where one of them may be wrong."""


def check_unread(
    name: str,
    kind: str,
    further: Sequence[str],
    readings: Collection[str],
    otherwise: Collection[str],
) -> None:
    """Raises `StudyError` where one of the `further` columns of a table that has none of the
    `readings` is named like one, or is one of those that the instrument reads `otherwise`, with
    other settings.
    """
    names = listed(sorted(readings))
    if others := [column for column in further if column in otherwise]:
        raise refusal(
            name,
            f"header, column{'s' * (len(others) > 1)} {listed(others)}",
            f"what a {kind} reads with other settings than those of its [instrument]",
            f"{names}; or no readings, in a plan",
            "correct the settings or the columns, or remove them from a plan",
        )
    for column in further:
        if meant := _like(column, readings):
            raise refusal(
                name,
                f"header, column {column}",
                f"no column of readings, but one that is named like {meant}",
                f"{names}, in these units; or no column like them, in a plan",
                "correct its name and unit, or give it another name where it is another quantity",
            )


def _like(column: str, readings: Collection[str]) -> str | None:
    """The reading that a column may be in another unit or spelling."""
    stems = {_stem(reading): reading for reading in sorted(readings)}
    own = _stem(column)
    if own in stems or len(own.replace("_", "")) < _LONG:
        return stems.get(own)
    return next((reading for stem, reading in stems.items() if _slip(own, stem)), None)


def _slip(one: str, other: str) -> bool:
    """Whether a letter too many, too few or another, or two exchanged, make one of the other."""
    start = len(os.path.commonprefix([one, other]))
    one, other = one[start:], other[start:]
    end = len(os.path.commonprefix([one[::-1], other[::-1]]))
    one, other = one[: len(one) - end], other[: len(other) - end]
    return max(len(one), len(other)) == 1 or (len(one) == 2 and one == other[::-1])


def _stem(column: str) -> str:
    """A name without its unit, in small letters: ``range`` of ``Range [mm]``."""
    parts = re.findall(r"[^\W_]+", column.casefold().replace("μ", "u"))  # also of the micro sign
    while len(parts) > 1 and parts[-1] in _UNITS:
        parts.pop()
    return "_".join(parts)


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


_LEAST, _ROUNDING = 0.03, 1e-9
"""Of the declared noise: readings whose standard deviation is less are in another unit, as noise
that is declared too large by a cautious hand is not. Less than rounding is none at all: readings of
a perfect machine, of a simulation.
"""
_FEWEST = 10
"""Rows from which readings are judged."""


def check_scatter(
    table: Table,
    columns: Collection[str],
    instrument: TableInstrument,
    plan: Plan,
    readings: np.ndarray,
) -> None:
    """Raise `StudyError` where the readings (n, m) are the same numbers in every row, or differ
    from row to row far less than their own noise lets them; `columns` are those of the readings.

    Readings that do not differ at all, of some of the kinds, are not judged: one may be zero by
    definition.
    """
    if (np.ptp(readings, axis=0) == 0.0).all():
        if readings.any():
            raise refusal(
                table.name,
                "columns of the readings",
                "the same numbers in every row",
                f"the readings of a {instrument.kind}, which differ from place to place",
                "export the readings again",
            )
        return
    reduced = np.asarray(instrument.reduce(readings, plan))
    noise, present = instrument.noise(plan, readings), instrument.present(plan)
    still = []
    for i, name in enumerate(instrument.readings):
        rows = present[:, i]
        std = float(np.std(reduced[rows, i])) if rows.sum() >= _FEWEST else 0.0
        declared = float(np.sqrt(np.square(noise[rows, i]).mean())) if std > 0.0 else 0.0
        if _ROUNDING * declared < std < _LEAST * declared:
            still.append((name, std, declared))
    if not still:
        return
    names = [_column(name, columns) for name, *_ in still]
    name, std, declared = min(still, key=lambda one: one[1] / one[2])
    own = np.std(table[column]) if (column := _column(name, columns)) in table else 0.0
    # In the unit of the column, whatever that is.
    factor, unit = (float(own) / std, f" in the unit of {column}") if own else (1.0, " in SI")
    raise refusal(
        table.name,
        f"column{'s' * (len(names) > 1)} {listed(names)}",
        f"readings with a standard deviation of {factor * std:.3g} over all rows, "
        f"{std / declared:.2g} of the noise that is declared of one of them",
        f"about {factor * declared:.3g} at least{unit}, as noise alone makes it",
        "correct the unit of the readings, or the noise in [instrument]",
    )


def _column(reading: str, columns: Collection[str]) -> str:
    """The column of a reading, its name with the unit; its own where there is none."""
    found = (c for c in sorted(columns) if c == reading or c.startswith(f"{reading}_"))
    return next(found, reading)
