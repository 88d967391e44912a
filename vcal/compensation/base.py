"""What a format of compensation is, the registry of all formats, and what a built one states.

A new format is one file in `formats/` with a class derived from `Format` and decorated with
``FORMATS.register``; the files there are found without a list. The class states name, source, sign
rule, units, resolution and limits, refuses what it cannot carry (`Format.refuse`), and makes the
`Tables` of a machine (`Format.tables`). `Tables` are the numbers as the control has them, after
rounding: `applied` computes from them what the control adds to its commands, and `files` writes
them. Everything else follows: `Format.build` finds by simulation which parts of the error the
format corrects, and how much of the others stays.
"""

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..errors import StudyError
from ..registry import Catalogue, nearest
from .machine import IdentifiedMachine
from .volume import POINTS, Use, working_volume

Covariates = Mapping[str, Float[np.ndarray, " n"] | float]
CARRIED = 0.1
"""Largest share of a part's rms that may stay where it counts as carried."""
FINE_UM = 0.05
"""What stays below this rms counts as carried, um: the resolution of a control."""

_FAR_K = 50.0
"""Most by which a temperature may lie outside the measured ones: an effect that is linear there
need not be so beyond."""


class Options(BaseModel):
    """Options of every format; a leaf derives its own from it, and describes every key."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    at: dict[str, float] = Field(
        default_factory=dict,
        description="conditions for which tables are made that cannot vary with them, such as "
        "T_Z=23.5 (degC as read on the sensor); by default, their mean in the measurement",
    )


class Tables(ABC):
    """The numbers that a control has, and what it does with them."""

    @property
    @abstractmethod
    def files(self) -> Mapping[str, str]:
        """The text of every file, by its name."""

    @abstractmethod
    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        """What the control adds to its commands (n, axes), m or rad, exactly: interpolated,
        truncated and rounded as it does it. A format whose sign rule is "subtract from the
        position" returns minus what is in its table.

        `position` are the commands (m or rad), `directions` +1 or -1 per axis (0: not moved),
        `covariates` those of `IdentifiedMachine.ranges` (temperatures: `Plan`).
        """


O = TypeVar("O", bound=Options)  # noqa: E741


@dataclass(frozen=True)
class Kept:
    """One part of the error of a machine, and how much of it a format leaves."""

    name: str
    """Name of the `Part`."""
    rms_um: float
    """Displacement of the tool point by this part alone: rms over the working volume."""
    largest_um: float
    stays_rms_um: float
    """The same with the compensation of this part by the format."""
    stays_largest_um: float
    reason: str = ""
    """Why it stays, where that is known."""

    @property
    def carried(self) -> bool:
        """Whether practically nothing of it stays."""
        return self.stays_rms_um <= max(CARRIED * self.rms_um, FINE_UM)


@dataclass(frozen=True)
class Compensation:
    """A machine's compensation in one format."""

    format: "Format[Any]"
    machine: IdentifiedMachine
    options: Options
    tables: Tables = dataclasses.field(repr=False)
    parts: tuple[Kept, ...] = dataclasses.field(repr=False)
    """Every identified part with what stays of it."""

    @property
    def files(self) -> Mapping[str, str]:
        """The text of every file, by its name."""
        return self.tables.files

    @property
    def carried(self) -> tuple[Kept, ...]:
        """Parts of which practically nothing stays (`Kept.carried`)."""
        return tuple(part for part in self.parts if part.carried)

    @property
    def not_carried(self) -> tuple[Kept, ...]:
        """Parts that the format cannot carry, or not fully, the largest remainder first."""
        left = (part for part in self.parts if not part.carried)
        return tuple(sorted(left, key=lambda part: -part.stays_rms_um))

    @property
    def not_identified(self) -> tuple[str, ...]:
        """Parts of which the readings know nothing: zero in the files, and named there."""
        return self.machine.unidentified

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates | None = None,
    ) -> Float[np.ndarray, "n axes"]:
        """What the control adds to its commands (`Tables.applied`)."""
        given = np.asarray(position, float), np.asarray(directions, float)
        return self.tables.applied(*given, covariates or {})


