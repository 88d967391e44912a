"""While the modules are imported, which takes seconds: Ctrl-C, no garbage collection, threads."""

import contextlib
import gc
import itertools
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

_INTERRUPTED = 130


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Import in this block what takes seconds.

    A process that was started as ``vcal`` or ``python -m vcal`` ends at once where it is
    interrupted here, without a traceback, and its linear algebra is for one core. Any other program
    sees its `KeyboardInterrupt` and keeps its threads.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(_uncollected())
        if _is_command():
            _alone()
            stack.enter_context(_ended_at_once())
        yield


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Importing leaves nothing behind to be freed, and looking for it is a quarter of the time.

    Nor is it looked for right afterwards: what was imported goes to the oldest generation as it is.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():  # else what the program froze would thaw
            gc.freeze()
            gc.unfreeze()
        gc.enable()


def _alone() -> None:
    """One thread for OpenBLAS, unless the user wants more: the matrices of a command are small.
    Further threads make nothing faster, and where other work shares the cores they wait for each
    other, fifty times as long in a campaign of R-tests.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@contextlib.contextmanager
def _ended_at_once() -> Iterator[None]:
    """By a handler, as an exception can be lost: in a callback of the garbage collector, of which
    JAX has one, it is printed and forgotten.
    """
    before = signal.getsignal(signal.SIGINT)
    # Whoever started the process without Ctrl-C, such as nohup, meant it.
    if before is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _leave(number: int, frame: FrameType | None) -> None:
    """Nothing was begun that would have to be ended."""
    os.write(2, b"vcal: interrupted\n")
    os._exit(_INTERRUPTED)


def _is_command() -> bool:
    if sys.argv[0] == "-m":  # as it is until the package is imported
        return ("-m", "vcal") in itertools.pairwise(sys.orig_argv)
    path = Path(sys.argv[0])
    return path.stem == "vcal" or path.parts[-2:] == ("vcal", "__main__.py")
