"""Propagation of distributions through a measurement function: JCGM 101, 5.9 and 7; JCGM 102, 7."""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import UInt64

from ..distributions import Inputs
from ..numerics.arrays import Array
from ..numerics.spatial import require_float64
from .adaptive import step_size
from .cautions import failed_notes, single_draw_notes
from .ensemble import Ensemble
from .evaluation import Evaluation, Function, code_digest, compiled_for, evaluation_of, named
from .intervals import Kind, check_coverage
from .streaming import MOST, Progress, stream

_BLOCK = 10_000
_TOGETHER = 5
"""Blocks of a campaign of many draws that one call of the compiled function computes in turn."""
_KEYS = 256
"""Blocks whose keys are computed at once."""


def propagate_distributions(
    function: Function,
    inputs: Inputs,
    draws: int | Literal["adaptive"] = 1_000_000,
    seed: int = 0,
    *,
    coverage: float = 0.95,
    kind: Kind = "symmetric",
    digits: Literal[1, 2] = 2,
    most: int = MOST,
    folder: Path | str | None = None,
    chunk: int | None = None,
    progress: Progress = lambda done, total: None,
) -> Ensemble:
    """Distribution of the outputs of a measurement function by Monte Carlo.

        y_r = f(x_r),   x_r drawn from the joint distribution of the inputs,   r = 1 ... M

    `function` takes the values of the inputs by name and gives a number (an output called
    ``"y"``), an array, or a dictionary of these, for one draw. The inputs of a block of draws
    follow from the seed, the number of the block and the position of the input, by a generator
    with counters (`vcal.numerics.counter_draws`), so that the result depends on the seed alone.

    A function written in JAX is compiled, and all local devices are used. Any other function is
    called with plain numbers, or with the arrays of a whole block where it gives the same with them
    (`vcal.uncertainty.evaluation.Plain.block`). The other arguments are those of `stream`. The
    campaign in a `folder` is identified by its seed, the compiled function, or the code of one that
    is not in JAX, and the numbers of the inputs.

    Draws that are not finite are left out, and a note states their share. Another note tells where
    a single draw has a large share of the variance, as of an output without one.

    Student's t has no standard deviation for nu <= 2 degrees of freedom (JCGM 101, 6.4.9.5), and no
    expectation for nu <= 1. The same holds for an output that grows with such an input. Its
    coverage intervals exist, but y and u of the draws do not converge with their number, an
    adaptive campaign does not end before its largest number of draws, and a note reports it.

    Raises `RuntimeError` where JAX runs in float32, `ValueError` for a function that fails at the
    estimates, takes an unknown input, or is finite in no draw, and for invalid settings,
    `TypeError` for inputs that are no `Inputs`, and `StudyError` for a folder of another campaign.
    """
    require_float64()
    check_coverage(coverage)
    how = evaluation_of(function, inputs)
    local = jax.local_devices() if how.plain is None else []

    keys = _Keys(inputs, seed)
    # An adaptive campaign may end after any block, and so may one in a folder, to be extended.
    many = isinstance(draws, int | np.integer) and draws >= _TOGETHER * _BLOCK
    together = _TOGETHER if many and how.plain is None and folder is None else 1
    what = _inputs if how.plain is not None else _draw if together == 1 else _draws
    program, arrays = compiled_for(what, (function, inputs))

    def evaluate(first: int, count: int, device: Any = None) -> Mapping[str, Array]:
        given = keys.of(first // _BLOCK, together)
        if together == 1:
            given = given[0]
        if device is not None:
            given = jax.device_put(given, device)
        found = program(arrays, given)
        if how.plain is not None:
            return how.plain.block({name: np.asarray(value) for name, value in found.items()})
        return found

    fingerprint = None
    if folder is not None:
        fingerprint = {"seed": seed} | _identity(function, inputs, how)
    done = stream(
        evaluate,
        draws,
        how.outputs,
        block=together * _BLOCK,
        step=step_size(coverage, _BLOCK),
        chunk=chunk,
        folder=folder,
        fingerprint=fingerprint,
        progress=progress,
        devices=local if len(local) > 1 else (),
        coverage=coverage,
        kind=kind,
        digits=digits,
        most=most,
    )
    if all(done.failed.get(label, 0) == done.draws for label in done.labels):
        raise ValueError(
            f"{', '.join(done.labels[:5])}: none of the {done.draws} draws is finite; check the "
            "measurement function over the range of the inputs"
        )
    notes = (*_without_moments(inputs), *failed_notes(done), *single_draw_notes(done))
    return dataclasses.replace(done, notes=notes)


def _without_moments(inputs: Inputs) -> tuple[str, ...]:
    """The note on inputs without a standard deviation."""
    index = {name: float(d.tail_index) for name, d in inputs.distributions.items()}
    heavy = {name: nu for name, nu in index.items() if nu <= 2.0}
    if not heavy:
        return ()
    listed = ", ".join(f"{name} (dof = {nu:g})" for name, nu in heavy.items())
    return (
        f"Student's t of {listed} has no standard deviation, and up to dof = 1 no expectation: "
        "where an output grows with it, take the coverage interval and the median, not mean and u "
        "of the draws (JCGM 101, 6.4.9.5)",
    )


class _Keys:
    """Keys of the blocks of a campaign, computed on the host for many blocks at once."""

    def __init__(self, inputs: Inputs, seed: int):
        self.inputs, self.seed = inputs, seed
        self.first, self.known = 0, inputs.row_keys(seed, np.zeros(0, np.uint32))

    def of(self, block: int, count: int) -> UInt64[np.ndarray, "count rows"]:
        """Keys of `count` blocks."""
        if not self.first <= block <= self.first + len(self.known) - count:
            self.first = block
            blocks = np.arange(block, block + max(_KEYS, count), dtype=np.uint32)
            self.known = self.inputs.row_keys(self.seed, blocks)
        return self.known[block - self.first :][:count]


def _draw(function: Function, inputs: Inputs, keys: Array) -> dict[str, Array]:
    """Outputs of the draws of a block."""
    drawn = inputs.draws(keys, _BLOCK)
    return jax.vmap(lambda values: named(function(values)))(drawn)


def _draws(function: Function, inputs: Inputs, keys: Array) -> dict[str, Array]:
    """Outputs of the draws of several blocks, one after the other."""
    found = jax.lax.map(lambda own: _draw(function, inputs, own), keys)
    return {name: values.reshape(-1, *values.shape[2:]) for name, values in found.items()}


def _inputs(function: Function, inputs: Inputs, keys: Array) -> dict[str, Array]:
    """Inputs of the draws of a block."""
    return inputs.draws(keys, _BLOCK)


def _identity(function: Function, inputs: Inputs, how: Evaluation) -> dict[str, str]:
    """Checksums of the program and of the numbers of the inputs."""
    program, arrays = compiled_for(_draw if how.plain is None else _inputs, (function, inputs))
    numbers = hashlib.sha256()
    for leaf in arrays:
        numbers.update(np.asarray(leaf).tobytes())
    lowered: Any = program
    text = lowered.lower(arrays, inputs.row_keys(0, np.zeros(1, np.uint32))[0]).as_text()
    checksum = hashlib.sha256(text.encode()).hexdigest()
    if how.plain is not None:
        checksum = code_digest(function) + checksum
    return {"measurement function": checksum, "inputs": numbers.hexdigest()}
