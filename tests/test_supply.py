"""What development and CI install is locked: versions, hashes, no address of a registry."""

import importlib.util
import json
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
LOCK = (ROOT / "requirements-dev.txt").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / ".ci" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def audit():
    return script("audit")


def requirements():
    """What pyproject.toml asks for, in any extra and to build the wheel."""
    project = PROJECT["project"]
    texts = [*project["dependencies"], *PROJECT["build-system"]["requires"]]
    texts += [text for extra in project["optional-dependencies"].values() for text in extra]
    return [one for one in map(Requirement, texts) if one.name != "vcal"]


def test_every_requirement_is_locked_in_a_version_that_fits(audit):
    pins = audit.locked(LOCK)
    for one in requirements():
        versions = pins.get(canonicalize_name(one.name), set())
        assert versions, f"{one.name} is not in requirements-dev.txt: make it anew"
        assert all(one.specifier.contains(version) for version in versions), (one, versions)


def test_every_package_has_a_version_and_a_hash():
    entries = re.sub(r"\\\n", "", LOCK)
    lines = [line for line in entries.splitlines() if line and not line.startswith("#")]
    assert len(lines) > 100
    for line in lines:
        assert re.match(r"[a-z0-9._-]+==\S+", line) and "--hash=sha256:" in line, line
        assert all(len(digest) == 64 for digest in re.findall(r"sha256:(\w+)", line))


def test_no_registry_is_named():
    assert "://" not in LOCK and "index-url" not in re.sub(r"^#.*$", "", LOCK, flags=re.MULTILINE)


ADVISORY = {
    "id": "TEST-1",
    "summary": "an example",
    "affected": [
        {
            "package": {"ecosystem": "PyPI", "name": "Ruff"},
            "ranges": [{"type": "ECOSYSTEM", "events": [{"introduced": "0"}, {"fixed": "99.0"}]}],
        }
    ],
}


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({}, 1),
        ({"withdrawn": "2026-01-01"}, 0),
        ({"affected": [ADVISORY["affected"][0] | {"ranges": []}]}, 0),
        ({"affected": [{"package": {"ecosystem": "npm", "name": "ruff"}, "versions": ["1"]}]}, 0),
    ],
)
def test_the_audit_reads_advisories(audit, tmp_path, capsys, change, code):
    (tmp_path / "one.json").write_text(json.dumps(ADVISORY | change), encoding="utf-8")
    assert audit.main([str(tmp_path)]) == code
    assert ("TEST-1" in capsys.readouterr().out) == bool(code)


def test_the_ends_of_ranges(audit):
    events = [
        {"introduced": "1.0"},
        {"fixed": "1.5"},
        {"introduced": "2.0"},
        {"last_affected": "2.1"},
    ]
    inside = {
        v: audit._in_range(audit.Version(v), events) for v in ("0.9", "1.0", "1.5", "2.1", "2.2")
    }
    assert inside == {"0.9": False, "1.0": True, "1.5": False, "2.1": True, "2.2": False}


def test_an_audit_without_advisories_says_so(audit, capsys, monkeypatch):
    monkeypatch.delenv("VCAL_ADVISORIES", raising=False)
    assert audit.main([]) == 0 and "not audited" in capsys.readouterr().out


# --- bill of materials ---------------------------------------------------------------------------


def test_the_bill_of_materials_is_of_this_version():
    made = script("sbom")
    text = made.FILE.read_text(encoding="utf-8")
    assert text == made.written(), "make it anew: python .ci/sbom.py"
    found = json.loads(text)
    listed = {one["name"]: one["properties"][0]["value"] for one in found["components"]}
    stated = {
        Requirement(text).name: Requirement(text) for text in PROJECT["project"]["dependencies"]
    }
    assert listed == {name: str(one) for name, one in stated.items()}
    refs = {one["bom-ref"] for one in found["components"]}
    assert {*found["dependencies"][0]["dependsOn"]} == refs and len(refs) == len(stated)


@pytest.mark.slow
def test_a_wheel_holds_the_bill_of_materials_and_nothing_but_vcal(tmp_path):
    pytest.importorskip("hatchling", reason="the extra dev has it")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (bill,) = (name for name in names if "/sboms/" in name)  # PEP 770
        assert archive.read(bill) == (ROOT / "sbom.cdx.json").read_bytes()
    place, _, _ = bill.partition("/")
    assert place.endswith(".dist-info") and {n.split("/")[0] for n in names} == {"vcal", place}
    assert not [name for name in names if Path(name).suffix in (".so", ".pyd", ".dll", ".pyc")]
