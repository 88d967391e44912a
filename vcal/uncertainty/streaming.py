"""The engine of every Monte Carlo campaign: draws are computed and summarised block by block.

    evaluate(first, count) -> the outputs of draws first ... first + count - 1, by name

`evaluate` is always called for whole blocks of one size, and derives the random numbers of a draw
from its index (`jax.random.fold_in`); the last block is computed whole and truncated. The result
therefore depends on the seed alone, and not on the number of blocks between two checkpoints, on the
number of devices, or on interruptions of the campaign.

An `evaluate` that works elsewhere may summarise there, so that the summaries travel and not the
draws (`Remote`).
"""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from ..errors import StudyError
from ..numerics.arrays import Array
from .adaptive import step_size
from .checkpoint import STATE, UNWRITTEN, Checkpoint, unwritten
from .ensemble import Ensemble, ensemble_of
from .intervals import Kind, check_coverage
from .outputs import Field, Output, check_declared
from .summary import Declared, Digest, Layout, Summary

Evaluate = Callable[..., Mapping[str, Array]]
"""evaluate(first, count), or evaluate(first, count, device=...) where devices are named."""
Device = Any
"""A device of JAX (`jax.local_devices`)."""
Progress = Callable[[int, int], None]
"""progress(draws done, draws to do)."""


class Coming(Protocol):
    """The summary of blocks that are being computed."""

    def result(self) -> Digest:
        """The summary; waits for it."""
        ...


@runtime_checkable
class Remote(Protocol):
    """An `evaluate` whose draws are computed and summarised in other processes."""

    def __call__(self, first: int, count: int, device: Device = None) -> Mapping[str, Array]:
        """The outputs of a block, which may be computed when they are read."""
        ...

    def summaries(
        self, first: int, block: int, blocks: int, declared: Declared, layout: Layout
    ) -> Coming:
        """The summary (`vcal.uncertainty.summary.digest`) of consecutive blocks of `block` draws
        each, from draw `first` on; returns before it is computed.
        """
        ...


KEEP = 10_000_000
"""Largest number of kept values, of all scalar outputs together."""
MOST = 100_000_000
"""Draws after which an adaptive campaign ends, stable or not."""
_CHUNK_S = 2.0
"""Time between two checkpoints where no chunk is given, s."""
_SAVING = 20.0
"""Least time between two checkpoints, as a multiple of the duration of the last one."""
_INDICES = 2**32
"""`fold_in` takes indices of 32 bits."""


