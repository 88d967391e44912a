"""``.. vcal-report-keys::``: the keys of report.json, from its schema."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

import vcal

from . import rst

Schema = Mapping[str, Any]


def schema() -> Schema:
    """The JSON schema that comes with vcal."""
    (path,) = Path(vcal.__file__).parent.rglob("report.schema.json")
    return json.loads(path.read_text(encoding="utf-8"))


def report_keys() -> str:
    """A table of the top level, and one of what is below each of its keys."""
    whole = schema()
    top = whole["properties"]
    found = rst.text(whole["description"]) + "\n\n"
    found += rst.table(
        ("key", "type", "meaning"),
        [
            (_link(key, part, whole), _type(part, whole), rst.text(_said(part, key, whole)))
            for key, part in top.items()
        ],
    )
    for key, part in top.items():
        rows = list(_below(part, whole))
        if rows:
            found += rst.heading(key, "-", f"report-{key}")
            found += rst.text(part["description"]) + "\n\n"
            found += rst.table(("key", "type", "meaning"), rows)
    return found


def _link(key: str, part: Schema, whole: Schema) -> str:
    return f":ref:`{key} <report-{key}>`" if any(_below(part, whole)) else f"``{key}``"


def _resolved(part: Schema, whole: Schema) -> Schema:
    """Without references and without the null that stands for nothing."""
    if "$ref" in part:
        return {**whole["$defs"][part["$ref"].rpartition("/")[2]], **part}
    if "anyOf" in part:
        one = next(each for each in part["anyOf"] if each.get("type") != "null")
        return {**_resolved(one, whole), **part}
    return part


def _below(part: Schema, whole: Schema, before: str = "") -> Iterator[tuple[str, str, str]]:
    """Rows of what a part holds, objects in it and in its lists with the path to their keys."""
    part = _resolved(part, whole)
    if part.get("type") == "array":
        yield from _below(part["items"], whole, before)
        return
    same = [_resolved(one, whole) for one in part.get("properties", {}).values()]
    if len(same) > 1 and all(one == same[0] for one in same) and "properties" in same[0]:
        names = ", ".join(f"``{before}{key}``" for key in part["properties"])
        yield names, "object", "Each with the keys that follow."
        yield from _below(same[0], whole, f"{before}….")
        return
    for key, one in part.get("properties", {}).items():
        said = _said(one, key, whole)
        if key not in part.get("required", ()):
            said += " Only where there are several data sets."
        yield f"``{before}{key}``", _type(one, whole), rst.text(said)
        inner = _resolved(one, whole)
        mark = "[]." if inner.get("type") == "array" else "."
        yield from _below(one, whole, f"{before}{key}{mark}")


def _said(part: Schema, key: str, whole: Schema) -> str:
    said = _resolved(part, whole).get("description")
    if not said:
        raise ValueError(f"report.schema.json: found no description of {key!r}, expected one")
    return said


def _type(part: Schema, whole: Schema) -> str:
    whole_type = part.get("anyOf", [part])
    null = any(each.get("type") == "null" for each in whole_type)
    part = _resolved(part, whole)
    kinds = part.get("type", "")
    names = [kinds] if isinstance(kinds, str) else list(kinds)
    if "array" in names:
        inner = _resolved(part["items"], whole).get("type", "")
        inner = inner if isinstance(inner, str) else " or ".join(inner)
        names = [f"array of {inner}"]
    return " or ".join(dict.fromkeys([*names, *(["null"] if null else [])]))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("vcal-report-keys", rst.directive(report_keys))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
