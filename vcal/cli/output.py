"""Standard output that may go away: a pipe whose reader has ended, a full disk, a closed stream.

What a command has computed is not lost with it. Where files are written they are written all the
same, and the rest of the text goes to stderr, after one message.
"""

import contextlib
import errno
import os
import signal
import sys
from typing import Any, TextIO

from .interruption import leave

NAME = "standard output"


class _State:
    """What is known about standard output in this process."""

    def __init__(self) -> None:
        self.lost = False
        self.writes_files = False
        """Whether the command has more to do than to print."""


_STATE = _State()


def lost() -> bool:
    """Whether a part of the text could not be written to standard output."""
    return _STATE.lost


def more_to_do(writes_files: bool) -> None:
    """State whether the command writes files, which it does also where nobody reads its text."""
    _STATE.writes_files = writes_files


def guard() -> None:
    """Have what cannot be written to standard output written to stderr from now on."""
    # Where a standard stream is closed, the next file that is opened would take its place.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            with contextlib.suppress(OSError):
                os.open(os.devnull, os.O_RDWR)
    sys.stdout = _Guarded(sys.stdout, sys.stderr)  # type: ignore[assignment]


class _Guarded:
    """A stream of text that goes on to another one where it fails; a `TextIO` to its users."""

    def __init__(self, stream: TextIO | None, instead: TextIO | None):
        self._stream, self._instead = stream, instead
        if stream is None:
            self._lose(OSError(errno.EBADF, "is closed"))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream or self._instead or sys.__stderr__, name)

    def write(self, text: str) -> int:
        if self._stream is not None:
            try:
                count = self._stream.write(text)
                # A buffer would hide until the end what cannot be written.
                self._stream.flush()
                return count
            except OSError as error:
                self._lose(error)
        if self._instead is not None:
            with contextlib.suppress(OSError):
                self._instead.write(text)
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        stream = self._stream or self._instead
        try:
            if stream is not None:
                stream.flush()
        except OSError as error:
            if self._stream is not None:
                self._lose(error)

    def _lose(self, error: OSError) -> None:
        """Tell it once, and write to the other stream from now on."""
        if self._stream is not None:
            with contextlib.suppress(OSError):  # what is left in its buffer goes nowhere
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)
        self._stream, _STATE.lost = None, True
        if error.errno == errno.EPIPE and not _STATE.writes_files:
            # As of other programs, of which nobody reads the rest.
            leave(128 + getattr(signal, "SIGPIPE", 13))
        if self._instead is not None:
            with contextlib.suppress(OSError):
                self._instead.write(f"vcal: {NAME}: {error.strerror}; the text follows here\n")
