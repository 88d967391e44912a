"""Programs that are compiled for a few runs: compiled in half the time, and no slower."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax

_P = ParamSpec("_P")
_T = TypeVar("_T")

_OPTIONS: dict[str, bool | int | str] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
}
"""What is linear algebra of LAPACK and short loops over the rows gains nothing from more. Without
any optimisation (0) compilation takes a third less still, but the loops twice as long."""


@functools.cache
def _options() -> dict[str, bool | int | str]:
    """Those of the options that this release of the compiler knows: they are no promise of its, and
    nothing but time depends on them.
    """
    known = {}
    for name, value in _OPTIONS.items():
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        except jax.errors.JaxRuntimeError:
            continue
        known[name] = value
    return known


def compiled_soon(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """`equinox.filter_jit` for what is called from outside of other compiled programs, a few times
    for each compilation. Raises `ValueError` inside another one.
    """

    @functools.cache
    def program() -> Callable[_P, _T]:
        return eqx.filter_jit(function, compiler_options=_options())  # type: ignore[call-overload]

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return program()(*args, **kwargs)

    return call
