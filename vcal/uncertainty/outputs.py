"""Declarations of the results of one draw of a Monte Carlo campaign: scalar outputs and fields."""

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..numerics.arrays import Array


@dataclass(frozen=True)
class Output:
    """A scalar output, or a small array whose elements are scalar outputs.

    Scalar outputs are described jointly: values of every draw, their covariance matrix, coverage
    intervals and regions.
    """

    name: str
    shape: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    """Names of its scalars; by default the name of the output and the index in its array."""

    def __post_init__(self) -> None:
        if self.names and len(self.names) != math.prod(self.shape):
            raise ValueError(
                f"names of output {self.name!r}: found {len(self.names)}, expected "
                f"{math.prod(self.shape)}, one per element"
            )

    @functools.cached_property
    def labels(self) -> tuple[str, ...]:
        """Name of every scalar: ``"V"``; ``"phi[0]"``, ``"phi[1]"``, counted from zero."""
        if self.names:
            return self.names
        if not self.shape:
            return (self.name,)
        places = itertools.product(*(range(n) for n in self.shape))
        return tuple(f"{self.name}[{', '.join(map(str, place))}]" for place in places)


@dataclass(frozen=True)
class Field:
    """An array of any size per draw, described element by element.

    Kept are mean, variance and range of every element, and the requested quantiles; neither single
    values nor covariances between elements.
    """

    name: str
    shape: tuple[int, ...]
    quantiles: tuple[float, ...] = ()
    """Probabilities, each above 0 and below 1."""

    def __post_init__(self) -> None:
        wrong = [q for q in self.quantiles if not 0.0 < q < 1.0]
        if wrong:
            raise ValueError(
                f"quantiles of field {self.name!r}: found {wrong[0]}, expected probabilities above "
                "0 and below 1"
            )

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


def check_declared(outputs: Sequence[Output], fields: Sequence[Field]) -> None:
    """Raise `ValueError` where nothing is declared or a name is declared twice."""
    names = [o.name for o in (*outputs, *fields)]
    if not names:
        raise ValueError("found no outputs and no fields, expected at least one")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"output {twice[0]!r} is declared twice; give each its own name")


def labels_of(outputs: Sequence[Output]) -> tuple[str, ...]:
    """Labels of all scalar outputs, in order."""
    return tuple(label for output in outputs for label in output.labels)


def check_names(
    values: Mapping[str, Array], outputs: Sequence[Output], fields: Sequence[Field]
) -> None:
    """Raise `ValueError` unless the values are those of the declared outputs."""
    expected = {o.name for o in (*outputs, *fields)}
    if set(values) != expected:
        raise ValueError(
            f"evaluate gave the outputs {sorted(values)}, expected {sorted(expected)} as declared"
        )


def scalar_rows(
    values: Mapping[str, Array], outputs: Sequence[Output], count: int
) -> Float[np.ndarray, "count k"]:
    """All scalar outputs of a block of draws as a matrix, one column each.

    Raises `ValueError` for an array of another shape or precision than declared.
    """
    size = sum(len(output.labels) for output in outputs)
    rows, start = np.empty((count, size)), 0
    for output in outputs:
        width = len(output.labels)
        rows[:, start : start + width] = _rows(output.name, output.shape, values, count)
        start += width
    return rows


def field_rows(
    values: Mapping[str, Array], field: Field, count: int
) -> Float[np.ndarray, "count size"]:
    """A field of a block of draws, one row per draw; raises as `scalar_rows` does."""
    return _rows(field.name, field.shape, values, count)


def _rows(
    name: str, shape: tuple[int, ...], values: Mapping[str, Array], count: int
) -> Float[np.ndarray, "count size"]:
    found = np.asarray(values[name])
    if found.shape != (count, *shape):
        raise ValueError(
            f"output {name!r}: evaluate gave an array of shape {found.shape}, expected "
            f"{(count, *shape)}: {count} draws, each of shape {shape}"
        )
    if found.dtype == np.float32:
        raise ValueError(
            f"output {name!r}: found float32, expected float64; call vcal.enable_float64() first"
        )
    return found.reshape(count, -1).astype(float, copy=False)
