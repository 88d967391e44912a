"""Compiled campaigns, for others whose models differ in numbers only.

Where everything but the draw is a constant, the compiler has most to work with, and compiles for
seconds. A sweep over many designs has the same structure again and again: with the numbers as
arguments it is compiled once per structure.
"""

import hashlib
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..effects.base import Effect
from ..numerics.compiled import jit_outermost


class Programs:
    """Programs by the structure of what they take; those of equal structure are the same one."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, Callable[..., Any]] = {}

    @property
    def count(self) -> int:
        """How many there are. Not a length, with which an empty one would be taken for none."""
        return len(self._kept)

    def of(
        self,
        function: Callable[..., Any],
        content: Any,
        name: Hashable,
        over: Callable[[Callable[..., Any]], Callable[..., Any]],
    ) -> Callable[..., Any]:
        """`function(content, key, index)` compiled as a function of key and many indices.

        `content` is any tree; its arrays are arguments of the program, all else - the effects in it
        among that - has to be equal for two contents to share one. `name` stands for everything
        that `function` depends on beside. `over(f)` makes a function of many indices of one of one.
        """
        numbers, rest = eqx.partition(content, _is_number, is_leaf=_is_effect)
        numbers = jax.tree.map(jnp.asarray, numbers)
        key = name, jax.tree.structure(numbers), _shapes(numbers), _digest(rest)
        if key not in self._kept:

            def program(numbers: Any, seed: Any, index: Any) -> Any:
                whole = eqx.combine(numbers, rest, is_leaf=_is_effect)
                return over(lambda i: function(whole, seed, i))(index)

            self._kept[key] = jit_outermost(program)
        kept = self._kept[key]
        return lambda seed, index: kept(numbers, seed, index)


def _is_effect(leaf: Any) -> bool:
    return isinstance(leaf, Effect)


def _is_number(leaf: Any) -> bool:
    # An effect works with plain numbers: it is a constant, whatever arrays it holds.
    return not _is_effect(leaf) and isinstance(leaf, jax.Array | np.ndarray)


def _shapes(tree: Any) -> tuple[Hashable, ...]:
    return tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(tree))


def _digest(tree: Any) -> str:
    found = hashlib.sha256(str(jax.tree.structure(tree)).encode())
    for leaf in jax.tree.leaves(tree):
        found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()
