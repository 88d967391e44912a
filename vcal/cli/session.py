"""What all commands share: precision, compilation cache, progress display and error messages."""

import contextlib
import errno
import functools
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import typer

from .. import enable_float64
from ..errors import StudyError
from ..startup import importing
from ..words import cut, printable

MISTAKE = 2
"""Exit code where the input cannot be used."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect it: 128 + SIGINT."""
_MOST_CHARACTERS = 1480
"""Most characters of a message after the name of the program."""
_CALLBACK = "_xla_gc_callback"


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command that reports a `StudyError` as one message with exit code 2, without a traceback.

    The same holds for files that cannot be read or written, and for errors raised in a user's own
    file. Ctrl-C gives exit code 130 where the command does not handle it itself.
    """

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            _require_unicode(kwargs)
            command(*args, **kwargs)
        except StudyError as error:
            tell(str(error))
            raise typer.Exit(MISTAKE) from None
        except OSError as error:
            if error.filename is None:
                lost(error)
            tell(f"{error.filename}: {error.strerror}")
            raise typer.Exit(MISTAKE) from None
        except KeyboardInterrupt:
            tell("interrupted; nothing was written")
            raise typer.Exit(INTERRUPTED) from None
        except BaseException as error:
            from ..study.plugins.trial import own_code_error

            # A user's own effect or instrument was called once on loading, which does not exclude
            # a later failure. Such a class may not end the program with a traceback either.
            if (text := own_code_error(error)) is None:
                raise
            tell(text)
            raise typer.Exit(MISTAKE) from None

    return run


def _require_unicode(arguments: Mapping[str, Any]) -> None:
    """Raise `StudyError` for a path or a text that is no Unicode, as file systems allow it: it can
    be in no report.
    """
    for name, value in arguments.items():
        for one in value if isinstance(value, list | tuple) else [value]:
            if isinstance(one, str | Path) and any("\ud800" <= c <= "\udfff" for c in str(one)):
                raise StudyError(
                    f"argument {name}: found {str(one)!r}, with bytes that are no characters, "
                    "expected a text in Unicode; rename the file or the folder"
                )


def lost(error: OSError) -> NoReturn:
    """End the process where what it prints cannot be written, as to a full disk; without a word
    where nobody reads it any more.
    """
    if error.errno == errno.EPIPE:
        os._exit(1)
    with contextlib.suppress(OSError):
        tell(f"the output could not be written: {error.strerror or error}")
    os._exit(MISTAKE)  # the interpreter would try it once more


def tell(message: str) -> None:
    """Print a message to the user on stderr."""
    say(f"vcal: {cut(message, _MOST_CHARACTERS)}", err=True)


def say(text: str, err: bool = False) -> None:
    """Print a text, in which the user's own words cannot control the terminal."""
    typer.echo(printable(text), err=err)


def listen() -> None:
    """Let Ctrl-C raise `KeyboardInterrupt` where it is not lost.

    Python prints and drops an exception raised in a callback of the garbage collector, and JAX has
    such a callback that runs often. An interruption inside it is sent again a moment later.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        if frame is not None and frame.f_code.co_name == _CALLBACK:
            later = threading.Timer(0.05, _again, [number])
            later.daemon = True
            later.start()
            return
        raise KeyboardInterrupt

    # A process that was started with SIGINT ignored, for example by nohup, keeps ignoring it.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)


def _again(number: int) -> None:
    """Send a signal to the main thread, also where it is waiting."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)
    else:  # Windows
        signal.raise_signal(number)


def leave(code: int) -> NoReturn:
    """End the process at once.

    For interruptions: threads of the compiler may still be running, and crash when the interpreter
    shuts down.
    """
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


def import_modules() -> None:
    """Import what all commands use, JAX with it: after the help, which does not need it."""
    with importing():
        from .. import compensation, loop, study  # noqa: F401
    gc.freeze()  # what has been imported stays; collections need not look at it again


def start() -> None:
    """Set JAX to float64 with a cache of compiled programs, for the commands that compute."""
    enable_float64()


@contextmanager
def working(text: str) -> Iterator[Callable[[str], None]]:
    """Show the current step on a terminal; yields the function to call with the next step.

    Silent where stderr is not a terminal. The display is removed at the end.
    """
    if not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(text, total=None)
        yield lambda step: progress.update(task, description=printable(step, lines=False))
