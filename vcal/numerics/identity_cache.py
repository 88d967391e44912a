"""Results that are asked for again and again of the very same objects."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class IdentityCache(Generic[T]):
    """The last few results, each by the objects it was made of: by identity, as arrays and what
    holds them cannot be hashed, a text by its letters. They must not be changed afterwards; nor
    may a result.
    """

    def __init__(self, most: int):
        self._most = most
        self._found: OrderedDict[tuple[int | str, ...], tuple[tuple[object, ...], T]] = (
            OrderedDict()
        )

    def of(self, objects: tuple[object, ...], make: Callable[[], T]) -> T:
        """What was made of these objects before, or is made now."""
        key = tuple(it if isinstance(it, str) else id(it) for it in objects)
        known = self._found.get(key)
        # The objects are kept beside the result, so that no other one gets their identity.
        made = make() if known is None else known[1]
        self._found[key] = objects, made
        self._found.move_to_end(key)
        if len(self._found) > self._most:
            self._found.popitem(last=False)
        return made
