"""Effects of a user's own file: the trial of their methods."""

import inspect
import math
import re
from collections.abc import Mapping
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np

from ...effects.base import Effect, Kind, Setup
from ...effects.data_set import in_setup
from ...errors import StudyError
from ...loop.screening.unconverted import as_in_file
from ...machine.parameters import Parameter
from ...machine.plan import Plan
from ..messages import listed
from .trial import Attribute, Trial, read_only

ATTRIBUTES: tuple[Attribute, ...] = (
    ("summary", lambda v: isinstance(v, str), "a line of text"),
    ("kind", lambda v: v in get_args(Kind), f"one of {listed(map(repr, get_args(Kind)))}"),
    ("where", lambda v: v in ("machine", "instrument"), "'machine' or 'instrument'"),
    ("odds", lambda v: isinstance(v, int | float) and 0.0 < v < math.inf, "a number above 0"),
)
_OF_PARAMETERS = (
    ("name", str, "a name in quotes"),
    ("unit", str, 'a unit in quotes, such as "um/K"'),
    ("sigma", int | float, "a number"),
    ("mean", int | float, "a number"),
    ("scale", int | float, "a number"),
)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.]*")
_PLACEMENT = re.compile(r"(?! )[^:=]{0,60}(?<! )")
"""Placements that can be written in ``--with NAME:PLACEMENT:KEY=VALUE`` and in a table."""
_RESERVED = ("name", "placement", "component", "data_set", "given", "priors")
"""Keys of a [[model.effect]] row, and fields of every effect."""


def check_own(file: str, classes: Mapping[str, type[Effect]], setup: Setup, plan: Plan) -> None:
    """Create every instance that the loop would test, and call its methods once.

    Raises `StudyError` with the class and the method where one fails or returns a wrong value, such
    as parameters without a unit, ports that do not exist, or values that are no numbers.
    """
    for kind in classes.values():
        _check(Trial(file, kind.__name__), kind, setup, read_only(plan))


def _check(trial: Trial, kind: type[Effect], setup: Setup, plan: Plan) -> None:
    if inspect.isabstract(kind):
        missing = listed(sorted(kind.__abstractmethods__))
        raise trial.refusal("body", f"no {missing}", "parameters and response")
    trial.check_attributes(kind, ATTRIBUTES)
    with trial.calling("candidates", "effects, as in `yield cls()`"):
        made = in_setup(kind, setup)
    for effect in made:
        if not isinstance(effect, Effect):
            raise trial.refusal("candidates", repr(effect), "effects, as in `yield cls()`")
        check_effect(trial, effect, setup, plan)


