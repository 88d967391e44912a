"""The workers of commands: those of a cluster, or processes of this computer."""

import contextlib
import os
from collections.abc import Iterator
from typing import Any

from ..errors import StudyError
from ..study.messages import refusal

_ANSWER_S = 10.0
"""Time within which a scheduler has to answer, s."""


def check_one(workers: int | None, scheduler: str | None) -> None:
    """Raise `StudyError` where both are given."""
    if workers is not None and scheduler is not None:
        raise refusal(
            "options", "--workers and --scheduler", "both", "one of them",
            "leave --workers out: the cluster has workers of its own",
        )  # fmt: skip


@contextlib.contextmanager
def client_of(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A client of the Dask cluster at an address, or of one that is made here of so many processes
    with one core each; None without either.

    Raises `StudyError` where both are given, where Dask is not installed, and where no scheduler
    answers.
    """
    check_one(workers, scheduler)
    if workers is None and scheduler is None:
        yield None
        return
    option = "--workers" if scheduler is None else "--scheduler"
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise refusal(
            "option", option, "no package distributed", "Dask",
            "install it with pip install 'vcal[cluster]'",
        ) from None  # fmt: skip
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0"
            )
            client = stack.enter_context(Client(stack.enter_context(cluster)))
            client.run(_on_one_core)
            yield client
            return
        try:
            client = stack.enter_context(Client(scheduler, timeout=_ANSWER_S))
        except (OSError, ValueError) as error:
            raise StudyError(
                f"option --scheduler: found {scheduler!r}, where no scheduler answers ({error}), "
                "expected the address of a running Dask scheduler, tcp://HOST:PORT; start one with "
                "dask scheduler, and workers with dask worker ADDRESS"
            ) from error
        yield client


def _on_one_core(dask_worker: Any) -> None:
    """Keep a worker to one core: JAX would start threads for all of them, in every worker."""
    if hasattr(os, "sched_setaffinity"):
        mine = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {mine[int(dask_worker.name) % len(mine)]})
