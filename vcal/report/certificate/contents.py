"""What a calibration certificate of an identified machine states, whatever its format."""

import re
from dataclasses import dataclass

import numpy as np

from ...compensation.computed_tests import LineTest, geometric_tests_of, largest_of, line_tests
from ...compensation.machine import IdentifiedMachine
from ...compensation.volumetric_error import VolumetricError
from ...errors import StudyError
from ...identification.fit import POORLY_DETERMINED
from ...study.statements import Statements, statements
from ..html.text import COVERAGE
from ..loop.decision import Decided, decided

NODES = 11
"""Positions at which error motions are stated."""
_TAILS = (0.025, 0.975)
_REQUIRED = (
    "machine.serial_number",
    "measurement.date",
    "certificate.number",
    "certificate.responsible",
    "certificate.laboratory.name",
    "certificate.laboratory.city",
    "certificate.laboratory.country",
    "certificate.customer.name",
    "certificate.customer.city",
)
"""Keys without which there is no certificate."""


@dataclass(frozen=True)
class Value:
    """One quantity with its uncertainty."""

    id: str
    """Unique in the certificate."""
    name: str
    unit: str
    """``"um"``, ``"urad"`` or ``"um/m"``."""
    value: float
    u: float
    """Standard uncertainty."""
    interval: tuple[float, float] | None = None
    """Probabilistically symmetric 95 % coverage interval (JCGM 101), of a quantity that is not
    normally distributed; None: U = 2 u."""


@dataclass(frozen=True)
class Series:
    """An error motion at some positions of its axis."""

    id: str
    name: str
    position: np.ndarray
    position_unit: str
    unit: str
    value: np.ndarray
    u: np.ndarray


@dataclass(frozen=True)
class Result:
    """One group of results."""

    id: str
    name: str
    about: str
    norm: str
    values: tuple[Value, ...] = ()
    series: tuple[Series, ...] = ()
    unknown: tuple[str, ...] = ()
    """Names of what the measurement did not determine; no value is stated."""


@dataclass(frozen=True)
class Certificate:
    """A certificate: the machine, the statements, and the results."""

    machine: IdentifiedMachine
    stated: Statements
    results: tuple[Result, ...]
    decision: Decided | None
    draft: bool
    """Whether keys are missing, whose place in the file says so."""


def certificate(
    machine: IdentifiedMachine, overrides: tuple[str, ...] = (), *, draft: bool = False
) -> Certificate:
    """The certificate of a machine; `overrides` replace keys of its statements.

    Raises `StudyError` where a key is missing that a certificate must state, unless it is a
    `draft`, for a machine about which nothing can be stated, and as `statements` does.
    """
    stated = statements(machine.about, overrides)
    lacking = missing(stated)
    if lacking and not draft:
        raise StudyError(
            f"certificate: found no {', '.join(lacking)}, expected all that a certificate must "
            "state; add these keys to the study file, or give them as in --set "
            f"{lacking[0]}=..., or write a draft with --draft"
        )
    if machine.chain.arm or not len(machine.theta):
        what = "an arm" if machine.chain.arm else "a machine without identified errors"
        raise StudyError(
            f"certificate: found {what}, expected a machine tool with linear axes; its results are "
            "in report.json"
        )
    decision = decided(machine)
    lines = line_tests(machine)
    groups = (
        _deviations(machine),
        _motions(machine),
        _positioning(lines),
        _diagonals(lines),
        *(() if decision is None else (_volumetric(decision.error),)),
    )
    results = tuple(one for one in groups if one.values or one.series or one.unknown)
    return Certificate(machine, stated, results, decision, bool(lacking))


def missing(stated: Statements) -> list[str]:
    """Required keys that are not stated."""
    found = []
    for key in _REQUIRED:
        value: object = stated
        for part in key.split("."):
            value = getattr(value, part)
        if value is None:
            found.append(key)
    return found


def _id(*parts: str) -> str:
    """A name that XML takes as an identifier."""
    text = "_".join(parts).replace("+", "p").replace("-", "n")
    return re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_")


