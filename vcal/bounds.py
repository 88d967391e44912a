"""Bounds of the numbers that a user declares, each with its reason.

A bound does not say what is usual. It excludes what no machine, instrument or measurement has, so
that a number beyond it is a mistake: of a unit, a decimal point or a sign. `Within` stands beside
the key that it bounds, in ``Annotated``; the table of all bounds in the documentation is made from
the keys (`declared_bounds`), and every number of a settings class has one (tests/test_bounds.py).
"""

import math
import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

OUT_OF_BOUNDS = "out_of_bounds"
"""Kind of the mistake in the errors of pydantic."""


@dataclass(frozen=True)
class Within:
    """Bounds of a number, ends included unless they are open, and why there is none beyond."""

    low: float
    high: float
    why: str
    """A clause that says what would be beyond the bounds: "no machine is longer"."""
    open_low: bool = False
    """Whether the lower bound itself is excluded."""
    open_high: bool = False
    """Whether the upper bound itself is excluded."""

    def holds(self, value: float) -> bool:
        """Whether a number is within the bounds; never for NaN."""
        above = value > self.low if self.open_low else value >= self.low
        below = value < self.high if self.open_high else value <= self.high
        return above and below

    def expected(self, value: float) -> str:
        """What was expected in place of a number outside, for messages."""
        if not value > self.low or value == self.low:
            return f"a number {'greater than' if self.open_low else 'of at least'} {self.low:g}"
        return f"a number {'less than' if self.open_high else 'of at most'} {self.high:g}"

    @property
    def interval(self) -> str:
        """The bounds in words, for documentation."""
        low = f"{'above' if self.open_low else 'at least'} {self.low:g}"
        high = f"{'below' if self.open_high else 'at most'} {self.high:g}"
        if math.isinf(self.low) or math.isinf(self.high):
            return high if math.isinf(self.low) else low
        if self.open_low or self.open_high:
            return f"{low}, {high}"
        return f"{self.low:g} to {self.high:g}"

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def _checked(self, value: float) -> float:
        if self.holds(value):
            return value
        raise PydanticCustomError(
            OUT_OF_BOUNDS,
            "Input should be {expected}",
            {"expected": self.expected(value), "why": self.why},
        )


@dataclass(frozen=True)
class Bounded:
    """The bound of one number of a settings class; `Within` is None for a number without one."""

    key: str
    """Its key, with a place for those of lists and tables: ``grid.0``, ``travel_mm.*.0``."""
    within: Within | None


def declared_bounds(model: type[BaseModel]) -> Iterator[Bounded]:
    """The bounds of all numbers of a settings class, not of the tables in it."""
    for name, field in model.model_fields.items():
        annotation = field.annotation
        if field.metadata:
            annotation = Annotated[annotation, *field.metadata]  # type: ignore[valid-type]
        yield from _bounds(annotation, field.alias or name, None)


def _bounds(annotation: Any, key: str, within: Within | None) -> Iterator[Bounded]:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        own = next((one for one in inner[1:] if isinstance(one, Within)), within)
        yield from _bounds(inner[0], key, own)
    elif origin in (Union, types.UnionType):
        for one in inner:
            yield from _bounds(one, key, within)
    elif origin is tuple:
        parts = inner[:1] if inner[-1] is Ellipsis or len(set(inner)) == 1 else inner
        for i, one in enumerate(parts):
            yield from _bounds(one, key if len(parts) == 1 else f"{key}.{i}", None)
    elif origin is dict:
        yield from _bounds(inner[1], f"{key}.*", None)
    elif annotation in (float, int):
        yield Bounded(key, within)


_ATOM = "less is below the size of an atom"

Noise = Annotated[
    float,
    Within(
        1e-5,
        5000.0,
        "less is a tenth of an atom; more than 5 mm or 5 mrad is a hundred times the noise of "
        "instruments that measure machines",
    ),
]
"""Standard deviation of the noise of a reading, um or urad."""
Uncertainty = Annotated[
    float,
    Within(
        0.0,
        5000.0,
        "more than 5 mm or 5 mrad is a hundred times the uncertainty of calibrated artefacts and "
        "instruments",
    ),
]
"""Standard uncertainty of something calibrated, um or urad; zero where it is neglected."""
PlaceSigma = Annotated[
    float, Within(0.0, 1e6, "more than a metre, or a radian, says nothing about a place")
]
"""Standard deviation of a place or an orientation that is approximately known, um or urad."""
Coordinate = Annotated[
    float, Within(-2e5, 2e5, "no instrument measures machines from more than 200 m away")
]
"""A coordinate in a work space, mm."""
Angle = Annotated[float, Within(-720.0, 720.0, "two turns say nothing more than one")]
"""An orientation or a bound of a joint, deg."""
LinkLength = Annotated[float, Within(-1e5, 1e5, "no arm has a link of 100 m")]
"""A length between joints, mm."""
JointBound = Annotated[
    float, Within(-1e5, 1e5, "no joint turns 270 times in one direction, or slides 100 m")
]
"""Lowest or highest position of a joint, deg or mm."""
Position = Annotated[float, Within(-2e5, 2e5, "no machine has an axis of more than 200 m")]
"""An axis position, mm."""
Offset = Annotated[float, Within(-1e4, 1e4, "no tool is longer than 10 m")]
"""A component of a tool offset, mm."""
ErrorSize = Annotated[
    float,
    Within(
        1e-6,
        5e4,
        f"{_ATOM}; more than 5 cm or 50 mrad is no error of a machine but another geometry",
    ),
]
"""Size of an error of a machine, um or urad."""
ArtefactLength = Annotated[
    float,
    Within(0.1, 2e4, "no artefact for machines is shorter than 0.1 mm or longer than 20 m"),
]
"""A length of an artefact, mm."""
Radius = Annotated[
    float, Within(0.01, 1000.0, "no sphere or stylus for machines is smaller or larger")
]
"""Radius of a sphere, mm."""
Range = Annotated[
    float,
    Within(1e-3, 100.0, "a probe or a bar that measures more than 100 mm is another instrument"),
]
"""Range of a probe, mm."""
Seconds = Annotated[float, Within(0.0, 1e6, "no step of a measurement takes eleven days")]
"""Time of one step of a measurement, s."""
Seed = Annotated[int, Within(0, 2**63 - 1, "random keys are made from 64 bits")]
"""Seed of random draws."""
Temperature = Annotated[
    float, Within(-50.0, 150.0, "no machine is measured at a temperature beyond")
]
"""A temperature, degC."""
Expansion = Annotated[
    float,
    Within(-50.0, 50.0, "materials of machines and artefacts expand by -1 to 25 um/(m K)"),
]
"""A coefficient of thermal expansion, um/(m K)."""
Index = Annotated[int, Within(0, 10**9, "an index counts from 0, and no table has as many rows")]
"""An index of rows that belong together."""
RotaryBound = Annotated[
    float, Within(-36_000.0, 36_000.0, "no rotary axis counts more than a hundred turns")
]
"""Lowest or highest angle of a rotary axis, deg."""
