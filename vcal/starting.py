"""While the modules are imported, which takes seconds: Ctrl-C, and no garbage collection."""

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
def starting() -> Iterator[None]:
    """End the process at once where it is interrupted in this block, without a traceback, if it was
    started as ``vcal`` or ``python -m vcal``. Any other program sees its `KeyboardInterrupt`.

    By a handler of its own, as an exception can be lost: in a callback of the garbage collector, of
    which JAX has one, it is printed and forgotten.
    """
    with _uncollected(), _at_once():
        yield


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Importing leaves nothing behind to be freed, and looking for it is a sixth of the time."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextlib.contextmanager
def _at_once() -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    # Whoever started the process without Ctrl-C, such as nohup, meant it.
    if not _is_command() or before is not signal.default_int_handler:
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
