"""Closing the loop on many studies, and the list of all of them."""

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..numerics.processes import TRIES, Ended, in_processes
from ..study.messages import refusal
from .dask import in_cluster
from .index import write_index
from .jobs import jobs_of
from .one_study import RECORD, Job, Member, Settings, close_one, content_of

_REWRITTEN_S = 10.0
"""Least time between two versions of the list while studies are closed."""


@dataclass(frozen=True)
class Fleet:
    """What has become of all studies, in their order."""

    members: tuple[Member, ...]
    page: Path
    """The page that lists them."""
    interrupted: bool = False

    def having(self, *status: str) -> list[Member]:
        """The members that ended in one of these ways (`one_study.Status`)."""
        return [one for one in self.members if one.status in status]


def close_fleet(
    setups: Sequence[Path | str],
    out: Path | str,
    settings: Settings | None = None,
    *,
    workers: int = 1,
    client: Any = None,
    command: str = "",
    progress: Callable[[str], None] = lambda step: None,
    ended: Callable[[Sequence[Member]], None] = lambda members: None,
) -> Fleet:
    """Close the loop on every study, each in a process of its own kind of worker, and write one
    report per study below `out`/reports and a page that lists them, `out`/index.html.

    `workers` is the number of processes; with a `distributed.Client` as `client`, its workers do
    the work, which must see the same folders. A study that cannot be used, that fails or whose
    process ends does not affect the others. A report that is up to date (same files, settings and
    versions) is kept, so that an interrupted call is resumed by repeating it. `ended` gets all
    members at the end, also where the page that lists them cannot be written.

    Raises `StudyError` where a study is named twice, and where `out` has other content.
    """
    out, settings = Path(out), settings or Settings()
    if not setups:
        raise refusal("arguments", "SETUP", "none", "at least one study", "name one")
    jobs = jobs_of([Path(one) for one in setups], out, settings)
    members = [Member(job, "not begun") for job in jobs]
    write_index(members, out, command=command)  # `out` is checked before the work, not after it
    before = [_written(job) for job in jobs]
    work = functools.partial(close_one, settings=settings)
    written = time.monotonic()
    results = (
        in_processes(work, jobs, workers) if client is None else in_cluster(work, jobs, client)
    )
    interrupted = False
    try:
        try:
            for index, member in _members(jobs, results):
                members[index] = member
                done = sum(one.status != "not begun" for one in members)
                progress(f"{done} of {len(members)} studies: {member.job.name} {member.status}")
                if time.monotonic() - written > _REWRITTEN_S:
                    write_index(members, out, command=command)
                    written = time.monotonic()
        except KeyboardInterrupt:
            interrupted = True
            # A report may be complete whose process had not told of it.
            for index, (member, earlier) in enumerate(zip(members, before, strict=True)):
                if member.status == "not begun" and _written(member.job) not in (None, earlier):
                    content = content_of(member.job.out)
                    seconds = content.get("seconds", 0.0)
                    members[index] = Member(member.job, "closed", seconds=seconds, content=content)
        page = write_index(members, out, command=command, interrupted=interrupted)
    finally:
        ended(members)
    return Fleet(tuple(members), page, interrupted)


def _written(job: Job) -> int | None:
    """When the report of a study was written, in nanoseconds; None where there is none."""
    try:
        return (job.out / RECORD).stat().st_mtime_ns
    except OSError:
        return None


def _members(
    jobs: Sequence[Job], results: Iterator[tuple[int, Member | Ended]]
) -> Iterator[tuple[int, Member]]:
    for index, result in results:
        if isinstance(result, Ended):
            yield index, Member(jobs[index], "lost", _lost(result))
        else:
            # The paths are those of the caller, not those that a worker has made absolute.
            yield index, replace(result, job=jobs[index])


def _lost(ended: Ended) -> str:
    how = {None: "", 0: ""}.get(ended.code, f" (exit code {ended.code})")
    if ended.code is not None and ended.code < 0:
        how = f" (signal {-ended.code})"
    return (
        f"its process ended {TRIES} times without a result{how}; either there is too little "
        "memory (use fewer workers), or the process was ended from outside, or compiled code has "
        "an error; close the loop on this study alone to see which"
    )
