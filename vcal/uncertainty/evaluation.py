"""Measurement functions: written in JAX, or any other function of numbers.

A function in JAX is compiled, and differentiated automatically. Any other one, in Python, numpy or
an external program, is called with plain numbers (`Plain`): derivatives are then differences, and a
Monte Carlo calls it draw by draw, or block by block where that is safe.
"""

import functools
import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..distributions import Inputs
from ..errors import StudyError
from ..numerics.arrays import Array
from ..numerics.compiled import jit_vectorised
from ..registry import nearest
from .outputs import Output

Function = Callable[[dict[str, Any]], Any]
"""Values of the inputs by name -> a number, an array, or a dictionary of these."""

_UNNAMED = "y"
_CHECKED = 8
"""Draws of a block on which a call with arrays is compared with calls draw by draw, beside those
with the extremes of every input."""
_SAME = 1e-10
"""Relative difference up to which both agree."""


class Flat(eqx.Module):
    """A measurement function in JAX from the vector of all inputs to the vector of all outputs."""

    function: Function
    inputs: Inputs

    def __call__(self, x: Float[Array, " k"]) -> Float[Array, " m"]:
        values = named(self.function(self.inputs.unflatten(x)))
        return jnp.concatenate([jnp.ravel(value) for value in values.values()])


