"""Jobs on the workers of a Dask cluster."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from ..numerics.processes import TRIES, Ended
from .one_study import Job, Member


def in_cluster(
    work: Callable[[Job], Member], jobs: Sequence[Job], client: Any
) -> Iterator[tuple[int, Member | Ended]]:
    """The results of jobs as they end: index and result.

    Paths are made absolute, because a worker has a working directory of its own. A job is begun
    again on another worker where its worker ends.
    """
    from distributed import KilledWorker, as_completed

    places = {
        client.submit(_in_float64, work, _absolute(job), pure=False, retries=TRIES - 1): index
        for index, job in enumerate(jobs)
    }
    try:
        for future in as_completed(list(places)):
            error = future.exception()
            if error is None:
                yield places[future], future.result()
            elif isinstance(error, KilledWorker):
                yield places[future], Ended(None)
            else:
                job = jobs[places[future]]
                yield places[future], Member(job, "failed", f"{type(error).__name__}: {error}")
            future.release()
    finally:
        client.cancel(list(places))


def _absolute(job: Job) -> Job:
    setup, out = (type(path)(os.path.abspath(path)) for path in (job.setup, job.out))
    return replace(job, setup=setup, out=out)


def _in_float64(work: Callable[[Job], Member], job: Job) -> Member:
    from .. import enable_float64

    enable_float64()
    return work(job)
