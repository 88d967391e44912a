"""Plausibility checks of tables: misspelled readings, repeated rows, scatter against the noise."""

import os
import re
from collections.abc import Collection, Sequence

import numpy as np

from ..instruments.base import TableInstrument
from ..machine.plan import Plan
from ..words import counted, plural
from .csv_table import Table
from .messages import listed, refusal

_UNITS = frozenset(
    "nm um mm cm m km in inch inches mil rad mrad urad deg degree degrees grad gon arcmin arcsec "
    "arcs micron microns".split()
)
_LONG = 5
"""Least length of a name in which one letter may be wrong."""


def check_unread(
    name: str,
    kind: str,
    further: Sequence[str],
    readings: Collection[str],
    otherwise: Collection[str],
) -> None:
    """Raise `StudyError` for a table without `readings` whose `further` columns look like readings.

    Such a table would be taken for a plan. A column looks like a reading if its name resembles one,
    or if it is one that the instrument reads with other settings (`otherwise`).
    """
    names = listed(sorted(readings))
    if others := [column for column in further if column in otherwise]:
        raise refusal(
            name,
            f"header, {plural(len(others), 'column')} {listed(others)}",
            f"readings of a {kind} with other settings than those of its [instrument]",
            f"{names}; or no readings, in a plan",
            "correct the settings or the columns, or remove the columns from a plan",
        )
    for column in further:
        if meant := _like(column, readings):
            raise refusal(
                name,
                f"header, column {column}",
                f"no column of readings, but a name similar to {meant}",
                f"{names}, in these units; or no similar column, in a plan",
                "correct its name and unit, or rename it if it is another quantity",
            )


def _like(column: str, readings: Collection[str]) -> str | None:
    """The reading that a column may stand for in another unit or spelling; None without one."""
    stems = {_stem(reading): reading for reading in sorted(readings)}
    own = _stem(column)
    if own in stems or len(own.replace("_", "")) < _LONG:
        return stems.get(own)
    return next((reading for stem, reading in stems.items() if _slip(own, stem)), None)


def _slip(one: str, other: str) -> bool:
    """Whether two names differ by one inserted, omitted or wrong letter, or by two exchanged."""
    start = len(os.path.commonprefix([one, other]))
    one, other = one[start:], other[start:]
    end = len(os.path.commonprefix([one[::-1], other[::-1]]))
    one, other = one[: len(one) - end], other[: len(other) - end]
    return max(len(one), len(other)) == 1 or (len(one) == 2 and one == other[::-1])


def _stem(column: str) -> str:
    """A name without its unit, in lower case: ``range`` for ``Range [mm]``."""
    parts = re.findall(r"[^\W_]+", column.casefold().replace("μ", "u"))  # also of the micro sign
    while len(parts) > 1 and parts[-1] in _UNITS:
        parts.pop()
    return "_".join(parts)


