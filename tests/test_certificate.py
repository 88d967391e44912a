"""The digital calibration certificate: read back, held against its schema, and what is refused."""

import datetime
import json
import math
import os
import re
import warnings
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from dsi_unit import DsiUnit

import vcal
from identified import identified
from test_cli import refused, run
from vcal.compensation.computed_tests import geometric_tests_of, line_tests
from vcal.compensation.machine import Range
from vcal.compensation.stored import machine_record
from vcal.report.certificate.contents import NODES, certificate, missing
from vcal.report.certificate.dcc import dcc, decimals
from vcal.report.loop.decision import decided
from vcal.study.identified_machine import FILE
from vcal.study.statements import statements

DCC, SI = "{https://ptb.de/dcc}", "{https://ptb.de/si}"
TODAY = datetime.date(2026, 3, 20)
ABOUT = {
    "machine": {"manufacturer": "Mill & Co", "model": "M 5", "serial_number": "A 17"},
    "instruments": {"laser_tracker": "laser_tracker"},
    "acceptance": {"volumetric_um": 20.0, "draws": 400},
    "measurement": {"operator": "N. N.", "date": "2026-03-14"},
    "certificate": {
        "number": "2026-17",
        "responsible": "A. Smith",
        "laboratory": {"name": "Lab", "city": "Bern", "country": "CH", "street": "Way 1"},
        "customer": {"name": "Works", "city": "Ulm"},
    },
}
SEQUENCES = {
    # Elements in the order of the schema; those with a star are required.
    "digitalCalibrationCertificate": "administrativeData* measurementResults* comment document",
    "coreData": "countryCodeISO3166_1* usedLangCodeISO639_1* mandatoryLangCodeISO639_1* "
    "uniqueIdentifier* identifications receiptDate beginPerformanceDate* endPerformanceDate* "
    "performanceLocation* issueDate",
    "software": "name* release* type description",
    "item": "name* equipmentClass description owner installedSoftwares manufacturer model "
    "identifications* itemQuantities subItems",
    "identification": "issuer* value* name",
    "contact": "name* eMail phone fax link location* descriptionData",
    "customer": "name* eMail phone fax link location* descriptionData",
    "respPerson": "person* description role mainSigner",
    "statement": "name description countryCodeISO3166_1 convention traceable norm reference link "
    "declaration valid date period respAuthority conformity data",
    "measurementResults": "measurementResult*",
    "usedMethod": "name* description norm reference link",
    "influenceCondition": "name* description status certificate data*",
    # PTB's Schematron requires methods, software and conditions where they are known.
    "measurementResult": "name* description usedMethods* usedSoftware* measuringEquipments "
    "influenceConditions* results* measurementMetaData",
    "result": "name* description data*",
    "quantity": "name description real realListXMLList",
    "list": "name description quantity*",
    "real": "value* unit* measurementUncertaintyUnivariate",
    "realListXMLList": "valueXMLList* unitXMLList* measurementUncertaintyUnivariateXMLList",
    "expandedMU": "valueExpandedMU* coverageFactor* coverageProbability* distribution",
    "coverageIntervalMU": "valueStandardMU* intervalMin* intervalMax* coverageProbability*",
    "expandedMUXMLList": "valueExpandedMUXMLList* coverageFactorXMLList* "
    "coverageProbabilityXMLList* distributionXMLList",
}


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    _, bare, _ = identified(tmp_path_factory.mktemp("certificate") / "study")
    ranges = {"T_Y": Range(20.0, 21.5, 23.0)}
    return replace(bare, about=ABOUT, name="mill 3", date="2026-03-15", ranges=ranges)


@pytest.fixture(scope="module")
def written(machine):
    return dcc(certificate(machine), TODAY)


@pytest.fixture(scope="module")
def root(written):
    return ElementTree.fromstring(written)


def words(element, path):
    return [one.text for one in element.iterfind(path.replace("dcc:", DCC).replace("si:", SI))]


def test_elements_stand_in_the_order_of_the_schema(root):
    seen = set()
    for element in root.iter():
        name = element.tag.partition("}")[2]
        if name not in SEQUENCES:
            continue
        seen.add(name)
        order = [one.rstrip("*") for one in SEQUENCES[name].split()]
        children = [child.tag.partition("}")[2] for child in element]
        assert [order.index(child) for child in children] == sorted(map(order.index, children))
        assert {one.rstrip("*") for one in SEQUENCES[name].split() if "*" in one} <= {*children}
    assert seen == set(SEQUENCES)
    assert root.get("schemaVersion") == "3.3.0"
    names = [element.get("refType") for element in root.iter() if element.get("refType")]
    assert len(names) == len({*names}) > 40
    assert all(re.fullmatch(r"vcal_[\w.-]+", one) for one in names)
    for text in root.iter():  # dcc:notEmptyStringType
        assert text.text is None or not text.text.strip() or text.text == text.text.strip()