def check_effect(trial: Trial, effect: Effect, setup: Setup, plan: Plan) -> None:
    """Call the methods of an effect once; raises `StudyError` as `check_own` does."""
    with trial.calling("parameters", "a tuple of vcal.Parameter"):
        try:
            parameters = effect.parameters
        except StudyError as error:
            said = str(error).removesuffix("; correct the unit")
            raise trial.refusal("parameters", said, 'a unit such as "um/K"') from error
    _check_parameters(parameters, trial, effect.kind)
    _check_placement(effect.placement, trial)
    with trial.calling("needs", "a tuple of names"):
        needs = effect.needs
    _check_names("needs", needs, trial)
    with trial.calling("indicators", "a tuple of names"):
        indicators = effect.indicators
    _check_names("indicators", indicators, trial)
    if not plan.has(*needs):
        return
    with trial.calling("scan", "a dict {shape: values}"):
        grids = effect.scan(plan)
    if not isinstance(grids, Mapping):
        raise trial.refusal("scan", type(grids).__name__, "a dict {shape: values}")
    shape = {}
    for p in effect.shapes:
        grid = _numbers(grids.get(p.name, ()))
        if grid.ndim != 1 or not len(grid) or not np.isfinite(grid).all():
            raise trial.refusal("scan", f"no numbers for {p.name}", "the values to try, in SI")
        shape[p.name] = float(grid[len(grid) // 2])
    expected = "a dict {(port, parameter): one number per row}"
    with trial.calling("response", expected):
        response = effect.response(plan, shape)
    if not isinstance(response, Mapping):
        raise trial.refusal("response", f"{type(response).__name__}", expected)
    for key, column in response.items():
        _check_column(key, column, effect, setup, plan, trial)
    for column in as_in_file(effect, plan, shape):
        raise trial.refusal(
            "response",
            f"the numbers of the column {column.name} in {column.unit}, as in the file, for "
            f"{column.label}",
            f"{column.factor:g} times these numbers, as the response is per unit in SI",
        )
    if not shape:
        return
    expected = "an array of the shape (2, rows) for shape values of the shape (2, 1)"
    two = {p: np.array([[value], [float(grids[p][-1])]]) for p, value in shape.items()}
    with trial.calling("response", expected):
        _check_grid(effect, plan, two)
    if any(p.moves for p in effect.shapes):
        expected = "jax.numpy, not numpy, and no float() or if, where a shape value is used"
        with trial.calling("response", expected):
            _slopes(effect, plan, shape)


def _check_grid(effect: Effect, plan: Plan, shape: Mapping[str, np.ndarray]) -> None:
    """Evaluate several values of each shape at once, as the grid search of the loop does."""
    for column in effect.response(plan, shape).values():
        np.broadcast_to(np.asarray(column, float), (2, plan.rows))


def _slopes(effect: Effect, plan: Plan, shape: Mapping[str, float]) -> None:
    """Differentiate by the shape values, as every fit does; JAX traces them."""
    at = {name: jnp.asarray(value) for name, value in shape.items()}
    jax.jvp(lambda s: dict(effect.response(plan, s)), (at,), (jax.tree.map(jnp.ones_like, at),))


def _check_placement(placement: Any, trial: Trial) -> None:
    good = isinstance(placement, str) and placement.isprintable()
    if not good or not _PLACEMENT.fullmatch(placement):
        expected = "a line of at most 60 characters without : and =, and no blank at either end"
        raise trial.refusal("candidates", f"the placement {placement!r}", expected)


def _check_names(method: str, names: Any, trial: Trial) -> None:
    if not isinstance(names, tuple | list) or not all(isinstance(name, str) for name in names):
        raise trial.refusal(method, repr(names), 'a tuple of names, as in ("T_x",)')


def _numbers(values: Any) -> np.ndarray:
    """The values as numbers; an empty array where they are not."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        return np.zeros(0)


def _check_parameters(parameters: Any, trial: Trial, kind: Kind) -> None:
    expected = "a tuple of vcal.Parameter, each with a name of its own"
    if not isinstance(parameters, tuple) or not all(isinstance(p, Parameter) for p in parameters):
        raise trial.refusal("parameters", repr(parameters), expected)
    for p in parameters:
        for attribute, kinds, what in _OF_PARAMETERS:
            value = getattr(p, attribute)
            if not isinstance(value, kinds) or isinstance(value, bool):
                raise trial.refusal("parameters", f"{attribute} = {value!r} of {p.name!r}", what)
        if not _NAME.fullmatch(p.name) or p.name in _RESERVED:
            raise trial.refusal(
                "parameters",
                f"the name {p.name!r}",
                f"letters, digits, . and _, no . or _ first, and none of {listed(_RESERVED)}",
            )
    names = [p.name for p in parameters]
    if not parameters or len(set(names)) < len(names):
        raise trial.refusal("parameters", listed(names), expected)
    for p in parameters:
        if not p.sigma >= 0.0 or not math.isfinite(p.mean):
            found = f"{p.name} with mean {p.mean:g} and sigma {p.sigma:g}"
            raise trial.refusal("parameters", found, "a finite mean and a sigma of at least 0")
        if not 0.0 < p.scale < math.inf:
            raise trial.refusal("parameters", f"{p.name} with scale {p.scale:g}", "one above 0")
        if kind == "random" and not p.informed:
            found = f"{p.name} of a random effect without sigma"
            raise trial.refusal("parameters", found, "its standard deviation")


def _check_column(
    key: Any,
    column: Any,
    effect: Effect,
    setup: Setup,
    plan: Plan,
    trial: Trial,
) -> None:
    amplitudes = [p.name for p in effect.amplitudes]
    if not (isinstance(key, tuple) and len(key) == 2):
        raise trial.refusal("response", f"the key {key!r}", "(port, parameter)")
    port, name = key
    if port not in setup.layout:
        raise trial.refusal(
            "response", f"the port {port!r}", f"one of {listed(setup.layout.names, 60)}"
        )
    if name not in amplitudes:
        raise trial.refusal("response", f"the parameter {name!r}", f"one of {listed(amplitudes)}")
    try:
        values = np.broadcast_to(np.asarray(column, float), (plan.rows,))
    except (TypeError, ValueError) as error:
        found = f"{error} for {key!r}"
        raise trial.refusal(
            "response", found, f"one number for each of the {plan.rows} rows"
        ) from error
    if not np.isfinite(values).all():
        row = int(np.argmin(np.isfinite(values)))
        found = f"{values[row]} for {key!r} in row {plan.row_name(row)}"
        raise trial.refusal("response", found, "finite numbers")