@threadpool_limits.wrap(limits=1, user_api="blas")
def stream(
    evaluate: Evaluate,
    draws: int | Literal["adaptive"],
    outputs: Sequence[Output] = (),
    *,
    fields: Sequence[Field] = (),
    block: int = 1000,
    step: int | None = None,
    chunk: int | None = None,
    folder: Path | str | None = None,
    fingerprint: Mapping[str, Any] | str | None = None,
    progress: Progress = lambda done, total: None,
    devices: Sequence[Device] = (),
    coverage: float = 0.95,
    kind: Kind = "symmetric",
    digits: Literal[1, 2] = 2,
    most: int = MOST,
    keep: int = KEEP,
) -> Ensemble:
    """Run a Monte Carlo campaign and summarise it; memory does not grow with the number of draws.

    `draws` is their number, or ``"adaptive"``. An adaptive campaign ends when y, u and both ends of
    the coverage interval of every scalar output are stable (JCGM 101, 7.9.4: 2 s <= delta, delta
    from u written with `digits` significant digits). This is checked after every sub-block: of
    `step` draws, or of max(100/(1 - p), 10 000) draws, rounded up to whole blocks; `most` is the
    largest number of draws. `coverage` and `kind` define the interval whose precision is
    monitored; the result provides any other interval as well.

    `outputs` and `fields` declare the results of `evaluate`: arrays of shape (count, *shape) in
    float64. All values of scalar outputs are kept as long as their total number is at most `keep`;
    beyond it, quantiles come from counts in fine bins, with a known bound of their error.

    `chunk` is the number of blocks between two checkpoints and calls of `progress`; by default, as
    many as take about two seconds. With a `folder`, a killed campaign resumes from its last
    finished chunk with the same numbers, and a finished one can be extended to more draws.
    `fingerprint` names everything on which the draws depend, the seed first; output declarations,
    block size and versions are added to it. With several `devices`, whole blocks go to them in
    turn, and `evaluate` gets the device (``device=``). It may return before its arrays are
    computed.

    `KeyboardInterrupt` ends the campaign with the results so far (`Ensemble.interrupted`).

    Raises `ValueError` for invalid settings, as a `step` of an adaptive campaign that is not in
    whole blocks, and for values that differ from their declaration, and
    `StudyError` for a folder of another campaign, or one that another process uses.
    """
    outputs, fields = tuple(outputs), tuple(fields)
    check_declared(outputs, fields)
    check_coverage(coverage)
    total = _total(draws, most)
    _check(block, chunk, digits, kind, folder is None or bool(fingerprint))
    if draws == "adaptive" and not outputs:
        raise ValueError("an adaptive campaign needs a scalar output to watch; found fields only")
    usual = step_size(coverage, block)
    step = usual if step is None else step
    if step < 2 or (draws == "adaptive" and step % block):
        raise ValueError(
            f"step: found {step}, expected at least 2 draws, and for an adaptive campaign whole "
            f"blocks of {block}"
        )
    summary = Summary(Declared(outputs, fields, step, coverage, kind, keep))
    checkpoint = None
    if folder is not None:
        mode = f"adaptive, {digits} digits" if draws == "adaptive" else "given"
        settings = _settings(fingerprint, summary.declared, block, mode)
        if step != usual:
            settings["sub-block"] = step
        checkpoint = Checkpoint(Path(folder), settings)
    watched = digits if draws == "adaptive" else None
    try:
        if checkpoint is not None:
            _resume(summary, checkpoint, total)
        run = _Run(summary, checkpoint, total, block, chunk, watched)
        interrupted = _drive(run, evaluate, progress, devices)
    finally:
        if checkpoint is not None:
            checkpoint.release()
    if interrupted and summary.draws < 2:
        raise KeyboardInterrupt
    adaptive = None
    if draws == "adaptive":
        adaptive = summary.steps.adaptive(summary.moments.deviation, digits)
    return ensemble_of(summary, adaptive, interrupted)


class _Run:
    """A running campaign. Its methods are called in one thread, block after block.

    That thread is not the main thread, in which `KeyboardInterrupt` is raised, so that every block
    is added completely or not at all.
    """

    def __init__(
        self,
        summary: Summary,
        checkpoint: Checkpoint | None,
        total: int,
        block: int,
        chunk: int | None,
        digits: int | None,
    ):
        self.summary, self.checkpoint, self.total = summary, checkpoint, total
        self.block, self.chunk, self.digits = block, chunk, digits
        self.next = summary.draws // block
        """Number of the first missing block."""
        self.saved = self.next
        self.started, self.saving = time.monotonic(), 0.0
        self.settled = False

    def take(self, number: int, values: Mapping[str, Array]) -> bool:
        """Add a block; returns whether a chunk ended with it."""
        if number != self.next or self.ended:
            return False  # an earlier block is missing, or this one is not needed any more
        rows = min(self.block, self.total - number * self.block)
        if rows < self.block:
            self.save()  # a longer campaign resumes without a truncated block
        self.summary.add(values, self.block, rows)
        self.next += 1
        self.judge()
        return self._added(rows == self.block)

    def take_summary(self, number: int, coming: Coming) -> bool:
        """Add whole blocks that were summarised elsewhere, as `take` does."""
        if number != self.next or self.ended:
            return False
        found = coming.result()
        self.summary.merge(found)
        self.next += found.draws // self.block
        self.judge()
        return self._added(True)

    def _added(self, whole: bool) -> bool:
        if whole and (self.ended or self._chunk_ended()):
            self.save()
            return True
        return self.ended

    def judge(self) -> None:
        """Check the stability of an adaptive campaign at the end of a sub-block."""
        summary = self.summary
        if self.digits is None or summary.draws % summary.declared.step:
            return
        if summary.steps.steps > 1:
            found = summary.steps.adaptive(summary.moments.deviation, self.digits)
            self.settled = found.done

    def save(self) -> None:
        """End a chunk: write the state, if it is to be written and has changed."""
        begun = time.monotonic()
        if self.checkpoint is not None and self.next > self.saved:
            self.checkpoint.save(self.summary.arrays(), self.summary.kept)
        self.saved, self.started = self.next, time.monotonic()
        self.saving = self.started - begun

    @property
    def ended(self) -> bool:
        """Whether there are enough draws."""
        return self.settled or self.next * self.block >= self.total

    def _chunk_ended(self) -> bool:
        if self.chunk is not None:
            return self.next - self.saved >= self.chunk
        return time.monotonic() - self.started > max(_CHUNK_S, _SAVING * self.saving)


