"""Compiled programs that no other one contains, compiled in two thirds of the time."""

import functools
from collections.abc import Callable, Mapping
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax

_P = ParamSpec("_P")
_T = TypeVar("_T")

_Options = dict[str, bool | int | str]

_OPTIONS: _Options = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
"""Fits run as fast with these; campaigns of a tracker take up to a fifth longer, those of a ball
array a third of the time. Without any optimisation (0) compilation takes a third less still, but
short loops over rows up to half as long again."""


def known_options(options: Mapping[str, bool | int | str]) -> _Options:
    """Those of the options that this release of the compiler knows: nobody promised them, and
    nothing but time may depend on them (jax 0.12 has no `xla_cpu_use_fusion_emitters`).
    """
    known = {}
    for name, value in options.items():
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        except jax.errors.JaxRuntimeError:
            continue
        known[name] = value
    return known


@functools.cache
def _options() -> _Options:
    """None on an accelerator, which has a compiler of its own."""
    return known_options(_OPTIONS) if jax.default_backend() == "cpu" else {}


def jit_outermost(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """`jax.jit` of what is called from outside of other compiled programs only; inside of one it
    raises `ValueError`.
    """
    return jax.jit(function, compiler_options=_options())  # type: ignore[return-value]


def filter_jit_outermost(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """The same of `equinox.filter_jit`, to decorate with; compiles nothing before a first call."""

    @functools.cache
    def program() -> Callable[_P, _T]:
        return eqx.filter_jit(function, compiler_options=_options())  # type: ignore[call-overload]

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return program()(*args, **kwargs)

    return call
