"""Section and record of the standard tests that are computed from the identified machine."""

from collections.abc import Sequence
from typing import Any

from ...compensation.computed_tests import Kind, LineTest, Quantity, largest_of
from ...identification.fit import POORLY_DETERMINED
from ..html import text
from ..html.sheet import Section, Table
from .positioning import symbol

_LARGEST = (("E", "E_d"), ("B", "B_d"))


def computed_section(tests: Sequence[LineTest]) -> list[Section]:
    """Positioning along the axes and the diagonals; no section without a line."""
    if not tests:
        return []
    axes = [row for test in tests if test.kind == "axis" for row in _rows(test)]
    diagonals = [row for test in tests if test.kind != "axis" for row in _rows(test)]
    diagonals += [
        ("body diagonals", name, label, "", *_cells(found[1]))
        for quantity, label in _LARGEST
        if (found := largest_of(tests, "body diagonal", quantity)) is not None
        for name in (found[0],)
    ]
    header = ("line", "axes", "quantity", "length, mm", "value, µm", "U (k = 2), µm", "information")
    return [
        Section(
            "Computed tests (ISO 230-2, ISO 230-6)",
            (
                "These values were not measured along these lines. They are computed from the "
                f"identified machine at {len(tests[0].target)} equidistant targets per line, at "
                "the mean conditions of the measurement, with its uncertainty. Axes move one at a "
                "time, the others stand in the middle of their travel; diagonals join opposite "
                "corners of the working volume, or of its middle planes.",
            ),
            tables=(
                Table(header, axes, "lllrrrr"),
                Table(header, diagonals, "lllrrrr"),
            ),
            note="E, M, B: systematic deviation, mean systematic deviation, reversal error, as "
            "ISO 230-2 defines them; E_d, B_d: the largest of the four body diagonals (ISO 230-6). "
            "Where the identified machine has no hysteresis on a line, E alone is stated, as it is "
            "the same in both directions. A and R need the repeatability and are stated where it "
            "is declared as an effect. A value without information from the data is that of the "
            "declared prior; only U is given.",
            minor=True,
        )
    ]


def _rows(test: LineTest) -> list[tuple[str, ...]]:
    length = f"{1e3 * test.length:.5g}"
    return [
        (test.kind, test.name, symbol(name), length, *_cells(one))
        for name, one in test.quantities.items()
    ]


def _cells(one: Quantity) -> tuple[str, str, str]:
    value, expanded = text.rounded(one.value, text.COVERAGE * one.u)
    if one.information < POORLY_DETERMINED:
        value = text.DASH
    return value, expanded, text.percent(one.information)


def computed_record(tests: Sequence[LineTest]) -> dict[str, Any]:
    """The key ``computed_tests`` of the record; empty without a line."""
    if not tests:
        return {}
    content: dict[str, Any] = {"lines": [_line(test) for test in tests]}
    body: Kind = "body diagonal"
    for quantity, label in _LARGEST:
        found = largest_of(tests, body, quantity)
        if found is not None:
            content[label] = {"axes": found[0], **_quantity(label, found[1])}
    return {"computed_tests": content}


def _line(test: LineTest) -> dict[str, Any]:
    return {
        "standard": test.standard,
        "kind": test.kind,
        "axes": test.name,
        "targets_mm": (1e3 * test.target).tolist(),
        "positive_um": test.up.tolist(),
        "negative_um": None if test.down is None else test.down.tolist(),
        "quantities": [_quantity(name, one) for name, one in test.quantities.items()],
    }


def _quantity(name: str, one: Quantity) -> dict[str, Any]:
    return {
        "name": name,
        "value": one.value,
        "standard_uncertainty": one.u,
        "unit": "um",
        "information_share": one.information,
    }
