"""A Dask cluster of processes on this computer."""

import contextlib
import gc
import warnings
from collections.abc import Iterator
from typing import Any

import pytest

LEAKS = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
"""For tests with a cluster: it leaves sockets open that the collector finds."""


@contextlib.contextmanager
def client_of(workers: int) -> Iterator[Any]:
    """A client of a cluster of so many processes with one thread each."""
    distributed = pytest.importorskip("distributed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with (
            distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0"
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
        gc.collect()