class Format(ABC, Generic[O]):
    """A kind of compensation that a control takes.

    A leaf declares the class attributes, `refuse` and `tables`; `options` where it has some.
    """

    name: ClassVar[str]
    """The word on the command line: ``"linuxcnc-screw"``."""
    summary: ClassVar[str]
    """One line."""
    source: ClassVar[str]
    """The public documentation from which it is written."""
    sign: ClassVar[str]
    """The sign rule: ``"add to the command"``."""
    units: ClassVar[str]
    resolution: ClassVar[str]
    """The smallest step of a value."""
    limits: ClassVar[str]
    """Number of points, spacing, axes."""
    options: ClassVar[type[Options]] = Options

    @abstractmethod
    def refuse(self, machine: IdentifiedMachine, options: O) -> str | None:
        """Why this machine, or these options, do not fit the format; None where they do.

        One message: what was found, what is expected, what to do.
        """

    @abstractmethod
    def tables(self, machine: IdentifiedMachine, options: O) -> Tables:
        """The tables of a machine that fits. It is called for the whole machine, and again for
        every part alone (`IdentifiedMachine.restricted`): texts are made in `Tables.files` only.
        """

    def reason(self, machine: IdentifiedMachine, part: str) -> str:
        """Why a part stays, in words; empty where nothing is to be said."""
        del machine, part
        return ""

    def build(
        self,
        machine: IdentifiedMachine,
        options: Mapping[str, Any] | O | None = None,
        *,
        parts: bool = True,
    ) -> Compensation:
        """The compensation of a machine; without `parts`, what is carried is not computed.

        Raises `StudyError` for options that are not known, and where the machine does not fit.
        """
        chosen = self._options(options)
        at_inside(machine, chosen)  # raises for a condition that is not known
        reason = self.refuse(machine, chosen)  # type: ignore[arg-type]
        if reason is not None:
            raise StudyError(f"format {self.name}: {reason}")
        tables = self.tables(machine, chosen)  # type: ignore[arg-type]
        use = working_volume(machine, POINTS)
        kept = tuple(
            self._kept(machine, part.name, chosen, use)  # type: ignore[arg-type]
            for part in machine.parts
            if parts and part.name in machine.shown
        )
        return Compensation(self, machine, chosen, tables, kept)

    def _kept(self, machine: IdentifiedMachine, part: str, options: O, use: Use) -> Kept:
        alone = machine.restricted([part])
        before = alone.displacement(use.plan(alone))
        after = left_over(alone, self.tables(alone, options), use)
        sizes = [_sizes_um(before), _sizes_um(after)]
        return Kept(part, *sizes[0], *sizes[1], reason=self.reason(machine, part))

    def _options(self, options: Mapping[str, Any] | O | None) -> Options:
        if isinstance(options, Options):
            return options
        try:
            return self.options.model_validate(dict(options or {}))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            known = list(self.options.model_fields)
            if first["type"] == "extra_forbidden":
                what = f"found the unknown option {key!r}{nearest(key, known)}"
                expected = f"one of {', '.join(known)}"
            else:
                what = f"option {key}: found {first['input']!r}"
                expected = first["msg"].lower()
            raise StudyError(
                f"format {self.name}: {what}, expected {expected}; correct it"
            ) from error


FORMATS: Catalogue[type[Format[Any]]] = Catalogue("compensation format")
"""All formats by their names."""


def at_inside(machine: IdentifiedMachine, options: Options) -> dict[str, float]:
    """`conditions_inside` of `Options.at`."""
    return conditions_inside(machine, options.at)


def conditions_inside(machine: IdentifiedMachine, at: Mapping[str, float]) -> dict[str, float]:
    """Conditions as the machine counts them (`temperature_offset_K`), from those that a sensor
    reads (temperatures in degC).

    Raises `StudyError` for a condition on which nothing depends, and for a value that is not a
    number or a temperature far from the measured ones.
    """
    found = {}
    for name, value in at.items():
        if name not in machine.ranges:
            known = ", ".join(machine.ranges) or "none: nothing depends on a condition"
            raise StudyError(
                f"option at: found {name!r}{nearest(name, machine.ranges)}, expected a condition "
                f"on which the identified errors depend ({known}); correct or remove it"
            )
        offset = machine.temperature_offset_K if name.startswith("T_") else 0.0
        known = machine.ranges[name]
        low, high = known.low + offset, known.high + offset
        if not math.isfinite(value):
            raise StudyError(
                f"option at: found {name}={value:g}, expected a finite number, such as "
                f"{known.mean + offset:.4g}; correct it"
            )
        if name.startswith("T_") and not low - _FAR_K <= value <= high + _FAR_K:
            raise StudyError(
                f"option at: found {name}={value:g}, expected a temperature in degC within "
                f"{_FAR_K:g} K of the measured ones, {low:.4g} to {high:.4g}; correct it"
            )
        found[name] = value - offset
    return found


def left_over(machine: IdentifiedMachine, tables: Tables, use: Use) -> Float[np.ndarray, "n 3"]:
    """Displacement of the tool point from its nominal place with the compensation, m."""
    added = tables.applied(use.position, use.directions, use.covariates)
    plan = machine.plan(use.position + added, use.directions, use.covariates)
    return machine.tool_points(plan) - machine.nominal(use.position)


def compensate(
    machine: IdentifiedMachine,
    to: str,
    options: Mapping[str, Any] | None = None,
    *,
    parts: bool = True,
) -> Compensation:
    """The compensation of a machine in the format named `to` (`FORMATS`), with its `options`;
    without `parts`, what is carried is not computed.

    Raises `StudyError` for a format that is not known, and as `Format.build` does.
    """
    return FORMATS.named(to)().build(machine, options, parts=parts)


def _sizes_um(moved: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """Rms and largest length, um."""
    square = (moved**2).sum(1)
    return 1e6 * float(np.sqrt(square.mean())), 1e6 * float(np.sqrt(square.max(initial=0.0)))