def _drive(run: _Run, evaluate: Evaluate, progress: Progress, devices: Sequence[Device]) -> bool:
    """Evaluate and add all missing blocks; returns whether this was interrupted.

    While a block is added, the next ones are computed, one per device.
    """
    waiting: deque[Future[bool]] = deque()
    summary, block = run.summary, run.block
    remote = evaluate if isinstance(evaluate, Remote) else None

    def collect(most: int) -> None:
        while len(waiting) > most:
            chunk_ended = waiting[0].result()
            waiting.popleft()
            if chunk_ended:
                progress(run.summary.draws, run.total)

    with ThreadPoolExecutor(1, "vcal-summary") as keeper:
        try:
            run.judge()
            number = run.next
            while number < math.ceil(run.total / block) and not run.ended:
                first, blocks = number * block, 1
                layout = summary.layout if remote is not None else None
                if remote is not None and layout is not None and first + block <= run.total:
                    blocks = summary.together(number, block, run.total)
                    if blocks > 1 and layout.bins is None:
                        collect(0)  # the values so far show where the bins are to lie
                        keeper.submit(summary.count).result()
                        layout = summary.layout or layout
                    coming = remote.summaries(first, block, blocks, summary.declared, layout)
                    waiting.append(keeper.submit(run.take_summary, number, coming))
                else:
                    if devices:
                        values = evaluate(first, block, device=devices[number % len(devices)])
                    else:
                        values = evaluate(first, block)
                    waiting.append(keeper.submit(run.take, number, values))
                # The first block shows how further ones are summarised.
                collect(0 if remote is not None and not summary.draws else max(len(devices), 1))
                number += blocks
            collect(0)
        except KeyboardInterrupt:
            for future in waiting:
                future.result()
            if run.ended:
                return False
            keeper.submit(run.save).result()
            return True
    return False


def _resume(summary: Summary, checkpoint: Checkpoint, total: int) -> None:
    """Resume from the state in the folder of a checkpoint, if there is one."""
    held = checkpoint.load()
    if held is None:
        return
    try:
        summary.restore(held.arrays, held.kept)
    except UNWRITTEN as error:
        raise unwritten(checkpoint.folder / STATE, error) from error
    if summary.draws > total:
        raise StudyError(
            f"{checkpoint.folder / STATE}: found {summary.draws} draws, expected at most the "
            f"{total} requested; request at least as many, or choose another folder"
        )


def _settings(
    fingerprint: Mapping[str, Any] | str | None, declared: Declared, block: int, mode: str
) -> dict[str, Any]:
    """Everything on which the numbers in a folder depend, by name."""
    own = {"campaign": fingerprint} if isinstance(fingerprint, str) else dict(fingerprint or {})
    return own | {
        "outputs": [[o.name, o.shape] for o in declared.outputs],
        "fields": [[f.name, f.shape, f.quantiles] for f in declared.fields],
        "block": block,
        "number of draws": mode,
        "coverage": [declared.coverage, declared.kind],
        "values kept at most": declared.keep,
        "platform": jax.default_backend(),
        "versions": {name: _version(name) for name in ("vcal", "jax", "numpy")},
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def _total(draws: int | Literal["adaptive"], most: int) -> int:
    """The largest possible number of draws."""
    total = most if draws == "adaptive" else draws
    if not isinstance(total, int | np.integer) or not 2 <= total <= _INDICES:
        raise ValueError(
            f"draws: found {total!r}, expected a whole number from 2 to 2^32, or 'adaptive'"
        )
    return int(total)


def _check(block: int, chunk: int | None, digits: int, kind: str, named: bool) -> None:
    if block < 1 or (chunk is not None and chunk < 1):
        raise ValueError(f"found block = {block}, chunk = {chunk}, expected at least 1 each")
    if digits not in (1, 2):
        raise ValueError(f"digits: found {digits}, expected 1 or 2 (JCGM 101, 7.9.2)")
    if kind not in ("symmetric", "shortest"):
        raise ValueError(f"kind: found {kind!r}, expected 'symmetric' or 'shortest'")
    if not named:
        raise ValueError(
            "a campaign in a folder needs a fingerprint: everything its draws depend on, the seed "
            "first"
        )
