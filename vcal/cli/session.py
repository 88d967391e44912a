"""What all commands share: precision, compilation cache, progress display and error messages."""

import errno
import functools
import gc
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import typer

from .. import enable_float64
from ..errors import StudyError
from ..startup import importing
from ..words import cut, printable
from . import interruption, output

MISTAKE = 2
"""Exit code where the input cannot be used."""
_MOST_CHARACTERS = 1480
"""Most characters of a message after the name of the program."""


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command that reports a `StudyError` as one message with exit code 2, without a traceback.

    The same holds for files that cannot be read or written, and for errors raised in a user's own
    file. Ctrl-C gives exit code 130 where the command does not handle it itself.
    """

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        interruption.begin()
        output.more_to_do(kwargs.get("out") is not None or "folder" in kwargs)
        try:
            _require_unicode(kwargs)
            command(*args, **kwargs)
        except StudyError as error:
            if interruption.received():
                _end_of_interrupted()
            tell(str(error))
            raise typer.Exit(MISTAKE) from None
        except OSError as error:
            if (text := _of_system(error)) is None:
                raise
            tell(text)
            raise typer.Exit(MISTAKE) from None
        except KeyboardInterrupt:
            _end_of_interrupted()
        except BaseException as error:
            if interruption.received():
                _end_of_interrupted()
            from ..study.plugins.trial import own_code_error

            # A user's own effect or instrument was called once on loading, which does not exclude
            # a later failure. Such a class may not end the program with a traceback either.
            text = own_code_error(error) or _out_of_memory(error)
            if text is None:
                raise
            tell(text)
            raise typer.Exit(MISTAKE) from None

    return run


def _end_of_interrupted() -> NoReturn:
    """End a command that was interrupted, by whatever exception: where a compiled module is being
    imported, `KeyboardInterrupt` becomes an `ImportError`.
    """
    interruption.tell_end(interruption.saved())
    raise typer.Exit(interruption.code()) from None


def _of_system(error: OSError) -> str | None:
    """What to say about an error of the system; None for one that is not about files."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    if error.filename is None and not full:
        return None
    remedy = "; make room there and repeat the command" if full else ""
    name = "a file" if error.filename is None else os.fsdecode(error.filename)
    return f"{name}: {error.strerror}{remedy}"


def _out_of_memory(error: BaseException) -> str | None:
    """What to say where there is too little memory; None for another error."""
    text = str(error)
    if not isinstance(error, MemoryError):
        if type(error).__name__ not in ("XlaRuntimeError", "JaxRuntimeError"):
            return None
        if "RESOURCE_EXHAUSTED" not in text and "out of memory" not in text.lower():
            return None
    size = re.search(r"allocat\w* (?:an array of )?(?:size )?(\d[\d.]*) ?(bytes|[KMGT]i?B)", text)
    what = f" for {size[1]} {size[2]}" if size else ""
    return (
        f"memory: found too little of it{what}, expected enough for all rows and draws; end other "
        "programs, use fewer --workers or rows, or another machine; files are as they were"
    )


@contextmanager
def telling(sentences: Callable[[], Sequence[str]]) -> Iterator[None]:
    """Context for the writing of results: where that fails, they are printed before the error."""
    try:
        yield
    except (OSError, StudyError):
        for sentence in sentences():
            say(sentence)
        raise


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


def tell(message: str) -> None:
    """Print a message to the user on stderr."""
    say(f"vcal: {cut(message, _MOST_CHARACTERS)}", err=True)


def say(text: str, err: bool = False) -> None:
    """Print a text, in which the user's own words cannot control the terminal."""
    typer.echo(printable(text), err=err)


def import_modules(*modules: str) -> None:
    """Import modules of vcal, JAX with them: after the help, which does not need it."""
    with importing():
        for name in modules:
            import_module(f"...{name}", __name__)
    gc.freeze()  # what has been imported stays; collections need not look at it again


def start() -> None:
    """Set JAX to float64 with a cache of compiled programs, for the commands that compute."""
    enable_float64()


_LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
_COMPILED = "/jax/core/compile/backend_compile_duration"
"""Events of JAX at the begin and at the end of a compilation."""


@contextmanager
def compiling(show: Callable[[str], None]) -> Iterator[None]:
    """Context in which `show` is told what is being compiled: ``"compiling program 3"``, and an
    empty text where nothing is. Programs from the cache count too.
    """
    import jax.monitoring

    begun = 0

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        nonlocal begun
        del duration_secs, kwargs
        if event == _LOWERED:
            begun += 1
            show(f"compiling program {begun}")
        elif event == _COMPILED:
            show("")

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


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
