"""The command line ``vcal``: one command per verb, from its arguments to its report.

Every command reads a study, calls one verb and writes one folder. Uses every room below; nothing
but ``python -m vcal`` stands on it. `commands` declares the arguments and the help, `session` holds
what all commands share, and `show` what they print.
"""

from . import certificate_command, compensation_commands, history_command  # commands of `app`
from .commands import app, main

__all__ = ["app", "certificate_command", "compensation_commands", "history_command", "main"]
