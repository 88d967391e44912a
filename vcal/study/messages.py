"""Messages for mistakes in the input: the place, what was found, what was expected, what to do."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from ..bounds import OUT_OF_BOUNDS
from ..errors import StudyError
from ..registry import closest, nearest
from ..words import cut, printable

_QUOTED = r"'([^']*)'"
FEW = 5
"""Most parameters that a message lists."""
_MOST_LINES = 5
"""Mistakes of one file that are listed; further ones are counted."""

MOST_CHARACTERS = 1400
"""Most characters of a message: what fills a screen is not read."""
_MOST_OF_A_PART, _MOST_OF_A_NAME = 500, 60
"""Most characters of what was found, expected or is to be done; of a name in a list."""
_MOST_OF_A_LIST = 900

_EXPECTED = {
    "bool_type": "true or false",
    "dict_type": "a table",
    "finite_number": "a finite number",
    "float_type": "a number",
    "int_type": "a whole number",
    "list_type": "a list in square brackets",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "string_too_short": "text that is not empty",
    "string_type": "text in quotes",
    "tuple_type": "a list in square brackets",
}

_ROWS = ("list_type", "tuple_type")
_TABLE = ("dict_type", "model_type", "model_attributes_type")


def refusal(file: str, where: str, found: str, expected: str, do: str) -> StudyError:
    """The error to raise for one mistake, in the form that all messages share: in one line, with
    control characters of the user's texts written as escapes, and cut where it would be long.
    """
    parts = (printable(p, lines=False, spaces=False) for p in (file, where, found, expected, do))
    most = (200, 200, _MOST_OF_A_PART, 1000, _MOST_OF_A_PART)
    file, where, found, expected, do = (cut(p, m) for p, m in zip(parts, most, strict=True))
    message = f"{file}, {where}: found {found}, expected {expected}; {do}"
    return StudyError(cut(message, MOST_CHARACTERS))


def stated(file: str, where: str, what: str) -> StudyError:
    """The same for a mistake whose words, from "found" on, are made already."""
    message = printable(f"{cut(file, 200)}, {cut(where, 200)}: {what}", lines=False, spaces=False)
    return StudyError(cut(message, MOST_CHARACTERS))


def shown(value: Any) -> str:
    """A value from a TOML file as the user wrote it, shortened where it is long."""
    try:
        text = json.dumps(value, default=str)
    except (ValueError, RecursionError):
        # Python writes no number of thousands of digits, and no tree of a thousand levels.
        if not isinstance(value, int):
            return f"a {'table' if isinstance(value, dict) else 'list'} of many levels"
        return f"a whole number of {value.bit_length()} bits"
    return text if len(text) <= 80 else text[:77] + "..."


def listed(names: Iterable[str], most: int = 30) -> str:
    """Names separated by commas, the first `most` of them, as many as have room; the others are
    counted. A long name is cut.
    """
    names = list(names)
    said = [n if len(n) <= _MOST_OF_A_NAME else f"{n[:_MOST_OF_A_NAME]}..." for n in names[:most]]
    while sum(map(len, said)) + 2 * len(said) > _MOST_OF_A_LIST:
        said.pop()
    more = f", ... ({len(names) - len(said)} more)" if len(names) > len(said) else ""
    return ", ".join(said) + more if names else "none"


def at(raw: Any, key: Sequence[str | int]) -> Any:
    """The value at a key path of a TOML tree; None where the path does not exist."""
    for part in key:
        try:
            raw = raw[part]
        except (KeyError, IndexError, TypeError):
            return None
    return raw


def explain(
    error: ValidationError,
    file: str,
    raw: Mapping[str, Any],
    model: type[BaseModel],
    overrides: Mapping[str, str],
) -> StudyError:
    """One message for all mistakes that pydantic found in a study file, one line each.

    `overrides` maps dotted keys to the text on the command line, so that the message names the
    override instead of the file.
    """
    errors = _of_one_kind(error.errors(include_url=False), raw)
    # A misspelled key is both unknown and missing. It is reported once, with the intended key.
    meant = set()
    for e in errors:
        if e["type"] == "extra_forbidden":
            known = _known_keys(model, e["loc"][:-1])
            meant.add((*e["loc"][:-1], closest(str(e["loc"][-1]), known)))
    lines, seen = [], set()
    for e in errors:
        loc = e["loc"]
        if any(len(o["loc"]) > len(loc) and o["loc"][: len(loc)] == loc for o in errors):
            continue  # a mistake inside this list or table is reported already
        if e["type"] == "missing" and (loc in meant or loc[:-1] in seen):
            continue
        if e["type"] == "missing" and isinstance(loc[-1], int):
            seen.add(loc[:-1])
        lines.append(_line(e, file, raw, model, overrides))
    kept = lines[:_MOST_LINES]
    while len(kept) > 1 and sum(map(len, kept)) > MOST_CHARACTERS - 100:
        kept.pop()
    if len(lines) > len(kept):
        lines[len(kept) :] = [f"... and {len(lines) - len(kept)} more of the same kind"]
    return StudyError("\n".join(lines))


def _of_one_kind(errors: Sequence[Any], raw: Mapping[str, Any]) -> list[Any]:
    """The mistakes of a value that may be of several kinds, such as a number or a list of numbers.

    pydantic reports one mistake for every kind, with the kind among the keys. Kept is the mistake
    of the kind that the value has; for a value of no kind, one mistake that lists all kinds.
    """
    found: list[Any] = []
    fields: dict[tuple, dict[str | int, list[Any]]] = {}
    for e in errors:
        loc, key = e["loc"], _in_file(raw, e["loc"])
        if loc[-1:] == ("[key]",):
            found.append(dict(e) | {"loc": loc[:-1], "type": "wrong_key"})
            continue
        if e["type"] in ("missing", "extra_forbidden") or len(key) == len(loc):
            found.append(e)
            continue
        place = next(i for i, part in enumerate(loc) if part not in key)
        if loc[:place] not in fields:
            fields[loc[:place]] = {}
            found.append(fields[loc[:place]])
        fields[loc[:place]].setdefault(loc[place], []).append(dict(e) | {"loc": key})
    return [e for one in found for e in (_nearest_kind(one) if "type" not in one else [one])]


def _nearest_kind(kinds: Mapping[str | int, list[Any]]) -> list[Any]:
    """The mistakes of the kind that a value has, or one that lists all kinds."""
    first = [errors[0] for errors in kinds.values()]
    of_it = [
        errors
        for errors in kinds.values()
        if len(errors) > 1
        or not errors[0]["type"].endswith("_type")
        or len(errors[0]["loc"]) > min(len(e["loc"]) for e in first)
    ]
    if of_it:
        return of_it[0]
    either = " or ".join(_EXPECTED.get(e["type"]) or e["msg"] for e in first)
    return [dict(first[0]) | {"type": "none_of_several", "msg": either}]


def _in_file(raw: Any, loc: Sequence[str | int]) -> tuple[str | int, ...]:
    """A key path without the parts that are not in the file."""
    found = []
    for part in loc:
        if at(raw, (part,)) is not None:
            raw = raw[part]
            found.append(part)
    return tuple(found)


def source(file: str, key: str, overrides: Mapping[str, str]) -> str:
    """The file, with the override that set a key in it."""
    for name, text in overrides.items():
        if key == name or key.startswith(f"{name}."):
            return f"{file} (override {name}={text})"
    return file


def _line(
    e: Any, file: str, raw: Mapping[str, Any], model: type[BaseModel], overrides: Mapping[str, str]
) -> str:
    loc, kind, context = e["loc"], e["type"], e.get("ctx", {})
    key = ".".join(str(part) for part in loc)
    found, do = shown(at(raw, loc)), "correct the value"
    name = str(loc[-1]) if loc else ""
    if kind in ("value_error", "assertion_error"):
        said = " ".join(str(context["error"]).split())
        if "expected" not in said:  # raised by a validator of the user's own
            said = f"found {found}, expected a value that its validator accepts" + (
                f" ({said}); {do}" if said else f"; {do}"
            )
        return f"{source(file, key, overrides)}, key {key}: {said}"
    if kind == "extra_forbidden":
        known = _known_keys(model, loc[:-1])
        found = f"the unknown key {name!r}{nearest(name, known)}"
        expected, do = f"one of {listed(known)}", "correct or remove the key"
    elif kind == "missing" and loc and isinstance(loc[-1], int):
        key = ".".join(str(part) for part in loc[:-1])
        found, expected = shown(at(raw, loc[:-1])), f"at least {loc[-1] + 1} values"
        do = "add what is missing"
    elif kind == "missing":
        found, expected, do = "nothing", "this key", f"add it to {file}"
    elif kind == OUT_OF_BOUNDS:
        expected, do = context["expected"], f"correct the value or its unit: {context['why']}"
    elif kind == "greater_than":
        expected = f"a number greater than {context['gt']:g}"
    elif kind == "greater_than_equal":
        expected = f"a number of at least {context['ge']:g}"
    elif kind == "less_than":
        expected = f"a number less than {context['lt']:g}"
    elif kind == "less_than_equal":
        expected = f"a number of at most {context['le']:g}"
    elif kind == "literal_error":
        expected = context["expected"]
        found += nearest(str(at(raw, loc)), re.findall(_QUOTED, expected))
    elif kind == "wrong_key":
        expected, do = context["expected"], "correct or remove the key"
        found = f"the unknown key {name!r}{nearest(name, re.findall(_QUOTED, expected))}"
    elif kind == "too_short":
        expected, do = f"at least {context['min_length']}", "add what is missing"
    elif kind == "too_long":
        expected = f"{context['max_length']} values"
    elif kind in _ROWS and _is_row(at(raw, loc)) and _known_keys(model, loc):
        # A single table and rows of tables differ in the brackets only.
        expected, do = f"rows, each below [[{_dotted(loc)}]]", "write it in double brackets"
    elif kind in _TABLE and _are_rows(at(raw, loc)):
        expected, do = f"one table, below [{_dotted(loc)}]", "write it in single brackets"
    else:
        expected = _EXPECTED.get(kind) or e["msg"]
    return str(refusal(source(file, key, overrides), f"key {key}", found, expected, do))


def _is_row(value: Any) -> bool:
    """Whether it is one table. Keys that are digits come from an override of a missing row."""
    return isinstance(value, dict) and not any(key.isdigit() for key in value)


def _are_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_is_row, value))


def _dotted(loc: Sequence[str | int]) -> str:
    """A key path as a TOML header writes it, without row numbers."""
    return ".".join(str(part) for part in loc if not isinstance(part, int))


def _known_keys(model: type[BaseModel], loc: Sequence[str | int]) -> list[str]:
    """The keys of the table at `loc`."""
    named = False
    for i, part in enumerate(loc):
        if isinstance(part, int) or named:
            named = False
            continue  # a row of an array of tables, or one of several named tables
        field = {f.alias or n: f for n, f in model.model_fields.items()}.get(part)
        row = loc[i + 1] if i + 1 < len(loc) else None
        inner = _model_in(field.annotation, row) if field else None
        if field is None or inner is None:
            return []
        model, named = inner, get_origin(field.annotation) is dict
    return [field.alias or name for name, field in model.model_fields.items()]


def _model_in(annotation: Any, row: str | int | None = None) -> type[BaseModel] | None:
    """The table in a type annotation; where the rows differ, the table of `row`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    arguments = get_args(annotation)
    if isinstance(row, int) and row < len(arguments) and Ellipsis not in arguments:
        arguments = arguments[row:]
    for argument in arguments:
        if found := _model_in(argument):
            return found
    return None
