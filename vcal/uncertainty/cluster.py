"""Blocks of draws on the workers of a Dask cluster.

What travels to a worker are the models, the plan and the quantities, once for every campaign; what
comes back are the summaries of blocks (`vcal.uncertainty.summary.digest`): sums, the numbers of
bins, and the values of those scalar outputs that are kept. The outputs of the first block come back
as they are and show where the bins lie; meanwhile the other workers compile, each for itself, and
keep what they compile in the cache of their user, as `vcal.enable_float64` does. The
blocks are those of one process, in the same order of addition, and so are the results, bit for bit,
on processors of one kind. A block whose worker ends is computed by another one.
"""

import contextlib
import pickle
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from types import ModuleType
from typing import Any, Protocol

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from ..numerics.program_cache import keep_programs
from .summary import Declared, Digest, Layout, digest

TRIES = 3
"""How often a block is begun whose worker ends."""
_AHEAD = 2
"""Blocks that are submitted for every thread of the workers, so that none waits for the next."""
_KEPT = 4
"""Most campaigns whose compiled programs a worker keeps."""


class Evaluate(Protocol):
    """The function of a range of draws."""

    workers: int
    """Number of threads that it uses."""

    def __call__(self, first: int, count: int) -> Mapping[str, np.ndarray]: ...


_made: OrderedDict[str, Evaluate] = OrderedDict()
_making = threading.Lock()


class InCluster:
    """The outputs of a range of draws, as `vcal.uncertainty.campaign` computes them, by the workers
    of a cluster.

    `make(*arguments)` is called once in every worker and returns the function of a range that does
    the work; `name` identifies the campaign. `slots` is what `stream` takes as its devices.
    """

    def __init__(self, client: Any, make: Callable[..., Evaluate], arguments: tuple, name: str):
        threads = sum(client.nthreads().values())
        if not threads:
            raise ValueError(
                "client: found no worker, expected at least one; start workers and wait for them "
                "(client.wait_for_workers)"
            )
        self.client, self.name = client, name
        self.slots = range(_AHEAD * threads)
        self._compiled: list[Any] = []
        self.work = client.scatter(_Work(make, arguments, name), hash=False, broadcast=True)

    def __call__(self, first: int, count: int, device: Any = None) -> Mapping[str, np.ndarray]:
        del device
        future = self._submit(_computed, first, count)
        self._compile(first, count)
        return _Coming(future)

    def summaries(
        self, first: int, block: int, blocks: int, declared: Declared, layout: Layout
    ) -> Any:
        """The summary of consecutive blocks, as a future."""
        return _Once(self._submit(_summarised, first, block, blocks, declared, layout))

    def _submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return self.client.submit(function, self.work, *arguments, pure=False, retries=TRIES - 1)

    def _compile(self, first: int, count: int) -> None:
        """Let every worker compute a block once, so that none compiles after another."""
        if not self._compiled:
            self._compiled = [
                self.client.submit(
                    _warmed,
                    self.work,
                    first,
                    count,
                    pure=False,
                    priority=-1,
                    workers=[one],
                    allow_other_workers=True,
                )  # fmt: skip
                for one in self.client.nthreads()
            ]


class _Work:
    """What a worker needs to compute blocks of one campaign.

    The arguments stay as bytes until the worker has been switched to float64: before that, JAX
    would read its arrays in float32.
    """

    def __init__(self, make: Callable[..., Evaluate], arguments: tuple, name: str):
        import cloudpickle

        with _by_value(arguments):
            self.content = cloudpickle.dumps(arguments)
        self.make, self.name = make, name

    def evaluate(self) -> Evaluate:
        """The function of a range of draws."""
        jax.config.update("jax_enable_x64", True)
        keep_programs()
        evaluate = self.make(*pickle.loads(self.content))
        evaluate.workers = 1  # every thread of a worker has a block of its own
        return evaluate


def _computed(work: _Work, first: int, count: int) -> dict[str, np.ndarray]:
    """The outputs of a block; runs in a worker."""
    with _making:
        if work.name not in _made:
            _made[work.name] = work.evaluate()
            while len(_made) > _KEPT:
                _made.popitem(last=False)
        evaluate = _made[work.name]
    return {name: np.asarray(value) for name, value in evaluate(first, count).items()}


def _summarised(
    work: _Work, first: int, block: int, blocks: int, declared: Declared, layout: Layout
) -> Digest:
    """The summary of consecutive blocks; runs in a worker."""
    found = (_computed(work, first + i * block, block) for i in range(blocks))
    with threadpool_limits(1, "blas"):  # as where the draws of one process are summarised
        return digest(found, block, declared, layout)


def _warmed(work: _Work, first: int, count: int) -> None:
    """Compile what a block needs; runs in a worker."""
    _computed(work, first, count)


class _Once:
    """A future that is released when its result has been read."""

    def __init__(self, future: Any):
        self._future = future

    def result(self) -> Digest:
        """The result; waits for it."""
        found = self._future.result()
        self._future.release()
        return found


class _Coming(Mapping[str, np.ndarray]):
    """The outputs of a block that is being computed; waits for them when they are read."""

    def __init__(self, future: Any):
        self._future, self._found = future, None

    def _all(self) -> Mapping[str, np.ndarray]:
        if self._found is None:
            self._found = self._future.result()
            self._future.release()
        return self._found

    def __getitem__(self, name: str) -> np.ndarray:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())


@contextlib.contextmanager
def _by_value(arguments: tuple) -> Iterator[None]:
    """Send classes of the user's own as they are: a worker cannot import their files."""
    import cloudpickle

    sent = [module for module in _own_modules(arguments)]
    for module in sent:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in sent:
            cloudpickle.unregister_pickle_by_value(module)


def _own_modules(arguments: tuple) -> list[ModuleType]:
    """Modules of effects and instruments that are not those of vcal."""
    kinds = set()
    for one in arguments:
        kinds |= {type(effect) for effect in getattr(one, "effects", ())}
        kinds |= {type(one), type(getattr(one, "instrument", None))}
    names = {kind.__module__ for kind in kinds}
    return [
        sys.modules[name]
        for name in sorted(names)
        if name in sys.modules and name.split(".")[0] not in ("vcal", "builtins", "numpy", "jax")
    ]
