"""``.. vcal-study-keys::``: the keys of a study file, from the settings that it is checked by."""

import inspect
import types
from collections.abc import Iterator, Mapping
from textwrap import indent
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

from vcal.demo import STARTS, starts
from vcal.design.spaces import SPACES
from vcal.instruments import INSTRUMENTS
from vcal.study import settings
from vcal.study.reading.formats import FORMAT_KEYS

from . import rst

_LEAST, _MOST = 1e-4, 1e4
"""Bounds beyond these only catch numbers in a wrong unit; they are not shown."""


_NAMED = {"columns": "x_mm", "tables": '"check.csv"'}
"""A name for tables that may have any; that of an axis for others."""


class Key(NamedTuple):
    """A key of a table: what it is called, holds, defaults to and means."""

    name: str
    holds: str
    default: str
    meaning: str


class Keys(NamedTuple):
    """A table of a study file with its own keys."""

    path: str
    """As it is written, ``[machine]`` or ``[[machine.joint]]``; with the kind of the instrument
    where it has keys of its own for each."""
    says: str
    keys: tuple[Key, ...]

    @property
    def label(self) -> str:
        """By which pages refer to it."""
        words = "".join(c if c.isalnum() else " " for c in self.path).split()
        rows = ["rows"] if self.path.startswith("[[") else []
        return "-".join(["study", *words, *rows]).lower().replace("_", "-")


def tables() -> list[Keys]:
    """All tables that a study file may have, in the order of the settings."""
    found = [*_tables(settings.StudySettings, "")]
    several = [*_tables(settings.SeveralSettings, "", "Top level, several data sets", "name")]
    at = next(i for i, one in enumerate(found) if one.path == "[data]") + 1
    return [*found[:at], several[0], *(o for o in several if o.path == "[[data]]"), *found[at:]]


def _tables(model: type[BaseModel], path: str, shown: str = "", skip: str = "") -> Iterator[Keys]:
    fields = {n: f for n, f in model.model_fields.items() if n not in skip.split()}
    below = {n: one for n, f in fields.items() if (one := _nested(f.annotation)) is not None}
    own = tuple(_key(model, n, f) for n, f in fields.items() if n not in below)
    if own:
        yield Keys(shown or "Top level", _says(model), own)
    for name, (inner, kind) in below.items():
        place = f"{path}.{name}" if path else name
        one = _NAMED.get(name, "C")
        header = {"one": f"[{place}]", "rows": f"[[{place}]]", "named": f"[{place}.{one}]"}[kind]
        yield from _variants(inner, place, header)


def _variants(inner: type[BaseModel], place: str, header: str) -> Iterator[Keys]:
    """A table that has other keys for every kind of instrument or family, or just its own."""
    if place == "instrument":
        yield from _tables(inner, place, header)
        common = " ".join(inner.model_fields)
        for kind, one in sorted(INSTRUMENTS.items()):
            yield from _tables(one.Settings, place, f'{header} kind = "{kind}"', common)
    elif place == "data.instrument":
        return  # as [instrument]
    elif place == "tables":
        yield from _tables(inner, place, header, "columns")
    elif header == "[[data]]":
        # The keys that say how the file is read are those of [data].
        yield from _tables(inner, place, header, " ".join(FORMAT_KEYS))
    elif place == "design":
        yield from _tables(inner, place, header)
        common = " ".join(inner.model_fields)
        for kind, one in sorted(SPACES.items()):
            yield from _tables(one.Settings, place, f"{header} for {kind}", common)
    elif place == "model.geometric":
        for one, name in (
            (settings.FourierSettings, 'family = "fourier"'),
            (settings.SmoothSettings, 'family = "smooth"'),
            (settings.LinkSettings, "of an arm"),
        ):
            yield from _tables(one, place, f"{header} {name}")
    else:
        yield from _tables(inner, place, header)


class Settings(NamedTuple):
    """A table by the class that checks it, and the keys of it that another table lists."""

    path: str
    model: type[BaseModel]
    skip: frozenset[str] = frozenset()


def settings_classes(model: type[BaseModel] = settings.StudySettings) -> list[Settings]:
    """The classes that check the tables of a study file, or of another one, each once."""
    found: list[Settings] = []
    seen: set[type[BaseModel]] = set()

    def add(one: type[BaseModel], path: str, skip: frozenset[str] = frozenset()) -> None:
        if one in seen:
            return
        seen.add(one)
        found.append(Settings(path or "Top level", one, skip))
        for name, field in one.model_fields.items():
            if name in skip:
                continue
            table, _, rest = path.partition("]")
            place = f"{table.strip('[')}.{name}" if table.startswith("[") else name
            stack = [field.annotation]
            while stack:
                annotation = stack.pop()
                if isinstance(annotation, type) and issubclass(annotation, BaseModel):
                    add(annotation, f"[{place}]{rest.strip(']')}")
                stack += get_args(annotation)

    add(model, "")
    if model is settings.StudySettings:
        for kind, instrument in sorted(INSTRUMENTS.items()):
            add(instrument.Settings, f"[instrument], {kind}")
        for kind, space in sorted(SPACES.items()):
            common = frozenset(settings.DesignSettings.model_fields)
            add(space.Settings, f"[design], {kind}", common)
        for family in (settings.SmoothSettings, settings.LinkSettings):
            add(family, f"[model.geometric], {family.__name__.removesuffix('Settings').lower()}")
        add(settings.SeveralSettings, "Several data sets")
    return found


