"""Propagation of distributions through a measurement function: JCGM 101, 5.9 and 7; JCGM 102, 7."""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, UInt32

from ..distributions import Inputs
from ..numerics.arrays import Array
from ..numerics.spatial import require_float64
from .ensemble import Ensemble
from .intervals import Kind
from .propagation import Function, named, outputs_of
from .streaming import MOST, Progress, stream

_BLOCK = 10_000


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
    ``"y"``), an array, or a dictionary of these; it is written in JAX, for one draw. Draw r uses
    the key ``fold_in(key(seed), r)``, and all local devices are used; the result depends on the
    seed alone. The other arguments are those of `stream`. The campaign in a `folder` is identified
    by its seed, the compiled function and the numbers of the inputs.

    Student's t has no standard deviation for nu <= 2 degrees of freedom (JCGM 101, 6.4.9.5), and no
    expectation for nu <= 1. The same holds for an output that grows with such an input. Its
    coverage intervals exist, but y and u of the draws do not converge with their number, an
    adaptive campaign does not end before its largest number of draws, and a note reports it.

    Raises `RuntimeError` where JAX runs in float32, `ValueError` for a function that is not written
    in JAX or takes an unknown input and for invalid settings, `TypeError` for inputs that are no
    `Inputs`, and `StudyError` for a folder of another campaign.
    """
    require_float64()
    outputs = outputs_of(function, inputs)
    key = jax.random.key(seed)
    local = jax.local_devices()

    def evaluate(first: int, count: int, device: Any = None) -> Mapping[str, Array]:
        here = key if device is None else jax.device_put(key, device)
        return _draw(function, inputs, here, np.asarray(first, np.uint32), count)

    fingerprint = None
    if folder is not None:
        fingerprint = {"seed": seed} | _identity(function, inputs, key)
    done = stream(
        evaluate,
        draws,
        outputs,
        block=_BLOCK,
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
    return dataclasses.replace(done, notes=_without_moments(inputs))


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


@eqx.filter_jit
def _draw(
    function: Function,
    inputs: Inputs,
    key: PRNGKeyArray,
    first: UInt32[np.ndarray, ""],
    count: int,
) -> dict[str, Array]:
    """Outputs of `count` draws, the first with index `first`."""

    def one(index: Array) -> dict[str, Array]:
        return named(function(inputs.sample(jax.random.fold_in(key, index))))

    return jax.vmap(one)(first + jnp.arange(count, dtype=jnp.uint32))


def _identity(function: Function, inputs: Inputs, key: PRNGKeyArray) -> dict[str, str]:
    """Checksums of the compiled program and of the numbers of the inputs."""
    lowered = _draw.lower(function, inputs, key, np.asarray(0, np.uint32), _BLOCK)
    numbers = hashlib.sha256()
    for leaf in jax.tree.leaves(eqx.filter((function, inputs), eqx.is_array)):
        numbers.update(np.asarray(leaf).tobytes())
    program = hashlib.sha256(lowered.as_text().encode())
    return {"measurement function": program.hexdigest(), "inputs": numbers.hexdigest()}
