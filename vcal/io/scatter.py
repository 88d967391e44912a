"""Whether readings differ as much as the noise that is declared of them makes them differ."""

from collections.abc import Collection

import numpy as np

from ..instruments.base import TableInstrument
from ..plan import Plan
from .messages import listed, refusal
from .table import Table

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
