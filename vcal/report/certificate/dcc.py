"""A certificate as XML by the schema of the Digital Calibration Certificate of PTB.

Source: documentation of the DCC schema 3.3.0 (https://ptb.de/dcc/v3.3.0) and of D-SI 2.2
(https://ptb.de/si). Quantities are D-SI elements: ``si:real`` for one value, ``si:realListXMLList``
for an error motion; units as ``\\micro\\metre``; uncertainty as ``si:expandedMU`` with k = 2, or as
``si:coverageIntervalMU`` where the quantity is not normally distributed. Values are rounded to the
last digit of a two-digit uncertainty (JCGM 100, 7.2.6). What the schema leaves open follows the
rules (Schematron) of PTB's library dcclib: method, software and conditions stand in every result,
releases begin with a letter, only what is referred to has an ``id``.
"""

import datetime
import math
from collections.abc import Iterable, Sequence
from xml.etree import ElementTree

import numpy as np

from ...compensation.headers import outside
from ...numerics.conformity import Conformity
from ...study.statements import ContactSettings
from ...words import printable
from ..html.provenance import versions
from ..loop.decision import chance
from .contents import COVERAGE, Certificate, Result, Series, Value

VERSION = "3.3.0"
_DCC, _SI = "https://ptb.de/dcc", "https://ptb.de/si"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_NAMED = "vcal_"
"""Before the name of a result in its ``refType``, by which programs find it."""
_NOT_STATED = "not stated"
_NOWHERE = "ZZ"
"""Country code that ISO 3166-1 leaves to its users, for a draft without a country."""
_UNITS = {
    "um": r"\micro\metre",
    "urad": r"\micro\radian",
    "um/m": r"\micro\metre\metre\tothe{-1}",
    "mm": r"\milli\metre",
    "deg": r"\degree",
    "degC": r"\degreecelsius",
}
_PROBABILITY = math.erf(COVERAGE / math.sqrt(2.0))
"""Coverage probability of U = k u for a normal distribution, 95.45 %."""
_INTERVAL = 0.95

Element = ElementTree.Element


def dcc(certificate: Certificate, today: datetime.date) -> str:
    """The text of the XML file; `today` is the date of issue."""
    for prefix, space in (("dcc", _DCC), ("si", _SI), ("xsi", _XSI)):
        ElementTree.register_namespace(prefix, space)
    root = Element(
        f"{{{_DCC}}}digitalCalibrationCertificate",
        {
            "schemaVersion": VERSION,
            f"{{{_XSI}}}schemaLocation": f"{_DCC} {_DCC}/v{VERSION}/dcc.xsd",
        },
    )
    root.append(_administrative(certificate, today))
    root.append(_results(certificate))
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


# --- elements ------------------------------------------------------------------------------------


def _dcc(name: str, *content: Element | str | None, **attributes: str) -> Element:
    """An element of the DCC with a text or with elements; None is left out."""
    return _element(_DCC, name, content, attributes)


def _si(name: str, *content: Element | str | None) -> Element:
    return _element(_SI, name, content, {})


def _element(
    space: str, name: str, content: Sequence[Element | str | None], attributes: dict[str, str]
) -> Element:
    found = Element(f"{{{space}}}{name}", attributes)
    for one in content:
        if isinstance(one, str):
            found.text = printable(one, lines=False).strip()
        elif one is not None:
            found.append(one)
    return found


def _text(name: str, *words: str) -> Element:
    """Text in English, of `dcc:textType` or `dcc:richContentType`."""
    return _dcc(name, *(_dcc("content", one, lang="en") for one in words))


# --- administrative data -------------------------------------------------------------------------


def _administrative(one: Certificate, today: datetime.date) -> Element:
    given = one.stated.certificate
    date = one.stated.measurement.date or one.machine.date or today.isoformat()
    core = _dcc(
        "coreData",
        _dcc("countryCodeISO3166_1", given.laboratory.country or _NOWHERE),
        _dcc("usedLangCodeISO639_1", "en"),
        _dcc("mandatoryLangCodeISO639_1", "en"),
        _dcc("uniqueIdentifier", given.number or _NOT_STATED),
        _dcc("beginPerformanceDate", date),
        _dcc("endPerformanceDate", date),
        _dcc("performanceLocation", given.place),
        _dcc("issueDate", today.isoformat()),
    )
    laboratory = _dcc("calibrationLaboratory", _contact("contact", given.laboratory))
    people = _dcc(
        "respPersons",
        _dcc(
            "respPerson",
            _dcc("person", _text("name", given.responsible or _NOT_STATED)),
            _dcc("role", "responsible for the certificate"),
            _dcc("mainSigner", "true"),
        ),
        _operator(one),
    )
    return _dcc(
        "administrativeData",
        _dcc("dccSoftware", *_software()),
        core,
        _dcc("items", _item(one)),
        laboratory,
        people,
        _contact("customer", given.customer),
        _dcc("statements", *_statements(one)),
    )


