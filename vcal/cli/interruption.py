"""Ctrl-C and SIGTERM: told at once, and honoured within two seconds whatever the program does.

A signal raises `KeyboardInterrupt` in the main thread, which ends what it does and writes what is
known. That alone is not enough: compiled code and the compiler run for many seconds without a look
at signals, and an exception that is raised in a callback of the garbage collector is lost. A second
thread therefore waits for signals (`signal.set_wakeup_fd`) and ends the process where the main
thread has not done so in time.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, NoReturn

import typer

from ..files import remove_temporary
from ..words import printable

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect it: 128 + SIGINT."""
_GRACE_S = 1.0
"""Time that the main thread has to end by itself, s. What follows takes a moment."""
_CALLBACK = "_xla_gc_callback"
_AGAIN_S = 0.05


class _State:
    """What is known about signals in this process."""

    def __init__(self) -> None:
        self.number = 0
        """The first signal that came; 0 before."""
        self.told = False
        """Whether the end was told to the user."""
        self.save: Callable[[], str] | None = None
        """Writes what is known so far and returns the sentence that says so."""


_STATE = _State()


def code() -> int:
    """Exit code of a process that was interrupted."""
    return 128 + _STATE.number if _STATE.number else INTERRUPTED


def received() -> bool:
    """Whether a signal has come."""
    return bool(_STATE.number)


def begin() -> None:
    """Forget what an earlier command of this process has kept and told, and how it ended."""
    _STATE.save, _STATE.told, _STATE.number = None, False, 0


def keep(save: Callable[[], str] | None) -> None:
    """Have `save` called where the command is interrupted: it writes what is known so far and
    returns the sentence that says so. It may be called in any thread, once.
    """
    _STATE.save = save


def saved() -> str:
    """Write what is known so far; the sentence that says so."""
    save, _STATE.save = _STATE.save, None
    if save is None:
        return "interrupted; nothing was written"
    try:
        return save()
    except OSError as error:
        return (
            f"interrupted; what is known could not be written: {error.filename}: {error.strerror}"
        )


def tell_end(sentence: str) -> None:
    """Tell the user once that the command was interrupted, and what has become of its results."""
    if not _STATE.told:
        _STATE.told = True
        with contextlib.suppress(OSError):
            typer.echo(f"vcal: {printable(sentence)}", err=True)


def listen(watched: bool = True) -> None:
    """Honour Ctrl-C and SIGTERM from now on; with `watched`, by the end of the process where the
    main thread does not end in time. A signal that the process was started to ignore, as by nohup,
    stays ignored.
    """
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    heard = [number for number, handler in usual.items() if signal.getsignal(number) is handler]
    for number in heard:
        signal.signal(number, _interrupt)
    if heard and watched:
        ours, theirs = os.pipe()
        os.set_blocking(theirs, False)
        signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
        threading.Thread(target=_watch, args=(ours, heard), daemon=True).start()
    lost = sys.unraisablehook

    def unraisable(args: Any) -> None:
        if args.exc_type is not None and issubclass(args.exc_type, KeyboardInterrupt):
            _raise_later()
        else:
            lost(args)

    sys.unraisablehook = unraisable


def quiet() -> None:
    """Leave signals to the system again, which ends the process: nothing is left to be lost.

    Raises `KeyboardInterrupt` for a signal that has come in the meantime.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is _interrupt:
            signal.signal(number, signal.SIG_DFL)


def leave(exit_code: int) -> NoReturn:
    """End the process at once: threads of the compiler may still be running, and crash when the
    interpreter shuts down.
    """
    _end_processes()
    remove_temporary()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(exit_code)


def _interrupt(number: int, frame: FrameType | None) -> None:
    _STATE.number = _STATE.number or number
    if frame is not None and frame.f_code.co_name == _CALLBACK:
        _raise_later()  # an exception in this callback would be printed and dropped
        return
    raise KeyboardInterrupt


def _raise_later() -> None:
    """Raise `KeyboardInterrupt` in the main thread a moment later, where it is not lost."""
    later = threading.Timer(_AGAIN_S, _again, [_STATE.number or signal.SIGINT])
    later.daemon = True
    later.start()


def _again(number: int) -> None:
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)
    else:  # Windows
        signal.raise_signal(number)


def _watch(pipe: int, heard: list[signal.Signals]) -> None:
    """Wait for a signal; end the process where the main thread does not."""
    while True:
        with contextlib.suppress(InterruptedError):
            numbers = [n for n in os.read(pipe, 64) if n in heard]
            if numbers:
                break
    _STATE.number = _STATE.number or numbers[0]
    until = time.monotonic() + _GRACE_S
    while (left := until - time.monotonic()) > 0:
        time.sleep(min(left, 0.05))
    tell_end(saved())
    leave(code())


def _end_processes() -> None:
    """End the processes that this one has started: nobody waits for their results."""
    module = sys.modules.get("multiprocessing")
    for process in module.active_children() if module is not None else ():
        with contextlib.suppress(OSError, AttributeError):
            process.kill()
