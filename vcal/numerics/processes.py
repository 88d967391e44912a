"""Jobs in processes of this computer.

Each process has one core, and does one job after the other. A job whose process ends, whatever the
reason, is done once more in a new process; the others are not affected.
"""

import contextlib
import multiprocessing
import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

_ONE_CORE = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
"""What limits a process to one core; XLA reads it as it is loaded."""
_SHARED = (
    "jax_enable_x64",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
"""Settings of jax that the processes have from this one: precision, and the cache of compiled
programs."""
TRIES = 2
"""How often a job is begun whose process ends."""


T = TypeVar("T")
R = TypeVar("R")


def cores() -> int:
    """Number of cores that this process may use: those to which it is restricted (`taskset`, a
    batch system), where the system tells.
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class Ended:
    """The process of a job ended without a result, as often as it was begun."""

    code: int | None
    """Exit code of the process; minus the number of the signal that ended it."""


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    job: int | None = None


def in_processes(
    work: Callable[[T], R], jobs: Sequence[T], workers: int
) -> Iterator[tuple[int, R | Ended]]:
    """The results of jobs as they end: index and result.

    `work` and its argument are pickled. When the iteration ends or is interrupted, so do the
    processes.
    """
    waiting = list(range(len(jobs)))
    begun = [0] * len(jobs)
    running: list[_Worker] = []
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(_started(work))
                _give(running[-1], waiting.pop(0), jobs, begun)
            ready = wait([w.pipe for w in running])
            for worker in [w for w in running if w.pipe in ready]:
                index = worker.job
                assert index is not None
                try:
                    result = worker.pipe.recv()
                except (EOFError, OSError):
                    worker.process.join()
                    running.remove(worker)
                    if begun[index] < TRIES:
                        waiting.insert(0, index)
                    else:
                        yield index, Ended(worker.process.exitcode)
                    continue
                if waiting:
                    _give(worker, waiting.pop(0), jobs, begun)
                else:
                    running.remove(worker)
                    _stop(worker)
                yield index, result
    finally:
        for worker in running:
            worker.process.terminate()
        for worker in running:
            worker.process.join()


def _started(work: Callable[[Any], Any]) -> _Worker:
    import jax  # here, so that a process which only waits for work does not load it

    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, work), daemon=True)
    given = {name: getattr(jax.config, name) for name in _SHARED}
    shared = {name.upper(): str(value) for name, value in given.items() if value is not None}
    with _environment(_ONE_CORE | shared):
        process.start()
    theirs.close()  # so that the end of the process closes the pipe
    return _Worker(process, ours)


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Environment variables for processes that are started meanwhile. Those that the user has set
    stay; flags of XLA are added.
    """
    before = dict(os.environ)
    for name, value in values.items():
        if name == "XLA_FLAGS":
            value = f"{before.get(name, '')} {value}".strip()
        os.environ[name] = value if name == "XLA_FLAGS" else before.get(name, value)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _give(worker: _Worker, index: int, jobs: Sequence[Any], begun: list[int]) -> None:
    worker.job = index
    begun[index] += 1
    # A process that has just ended is noticed at the other end of the pipe.
    with contextlib.suppress(OSError):
        worker.pipe.send(jobs[index])


def _stop(worker: _Worker) -> None:
    with contextlib.suppress(OSError):
        worker.pipe.send(None)
    worker.pipe.close()
    worker.process.join()


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    """Do one job after the other; the body of a process."""
    # Ctrl-C reaches all processes of a terminal. The one that started this one ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A truncated file, or one that another process is writing, is compiled again.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation")
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        if job is None:
            return
        pipe.send(work(job))
