"""Studies that come with vcal: the demo, and one per instrument to start from (README.md)."""

from pathlib import Path

FOLDER = Path(__file__).parent
"""The demo's study: a laser tracker run with an undeclared thermal effect."""
