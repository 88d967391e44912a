"""What all commands share: precision, compilation cache, progress, and how mistakes are told."""

import functools
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import jax
import typer

from .. import enable_float64
from ..errors import StudyError
from ..study.plugins.trial import told

MISTAKE = 2
"""Exit code where the input cannot be used."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect it: 128 + SIGINT."""
_CALLBACK = "_xla_gc_callback"
_WORTH_KEEPING_S = 0.1
"""Programs that compile faster than this are not kept: reading them back would take as long."""


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command that tells a `StudyError` in one message with exit code 2, without a traceback.

    So are files that cannot be read or written, and what fails in a file of the user's own. Ctrl-C,
    where the command does not deal with it itself, gives exit code 130.
    """

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
        except StudyError as error:
            tell(str(error))
            raise typer.Exit(MISTAKE) from None
        except OSError as error:
            if error.filename is None:
                raise
            tell(f"{error.filename}: {error.strerror}")
            raise typer.Exit(MISTAKE) from None
        except KeyboardInterrupt:
            tell("interrupted; nothing was written")
            raise typer.Exit(INTERRUPTED) from None
        except BaseException as error:
            # Effects and instruments of a user's own were tried once, which not all survive; nor
            # may one of them end the program.
            if (text := told(error)) is None:
                raise
            tell(text)
            raise typer.Exit(MISTAKE) from None

    return run


def tell(message: str) -> None:
    """Print a message to the user on stderr."""
    typer.echo(f"vcal: {message}", err=True)


def listen() -> None:
    """Have Ctrl-C raise `KeyboardInterrupt`, and not where it would be lost.

    What is raised in a callback of the garbage collector is printed and forgotten, and JAX has one
    that runs often; the interruption then comes again a moment later.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        if frame is not None and frame.f_code.co_name == _CALLBACK:
            later = threading.Timer(0.05, _again, [number])
            later.daemon = True
            later.start()
            return
        raise KeyboardInterrupt

    # Whoever started the process without Ctrl-C, such as nohup, meant it.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)


def _again(number: int) -> None:
    """Send a signal to the main thread, so that it wakes up for it."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)
    else:  # Windows
        signal.raise_signal(number)


def leave(code: int) -> NoReturn:
    """End the process at once.

    For interruptions: the compiler's threads may still be at work, and crash where the interpreter
    is taken down below them.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def start() -> None:
    """Make JAX ready for the commands that compute."""
    enable_float64()
    enable_cache()


def cache_folder() -> Path | None:
    """Where compiled programs are kept from one run to the next; None if they are not to be kept.

    ``vcal`` in ``XDG_CACHE_HOME``, or in what the platform has for that purpose. The environment
    variable ``VCAL_NO_CACHE`` switches it off.
    """
    if os.environ.get("VCAL_NO_CACHE"):
        return None
    try:
        home = Path.home()
    except RuntimeError:  # a user without a home
        return None
    if root := os.environ.get("XDG_CACHE_HOME"):
        base = Path(root)
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = home / ".cache"
    return base / "vcal" / f"jax-{jax.__version__}"


def enable_cache() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX was told of another one.

    Without a word where that folder cannot be written: it is only there to save time.
    """
    folder = cache_folder()
    if folder is None or jax.config.jax_compilation_cache_dir is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK | os.X_OK):
        return
    # A file that was cut off, or is being written by another process, is compiled anew.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING_S)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@contextmanager
def working(text: str) -> Iterator[Callable[[str], None]]:
    """Show on a terminal that something is going on, and what: a function to call with the step.

    Quiet where stderr is not a terminal. Nothing of it remains on the screen.
    """
    if not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(text, total=None)
        yield lambda step: progress.update(task, description=step)
