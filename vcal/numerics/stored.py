"""Records as plain values of JSON and back, to the last bit: a machine outlives its measurement.

A record is written with the name of its class and its fields. Records and arrays that occur again
are written once. Only classes of this package are written and read: a file that is read back can
make objects, but run nothing else.
"""

import dataclasses
import importlib
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

_PACKAGE = __name__.partition(".")[0] + "."


class NotStoredError(ValueError):
    """A value that cannot be written or read back; the message names it."""


class Writer:
    """Turns values into plain ones; `records` and `arrays` collect what they refer to."""

    def __init__(self) -> None:
        self.records: list[Any] = []
        self.arrays: list[Any] = []
        self._known: dict[str, int] = {}

    def plain(self, value: Any) -> Any:
        """A value in the types of JSON. Raises `NotStoredError` for a class outside this package,
        and for a value of another kind, such as a function.
        """
        if value is None or isinstance(value, bool | str):
            return value
        if isinstance(value, int | np.integer):
            return int(value)
        if isinstance(value, float | np.floating):
            return float(value) if math.isfinite(value) else {"number": str(float(value))}
        if isinstance(value, tuple):
            items = [self.plain(item) for item in value]
            if type(value) is tuple:
                return items
            made = [self.plain(item) for item in value.__getnewargs__()]  # type: ignore[attr-defined]
            return {"made": _name(type(value)), "from": made}
        if isinstance(value, list):
            return {"list": [self.plain(item) for item in value]}
        if isinstance(value, frozenset):
            return {"set": sorted(self.plain(item) for item in value)}
        if isinstance(value, Mapping):
            return {"map": [[self.plain(k), self.plain(v)] for k, v in value.items()]}
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = {f.name: self.plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
            found = {"class": _name(type(value)), "fields": fields}
            return {"record": self._place(found, self.records)}
        if hasattr(value, "__array__") and not isinstance(value, type):
            array = np.asarray(value)
            if array.dtype.kind not in "biuf":
                raise NotStoredError(f"an array of {array.dtype}")
            data = [self.plain(v) for v in array.ravel().tolist()]
            found = {"type": array.dtype.str, "shape": list(array.shape), "data": data}
            return {"array": self._place(found, self.arrays)}
        raise NotStoredError(f"{type(value).__module__}.{type(value).__qualname__}")

    def _place(self, found: Any, table: list[Any]) -> int:
        key = json.dumps(found, sort_keys=True)
        if key not in self._known:
            self._known[key] = len(table)
            table.append(found)
        return self._known[key]


class Reader:
    """Turns plain values back; `records` and `arrays` are those that a `Writer` has collected."""

    def __init__(self, records: list[Any], arrays: list[Any]) -> None:
        self._records, self._arrays = records, arrays
        self._made: dict[int, Any] = {}
        self._open: set[int] = set()

    def value(self, plain: Any) -> Any:
        """The value that was written. Raises `NotStoredError` for anything that `Writer` does not
        write, for a class that does not exist, and for one whose fields are others now.
        """
        if plain is None or isinstance(plain, bool | int | float | str):
            return plain
        if isinstance(plain, list):
            return tuple(self.value(item) for item in plain)
        try:
            return self._tagged(plain)
        except NotStoredError:
            raise
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise NotStoredError(f"what no version of vcal writes ({error})") from error

    def _tagged(self, plain: Mapping[str, Any]) -> Any:
        kind = next(iter(plain))
        if kind == "number":
            return float(plain[kind])
        if kind == "list":
            return [self.value(item) for item in plain[kind]]
        if kind == "set":
            return frozenset(self.value(item) for item in plain[kind])
        if kind == "map":
            return {self.value(k): self.value(v) for k, v in plain[kind]}
        if kind == "array":
            one = self._arrays[plain[kind]]
            data = [self.value(v) for v in one["data"]]
            return np.array(data, dtype=one["type"]).reshape(one["shape"])
        if kind == "made":
            made = _class(plain[kind])
            if not issubclass(made, tuple):
                raise NotStoredError(f"the class {plain[kind]}, which is no tuple")
            return made(*(self.value(item) for item in plain["from"]))
        if kind == "record":
            return self._record(plain[kind])
        raise NotStoredError(f"a value of the kind {kind!r}")

    def _record(self, place: int) -> Any:
        if place in self._made:
            return self._made[place]
        if place in self._open:
            raise NotStoredError("a record that contains itself")
        self._open.add(place)
        one = self._records[place]
        kind, given = _class(one["class"]), one["fields"]
        if not dataclasses.is_dataclass(kind):
            raise NotStoredError(f"the class {one['class']}, which is no record")
        fields = {f.name for f in dataclasses.fields(kind)}
        if fields != set(given):
            differ = ", ".join(sorted(fields ^ set(given)))
            raise NotStoredError(f"{one['class']} of another version of vcal ({differ})")
        found = object.__new__(kind)
        for name, value in given.items():
            object.__setattr__(found, name, self.value(value))
        self._made[place] = found
        return found


def _name(kind: type) -> str:
    if not kind.__module__.startswith(_PACKAGE):
        raise NotStoredError(f"{kind.__qualname__}, a class outside vcal")
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str) -> type:
    module, _, path = name.partition(":")
    if not module.startswith(_PACKAGE) or "." in path or not path.isidentifier():
        raise NotStoredError(f"{name}, a class outside vcal")
    try:
        found = getattr(importlib.import_module(module), path)
    except (ImportError, AttributeError) as error:
        raise NotStoredError(f"{name}, a class that this version of vcal does not have") from error
    if not isinstance(found, type) or found.__module__ != module:
        raise NotStoredError(f"{name}, which is no class of vcal")
    return found
