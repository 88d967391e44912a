"""Effects of a user's own file, tried once before any work is done with them."""

import inspect
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np

from ..effects.base import Effect, Kind, Setup
from ..effects.data_set import in_setup
from ..errors import StudyError
from ..parameters import Parameter
from ..plan import Plan
from ..units import si_factor
from .messages import listed, refusal

_DO = "mend the class"
_ATTRIBUTES = (
    ("summary", lambda v: isinstance(v, str), "a line of text"),
    ("kind", lambda v: v in get_args(Kind), f"one of {listed(map(repr, get_args(Kind)))}"),
    ("where", lambda v: v in ("machine", "instrument"), "'machine' or 'instrument'"),
    ("odds", lambda v: isinstance(v, int | float) and 0.0 < v < math.inf, "a number above 0"),
)
"""Class attributes: name, what is good, and how messages call that."""
_OF_PARAMETERS = (
    ("name", str, "a name in quotes"),
    ("unit", str, 'a unit in quotes, such as "um/K"'),
    ("sigma", int | float, "a number"),
    ("mean", int | float, "a number"),
    ("scale", int | float, "a number"),
)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.]*")
_RESERVED = ("name", "placement", "component", "data_set", "given", "priors")
"""Keys of a [[model.effect]] row, and fields of every effect."""


def check_own(file: str, classes: Mapping[str, type[Effect]], setup: Setup, plan: Plan) -> None:
    """Every instance that the loop would try, made and asked for its response once.

    Raises `StudyError` that names the class and its method where it fails, or gives something that
    cannot be used: parameters without unit, ports that do not exist, values that are no numbers.
    """
    for kind in classes.values():
        _check(file, kind, setup, plan)


