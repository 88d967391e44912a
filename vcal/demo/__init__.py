"""Bundled studies: the demo, and one start study per instrument (README.md), with simulated data.

`plans` holds the plans behind the data. Uses `study` and what lies below; `report`, `reproduce` and
`cli` may stand on it.
"""

from pathlib import Path

FOLDER = Path(__file__).parent
"""Folder of the demo: a laser-tracker measurement with an undeclared thermal effect."""
STARTS = FOLDER / "start"


def starts() -> list[str]:
    """Kinds of instruments with a start study."""
    return sorted(entry.name for entry in STARTS.iterdir() if entry.is_dir())
