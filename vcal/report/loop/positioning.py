"""Section and record of the positioning tests of an interferometer (ISO 230-2)."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...geometry.positioning import COVERAGE, QUANTITIES
from ...geometry.positioning_lines import PositioningTest
from ..html import text
from ..html.sheet import Section, Table

_WORDS = {
    "A": "accuracy, bidirectional",
    "A+": "accuracy, positive direction",
    "A-": "accuracy, negative direction",
    "R": "repeatability, bidirectional",
    "R+": "repeatability, positive direction",
    "R-": "repeatability, negative direction",
    "E": "systematic error, bidirectional",
    "E+": "systematic error, positive direction",
    "E-": "systematic error, negative direction",
    "M": "mean bidirectional systematic error",
    "B": "reversal error, largest",
    "B_mean": "reversal error, mean",
}


def positioning_section(tests: Sequence[PositioningTest]) -> list[Section]:
    """The evaluation by ISO 230-2 beside that of the identified machine, a table per line."""
    if not tests:
        return []
    header = ("", "deviation, µm", "ISO 230-2", "U (k = 2)", "identified machine", "U (k = 2)")
    tables = [Table(header, _rows(test), "llrrrr", caption=_caption(test)) for test in tests]
    return [
        Section(
            "Positioning (ISO 230-2)",
            (
                "Positioning tests as ISO 230-2:2014 evaluates their readings, at the place of the "
                "reflector. Beside it, the same quantities of the identified machine at the tool "
                "point: without the noise of the readings, the slope of the set-up and the Abbe "
                "error of the reflector.",
            ),
            tables=tuple(tables),
            note="U of ISO 230-2: measuring device, misalignment, temperature and expansion "
            "coefficient of the compensation, and environmental variation, as in ISO/TR 230-9. U "
            "of the identified machine: from noise and declared priors. A and R contain the "
            "scatter of the readings, which the identified machine does not have.",
            minor=True,
        )
    ]


def _caption(test: PositioningTest) -> str:
    stated, of = test.stated, f" of {test.data_set}" if test.data_set else ""
    low, high = 1e3 * stated.target.min(), 1e3 * stated.target.max()
    both = "both directions" if "B" in stated.values else "one direction"
    return (
        f"Axis {test.axis}, line {test.line}{of}: {len(stated.target)} targets from {low:.5g} to "
        f"{high:.5g} mm, {stated.runs} runs in {both}."
    )


def _rows(test: PositioningTest) -> list[tuple[str, ...]]:
    rows = []
    for name in QUANTITIES:
        if name not in test.stated.values:
            continue
        cells = _cells(test.stated.values[name], test.stated.U(name))
        value, u = test.estimated.get(name, (np.nan, np.nan))
        rows.append((symbol(name), _WORDS[name], *cells, *_cells(value, COVERAGE * u)))
    return rows


def symbol(name: str) -> str:
    """A quantity of ISO 230-2 as it is printed: ``"A↑"``."""
    return {"B_mean": "B̄"}.get(name, name.replace("+", "↑").replace("-", "↓"))


def _cells(value: float, u: float) -> tuple[str, str]:
    if not np.isfinite(value):
        return text.DASH, text.DASH
    if not u > 0.0:
        return text.number(value), text.DASH
    return text.rounded(value, u)


def positioning_record(test: PositioningTest) -> dict[str, Any]:
    """One test for programs."""
    stated = test.stated
    return {
        **({"data_set": test.data_set} if test.data_set else {}),
        "line": test.line,
        "axis": test.axis,
        "runs": stated.runs,
        "targets_mm": (1e3 * stated.target).tolist(),
        "quantities": [
            {
                "name": name,
                "value": value,
                "standard_uncertainty": stated.u[name],
                "identified": test.estimated[name][0] if name in test.estimated else None,
                "identified_standard_uncertainty": test.estimated[name][1]
                if name in test.estimated
                else None,
                "unit": "um",
            }
            for name, value in stated.values.items()
        ],
    }
