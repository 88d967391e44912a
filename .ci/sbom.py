"""The bill of materials of the wheel, CycloneDX 1.6: `python .ci/sbom.py` writes sbom.cdx.json.

The wheel holds vcal alone. What it needs at run time is listed with the version ranges of
pyproject.toml, without versions: those are chosen where it is installed.
"""

import json
import tomllib
import uuid
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "sbom.cdx.json"


def sbom(project: dict[str, Any]) -> dict[str, Any]:
    """The document for the ``[project]`` table of pyproject.toml; the same for the same table."""
    name, version = project["name"], project["version"]
    own = f"pkg:pypi/{name}@{version}"
    needed = [_component(text) for text in sorted(project["dependencies"])]
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": uuid.uuid5(uuid.NAMESPACE_URL, json.dumps([own, needed])).urn,
        "version": 1,
        "metadata": {
            "component": {
                "type": "library",
                "bom-ref": own,
                "name": name,
                "version": version,
                "description": project["description"],
                "licenses": [{"license": {"id": project["license"]}}],
                "purl": own,
            }
        },
        "components": needed,
        "dependencies": [
            {"ref": own, "dependsOn": [one["bom-ref"] for one in needed]},
            *({"ref": one["bom-ref"]} for one in needed),
        ],
    }


def _component(text: str) -> dict[str, Any]:
    """A package that is not part of the wheel, with the range of its versions."""
    requirement = Requirement(text)
    purl = f"pkg:pypi/{canonicalize_name(requirement.name)}"
    return {
        "type": "library",
        "bom-ref": purl,
        "name": requirement.name,
        "scope": "required",
        "purl": purl,
        "properties": [{"name": "python:requires-dist", "value": str(requirement)}],
    }


def written() -> str:
    """The text of the file for the present pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return json.dumps(sbom(project), indent=1) + "\n"


if __name__ == "__main__":
    FILE.write_text(written(), encoding="utf-8")
