"""The reproduction from its arguments to the folder."""

from pathlib import Path

from ...errors import StudyError
from ..registry import Progress, Reproduction, check_place, write
from .page import page
from .pictures import pictures
from .record import record
from .results import CYCLES, LEAST, compute
from .table import table

_NAME = "laser-frame"


def run(out: Path, draws: int, seed: int, progress: Progress) -> Path:
    """Compute everything and write it into `out`; returns the path of the page.

    Raises `StudyError` for a folder with other things in it, and for too few cycles or a negative
    seed.
    """
    check_place(_NAME, out)
    if draws < LEAST or seed < 0:
        raise StudyError(
            f"found draws = {draws}, seed = {seed}, expected at least {LEAST} draws, so that the "
            "cycles have a spread, and a seed of at least 0; correct them"
        )
    results = compute(draws, seed, progress)
    progress("drawing the pictures")
    rows, drawn = table(results), pictures(results)
    flat = [picture for group in drawn.values() for picture in group]
    return write(_NAME, out, page(results, rows, drawn), rows, record(results), flat)


LASER_FRAME = Reproduction(
    name=_NAME,
    summary="A laser frame measures thermo-elastic errors, and its budget: Brecher et al. 2022",
    run=run,
    draws=CYCLES,
)