def _check(file: str, kind: type[Effect], setup: Setup, plan: Plan) -> None:
    name = f"class {kind.__name__}"

    def attempt(method: str, expected: str, run: Callable[[], Any]) -> Any:
        try:
            return run()
        except StudyError:
            raise
        except Exception as error:
            found = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
            raise refusal(file, f"{name}, {method}", found, expected, _DO) from error

    def refuse(method: str, found: str, expected: str) -> StudyError:
        return refusal(file, f"{name}, {method}", found, expected, _DO)

    if inspect.isabstract(kind):
        missing = listed(sorted(kind.__abstractmethods__))
        raise refuse("body", f"no {missing}", "parameters and response")
    for attribute, good, expected in _ATTRIBUTES:
        if not good(value := getattr(kind, attribute)):
            raise refuse(attribute, repr(value), expected)
    made = attempt("candidates", "effects, as in `yield cls()`", lambda: in_setup(kind, setup))
    for effect in made:
        if not isinstance(effect, Effect):
            raise refuse("candidates", repr(effect), "effects, as in `yield cls()`")
        parameters = attempt(
            "parameters", "a tuple of vcal.Parameter", lambda e=effect: e.parameters
        )
        _check_parameters(parameters, refuse)
        needs = attempt("needs", "a tuple of names", lambda e=effect: e.needs)
        _check_names("needs", needs, refuse)
        betrayed = attempt("betrayed_by", "a tuple of names", lambda e=effect: e.betrayed_by)
        _check_names("betrayed_by", betrayed, refuse)
        if not plan.has(*needs):
            continue
        grids = attempt("scan", "a dict {shape: values}", lambda e=effect: e.scan(plan))
        if not isinstance(grids, Mapping):
            raise refuse("scan", type(grids).__name__, "a dict {shape: values}")
        shape = {}
        for p in effect.shapes:
            grid = _numbers(grids.get(p.name, ()))
            if grid.ndim != 1 or not len(grid) or not np.isfinite(grid).all():
                raise refuse("scan", f"no numbers for {p.name}", "the values to try, in SI")
            shape[p.name] = float(grid[len(grid) // 2])
        expected = "a dict {(port, parameter): one number per row}"
        response = attempt("response", expected, lambda e=effect, s=shape: e.response(plan, s))
        if not isinstance(response, Mapping):
            raise refuse("response", f"{type(response).__name__}", expected)
        for key, column in response.items():
            _check_column(key, column, effect, setup, plan, refuse)
        if not shape:
            continue
        expected = "a column of the shape (2, rows) where the shape values are columns of two"
        two = {p: np.array([[value], [float(grids[p][-1])]]) for p, value in shape.items()}
        attempt("response", expected, lambda e=effect, s=two: _check_grid(e, plan, s))
        if any(p.moves for p in effect.shapes):
            expected = "jax.numpy, not numpy, and no float() or if, where a shape value comes in"
            attempt("response", expected, lambda e=effect, s=shape: _slopes(e, plan, s))


def _check_grid(effect: Effect, plan: Plan, shape: Mapping[str, np.ndarray]) -> None:
    """Several values of each shape at once, as the loop looks for the best."""
    for column in effect.response(plan, shape).values():
        np.broadcast_to(np.asarray(column, float), (2, plan.rows))


def _slopes(effect: Effect, plan: Plan, shape: Mapping[str, float]) -> None:
    """The derivative by the shape values, as every fit takes it: they are traced."""
    at = {name: jnp.asarray(value) for name, value in shape.items()}
    jax.jvp(lambda s: dict(effect.response(plan, s)), (at,), (jax.tree.map(jnp.ones_like, at),))


def _check_names(method: str, names: Any, refuse: Callable[[str, str, str], StudyError]) -> None:
    if not isinstance(names, tuple | list) or not all(isinstance(name, str) for name in names):
        raise refuse(method, repr(names), 'a tuple of names, as in ("T_x",)')


def _numbers(values: Any) -> np.ndarray:
    """The values as numbers; none where they are something else."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        return np.zeros(0)


def _check_parameters(parameters: Any, refuse: Callable[[str, str, str], StudyError]) -> None:
    expected = "a tuple of vcal.Parameter, each with a name of its own"
    if not isinstance(parameters, tuple) or not all(isinstance(p, Parameter) for p in parameters):
        raise refuse("parameters", repr(parameters), expected)
    for p in parameters:
        for attribute, kinds, what in _OF_PARAMETERS:
            value = getattr(p, attribute)
            if not isinstance(value, kinds) or isinstance(value, bool):
                raise refuse("parameters", f"{attribute} = {value!r} of {p.name!r}", what)
        if not _NAME.fullmatch(p.name) or p.name in _RESERVED:
            raise refuse(
                "parameters",
                f"the name {p.name!r}",
                f"letters, digits, . and _, a letter first, and none of {listed(_RESERVED)}",
            )
    names = [p.name for p in parameters]
    if not parameters or len(set(names)) < len(names):
        raise refuse("parameters", listed(names), expected)
    for p in parameters:
        try:
            si_factor(p.unit)
        except ValueError as error:
            raise refuse("parameters", f"{p.name}: {error}", 'a unit such as "um/K"') from error
        if not p.sigma >= 0.0 or not math.isfinite(p.mean):
            found = f"{p.name} with mean {p.mean:g} and sigma {p.sigma:g}"
            raise refuse("parameters", found, "a finite mean and a sigma of at least 0")


def _check_column(
    key: Any,
    column: Any,
    effect: Effect,
    setup: Setup,
    plan: Plan,
    refuse: Callable[[str, str, str], StudyError],
) -> None:
    amplitudes = [p.name for p in effect.amplitudes]
    if not (isinstance(key, tuple) and len(key) == 2):
        raise refuse("response", f"the key {key!r}", "(port, parameter)")
    port, name = key
    if port not in setup.layout:
        raise refuse("response", f"the port {port!r}", f"one of {listed(setup.layout.names, 60)}")
    if name not in amplitudes:
        raise refuse("response", f"the parameter {name!r}", f"one of {listed(amplitudes)}")
    try:
        values = np.broadcast_to(np.asarray(column, float), (plan.rows,))
    except (TypeError, ValueError) as error:
        found = f"{error} for {key!r}"
        raise refuse("response", found, f"one number for each of the {plan.rows} rows") from error
    if not np.isfinite(values).all():
        row = int(np.argmin(np.isfinite(values)))
        found = f"{values[row]} for {key!r} in row {row + 1}"
        raise refuse("response", found, "finite numbers")