TYPES = {
    # Forms of texts in the schemas, DCC 3.3.0 and D-SI 2.2.
    r"[-+]?(\d*\.\d+|\d+\.?)([Ee][-+]?\d+)?": "value intervalMin intervalMax valueXMLList",
    r"(\d*\.\d+|\d+\.?)([Ee][-+]?\d+)?": "valueExpandedMU valueStandardMU valueExpandedMUXMLList",
    r"[1-9]\d*(\.\d*)?": "coverageFactor coverageFactorXMLList",
    r"0(\.\d*)?|1(\.0*)?": "coverageProbability coverageProbabilityXMLList",
    r"\d{4}-\d{2}-\d{2}": "beginPerformanceDate endPerformanceDate issueDate",
    r"[A-Z]{2}": "countryCodeISO3166_1 countryCode",
    r"[a-z]{2}": "usedLangCodeISO639_1 mandatoryLangCodeISO639_1",
    r"laboratory|customer|other": "performanceLocation",
    r"application|library": "type",
    r"manufacturer": "issuer",
    r"true|false": "mainSigner",
    r"(conditional)?(P|p)ass|(conditional)?(F|f)ail": "conformity",
    r"\S+(\s+\S+)*": "release model eMail city street postCode norm role uniqueIdentifier",
}


def test_texts_have_the_forms_of_the_schema(root):
    seen = set()
    for form, names in TYPES.items():
        for name in names.split():
            for element in root.iter():
                if element.tag.partition("}")[2] == name and (name != "value" or SI in element.tag):
                    seen.add(name)
                    items = element.text.split() if name.endswith("List") else [element.text]
                    assert items and all(re.fullmatch(form, item) for item in items), name
    assert {*" ".join(TYPES.values()).split()} - seen <= {"postCode", "eMail", "countryCode"}


def schema_of_ptb():
    """Path of the schema: a copy that the user has, or one that PTB's package fetches."""
    if path := os.environ.get("VCAL_DCC_SCHEMA"):
        return path
    why = "needs VCAL_DCC_SCHEMA=.../dcc.xsd (version 3.3.0, with its imports), or dcc-json-toolkit"
    ptb = pytest.importorskip("dcc_json_toolkit", reason=why)
    try:
        return str(ptb.DccSchema("3.3.0").get_schema_uri(no_cache=False))
    except Exception as error:  # of several libraries, where the network cannot be reached
        pytest.skip(f"the schema could not be fetched: {type(error).__name__}")


def test_the_schema_of_ptb_takes_it(written, machine):
    xmlschema = pytest.importorskip("xmlschema")
    schema = xmlschema.XMLSchema(schema_of_ptb())
    schema.validate(written)
    bare = replace(machine, about={}, name="", date="")
    schema.validate(dcc(certificate(bare, draft=True), TODAY))
    for there, instead in (
        ("dcc:customer>", "dcc:buyer>"),
        ('schemaVersion="3.3.0"', 'schemaVersion="3.2.1"'),
        ("<si:coverageFactor>2<", "<si:coverageFactor>0.5<"),
        (f"<dcc:uniqueIdentifier>{ABOUT['certificate']['number']}</dcc:uniqueIdentifier>", ""),
    ):
        broken = written.replace(there, instead)
        assert broken != written and not schema.is_valid(broken)


def unit_of(text):
    """A unit as PTB's library reads it, which warns of notations in its own tables."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        unit = DsiUnit(text)
    assert unit.valid and not unit.warnings
    return unit


def real(root, name):
    """Value, unit in SI by PTB's reader of units, and expanded uncertainty of a quantity."""
    (element,) = (q for q in root.iter(f"{DCC}quantity") if q.get("refType") == f"vcal_{name}")
    one = element.find(f"{SI}real")
    unit = unit_of(one.find(f"{SI}unit").text)
    found = {child.tag.partition("}")[2]: child.text for child in one.iter()}
    return found, unit


