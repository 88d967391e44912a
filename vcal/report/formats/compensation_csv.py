"""compensation.csv: error motions and location errors for the compensation of a control.

Source: the posterior of the identified machine (`geometry.error_motions`).
Sign: error = actual − nominal; a compensation subtracts the value.
None where compensation does not reduce the error (`Closure.no_gain`), unless asked for.
Units: positions in mm or deg, values and uncertainties in um or urad, as the columns state.
"""

from collections.abc import Sequence

from ...geometry.error_motions import ErrorMotionTable
from .base import FORMATS, Format, Results, csv_text, number


@FORMATS.register
class CompensationCsv(Format):
    """Error motions on a grid; source, sign rule and units as in the docstring of this file."""

    file = "compensation.csv"
    summary = "error motions on a grid with their standard uncertainty"

    def text(self, results: Results) -> str | None:
        if results.closure.no_gain and not results.anyway:
            return None
        return compensation_csv(results.motions)


def compensation_csv(tables: Sequence[ErrorMotionTable]) -> str:
    """The tables as CSV in long format, one position of one error motion per line.

    Columns: component (ISO 230-1 name), axis, position_mm and/or position_deg, value, unit,
    standard_uncertainty, information_share (1 − variance after / variance before the measurement,
    both without the between-model variance, which the uncertainty includes). Location errors have
    no position.
    """
    units = sorted({t.position_unit for t in tables} or {"mm"}, reverse=True)
    header = ["component", "axis", *(f"position_{u}" for u in units), "value", "unit"]
    rows = [[*header, "standard_uncertainty", "information_share"]]
    for t in tables:
        for k in range(len(t.value)):
            place = [
                number(t.position[k]) if len(t.position) and u == t.position_unit else ""
                for u in units
            ]
            value, u, information = (number(v) for v in (t.value[k], t.u[k], t.information[k]))
            rows.append([t.name, t.axis, *place, value, t.unit, u, information])
    return csv_text(rows)
