"""The JSON schema of report.json, which comes with vcal, and what holds reports against it."""

import json
from pathlib import Path
from typing import Any

import jsonschema

import vcal

(FILE,) = Path(vcal.__file__).parent.rglob("report.schema.json")
SCHEMA = json.loads(FILE.read_text(encoding="utf-8"))


def validated(content: dict[str, Any]) -> dict[str, Any]:
    """The content of a report.json; raises `jsonschema.ValidationError` for a key that the schema
    does not know, one that is missing, and a value of another type.
    """
    jsonschema.validate(content, SCHEMA)
    return content
