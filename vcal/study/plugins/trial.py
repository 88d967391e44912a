"""The trial of a user's own class: each method is called once, and failures become messages."""

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ...errors import StudyError
from ...machine.plan import Plan
from ...registry import in_own_words, own_place
from ..messages import refusal

_DO = "correct the class"
Attribute = tuple[str, Callable[[Any], bool], str]
"""A class attribute: its name, a test of its value, and the expected value in words."""


@dataclass(frozen=True)
class Trial:
    """A class of a user's file during the trial of its methods."""

    file: str
    """Name of the file in the study."""
    kind: str
    """Name of the class."""

    def refusal(self, method: str, found: str, expected: str) -> StudyError:
        """The error to raise for a wrong result of a method."""
        found = " ".join(found.split())  # in one line
        return refusal(self.file, f"class {self.kind}, {method}", found, expected, _DO)

    @contextmanager
    def calling(self, method: str, expected: str) -> Iterator[None]:
        """Report any exception in this block, other than a `StudyError`, as a mistake of `method`.

        That includes ``exit()``, which would end vcal without a message, but not Ctrl-C.
        """
        try:
            yield
        except (StudyError, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise self.refusal(method, in_own_words(error), expected) from error

    def check_attributes(self, kind: type, attributes: Sequence[Attribute]) -> None:
        """Raise `StudyError` for a class attribute with a wrong value."""
        for name, good, expected in attributes:
            if not good(value := getattr(kind, name, None)):
                raise self.refusal(name, repr(value), expected)

    def numbers(self, method: str, values: Any, shape: Sequence[int], what: str) -> np.ndarray:
        """The values as finite numbers of a shape; `what` describes them in messages."""
        found = self.array(method, values, shape, what)
        if found.dtype.kind == "c":
            raise self.refusal(method, f"an array of {found.dtype}", what)
        try:
            found = found.astype(float)
        except (TypeError, ValueError) as error:
            raise self.refusal(method, f"{found.dtype} ({error})", what) from error
        if not np.isfinite(found).all():
            place = np.argwhere(~np.isfinite(found))[0]
            raise self.refusal(method, f"{found[tuple(place)]} in row {place[0] + 1}", what)
        return found

    def array(self, method: str, values: Any, shape: Sequence[int], what: str) -> np.ndarray:
        """The values as an array of a shape; `what` describes them in messages."""
        try:
            found = np.asarray(values)
        except (TypeError, ValueError) as error:
            raise self.refusal(method, f"a value that is no array ({error})", what) from error
        if found.shape != tuple(shape):
            given = f"shape {found.shape}" if found.shape else f"{values!r}"
            raise self.refusal(method, given, f"{what}, an array of the shape {tuple(shape)}")
        if not isinstance(values, np.ndarray | jax.Array):
            found = f"a {type(values).__name__}"
            raise self.refusal(method, found, f"{what}, an array of numpy")
        return found


def shown(value: Any) -> str:
    """A value in words; for a method, that it lacks ``@property``."""
    return "a method without @property" if inspect.ismethod(value) else repr(value)


def read_only(plan: Plan) -> Plan:
    """A read-only copy of the plan, so that a method that writes into it fails."""

    def locked(values: Any) -> Any:
        if isinstance(values, np.ndarray):
            values = values.view()
            values.flags.writeable = False
        return values

    return jax.tree.map(locked, plan)


def own_code_error(error: BaseException) -> str | None:
    """The message for an error raised in a user's own file; None for any other error."""
    place = own_place(error)
    if place is None:
        return None
    file, _, method = place
    return str(refusal(file, method, in_own_words(error), "code that runs", _DO))
