"""A cache of results by the identity of the objects that they were computed from."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class IdentityCache(Generic[T]):
    """The last `most` results, each found by the objects that it was computed from.

    Objects are compared by identity, because arrays and their containers cannot be hashed; texts
    are compared by value. Neither the objects nor a result may be changed afterwards.
    """

    def __init__(self, most: int):
        self._most = most
        self._found: OrderedDict[tuple[int | str, ...], tuple[tuple[object, ...], T]] = (
            OrderedDict()
        )

    def of(self, objects: tuple[object, ...], make: Callable[[], T]) -> T:
        """The result kept for these objects, or the one that `make` computes now."""
        key = tuple(it if isinstance(it, str) else id(it) for it in objects)
        known = self._found.get(key)
        # The objects are kept with the result, so that no other object gets their identity.
        made = make() if known is None else known[1]
        self._found[key] = objects, made
        self._found.move_to_end(key)
        if len(self._found) > self._most:
            self._found.popitem(last=False)
        return made