@dataclass(frozen=True)
class Plain:
    """A measurement function of plain numbers and numpy arrays.

    A draw in which it raises `ArithmeticError` or `ValueError`, as ``math.sqrt(-1.0)`` does, is not
    finite; other errors are those of the function and end the evaluation.
    """

    function: Function
    inputs: Inputs
    outputs: tuple[Output, ...]

    def rows(self, x: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n m"]:
        """Outputs of the flattened inputs in every row."""
        shapes = [d.shape for d in self.inputs.distributions.values()]
        ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
        parts = [(e - math.prod(shape), e, shape) for e, shape in zip(ends, shapes, strict=True)]
        found = np.empty((len(x), sum(len(o.labels) for o in self.outputs)))
        for row, numbers in zip(found, x, strict=True):
            values = {
                name: numbers[start:end].copy() if shape else float(numbers[start])
                for name, (start, end, shape) in zip(self.inputs.names, parts, strict=True)
            }
            row[:] = self.one(values)
        return found

    def one(self, values: dict[str, Any]) -> Float[np.ndarray, " m"]:
        """Outputs of one draw; NaN where the function raises an error of arithmetic."""
        try:
            with np.errstate(all="ignore"):
                found = self.function(values)
        except (ArithmeticError, ValueError):
            return np.full(sum(len(o.labels) for o in self.outputs), np.nan)
        parts = plain(found)
        for output in self.outputs:
            value = parts.get(output.name)
            if value is None or value.shape != output.shape:
                raise ValueError(
                    f"the measurement function gave {sorted(parts)} with {output.name!r} of shape "
                    f"{None if value is None else value.shape}, expected the shape {output.shape} "
                    "that it has at the estimates"
                )
        return np.concatenate([parts[o.name].ravel() for o in self.outputs])

    def block(self, drawn: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Outputs of many draws by name, draws along the first axis.

        The function is called once with the arrays of all draws, those of an array input with the
        draws along the last axis. The result is used where it agrees with calls draw by draw for
        the draws with the least and the greatest value of every input and a few others; otherwise
        every draw has its own call.
        """
        count = len(next(iter(drawn.values())))
        x = np.concatenate([drawn[n].reshape(count, -1) for n in self.inputs.names], axis=1)
        found = self._together(drawn, x, count)
        if found is None:
            found = self.rows(x)
        ends = np.cumsum([0, *(len(o.labels) for o in self.outputs)])
        return {
            o.name: found[:, start : start + len(o.labels)].reshape(count, *o.shape)
            for o, start in zip(self.outputs, ends, strict=False)
        }

    def _together(
        self, drawn: Mapping[str, np.ndarray], x: Float[np.ndarray, "n k"], count: int
    ) -> Float[np.ndarray, "n m"] | None:
        given = {name: np.moveaxis(value, 0, -1).copy() for name, value in drawn.items()}
        try:
            with np.errstate(all="ignore"):
                parts = plain(self.function(given))
        except Exception:
            return None  # it takes single numbers only, or fails for a single draw
        if any(o.name not in parts for o in self.outputs):
            return None
        if any(parts[o.name].shape != (*o.shape, count) for o in self.outputs):
            return None
        found = np.concatenate([parts[o.name].reshape(-1, count) for o in self.outputs]).T
        some = np.linspace(0, count - 1, _CHECKED).astype(int)
        rows = np.unique(np.concatenate([x.argmin(0), x.argmax(0), some]))
        same = np.isclose(found[rows], self.rows(x[rows]), rtol=_SAME, atol=0.0, equal_nan=True)
        return np.ascontiguousarray(found) if same.all() else None


@dataclass(frozen=True)
class Evaluation:
    """A measurement function with its outputs, and how it is evaluated."""

    outputs: tuple[Output, ...]
    plain: Plain | None
    """The function of plain numbers; None for one in JAX."""


def evaluation_of(function: Function, inputs: Inputs) -> Evaluation:
    """Names and shapes of the outputs of a measurement function, in its own order.

    Raises `ValueError` if the function fails at the estimates, has no output, or takes an unknown
    input, and `TypeError` for inputs that are no `Inputs`.
    """
    if not isinstance(inputs, Inputs):
        raise TypeError(
            f"inputs: found {inputs!r}, expected Inputs; write Inputs({{'x': Normal(0, 1)}}), with "
            "a distribution for every quantity"
        )
    traced = True
    try:
        names, shapes = _traced(function, _kinds(inputs))
    except Exception as error:
        # What fails with an abstract value may work with numbers; if not, its error is told.
        found = _at_estimates(function, inputs, error)
        names, shapes, traced = list(found), [value.shape for value in found.values()], False
    if not any(math.prod(shape) for shape in shapes):
        raise ValueError("the measurement function gave no outputs, expected at least one")
    outputs = tuple(Output(name, shape) for name, shape in zip(names, shapes, strict=True))
    return Evaluation(outputs, None if traced else Plain(function, inputs, outputs))


def _kinds(inputs: Inputs) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Name and shape of every input."""
    return tuple((name, d.shape) for name, d in inputs.distributions.items())


@functools.lru_cache(maxsize=128)
def _traced(
    function: Function, inputs: tuple[tuple[str, tuple[int, ...]], ...]
) -> tuple[list[str], list[tuple[int, ...]]]:
    """Names and shapes of the outputs of a function in JAX, from the shapes of its inputs."""
    names: list[str] = []

    def in_order(values: dict[str, Array]) -> list[Array]:
        # JAX would return a dictionary in alphabetical order.
        outputs = named(function(values))
        names.extend(outputs)
        return list(outputs.values())

    given = {name: jax.ShapeDtypeStruct(shape, jnp.float64) for name, shape in inputs}
    return names, [found.shape for found in jax.eval_shape(in_order, given)]


def _at_estimates(
    function: Function, inputs: Inputs, traced: Exception
) -> dict[str, Float[np.ndarray, "..."]]:
    values = {
        name: np.asarray(mean) if np.ndim(mean) else float(mean)
        for name, mean in inputs.mean.items()
    }
    try:
        with np.errstate(all="ignore"):
            found = function(values)
    except KeyError as error:
        name = next(iter(error.args), None)
        if not isinstance(name, str) or name in inputs.names:
            raise
        raise ValueError(
            f"the measurement function takes the input {name!r}{nearest(name, inputs.names)}, "
            f"expected one of {', '.join(inputs.names)}; correct the name, or add it to the inputs"
        ) from error
    except Exception as error:
        listed = ", ".join(f"{name} = {value}" for name, value in list(values.items())[:5])
        raise ValueError(
            f"the measurement function fails at the estimates ({listed}): {type(error).__name__}: "
            f"{error}; correct it, or the estimates"
        ) from traced
    return plain(found)


def named(values: Any) -> dict[str, Array]:
    """Outputs of a measurement function in JAX by name; a single one is called ``"y"``.

    A complex output ``"S"`` is two real ones, ``"S.re"`` and ``"S.im"``. Raises `ValueError` for a
    value that is neither a number nor an array.
    """
    return _named(values, jnp)


def plain(values: Any) -> dict[str, np.ndarray]:
    """The same for outputs as numbers and numpy arrays; raises as `named` does."""
    return _named(values, np)


def _named(values: Any, library: Any) -> dict[str, Any]:
    found = dict(values) if isinstance(values, Mapping) else {_UNNAMED: values}
    real: dict[str, Any] = {}
    try:
        for name, value in found.items():
            array = library.asarray(value)
            if library.iscomplexobj(array):
                real |= {f"{name}.re": library.real(array), f"{name}.im": library.imag(array)}
            else:
                real[str(name)] = library.asarray(array, dtype=float)
    except jax.errors.JAXTypeError:
        raise
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the measurement function gave {values!r}, expected a number, an array, or a "
            "dictionary of these"
        ) from error
    return real


def compiled_for(what: Callable[..., Any], given: Any) -> tuple[Callable[..., Any], list[Array]]:
    """A compiled `what(*given, *arguments)`, called as program(arrays, *arguments), and the arrays
    in the tuple `given`.

    One program serves all calls with equal functions and the same kinds of inputs, in whatever
    numbers they differ. A call of it takes a tenth of the time of one that looks for its static
    parts first.
    """
    arrays, rest = eqx.partition(given, eqx.is_array)
    numbers, structure = jax.tree.flatten(arrays)
    kept, other = jax.tree.flatten(rest)
    return _compiled(what, structure, other, tuple(kept)), numbers


@functools.lru_cache(maxsize=128)
def _compiled(
    what: Callable[..., Any], structure: Any, other: Any, kept: tuple[Any, ...]
) -> Callable[..., Any]:
    def program(numbers: list[Array], *arguments: Array) -> Any:
        arrays = jax.tree.unflatten(structure, numbers)
        return what(*eqx.combine(arrays, jax.tree.unflatten(other, kept)), *arguments)

    return jit_vectorised(program)


def code_digest(function: Function) -> str:
    """SHA-256 of the code of a Python function and of the values that it encloses.

    Raises `StudyError` for a callable without code of its own.
    """
    code = getattr(function, "__code__", None)
    if code is None:
        raise StudyError(
            f"found {function!r}, expected a function defined by def or lambda for a campaign in a "
            "folder, which is identified by its code; wrap it in one, or leave out the folder"
        )
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    text = repr((_code_text(code), function.__defaults__, cells))
    return hashlib.sha256(text.encode()).hexdigest()


def _code_text(code: Any) -> tuple:
    constants = tuple(_code_text(c) if hasattr(c, "co_code") else repr(c) for c in code.co_consts)
    return code.co_code.hex(), code.co_names, constants