def resolution(text):
    """Half of the last printed digit, and the error of a double."""
    return 0.500001 * 10.0 ** -len(text.partition(".")[2])


@pytest.mark.parametrize(
    ("what", "si"), [("um", r"\metre"), ("urad", r"\radian"), ("um/m", r"\one")]
)
def test_geometric_deviations_come_back(root, machine, what, si):
    tests = [t for t in geometric_tests_of(machine) if t.unit == what]
    assert tests
    for test in tests:
        name = re.sub(r"\W+", "_", f"{test.name}_{test.what}").strip("_")
        found, unit = real(root, name)
        base = unit.to_base_unit_tree()
        assert str(base) == rf"1e-06*{si}"
        assert float(found["value"]) == pytest.approx(test.value, abs=resolution(found["value"]))
        expanded = found["valueExpandedMU"]
        assert float(expanded) == pytest.approx(2.0 * test.u, abs=resolution(expanded))
        assert len(expanded.replace(".", "").lstrip("0")) in (2, 3)
        assert found["coverageFactor"] == "2"
        k2 = math.erf(2.0 / math.sqrt(2.0))
        assert float(found["coverageProbability"]) == pytest.approx(k2, abs=1e-4)


def test_error_motions_come_back(root, machine):
    tables = {t.name: t for t in machine.error_motions(NODES) if len(t.position)}
    lists = {one.get("refType").removeprefix("vcal_"): one for one in root.iter(f"{DCC}list")}
    assert set(lists) == set(tables)
    for name, table in tables.items():
        position, error = lists[name].iterfind(f"{DCC}quantity/{SI}realListXMLList")
        where = np.array(position.find(f"{SI}valueXMLList").text.split(), float)
        np.testing.assert_allclose(where, table.position, rtol=1e-5)
        assert str(unit_of(position.find(f"{SI}unitXMLList").text)) == r"\milli\metre"
        texts = error.find(f"{SI}valueXMLList").text.split()
        np.testing.assert_allclose([*map(float, texts)], table.value, atol=resolution(texts[0]))
        (expanded,) = error.iter(f"{SI}valueExpandedMUXMLList")
        texts = expanded.text.split()
        np.testing.assert_allclose([*map(float, texts)], 2.0 * table.u, atol=resolution(texts[0]))


def test_diagonals_and_the_volumetric_error_come_back(root, machine):
    for line in line_tests(machine):
        sign = line.name.replace("+", "p").replace("-", "n")
        found, _ = real(root, f"{line.kind}_{sign}_E".replace(" ", "_"))
        value = line.quantities["E"].value
        assert float(found["value"]) == pytest.approx(value, abs=resolution(found["value"]))
    error = decided(machine).error.before.largest
    found, _ = real(root, "volumetric_largest")
    ends = np.quantile(error, [0.025, 0.975])
    for key, value in (("value", error.mean()), ("intervalMin", ends[0]), ("intervalMax", ends[1])):
        assert float(found[key]) == pytest.approx(value, abs=resolution(found[key]))
    assert found["coverageProbability"] == "0.95"


def test_what_identifies_machine_laboratory_and_software(root):
    assert words(root, ".//dcc:uniqueIdentifier") == ["2026-17"]
    assert words(root, ".//dcc:beginPerformanceDate") == ["2026-03-14"]
    assert words(root, ".//dcc:issueDate") == ["2026-03-20"]
    assert words(root, ".//dcc:item/dcc:name/dcc:content") == ["mill 3"]
    assert words(root, ".//dcc:item/dcc:manufacturer/dcc:name/dcc:content") == ["Mill & Co"]
    assert words(root, ".//dcc:item/dcc:model") == ["M 5"]
    assert words(root, ".//dcc:identification/dcc:value") == ["A 17"]
    assert words(root, ".//dcc:respPerson/dcc:person/dcc:name/dcc:content") == ["A. Smith", "N. N."]
    assert words(root, ".//dcc:calibrationLaboratory//dcc:countryCode") == ["CH"]
    results = [*root.iter(f"{DCC}measurementResult")]
    for result in results:
        equipment = words(result, ".//dcc:measuringEquipment/dcc:name/dcc:content")
        assert equipment == ["laser tracker"]
        assert words(result, ".//dcc:software/dcc:name/dcc:content") == ["vcal"]
    software = dict(
        zip(
            words(root, ".//dcc:dccSoftware/dcc:software/dcc:name/dcc:content"),
            words(root, ".//dcc:dccSoftware/dcc:software/dcc:release"),
            strict=True,
        )
    )
    assert software["vcal"] == f"v{vcal.__version__}"
    assert software["numpy"] == f"v{np.__version__}"
    assert "not measured one by one" in " ".join(
        words(root, ".//dcc:statement/dcc:declaration/dcc:content")
    )
    for temperature in root.iter(f"{DCC}influenceCondition"):
        assert words(temperature, ".//si:value") == ["21.50"]
    norms = words(root, ".//dcc:usedMethod/dcc:norm")
    assert len(norms) == len(results)
    assert {"ISO 230-1:2012", "ISO 230-2:2014", "ISO 230-6:2002"} <= {*norms}


