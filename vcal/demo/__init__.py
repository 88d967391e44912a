"""Studies that come with vcal: the demo, and one per instrument to start from (README.md)."""

from pathlib import Path

FOLDER = Path(__file__).parent
"""The demo's study: a laser tracker run with an undeclared thermal effect."""
STARTS = FOLDER / "start"


def starts() -> list[str]:
    """Instruments for which there is a study to start from."""
    return sorted(entry.name for entry in STARTS.iterdir() if entry.is_dir())
