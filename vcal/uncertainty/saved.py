"""Budgets in JSON files, with every number as it was."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StudyError
from .budget import Budget, Source
from .taylor import Taylor

SCHEMA = Path(__file__).with_name("budget.schema.json")
"""JSON schema of the files."""

_KIND = "vcal uncertainty budget"
_VERSION = 1
_DERIVATIVES = ("a", "H", "T", "t", "skewness", "excess")
_TOLERANCE = 1e-9
"""Relative difference at which a u is not that of the rest of the file."""


def save_budget(budget: Budget, path: Path | str) -> None:
    """Write a budget to a JSON file, the same bytes for the same budget.

    The file has the keys of `vcal/uncertainty/budget.schema.json`, among them ``schema`` with its
    version. Numbers have all their digits; infinite ones are the text ``"inf"``.
    """
    content = json.dumps(_written(budget), indent=1, ensure_ascii=False, allow_nan=False)
    Path(path).write_text(content + "\n", encoding="utf-8")


def load_budget(path: Path | str) -> Budget:
    """A budget that `save_budget` wrote, equal to it in every number.

    The standard uncertainties are computed again from sensitivities and inputs. Raises
    `StudyError` for a file that cannot be read or is no budget, another version, a key that is
    missing or of another shape, and where an uncertainty is not that of the rest of the file.
    """
    file = Path(path)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise StudyError(f"{file}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise StudyError(
            f"{file}: found no JSON ({error}), expected a budget that save_budget wrote"
        ) from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if not isinstance(schema, dict) or schema.get("name") != _KIND:
        raise StudyError(
            f"{file}: schema: found {schema!r}, expected the name {_KIND!r}; is this a budget that "
            "save_budget wrote?"
        )
    if schema.get("version") != _VERSION:
        raise StudyError(
            f"{file}: schema: found version {schema.get('version')!r}, expected {_VERSION}; read "
            "it with the version of vcal that wrote it"
        )
    return _read(_Keys(file, content))


def _written(budget: Budget) -> dict[str, Any]:
    source, taylor = budget.source, budget.taylor
    return {
        "schema": {"name": _KIND, "version": _VERSION},
        "outputs": list(budget.labels),
        "value": _plain(budget.value),
        "u": _plain(budget.u),
        "nu_eff": _plain(budget.nu_eff),
        "coverage": budget.coverage,
        "order": budget.order,
        "stated_k": budget.stated_k,
        "stated_dof": budget.stated_dof,
        "notes": list(budget.notes),
        "inputs": {
            "labels": list(source.labels),
            "distributions": list(source.distributions),
            "value": _plain(source.value),
            "covariance": _plain(source.covariance),
            "dof": _plain(source.dof),
            "groups": [list(group) for group in source.groups],
        },
        "sensitivity": _plain(budget.sensitivity),
        "taylor": {name: _plain(getattr(taylor, name)) for name in _DERIVATIVES},
    }


def _plain(array: np.ndarray) -> Any:
    """Nested lists of numbers, of which infinite ones are text."""
    return _texts(np.asarray(array, float).tolist())


def _texts(value: Any) -> Any:
    if isinstance(value, list):
        return [_texts(one) for one in value]
    return value if math.isfinite(value) else str(value)


class _Keys:
    """The keys of a part of the file, checked as they are read."""

    def __init__(self, file: Path, content: Any, where: str = ""):
        if not isinstance(content, dict):
            raise StudyError(f"{file}: {where}: found {type(content).__name__}, expected an object")
        self.file, self.content, self.where = file, content, where

    def key(self, name: str) -> Any:
        if name not in self.content:
            raise StudyError(
                f"{self.file}: {self.where}{name} is missing, as save_budget writes it"
            )
        return self.content[name]

    def part(self, name: str) -> "_Keys":
        return _Keys(self.file, self.key(name), f"{self.where}{name}.")

    def fail(self, name: str, found: str, expected: str) -> StudyError:
        return StudyError(f"{self.file}: {self.where}{name}: found {found}, expected {expected}")

    def numbers(self, name: str, *shape: int | None) -> np.ndarray:
        content = self.key(name)
        try:
            found = np.array(content, float)
        except (TypeError, ValueError):
            raise self.fail(name, "something other than numbers", "numbers") from None
        if found.size == 0:
            found = found.reshape([n or 0 for n in shape])
        if found.ndim != len(shape) or any(
            n is not None and n != size for n, size in zip(shape, found.shape, strict=True)
        ):
            raise self.fail(name, f"shape {found.shape}", f"{tuple(shape)}")
        return found

    def texts(self, name: str) -> tuple[str, ...]:
        found = self.key(name)
        if not isinstance(found, list) or not all(isinstance(one, str) for one in found):
            raise self.fail(name, repr(found), "a list of texts")
        return tuple(found)

    def number(self, name: str) -> float:
        found = self.key(name)
        if isinstance(found, bool) or not isinstance(found, int | float):
            raise self.fail(name, repr(found), "a number")
        return found


def _read(keys: _Keys) -> Budget:
    labels = keys.texts("outputs")
    m = len(labels)
    source = _source(keys.part("inputs"))
    k = len(source.labels)
    derivatives = keys.part("taylor")
    a = derivatives.numbers("a", m, None)
    r = a.shape[1]
    order = keys.number("order")
    curved = r if order == 2 else 0
    taylor = Taylor(
        a,
        derivatives.numbers("H", m, curved, curved),
        derivatives.numbers("T", m, r),
        derivatives.numbers("t", m, r),
        derivatives.numbers("skewness", r),
        derivatives.numbers("excess", r),
    )
    stated = keys.key("stated_k")
    budget = Budget(
        labels=labels,
        value=keys.numbers("value", m),
        u=keys.numbers("u", m),
        nu_eff=keys.numbers("nu_eff", m),
        coverage=keys.number("coverage"),
        order=int(order),
        source=source,
        sensitivity=keys.numbers("sensitivity", m, k),
        taylor=taylor,
        notes=keys.texts("notes"),
        stated_k=None if stated is None else keys.number("stated_k"),
        stated_dof=bool(keys.key("stated_dof")),
    )
    _check(budget, keys)
    return budget


def _source(keys: _Keys) -> Source:
    labels, kinds = keys.texts("labels"), keys.texts("distributions")
    k = len(labels)
    if len(kinds) != k:
        raise keys.fail("distributions", f"{len(kinds)} names", f"{k}, one for every label")
    groups = keys.key("groups")
    if not isinstance(groups, list) or not all(
        isinstance(group, list) and all(isinstance(i, int) and 0 <= i < k for i in group)
        for group in groups
    ):
        raise keys.fail("groups", repr(groups), f"lists of indices from 0 to {k - 1}")
    return Source(
        labels,
        kinds,
        keys.numbers("value", k),
        keys.numbers("covariance", k, k),
        keys.numbers("dof", k),
        tuple(tuple(group) for group in groups),
    )


def _check(budget: Budget, keys: _Keys) -> None:
    """Raise `StudyError` where u is not what sensitivities, inputs and derivatives give."""
    c, s = budget.sensitivity, budget.source.covariance
    linear = np.maximum(((c @ s) * c).sum(1), 0.0)
    for name, found, expected in (
        ("u", budget.u, np.sqrt(np.maximum(budget.taylor.variance, 0.0))),
        ("sensitivity", np.sqrt(linear), np.sqrt(budget.taylor.linear)),
    ):
        apart = np.abs(found - expected) > _TOLERANCE * np.maximum(budget.u, expected)
        for i in np.flatnonzero(apart)[:1]:
            raise StudyError(
                f"{keys.file}: {name} of {budget.labels[i]!r} gives a standard uncertainty of "
                f"{found[i]:.10g}, the rest of the file {expected[i]:.10g}; the file was changed"
            )
