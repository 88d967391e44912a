"""Reading a study file as TOML, with overrides of its keys."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import StudyError
from ..words import cut
from .messages import refusal, shown

LARGEST_WHOLE = 2**63 - 1
"""Largest whole number of a study file, in size."""
_LARGEST_FILE = 16 * 2**20
"""Largest size of a study file in bytes; the tables have files of their own."""
_MOST_LEVELS = 16
"""Largest depth of a key; no key of a study file has half as many."""


def read_setup(
    path: Path, overrides: Mapping[str, Any] | Sequence[str] = ()
) -> tuple[dict[str, Any], dict[str, str]]:
    """The raw tree of a study file with the overrides applied, and the overrides as text by key.

    An override is a text such as ``"instrument.joints=read"``, or a key and its value. Rows of an
    array of tables count from 0 (``"model.effect.0.size_um=3"``). Raises `StudyError` for a file
    that is missing or not TOML, and for an override without ``=``, without a place in the tree, in
    contradiction to another one, or of a whole table together with one of its keys.
    """
    if not path.is_file():
        raise refusal(
            path.name,
            "file",
            f"no such file in {path.parent}",
            "a study file in TOML",
            "correct the path",
        )
    if (size := path.stat().st_size) > _LARGEST_FILE:
        raise refusal(
            path.name,
            "file",
            f"{size / 2**20:.0f} MB",
            f"a study file of at most {_LARGEST_FILE / 2**20:.0f} MB",
            "correct the path, or move tables into files of their own",
        )
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise refusal(
            path.name, "file", f"unreadable text ({error})", "TOML in UTF-8", "save it in UTF-8"
        ) from error
    except (ValueError, RecursionError) as error:
        # For numbers of thousands of digits and deeply nested brackets, the parser has no place.
        what, _, place = str(error).partition(" (at ")
        named = path.suffix == ".toml"
        other = "" if named else ", or name a study file (setup.toml) or its folder"
        raise refusal(
            path.name,
            place.rstrip(")") or "file",
            f"what is not TOML ({what})",
            "`key = value` below a [table], text in quotes",
            f"correct the line{other}",
        ) from error
    check_tree(raw, path.name)
    given: dict[str, str] = {}
    for key, value in _pairs(overrides):
        said = value if isinstance(value, str) else shown(value)
        if given.get(key, said) != said and _toml_value(key, given[key]) != _toml_value(key, said):
            raise refusal(
                f"{path.name} (override {key}={said})",
                f"key {key}",
                f"{given[key]} as well",
                "one value for a key, by an option or by --set",
                "leave one of them out",
            )
        for other in given:
            if other.startswith(f"{key}.") or key.startswith(f"{other}."):
                raise refusal(
                    f"{path.name} (override {key}={said})",
                    f"key {key}",
                    f"{other}={given[other]} as well",
                    "a whole table, or some of its keys",
                    "remove one of them, or move the key into the table",
                )
        given[key] = said
        parsed = _toml_value(key, value)
        check_tree(parsed, f"{path.name} (override {shown(f'{key}={said}')})", key)
        _put(raw, key, parsed, said)
    return raw, given


def check_tree(tree: Any, file: str, key: str = "") -> None:
    """Raise `StudyError` for a whole number outside 64 bits, and for a value below more than
    `_MOST_LEVELS` keys. No later step can read such a file.
    """
    stack = [(key, tree)]
    while stack:
        key, value = stack.pop()
        if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
            raise refusal(
                file,
                f"key {key}",
                shown(value),
                "a whole number of at most 2^63 - 1",
                "correct the value",
            )
        if key.count(".") >= _MOST_LEVELS:
            raise refusal(
                file,
                f"key {'.'.join(key.split('.')[:3])}...",
                f"a key of more than {_MOST_LEVELS} levels",
                "tables and keys as in the reference of the study file",
                "correct or remove the key",
            )
        if not isinstance(value, Mapping | list):
            continue
        items = value.items() if isinstance(value, Mapping) else enumerate(value)
        stack += [(f"{key}.{part}" if key else str(part), inner) for part, inner in items]


def _pairs(overrides: Mapping[str, Any] | Sequence[str]) -> Iterator[tuple[str, Any]]:
    if isinstance(overrides, Mapping):
        yield from overrides.items()
        return
    for text in overrides:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise StudyError(
                f"override {cut(text, 80)!r}: found no key and value, expected key=value such as "
                "instrument.joints=read; add the missing part"
            )
        yield key.strip(), value.strip()


def _toml_value(key: str, value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return value  # text without its quotes
    except (ValueError, RecursionError) as error:
        raise refusal(
            f"override {key}={shown(value)}",
            f"key {key}",
            f"what is not TOML ({error})",
            "a value as in the study file",
            "correct the value",
        ) from error


def _put(raw: dict[str, Any], key: str, value: Any, text: str) -> None:
    *path, last = key.split(".")
    table: Any = raw
    for i, part in enumerate(path):
        if isinstance(table, dict):
            table = table.setdefault(part, {})
        else:
            table = _row(table, part, key, text)
        if not isinstance(table, dict | list):
            raise refusal(
                f"override {key}={text}",
                f"key {'.'.join(path[: i + 1])}",
                shown(table),
                "a table",
                "correct the key",
            )
    if isinstance(table, list):
        _row(table, last, key, text)
        table[int(last)] = value
    else:
        table[last] = value


def _row(table: list[Any], part: str, key: str, text: str) -> Any:
    # isdigit alone is true of digits that int does not read, such as a superscript.
    if not (part.isascii() and part.isdigit()) or len(part) > 9 or int(part) >= len(table):
        raise refusal(
            f"override {key}={text}",
            f"key {key}",
            f"row {part!r}",
            f"a row from 0 to {len(table) - 1}",
            "correct the number",
        )
    return table[int(part)]