def _software(*names: str) -> list[Element]:
    """The programs of these names; all without any."""
    kinds = {"vcal": "application"}
    return [
        _dcc(
            "software",
            _text("name", name),
            _dcc("release", f"v{release}"),
            _dcc("type", kinds.get(name, "library")),
        )
        for name, release in versions().items()
        if not names or name in names
    ]


def _operator(one: Certificate) -> Element | None:
    who = one.stated.measurement.operator
    if who is None:
        return None
    return _dcc("respPerson", _dcc("person", _text("name", who)), _dcc("role", "measurement"))


def _item(one: Certificate) -> Element:
    machine, stated = one.machine, one.stated.machine
    number = stated.serial_number or _NOT_STATED
    travels = ", ".join(
        f"{axis} {_travel(low, high, joint.turns)}"
        for axis, joint, (low, high) in zip(
            machine.axes, machine.chain.joints, machine.volume, strict=True
        )
    )
    tool = ", ".join(f"{1e3 * v:.6g}" for v in np.asarray(machine.chain.tool_offset))
    about = (
        f"Kinematic chain by ISO 10791-6: {machine.chain.text}. Working volume: {travels}. Tool "
        f"offset {tool} mm."
    )
    made = stated.manufacturer
    return _dcc(
        "item",
        _text("name", machine.name or "machine tool"),
        _text("description", about),
        None if made is None else _dcc("manufacturer", _text("name", made)),
        None if stated.model is None else _dcc("model", stated.model),
        _dcc(
            "identifications",
            _dcc(
                "identification",
                _dcc("issuer", "manufacturer"),
                _dcc("value", number),
                _text("name", "serial number"),
            ),
        ),
    )


def _travel(low: float, high: float, turns: bool) -> str:
    factor, unit = (math.degrees(1.0), "deg") if turns else (1e3, "mm")
    return f"{factor * low:.6g} to {factor * high:.6g} {unit}"


def _contact(name: str, given: ContactSettings) -> Element:
    place = {
        "street": given.street,
        "postCode": given.post_code,
        "city": given.city,
        "countryCode": given.country,
    }
    known = [_dcc(key, value) for key, value in place.items() if value is not None]
    return _dcc(
        name,
        _text("name", given.name or _NOT_STATED),
        None if given.e_mail is None else _dcc("eMail", given.e_mail),
        _dcc("location", *(known or [_dcc("city", _NOT_STATED)])),
    )


def _statements(one: Certificate) -> Iterable[Element]:
    if one.draft:
        yield _dcc(
            "statement",
            _text("name", "draft"),
            _text(
                "declaration",
                "This is a draft and no certificate: data that a certificate must state are "
                f"missing, and their places read '{_NOT_STATED}', or '{_NOWHERE}' for a country.",
            ),
        )
    yield _dcc(
        "statement",
        _text("name", "measurement uncertainty"),
        _dcc("norm", "JCGM 100:2008"),
        _text(
            "declaration",
            f"Expanded uncertainties are U = k u with k = {COVERAGE:g}; for a normal distribution, "
            f"this is a coverage probability of {100.0 * _PROBABILITY:.1f} %. u is the standard "
            "deviation of the posterior distribution of the identified machine, from the noise of "
            "the readings and the declared prior knowledge.",
        ),
    )
    yield _dcc(
        "statement",
        _text("name", "computed results"),
        _text(
            "declaration",
            "All results are computed from a model of the machine that was identified from "
            "readings. They were not measured one by one.",
        ),
    )
    if one.decision is not None and one.decision.asked is not None:
        yield _conformity(one, one.decision.decisions["before"], one.decision.asked.volumetric_um)


def _conformity(one: Certificate, found: Conformity, tolerance: float) -> Element:
    """The decision on the machine as it was measured; one that cannot be decided passes or fails
    conditionally, by the side of the tolerance on which the estimate is.
    """
    assert one.decision is not None and one.decision.asked is not None
    asked = one.decision.asked
    status = {"conforms": "pass", "does_not_conform": "fail"}.get(found.verdict)
    if status is None:
        status = "conditionalPass" if found.estimate <= tolerance else "conditionalFail"
    rule = (
        f"guarded acceptance and rejection with a risk of at most {asked.risk_percent:g} %, guard "
        f"band {found.guard_band[1]:.3g} um"
        if asked.rule == "guarded"
        else "simple acceptance"
    )
    return _dcc(
        "statement",
        _text("name", "conformity of the volumetric error"),
        _dcc("norm", "JCGM 106:2012"),
        _text(
            "declaration",
            f"Largest volumetric error without compensation, tolerance {tolerance:g} um. Decision "
            f"rule: {rule}. Conformance probability {chance(found)}.",
        ),
        _dcc("conformity", status),
    )


# --- results -------------------------------------------------------------------------------------


def _results(one: Certificate) -> Element:
    return _dcc("measurementResults", *(_result(one, result) for result in one.results))


