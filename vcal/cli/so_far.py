"""What the loop has found so far, kept for an interruption before the report is written."""

import datetime
from pathlib import Path
from typing import Any

from ..report.html.folder import INTERRUPTED_FILE, write_interrupted
from ..words import counted
from . import interruption

SCHEMA = "vcal-interrupted/1"


class SoFar:
    """The effects that a running loop has added, written where it is interrupted.

    They are final neither in number nor in value: effects that are found later change them, and
    their rivals have not been weighed again.
    """

    def __init__(self, out: Path, command: str):
        self.out, self.command = out, command
        self.effects: list[dict[str, Any]] = []
        interruption.keep(self.save)

    def known(self, effects: list[dict[str, Any]]) -> None:
        """Take the effects that are known now."""
        self.effects = effects

    def save(self) -> str:
        """Write the effects into the folder of the report; the sentence that says so."""
        effects = self.effects
        earlier = "; the earlier report is as it was" if (self.out / "report.json").exists() else ""
        if not effects:
            return f"interrupted; nothing was written{earlier}"
        write_interrupted(
            self.out,
            {
                "schema": SCHEMA,
                "command": self.command,
                "written": datetime.datetime.now().isoformat(timespec="seconds"),
                "interrupted": True,
                "effects": effects,
            },
        )
        names = ", ".join(f"{one['effect']} {one['placement']}".strip() for one in effects)
        return (
            f"interrupted: {counted(len(effects), 'effect')} found so far ({names}), in "
            f"{self.out / INTERRUPTED_FILE}{earlier}"
        )

    def written(self) -> None:
        """From now on there is a report."""
        interruption.keep(lambda: f"interrupted; the report in {self.out} is complete")