def _nested(annotation: Any) -> tuple[type[BaseModel], str] | None:
    """The settings that a key holds, and whether it is one table, rows of tables or named ones."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, "one"
    origin, args = get_origin(annotation), get_args(annotation)
    kind = {tuple: "rows", dict: "named"}.get(origin)  # type: ignore[call-overload]
    for one in args:
        if isinstance(one, type) and issubclass(one, BaseModel):
            return one, kind or "one"
    return None


def _says(model: type[BaseModel]) -> str:
    return inspect.cleandoc(model.__doc__ or "")


def _key(model: type[BaseModel], name: str, field: FieldInfo) -> Key:
    holds = _holds(field.annotation, field.metadata)
    default = "required" if field.is_required() else _shown(field.default)
    return Key(field.alias or name, holds, default, _meaning(model, name, field))


def _meaning(model: type[BaseModel], name: str, field: FieldInfo) -> str:
    """What stands below the field in the source, of the class that declares it last."""
    for one in model.__mro__:
        if not issubclass(one, BaseModel) or one is BaseModel:
            continue
        said = _attribute_docs(one.__module__).get((one.__qualname__, name))
        if said:
            return "\n".join(said).strip()
    if field.description:
        return field.description
    raise ValueError(
        f"{model.__module__}.{model.__qualname__}.{name}: found no docstring below the field, "
        "expected what the key means; add one"
    )


def _attribute_docs(module: str) -> Mapping[tuple[str, str], list[str]]:
    return ModuleAnalyzer.for_module(module).find_attr_docs()


def _holds(annotation: Any, metadata: list[Any]) -> str:
    """What a value has to be, in words."""
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _holds(args[0], [*_constraints(args[1:]), *metadata])
    if origin in (Union, types.UnionType):
        known = [one for one in args if one is not type(None)]
        return " or ".join(_holds(one, metadata) for one in known)
    if origin is Literal:
        return ("one of " if len(args) > 2 else "") + rst.either(map(_shown_value, args))
    if origin is tuple and args[-1] is Ellipsis:
        return f"list of {_plural(_holds(args[0], []))}"
    if origin is tuple:
        inner = _holds(args[0], [])
        return f"{len(args)} {'rows of ' if inner[0].isdigit() else ''}{_plural(inner)}"
    if origin is dict:
        return f"table of {_plural(_holds(args[1], []))} by name"
    word = {float: "number", int: "whole number", str: "text", bool: "true or false"}
    return word.get(annotation, "value") + _bounds(metadata)


def _constraints(extra: tuple[Any, ...]) -> list[Any]:
    found: list[Any] = []
    for one in extra:
        found += one.metadata if isinstance(one, FieldInfo) else [one]
    return found


def _plural(words: str) -> str:
    for one in ("number", "text", "value"):
        if words.startswith((one, f"whole {one}")):
            return words.replace(one, f"{one}s", 1)
    return words


def _bounds(metadata: list[Any]) -> str:
    limits = {}
    for one in metadata:
        for name in ("ge", "gt", "le", "lt"):
            value = getattr(one, name, None)
            if value == 0 or value is not None and _LEAST <= abs(value) < _MOST:
                limits[name] = f"{value:g}"
    words = {"ge": "at least {}", "gt": "above {}", "le": "at most {}", "lt": "below {}"}
    said = [words[name].format(value) for name, value in limits.items()]
    return f", {' and '.join(said)}" if said else ""


def _shown(value: Any) -> str:
    if value is None or value == {} or isinstance(value, BaseModel):
        return ""
    return f"``{_shown_value(value)}``"


def _shown_value(value: Any) -> str:
    """As it is written in TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple | list):
        return f"[{', '.join(_shown_value(one) for one in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def study_keys() -> str:
    """A section for each table."""
    found = ""
    for one in tables():
        found += rst.heading(one.path, "-", one.label) + rst.text(one.says) + "\n\n"
        rows = [(f"``{k.name}``", k.holds, k.default, rst.text(k.meaning)) for k in one.keys]
        found += rst.table(("key", "holds", "default", "meaning"), rows)
    found += rst.heading("Study files to start from", "-", "study-starts")
    for kind in starts():
        text = (STARTS / kind / "setup.toml").read_text(encoding="utf-8")
        found += rst.heading(kind, "~", f"study-start-{kind}".replace("_", "-"))
        found += f".. code-block:: toml\n\n{indent(text, ' ' * 3)}\n\n"
    return found


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("vcal-study-keys", rst.directive(study_keys))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
