"""Evaluations that a standard prescribes for the readings of one kind of instrument, beside the
estimates of vcal.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...geometry.circular_deviations import CircularDeviations
from ...geometry.circular_tests import CircularTest, circular_tests
from ...instruments.double_ball_bar import DoubleBallBar
from ...loop.outcome.closure import Closure
from ...study.data_sets import DataSet
from ...study.study import Study
from ..html import text
from ..html.sheet import Section, Table

_UM = 1e6
_CIRCULAR = (("circular", "G"), ("circular_least_squares", "G, least squares"))
_CENTRED = (("radial_max_centred", "F max"), ("radial_min_centred", "F min"))
_AS_SET_UP = (("radial_max", "F max, as set up"), ("radial_min", "F min, as set up"))
_BOTH = (("circular", "G(b)"), ("mean_radial", "D"), ("hysteresis", "H (1996)"))


def circular(closure: Closure, one: DataSet) -> list[CircularTest]:
    """The circular tests of ISO 230-4 in a data set of a double ball bar."""
    assert isinstance(one.instrument, DoubleBallBar)
    inside = closure.after.measurement.plan.parts[one.name]
    return circular_tests(closure.after, one.instrument, one.plan, np.flatnonzero(inside))


def _circular_section(closure: Closure, one: DataSet) -> list[Section]:
    rows: list[tuple[str, ...]] = []
    for test in circular(closure, one):
        full = math.isfinite(test.measured.mean_radial)
        named = (*_CIRCULAR, *(_CENTRED if full else _AS_SET_UP))
        for attribute, label in _BOTH if test.sense == "both" else named:
            cells = _cells(test, attribute)
            if cells is not None:
                rows.append((*_about(test), label, *cells))
    if not rows:
        return []
    header = (
        "plane", "runs", "sense", "radius, mm", "arc", "deviation", "readings, µm",
        "identified machine, µm", "u, µm",
    )  # fmt: skip
    note = (
        "G, G(b): radial separation of the minimum zone circles; least squares: radial range about "
        "the centre of the least-squares circle. F: radial deviation about that centre or, on an "
        "arc, about the one at which the bar was set up. D: mean radius of both senses minus the "
        "nominal radius, full circles only. H: circular hysteresis, the largest radial difference "
        "of both senses, in the edition of 1996. Readings: as measured, with noise, position of "
        "the ball and length of the bar. Identified machine: without them, on the same circles; u "
        "is its standard uncertainty."
    )
    of = f" of {one.name}" if one.name else ""
    return [
        Section(
            f"Circular tests (ISO 230-4){of}",
            tables=(Table(header, rows, "lllrrlrrr", note=note),),
            minor=True,
        )
    ]


def _about(test: CircularTest) -> tuple[str, ...]:
    return (
        test.plane,
        ", ".join(str(run) for run in test.runs),
        test.sense,
        f"{1e3 * test.radius:g}",
        f"{math.degrees(test.arc):.0f}°",
    )


def _cells(test: CircularTest, attribute: str) -> tuple[str, str, str] | None:
    """Deviation of the readings, of the machine and its uncertainty; None where it has none."""
    read, found, u = (
        _UM * getattr(one, attribute) for one in (test.measured, test.machine, test.u)
    )
    if not math.isfinite(read):
        return None
    return (text.rounded(read, u)[0], *text.rounded(found, u))


def _circular_record(closure: Closure, one: DataSet) -> list[dict[str, Any]]:
    return [
        {
            "data_set": one.name,
            "plane": test.plane,
            "runs": list(test.runs),
            "sense": test.sense,
            "radius_mm": 1e3 * test.radius,
            "arc_deg": math.degrees(test.arc),
            "readings": _numbers(test.measured),
            "machine": _numbers(test.machine),
            "standard_uncertainty": _numbers(test.u),
        }
        for test in circular(closure, one)
    ]


def _numbers(found: CircularDeviations) -> dict[str, float | None]:
    return {
        f"{name}_um": _UM * value if math.isfinite(value) else None
        for name, value in zip(found.__dataclass_fields__, found.values, strict=True)
    }


_SECTIONS: Mapping[str, Callable[[Closure, DataSet], list[Section]]] = {
    DoubleBallBar.kind: _circular_section,
}
"""Sections by the kind of the instrument."""
_RECORDS: Mapping[str, tuple[str, Callable[[Closure, DataSet], list[dict[str, Any]]]]] = {
    DoubleBallBar.kind: ("circular_tests", _circular_record),
}
"""Key in the record, and its content, by the kind of the instrument."""


def standards(closure: Closure, study: Study) -> list[Section]:
    """The sections of all data sets whose instrument has a standardised evaluation."""
    found: list[Section] = []
    for one in study.sets:
        if (make := _SECTIONS.get(one.settings.kind)) is not None:
            found += make(closure, one)
    return found


def standards_record(closure: Closure, study: Study) -> dict[str, list[dict[str, Any]]]:
    """The same for programs, by key; empty without such an instrument."""
    found: dict[str, list[dict[str, Any]]] = {}
    for one in study.sets:
        if (entry := _RECORDS.get(one.settings.kind)) is not None:
            key, make = entry
            found.setdefault(key, []).extend(make(closure, one))
    return found
