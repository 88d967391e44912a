"""Campaigns on the workers of a Dask cluster: time, traffic and memory, and the same numbers.

The problem is that of batch.py. The same campaign runs on one worker, on two, and on two of which
one is killed after the first tenth of the draws; scheduler and workers are processes of their own,
every worker on one core. CPU seconds are those of all workers that live at the end. What leaves the
workers is counted by them; the memory of the scheduler is its peak. Needs the extra `cluster` and
Linux.

    python benchmarks/workers.py --draws 1000000
"""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from batch import problem
from records import parser_of, write

import vcal
from vcal.uncertainty import Campaign, ParameterErrors, VolumetricErrors, monte_carlo
from vcal.uncertainty.virtual import judged_points

SINGLE = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@contextlib.contextmanager
def cluster(workers: int) -> Iterator[Any]:
    """A client of a scheduler with so many workers."""
    from distributed import Client

    environment = dict(os.environ, **dict.fromkeys(SINGLE, "1"))
    environment["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    with tempfile.TemporaryDirectory() as folder:
        place = str(Path(folder) / "scheduler.json")
        base = [sys.executable, "-m", "distributed.cli"]
        begin = ["--scheduler-file", place]
        scheduler = [f"{base[-1]}.dask_scheduler", *begin, "--port", "0", "--no-dashboard"]
        worker = [f"{base[-1]}.dask_worker", *begin, "--nthreads", "1", "--no-dashboard",
                  "--local-directory", folder]  # fmt: skip
        cores = sorted(os.sched_getaffinity(0))
        running = [
            subprocess.Popen(
                [*base[:-1], *one],
                env=environment,
                stderr=subprocess.DEVNULL,
                # JAX starts threads for all cores that it may use, whatever its flags say.
                preexec_fn=lambda mine=mine: os.sched_setaffinity(0, mine),
            )
            for one, mine in (
                (scheduler, cores),
                *((worker, {cores[i % len(cores)]}) for i in range(workers)),
            )
        ]
        try:
            while not Path(place).is_file():
                time.sleep(0.1)
            with Client(scheduler_file=place) as client:
                client.wait_for_workers(workers)
                yield client
        finally:
            for process in reversed(running):
                process.terminate()
            for process in running:
                process.wait()


def used() -> float:
    """CPU seconds of a process so far."""
    found = resource.getrusage(resource.RUSAGE_SELF)
    return found.ru_utime + found.ru_stime


def sent(dask_worker: Any) -> int:
    """Bytes that a worker has sent."""
    return dask_worker.transfer_outgoing_bytes_total


def forget_peak() -> float:
    """Memory of a process now, MiB; its peak begins there."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak()


def peak() -> float:
    """Largest memory of a process since `forget_peak`, MiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024.0


def measured(given: dict[str, Any], workers: int, kill: bool) -> tuple[Campaign, dict[str, Any]]:
    """One campaign on a new cluster, after a short one that compiles."""
    with cluster(workers) as client:
        monte_carlo(**given | {"draws": 4_000}, client=client)
        memory = client.run_on_scheduler(forget_peak)
        cpu, traffic, own = client.run(used), client.run(sent), used()
        pids = client.run(os.getpid)
        killed = []

        def progress(done: int, total: int) -> None:
            if kill and not killed and done >= total / 10:
                killed.append(next(iter(pids.values())))
                os.kill(killed[0], signal.SIGKILL)

        begun = time.perf_counter()
        found = monte_carlo(**given, client=client, progress=progress)
        wall = time.perf_counter() - begun
        record = {
            "workers": workers,
            "killed": len(killed),
            "wall_s": wall,
            "workers_cpu_s": [
                value - cpu.get(name, 0.0) for name, value in client.run(used).items()
            ],
            "client_cpu_s": used() - own,
            "sent_mb": sum(
                value - traffic.get(name, 0) for name, value in client.run(sent).items()
            ) / 1e6,
            "scheduler_mib": client.run_on_scheduler(peak),
            "scheduler_mib_before": memory,
            "scheduler_tasks_left": client.run_on_scheduler(lambda dask_scheduler: len(
                dask_scheduler.tasks)),
        }  # fmt: skip
        return found, record


def same(one: Campaign, other: Campaign) -> bool:
    """Whether all numbers are equal, bit for bit."""
    a, b = one.ensemble, other.ensemble
    names = ("mean", "covariance", "minimum", "maximum", "values")
    pairs = [(getattr(a, name), getattr(b, name)) for name in names]
    pairs += [(x.total, y.total) for x, y in zip(a.columns, b.columns, strict=True)]
    for name, field in a.fields.items():
        pairs += [(field.mean, b.fields[name].mean), (field.u, b.fields[name].u)]
        pairs += [(field.quantiles[q], b.fields[name].quantiles[q]) for q in field.quantiles]
    return all(np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def main() -> None:
    """Run all campaigns."""
    parser = parser_of(__doc__, "workers")
    parser.add_argument("--draws", type=int, default=1_000_000)
    parser.add_argument("--field-draws", type=int, default=100_000)
    options = parser.parse_args()
    vcal.enable_float64()
    model, plan = problem()
    points, _ = judged_points(model.chain, plan)
    ways = [(1, False), (2, False), (2, True)]
    rows = []
    for what, draws, more in (
        ("parameters", options.draws, {"quantities": (ParameterErrors(),)}),
        (
            "volumetric error, no values kept",
            options.field_draws,
            {"quantities": (VolumetricErrors(points, quantiles=(0.95,)),), "keep": 0},
        ),
    ):
        given = {"truth": model, "fit": model, "plan": plan, "draws": draws, "seed": 2, **more}
        first = None
        for workers, kill in ways:
            found, record = measured(given, workers, kill)
            first = first or found
            row = {"what": what, "draws": draws, "same": same(first, found), **record}
            row["kb_per_1000_draws"] = 1e6 * record["sent_mb"] / draws
            rows.append(row)
            print(row, flush=True)
            write(options.out, {"rows": rows, "cores": os.cpu_count()})


if __name__ == "__main__":
    main()