def check_repeated(table: Table, readings: Collection[str]) -> None:
    """Raise `StudyError` for rows that equal an earlier row in every column.

    Their readings would count twice, and their scatter would seem too small. Genuinely repeated
    measurements differ in their readings. With a coarse resolution some of them may agree, so that
    nothing is refused where most repetitions under the same conditions differ.
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
    others = len(repeated) - 1
    more = f", and {counted(others, 'more row')} that {plural(others, 'repeats', 'repeat')} one"
    raise refusal(
        table.name,
        table.where(row),
        f"the same as in {table.where(earlier)}, in every column{more if others else ''}",
        "every reading once, as it would count twice",
        "remove the rows or, if the measurement was really repeated, add a column that "
        "distinguishes them, such as t_s or run",
    )


def _first(table: Table, names: Collection[str]) -> np.ndarray:
    """For every row, the index of the first row with the same values in these columns."""
    code = np.zeros(table.rows, np.int64)
    for name in names:
        own = np.unique(table[name], return_inverse=True)[1]
        code = np.unique(code * (own.max() + 1) + own, return_inverse=True)[1]
        if code.max() + 1 == table.rows:
            break  # every row differs already
    _, first, index = np.unique(code, return_index=True, return_inverse=True)
    return first[index]


_LEAST, _ROUNDING = 0.03, 1e-9
"""Shares of the declared noise. Readings with a standard deviation below the first are in another
unit; noise that is declared cautiously is not that much too large. A standard deviation below the
second is none at all, as for a simulated perfect machine.
"""
_FEWEST = 10
"""Least number of rows for these checks."""
_AXIS = re.compile(r"_[xyz](?=_)")
"""The direction in the name of a coordinate (``smr1_x_mm``)."""


def check_alive(table: Table, columns: Collection[str], kind: str) -> None:
    """Raise `StudyError` for a column of readings that is the same in every row, or alternates
    between two values: a channel that is not connected, or a value that was filled in. A fit would
    take it for an exact measurement.

    Accepted are fewer than `_FEWEST` rows, `columns` that are all constant (see `check_scatter`),
    and a target of which every coordinate is constant, as it may have been measured once (the
    reflectors on a base).
    """
    targets: dict[str, list[str]] = {}
    for name in columns:
        if table.rows >= _FEWEST and name in table and table[name].dtype.kind == "f":
            targets.setdefault(_AXIS.sub("", name), []).append(name)
    still = {name: bool(np.ptp(table[name]) == 0.0) for of in targets.values() for name in of}
    once = [of for of in targets.values() if len(of) > 1 and all(still[name] for name in of)]
    dead = [name for name in table if still.get(name) and not any(name in of for of in once)]
    switching = [name for name in still if not still[name] and alternates(table[name])]
    if switching:
        low, high = sorted(table[switching[0]][:2])
        raise refusal(
            table.name,
            f"{plural(len(switching), 'column')} {listed(switching)}",
            f"a channel that alternates between {low:.10g} and {high:.10g} from row to row",
            f"readings of a {kind}, which differ by their noise and with the position",
            "export the readings again: a cable or a converter is the likely cause",
        )
    if not dead or all(still.values()):
        return
    raise refusal(
        table.name,
        f"{plural(len(dead), 'column')} {listed(dead)}",
        f"a channel that never changes, {table[dead[0]][0]:.10g} in every row",
        f"readings of a {kind}, which differ at least by their noise",
        "export the readings again, or measure with an instrument that has only the other channels",
    )


def alternates(values: np.ndarray) -> bool:
    """Whether numbers (n,) take two values in strict turn, over ten rows at least."""
    if len(values) < _FEWEST or values[0] == values[1]:
        return False
    return bool((values[2:] == values[:-2]).all())


def check_scatter(
    table: Table,
    columns: Collection[str],
    instrument: TableInstrument,
    plan: Plan,
    readings: np.ndarray,
) -> None:
    """Raise `StudyError` where readings (n, m) are constant, or scatter far less than their noise.

    `columns` are those of the readings. All readings may be zero, as those of a simulated perfect
    machine.
    """
    if (np.ptp(readings, axis=0) == 0.0).all():
        if readings.any():
            raise refusal(
                table.name,
                "columns of the readings",
                "the same numbers in every row",
                f"the readings of a {instrument.kind}, which differ between positions",
                "export the readings again",
            )
        return
    noise, present = instrument.noise(plan, readings), instrument.present(plan)
    reduced = np.asarray(instrument.reduce(readings, plan))
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
    own = np.nanstd(table[column]) if (column := _column(name, columns)) in table else 0.0
    # In the unit of the column.
    factor, unit = (float(own) / std, f" in the unit of {column}") if own else (1.0, " in SI")
    raise refusal(
        table.name,
        f"{plural(len(names), 'column')} {listed(names)}",
        f"readings with a standard deviation of {factor * std:.3g} over all rows, "
        f"{std / declared:.2g} of the declared noise of one reading",
        f"at least about {factor * declared:.3g}{unit}, as noise alone causes it",
        "correct the unit of the readings, or the noise in [instrument]",
    )


def _column(reading: str, columns: Collection[str]) -> str:
    """The column of a reading, that is, its name with the unit; the name itself without one."""
    found = (c for c in sorted(columns) if c == reading or c.startswith(f"{reading}_"))
    return next(found, reading)
