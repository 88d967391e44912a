"""Compiled campaigns that are shared by models which differ in numbers only.

A program in which everything but the draw is a constant runs fastest and compiles for seconds. A
sweep over many designs repeats one structure. With the numbers as arguments, it is compiled once
per structure.
"""

import hashlib
import threading
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..effects.base import Effect
from ..numerics.compiled import jit_outermost


class Programs:
    """Compiled programs by the structure of their content; equal structures share a program.

    Several threads may use them. `brief` programs compile in two thirds of the time and run more
    slowly: for campaigns of a few thousand draws.
    """

    def __init__(self, *, brief: bool = False) -> None:
        self.brief = brief
        self._kept: dict[Hashable, Callable[..., Any]] = {}
        self._kept_by_one = threading.Lock()

    @property
    def count(self) -> int:
        """Number of programs. Not `__len__`, as an empty object would then be false."""
        return len(self._kept)

    def of(
        self,
        function: Callable[..., Any],
        content: Any,
        name: Hashable,
        over: Callable[[Callable[..., Any]], Callable[..., Any]],
    ) -> Callable[..., Any]:
        """`function(content, key, index)` compiled as a function of key and many indices.

        `content` is any tree. Its arrays are arguments of the program. Everything else, including
        the effects, has to be equal for two contents to share a program. `name` identifies all
        other dependencies of `function`. `over(f)` turns a function of one index into one of many.
        """
        numbers, rest = eqx.partition(content, _is_number, is_leaf=_is_effect)
        numbers = jax.tree.map(jnp.asarray, numbers)
        key = name, jax.tree.structure(numbers), _shapes(numbers), _digest(rest)

        def program(numbers: Any, seed: Any, index: Any) -> Any:
            whole = eqx.combine(numbers, rest, is_leaf=_is_effect)
            return over(lambda i: function(whole, seed, i))(index)

        with self._kept_by_one:
            kept = self._kept.setdefault(key, jit_outermost(program, brief=self.brief))
        return lambda seed, index: kept(numbers, seed, index)


def _is_effect(leaf: Any) -> bool:
    return isinstance(leaf, Effect)


def _is_number(leaf: Any) -> bool:
    # An effect computes with plain numbers, so that it is a constant even if it holds arrays.
    return not _is_effect(leaf) and isinstance(leaf, jax.Array | np.ndarray)


def _shapes(tree: Any) -> tuple[Hashable, ...]:
    return tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(tree))


def _digest(tree: Any) -> str:
    found = hashlib.sha256(str(jax.tree.structure(tree)).encode())
    for leaf in jax.tree.leaves(tree):
        found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()
