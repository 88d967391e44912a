"""The command line: `vcal loop`, `demo`, `init`, `simulate`, `check` and `effects`."""

from .commands import app, main

__all__ = ["app", "main"]
