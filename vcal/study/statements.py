"""Keys of a study file for what a report decides and a certificate states: tolerance, measurement,
laboratory and customer.
"""

import datetime
import json
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    model_validator,
)

from ..bounds import Seed, Within
from ..errors import StudyError
from .messages import explain

Words = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=200)]
"""A short text that is not blank: a blank one is no entry of a certificate."""
_TABLES = ("machine", "measurement", "certificate")
_FEWEST = 10
"""Least number of draws that are expected to lie in the tail that a decision depends on."""


class Statement(BaseModel):
    """A table of a study file. Unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class AcceptanceSettings(Statement):
    """``[acceptance]``: the tolerance of the volumetric error, on which the report decides by JCGM
    106:2012: the largest error of the tool point in the working volume, after the best rigid
    alignment, before and after compensation.
    """

    volumetric_um: Annotated[
        float, Within(1e-3, 1e5, "no tolerance of a machine is below a nanometre or above 100 mm")
    ]
    """Largest permissible volumetric error."""
    risk_percent: Annotated[
        float, Within(0.1, 50.0, "less cannot be counted, and more is a coin")
    ] = 5.0
    """Largest probability of a wrong decision with the rule "guarded"."""
    rule: Literal["guarded", "simple"] = "guarded"
    """``"guarded"``: the machine conforms, or does not conform, where the probability of the
    opposite is at most `risk_percent`; otherwise it cannot be decided (JCGM 106, 8.3).
    ``"simple"``: the estimate is compared with the tolerance; the risk is shared (JCGM 106, 8.2).
    """
    draws: Annotated[
        int, Within(100, 20_000, "fewer do not decide, and more do not fit into memory")
    ] = 2000
    """Machines drawn from the identified distribution, from which the probability is counted."""
    seed: Seed = 0
    """Seed of the draws."""

    @model_validator(mode="after")
    def _enough_draws(self) -> Self:
        needed = round(100 * _FEWEST / self.risk_percent + 0.5)
        if self.rule == "guarded" and self.draws < 100 * _FEWEST / self.risk_percent:
            raise ValueError(
                f"found draws = {self.draws} with risk_percent = {self.risk_percent:g}, expected "
                f"{needed} draws at least, so that {_FEWEST} of them decide; raise one of them"
            )
        return self


class MeasurementSettings(Statement):
    """``[measurement]``: who measured, and when; shown in the report and in a certificate."""

    operator: Words | None = None
    """Who measured."""
    date: str | None = None
    """Date of the measurement, such as 2026-03-14."""

    @model_validator(mode="after")
    def _a_date(self) -> Self:
        if self.date is not None:
            try:
                found = datetime.date.fromisoformat(self.date).isoformat()
            except ValueError:
                found = ""
            if found != self.date:  # 20260314 and 2026-W11-6 are dates too, but not in a DCC
                raise ValueError(
                    f"found date = {self.date!r}, expected year, month and day such as 2026-03-14; "
                    "correct it"
                )
        return self


class ContactSettings(Statement):
    """A laboratory or a customer, with its address."""

    name: Words | None = None
    """Name of the organisation."""
    street: Words | None = None
    """Street and number."""
    post_code: Words | None = None
    """Postal code."""
    city: Words | None = None
    """Town or city."""
    country: str | None = Field(default=None, pattern="^[A-Z]{2}$")
    """Country by ISO 3166-1, two capital letters."""
    e_mail: Words | None = None
    """Electronic address."""


class CertificateSettings(Statement):
    """``[certificate]``: what a calibration certificate states beside the results; see
    ``vcal certificate``.
    """

    number: Words | None = None
    """Unique number of the certificate, given by the laboratory."""
    responsible: Words | None = None
    """Name of the person who is responsible for the certificate."""
    place: Literal["laboratory", "customer", "other"] = "customer"
    """Where the machine was measured."""
    equipment: Words | None = None
    """Measuring equipment, with its serial number and the certificate of its own calibration, which
    makes the results traceable; the kinds of the instruments by default."""
    laboratory: ContactSettings = ContactSettings()
    customer: ContactSettings = ContactSettings()


class MachineStatement(Statement):
    """What ``[machine]`` states of the machine as an item."""

    manufacturer: Words | None = None
    model: Words | None = None
    serial_number: Words | None = None


class Statements(Statement):
    """Everything that a study states beside its model, as an identified machine holds it."""

    machine: MachineStatement = MachineStatement()
    instruments: dict[str, str] = {}
    """Kinds of the instruments by the names of their data sets."""
    acceptance: AcceptanceSettings | None = None
    measurement: MeasurementSettings = MeasurementSettings()
    certificate: CertificateSettings = CertificateSettings()


def statements(about: Mapping[str, Mapping[str, Any]], overrides: Sequence[str] = ()) -> Statements:
    """The statements of a machine, with overrides ``"certificate.number=17"``.

    Raises `StudyError` for an override of another form or of another key, and for a value that a
    study file could not have.
    """
    tree: dict[str, Any] = json.loads(json.dumps(about))
    given = {}
    for text in overrides:
        key, equals, value = text.partition("=")
        parts = key.strip().split(".")
        if not equals or len(parts) < 2 or parts[0] not in _TABLES:
            raise StudyError(
                f"--set: found {text!r}, expected KEY=VALUE with a key of the tables "
                f"{', '.join(_TABLES)}, such as certificate.number=2026-17; correct it"
            )
        inner = tree
        for part in parts[:-1]:
            inner = inner.setdefault(part, {})
            if not isinstance(inner, dict):
                raise StudyError(f"--set: found {text!r}, expected the key of a value; correct it")
        inner[parts[-1]] = value.strip()
        given[key.strip()] = value.strip()
    try:
        return Statements.model_validate(tree)
    except ValidationError as error:
        raise explain(error, "machine.json", tree, Statements, given) from error


def stated(**tables: BaseModel | None) -> dict[str, dict[str, Any]]:
    """Those keys of some tables that are stated, by the name of the table; without empty tables."""
    found = {}
    for name, one in tables.items():
        content = {} if one is None else one.model_dump(exclude_defaults=True)
        if one is not None and isinstance(one, AcceptanceSettings):
            content = one.model_dump()
        if content := {k: v for k, v in content.items() if v not in (None, {})}:
            found[name] = content
    return found
