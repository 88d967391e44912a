"""jit for outermost functions, with compiler options that cut compile time by a third.

Only an outermost function, one that no other compiled function calls, may have compiler options.
"""

import functools
import os
from collections.abc import Callable, Mapping
from typing import Literal, ParamSpec, TypeVar

import equinox as eqx
import jax

_P = ParamSpec("_P")
_T = TypeVar("_T")

_Options = dict[str, bool | int | str]

_OPTIONS: _Options = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
"""Fits run as fast with these options. Campaigns of a tracker take up to a fifth longer, campaigns
of a ball array a third of the time. No optimisation at all (level 0) would cut compile time by a
further third, but short loops over rows take up to half as long again."""


def known_options(options: Mapping[str, bool | int | str]) -> _Options:
    """The options that this release of the compiler accepts.

    They are not part of a stable interface, and only the run time may depend on them (jax 0.12 has
    no `xla_cpu_use_fusion_emitters`).
    """
    if _accepted(options):
        return dict(options)
    return {name: value for name, value in options.items() if _accepted({name: value})}


def _accepted(options: Mapping[str, bool | int | str]) -> bool:
    """Whether the compiler takes all of these options, by a program that does nothing."""
    try:
        jax.jit(lambda x: x, compiler_options=dict(options)).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


_BRIEF: _Options = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
"""Compiles in two thirds of the time again, for programs that run for less time than they take to
compile."""

_VECTORISED: _Options = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_prefer_vector_width": 512,
}
"""Compiles random numbers and a formula in two thirds of the time, and computes them in two thirds
on a processor with vectors of 512 bits, of which the compiler would use half. The lower level of
optimisation would compute them three times slower, one number after the other.
"""


@functools.cache
def _options(kind: Literal["usual", "brief", "vectorised"] = "usual") -> _Options:
    """The accepted options, with the values that the user has set in XLA_FLAGS; none on an
    accelerator, which has its own compiler.
    """
    if jax.default_backend() != "cpu":
        return {}
    flags = (flag.partition("=") for flag in os.environ.get("XLA_FLAGS", "").split())
    given = {name.removeprefix("--"): value for name, _, value in flags if value}
    wanted = {"usual": _OPTIONS, "brief": _BRIEF, "vectorised": _VECTORISED}[kind]
    return known_options({name: given.get(name, value) for name, value in wanted.items()})


def jit_outermost(function: Callable[_P, _T], *, brief: bool = False) -> Callable[_P, _T]:
    """`jax.jit` with these options, for a function that no compiled function calls.

    A `brief` program runs for less time than it takes to compile. The result raises `ValueError`
    where it is called inside another compiled function.
    """
    options = _options("brief" if brief else "usual")
    return jax.jit(function, compiler_options=options)  # type: ignore[return-value]


def jit_vectorised(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """The same for a formula of many numbers, of which the compiler is to compute several at
    once.
    """
    return jax.jit(function, compiler_options=_options("vectorised"))  # type: ignore[return-value]


def filter_jit_outermost(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """`equinox.filter_jit` with these options, as a decorator; compiles nothing before the first
    call.
    """

    @functools.cache
    def program() -> Callable[_P, _T]:
        return eqx.filter_jit(function, compiler_options=_options())  # type: ignore[call-overload]

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return program()(*args, **kwargs)

    return call
