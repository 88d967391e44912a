"""Start-up: Ctrl-C, garbage collection and threads while modules are imported or pictures drawn."""

import contextlib
import gc
import itertools
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Context for imports that take seconds.

    A process that was started as ``vcal`` or ``python -m vcal`` exits at once on Ctrl-C and SIGTERM
    in this context, without a traceback, and its linear algebra uses one thread. Any other program
    gets its `KeyboardInterrupt` and keeps its threads.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(_uncollected())
        if _is_command():
            _single_thread()
            stack.enter_context(_ended_at_once())
        yield


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Context without garbage collection, which would take a quarter of the time of an import.

    Imports leave nothing to free. Nothing is collected right afterwards either: imported objects
    move to the oldest generation.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        # The frozen objects are counted one by one: only where a collection would follow. Objects
        # that the program has frozen stay so.
        if gc.get_count()[0] > gc.get_threshold()[0] and not gc.get_freeze_count():
            gc.freeze()
            gc.unfreeze()
        gc.enable()


@contextlib.contextmanager
def collected_afterwards() -> Iterator[None]:
    """Context that puts off garbage collection, for work that makes many objects and needs them."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()  # new objects are young still, so that the next collection frees them


def _single_thread() -> None:
    """One thread for OpenBLAS, unless the user sets another number: the matrices of a command are
    small.

    Further threads make nothing faster. Where other work shares the cores, they wait for each
    other: a campaign of R-tests then takes fifty times as long.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@contextlib.contextmanager
def _ended_at_once() -> Iterator[None]:
    """Exit at once on Ctrl-C and SIGTERM, by a signal handler.

    An exception can be lost: in a callback of the garbage collector, of which JAX has one, it is
    printed and ignored.
    """
    usual = {number: signal.getsignal(number) for number in _SIGNALS}
    # A process that was started without Ctrl-C, as by nohup, keeps it that way.
    heard = [number for number, handler in usual.items() if handler not in (signal.SIG_IGN, None)]
    for number in heard:
        signal.signal(number, _leave)
    try:
        yield
    finally:
        for number in heard:
            signal.signal(number, usual[number])


def _leave(number: int, frame: FrameType | None) -> None:
    """Exit without cleaning up: nothing has been started yet."""
    os.write(2, b"vcal: interrupted\n")
    os._exit(128 + number)


def _is_command() -> bool:
    if sys.argv[0] == "-m":  # its value until the package is imported
        return ("-m", "vcal") in itertools.pairwise(sys.orig_argv)
    path = Path(sys.argv[0])
    return path.stem == "vcal" or path.parts[-2:] == ("vcal", "__main__.py")