def _under_which(one: Certificate, result: Result) -> list[Element | None]:
    """Method, software, equipment and conditions of a result. Readers look for them in every one,
    not beside them.
    """
    equipment = one.stated.certificate.equipment
    kinds = ", ".join(kind.replace("_", " ") for kind in one.stated.instruments.values())
    conditions = [_condition(one, name) for name in one.machine.ranges if name.startswith("T_")]
    return [
        _dcc(
            "usedMethods",
            _dcc(
                "usedMethod",
                _text("name", "identification of a machine model"),
                _text(
                    "description",
                    "The error motions and location errors of all axes, and effects of direction, "
                    "temperature and load where they are significant, are estimated together from "
                    "the readings (generalised least squares with declared prior knowledge). The "
                    "results are evaluated on the estimated machine, their uncertainties follow "
                    "from its covariance by the law of propagation (JCGM 100) or by Monte Carlo "
                    "(JCGM 101).",
                ),
                _dcc("norm", result.norm),
            ),
        ),
        _dcc("usedSoftware", *_software("vcal")),
        _dcc(
            "measuringEquipments",
            _dcc("measuringEquipment", _text("name", equipment or kinds)),
        )
        if equipment or kinds
        else None,
        _dcc("influenceConditions", *conditions) if conditions else None,
    ]


def _condition(one: Certificate, name: str) -> Element:
    known = one.machine.ranges[name]
    low, mean, high = (
        outside(one.machine, name, value) for value in (known.low, known.mean, known.high)
    )
    return _dcc(
        "influenceCondition",
        _text("name", f"temperature {name.removeprefix('T_')}"),
        _text("description", f"Mean in the measurement; it was from {low:.4g} to {high:.4g} degC."),
        _dcc("data", _dcc("quantity", _si("real", *_number(mean, 2), _si("unit", _UNITS["degC"])))),
    )


def _number(value: float, places: int) -> list[Element]:
    return [_si("value", _digits(value, places))]


def _result(one: Certificate, result: Result) -> Element:
    content = [*map(_quantity, result.values), *map(_list, result.series)]
    if result.unknown:
        words = f"Not determined by the measurement: {'; '.join(result.unknown)}."
        content.append(_text("text", words))
    return _dcc(
        "measurementResult",
        _text("name", f"{result.name} ({result.norm})"),
        *_under_which(one, result),
        _dcc(
            "results",
            _dcc(
                "result",
                _text("name", result.name),
                _text("description", result.about),
                _dcc("data", *content),
            ),
        ),
        refType=_NAMED + result.id,
    )


def _quantity(one: Value) -> Element:
    places = decimals(COVERAGE * one.u)
    return _dcc(
        "quantity",
        _text("name", one.name),
        _si(
            "real",
            _si("value", _digits(one.value, places)),
            _si("unit", _UNITS[one.unit]),
            _uncertainty(one, places),
        ),
        refType=_NAMED + one.id,
    )


def _uncertainty(one: Value, places: int) -> Element | None:
    if not one.u > 0.0:
        return None
    if one.interval is None:
        stated = _si(
            "expandedMU",
            _si("valueExpandedMU", _digits(COVERAGE * one.u, places)),
            _si("coverageFactor", f"{COVERAGE:g}"),
            _si("coverageProbability", f"{_PROBABILITY:.4f}"),
            _si("distribution", "normal"),
        )
    else:
        low, high = one.interval
        stated = _si(
            "coverageIntervalMU",
            _si("valueStandardMU", _digits(one.u, places + 1)),
            _si("intervalMin", _digits(low, places)),
            _si("intervalMax", _digits(high, places)),
            _si("coverageProbability", f"{_INTERVAL:g}"),
        )
    return _si("measurementUncertaintyUnivariate", stated)


def _list(one: Series) -> Element:
    places = decimals(COVERAGE * float(one.u[one.u > 0.0].min(initial=math.inf)))
    values = " ".join(_digits(float(v), places) for v in one.value)
    expanded = " ".join(_digits(COVERAGE * float(u), places) for u in one.u)
    return _dcc(
        "list",
        _text("name", one.name),
        _dcc(
            "quantity",
            _text("name", "position"),
            _si(
                "realListXMLList",
                _si("valueXMLList", " ".join(f"{v:.6g}" for v in one.position)),
                _si("unitXMLList", _UNITS[one.position_unit]),
            ),
        ),
        _dcc(
            "quantity",
            _text("name", "error motion"),
            _si(
                "realListXMLList",
                _si("valueXMLList", values),
                _si("unitXMLList", _UNITS[one.unit]),
                _si(
                    "measurementUncertaintyUnivariateXMLList",
                    _si(
                        "expandedMUXMLList",
                        _si("valueExpandedMUXMLList", expanded),
                        _si("coverageFactorXMLList", f"{COVERAGE:g}"),
                        _si("coverageProbabilityXMLList", f"{_PROBABILITY:.4f}"),
                        _si("distributionXMLList", "normal"),
                    ),
                ),
            ),
        ),
        refType=_NAMED + one.id,
    )


def decimals(expanded: float) -> int:
    """Decimals of an expanded uncertainty with two significant digits; six without one."""
    if not 0.0 < expanded < math.inf:
        return 6
    places = 1 - math.floor(math.log10(expanded))
    return places - 1 if round(expanded, places) >= 10.0 ** (2 - places) else places


def _digits(value: float, places: int) -> str:
    text = f"{round(value, places):.{max(places, 0)}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text
