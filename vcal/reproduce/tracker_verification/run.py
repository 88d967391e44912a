"""The reproduction from its arguments to the folder."""

from pathlib import Path

from ...errors import StudyError
from ..registry import Progress, Reproduction, check_place, write
from .page import page
from .pictures import pictures
from .record import record
from .results import LEAST, compute
from .setting import Setting
from .table import table

_NAME = "tracker-verification"
_DRAWS = 30_000


def run(
    out: Path, draws: int, seed: int, progress: Progress, setting: Setting | None = None
) -> Path:
    """Compute everything and write it into `out`; returns the path of the page.

    `setting` gives grid and degrees where they are not the usual ones. Raises `StudyError` for a
    folder with other things in it, and for too few tests or a negative seed.
    """
    check_place(_NAME, out)
    if draws < LEAST or seed < 0:
        raise StudyError(
            f"found draws = {draws}, seed = {seed}, expected at least {LEAST} draws, so that the "
            "tests have a spread, and a seed of at least 0; correct them"
        )
    results = compute(draws, seed, progress, setting or Setting())
    progress("drawing the pictures")
    rows, drawn = table(results), pictures(results)
    flat = [picture for group in drawn.values() for picture in group]
    return write(_NAME, out, page(results, rows, drawn), rows, record(results), flat)


TRACKER_VERIFICATION = Reproduction(
    name=_NAME,
    summary="A laser tracker verifies a milling machine, and what that leaves: Aguado et al. 2017",
    run=run,
    draws=_DRAWS,
)
