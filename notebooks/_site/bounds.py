"""``.. vcal-bounds::``: the bounds of all declared numbers and columns, each with its reason."""

import math
from collections.abc import Iterator

from sphinx.application import Sphinx

from vcal.bounds import Within, declared_bounds
from vcal.study.declared_effects import SHAPE_BOUNDS, TIME_BOUNDS
from vcal.study.geometric_family import FAMILY_COLUMNS
from vcal.study.machine_description import MachineDescription
from vcal.study.optional_columns import CONDITIONS

from . import rst
from .study_keys import Settings, settings_classes

_HEADER = ("number", "bounds", "why nothing is beyond")


def bounds() -> str:
    """The bounds of a study file, of columns, of effects and of a machine description."""
    found = ""
    for one in settings_classes():
        found += rst.heading(one.path, "-") + _table(_rows(one))
    found += rst.heading("Columns of conditions", "-")
    found += _table(
        (rst.text(c.name), _interval(c.low, c.high), rst.text(c.why)) for c in CONDITIONS
    )
    found += rst.heading("Columns of a Fourier family", "-")
    found += _table(
        (f"``{c.name}``", _interval(c.low, c.high), rst.text(c.why)) for c in FAMILY_COLUMNS
    )
    found += rst.heading("Parameters of declared effects", "-")
    found += rst.text(
        "A declared amplitude is at most 100 times the size that the catalogue expects (its "
        "prior standard deviation), unless the effect says otherwise. Pitches, speeds, time "
        "constants and points of time have bounds by their unit:"
    )
    found += "\n\n" + _table(
        (f"{kind}, {unit}", w.interval, rst.text(w.why))
        for kind, table in (
            ("pitch, speed or time constant", SHAPE_BOUNDS),
            ("point of time", TIME_BOUNDS),
        )
        for unit, w in table.items()
    )
    found += rst.heading("Description of a machine's dynamics", "-")
    return found + _table(
        row for one in settings_classes(MachineDescription) for row in _rows(one, one.path)
    )


def _rows(one: Settings, before: str = "") -> Iterator[tuple[str, str, str]]:
    said: dict[tuple[str, str], list[str]] = {}
    for bounded in declared_bounds(one.model):
        name = bounded.key.partition(".")[0]
        if bounded.within is None or name in one.skip:
            continue
        names = said.setdefault((bounded.within.interval, bounded.within.why), [])
        if f"``{name}``" not in names:
            names.append(f"``{name}``")
    for (interval, why), names in said.items():
        yield (f"{before} " if before else "") + ", ".join(names), interval, rst.text(why)


def _table(rows) -> str:
    return rst.table(_HEADER, rows) or "No number.\n\n"


def _interval(low: float, high: float) -> str:
    return Within(low, high, "").interval if math.isfinite(low) else ""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("vcal-bounds", rst.directive(bounds))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