def _deviations(machine: IdentifiedMachine) -> Result:
    tests = geometric_tests_of(machine)
    known = [t for t in tests if t.information >= POORLY_DETERMINED]
    return Result(
        "ISO_230_1",
        "Geometric deviations",
        "Deviations of the path of the tool point in the frame of the workpiece from its "
        "least-squares line: one axis at a time moves over its travel, the others stand in the "
        "middle, rotary axes at zero. Squareness is positive where the later axis is rotated in "
        "the positive sense from the earlier one. Errors that depend on direction, temperature or "
        "time are not included.",
        "ISO 230-1:2012",
        tuple(
            Value(_id(t.name, t.what), f"{t.name}, {t.what}", t.unit, t.value, t.u) for t in known
        ),
        unknown=tuple(f"{t.name}, {t.what}" for t in tests if t not in known),
    )


def _motions(machine: IdentifiedMachine) -> Result:
    known = {part.name for part in machine.parts if part.information >= POORLY_DETERMINED}
    tables = [t for t in machine.error_motions(NODES) if len(t.position)]
    return Result(
        "error_motions",
        "Error motions",
        "Error motions of the axes at positions over their travel, actual minus nominal, in the "
        "frame of the axis. Slopes depend on how location errors are separated from them.",
        "ISO 230-1:2012",
        series=tuple(
            Series(_id(t.name), t.name, t.position, t.position_unit, t.unit, t.value, t.u)
            for t in tables
            if t.name in known
        ),
        unknown=tuple(t.name for t in tables if t.name not in known),
    )


_COMPUTED = (
    "Computed from the identified machine at {} equidistant targets per line, at the mean "
    "conditions of the measurement; not measured along these lines."
)


def _positioning(lines: list[LineTest]) -> Result:
    return _computed("ISO_230_2", "Positioning of the axes", lines, ("axis",), "ISO 230-2:2014")


def _diagonals(lines: list[LineTest]) -> Result:
    kinds = ("body diagonal", "face diagonal")
    found = _computed("ISO_230_6", "Diagonal displacements", lines, kinds, "ISO 230-6:2002")
    largest = tuple(
        Value(_id(label), f"{label}, body diagonal {one[0]}", "um", one[1].value, one[1].u)
        for quantity, label in (("E", "E_d"), ("B", "B_d"))
        if (one := largest_of(lines, "body diagonal", quantity)) is not None
    )
    return Result(found.id, found.name, found.about, found.norm, (*largest, *found.values))


def _computed(
    id_: str, name: str, lines: list[LineTest], kinds: tuple[str, ...], norm: str
) -> Result:
    mine = [line for line in lines if line.kind in kinds]
    named = [
        (f"{quantity}, {line.kind} {line.name}", line, quantity, one)
        for line in mine
        for quantity, one in line.quantities.items()
    ]
    return Result(
        id_,
        name,
        _COMPUTED.format(len(mine[0].target)) if mine else "",
        norm,
        tuple(
            Value(_id(line.kind, line.name, quantity), words, "um", one.value, one.u)
            for words, line, quantity, one in named
            if one.information >= POORLY_DETERMINED
        ),
        unknown=tuple(words for words, *_, one in named if one.information < POORLY_DETERMINED),
    )


def _volumetric(error: VolumetricError) -> Result:
    values = []
    for name, words in (("largest", "largest error"), ("rms", "rms error")):
        drawn = getattr(error.before, name)
        low, high = np.quantile(drawn, _TAILS)
        interval = float(low), float(high)
        mean, u = float(drawn.mean()), float(drawn.std(ddof=1))
        values.append(Value(_id("volumetric", name), words, "um", mean, u, interval))
    return Result(
        "volumetric_error",
        "Volumetric error",
        f"Length of the error of the tool point at {error.positions} positions in the working "
        "volume, each approached in a random direction and under conditions of the measurement, "
        "after the best rigid alignment, without compensation: mean and coverage interval over "
        f"{error.draws} machines drawn from the identified distribution (seed {error.seed}).",
        "JCGM 101:2008",
        tuple(values),
    )


__all__ = ["COVERAGE", "Certificate", "Result", "Series", "Value", "certificate", "missing"]