@pytest.mark.parametrize(
    ("factor", "status"),
    [(0.5, "fail"), (0.995, "conditionalFail"), (1.01, "conditionalPass"), (2.0, "pass")],
)
def test_conformity_has_the_words_of_the_schema(machine, factor, status):
    tolerance = factor * float(decided(machine).error.before.largest.mean())
    about = ABOUT | {"acceptance": {"volumetric_um": tolerance, "draws": 400}}
    text = dcc(certificate(replace(machine, about=about)), TODAY)
    assert words(ElementTree.fromstring(text), ".//dcc:conformity") == [status]


@pytest.mark.parametrize(
    ("expanded", "places"), [(1.4, 1), (0.0996, 2), (0.0994, 3), (23.0, 0), (230.0, -1), (0.0, 6)]
)
def test_two_digits_of_the_uncertainty(expanded, places):
    assert decimals(expanded) == places


# --- the command ---------------------------------------------------------------------------------


@pytest.fixture
def report(machine, tmp_path):
    folder = tmp_path / "report"
    folder.mkdir()
    (folder / FILE).write_text(json.dumps(machine_record(machine)), encoding="utf-8")
    return folder


def test_the_command_writes_it(report, tmp_path):
    out = tmp_path / "certificate.xml"
    said = run("certificate", report, "--out", out, "--set", "certificate.number=B/2").stdout
    root = ElementTree.parse(out).getroot()
    assert words(root, ".//dcc:uniqueIdentifier") == ["B/2"]
    assert "ISO 230-6:2002: Diagonal displacements, 11 stated" in said
    assert "found a file that is there" in refused("certificate", report, "--out", out)


def test_what_is_missing_is_listed_and_a_draft_says_so(machine, report, tmp_path):
    content = machine_record(replace(machine, about={"measurement": {"date": "2026-03-14"}}))
    (report / FILE).write_text(json.dumps(content), encoding="utf-8")
    out = tmp_path / "certificate.xml"
    message = refused("certificate", report, "--out", out)
    lacking = missing(statements({"measurement": {"date": "2026-03-14"}}))
    assert len(lacking) == 8 and f"found no {', '.join(lacking)}, expected all" in message
    assert not out.exists()
    run("certificate", report, "--out", out, "--draft")
    root = ElementTree.parse(out).getroot()
    assert words(root, ".//dcc:statement/dcc:name/dcc:content")[0] == "draft"
    assert words(root, ".//dcc:uniqueIdentifier") == ["not stated"]
    assert words(root, ".//dcc:countryCodeISO3166_1") == ["ZZ"]
    assert words(root, ".//dcc:measuringEquipments") == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("number=17", "found 'number=17', expected KEY=VALUE with a key of the tables machine,"),
        ("certificate.numbr=17", "did you mean 'number'"),
        ("certificate.laboratory.country=Swiss", "certificate.laboratory.country"),
        ("measurement.date=14.3.2026", "expected year, month and day"),
        ("measurement.date=20260314", "expected year, month and day"),
        ("measurement.date=2026-W11-6", "expected year, month and day"),
        ("machine.serial_number= ", "machine.serial_number"),
        ("certificate.number.x=17", "expected the key of a value"),
    ],
)
def test_mistakes_in_overrides(report, tmp_path, given, said):
    message = refused("certificate", report, "--out", tmp_path / "c.xml", "--set", given)
    assert said in " ".join(message.split())


def test_certificates_that_do_not_exist(machine, report, tmp_path):
    out = tmp_path / "no folder" / "c.xml"
    assert "found no folder" in refused("certificate", report, "--out", out)
    nothing = replace(machine, theta=np.zeros(0), effects=(), shapes=())
    with pytest.raises(vcal.StudyError, match="found a machine without identified errors"):
        certificate(nothing)
