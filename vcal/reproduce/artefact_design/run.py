"""The reproduction from its arguments to the folder."""

from pathlib import Path

from ...errors import StudyError
from ..registry import Progress, Reproduction, check_place, write
from .page import page
from .pictures import pictures
from .record import record
from .results import LEAST, MACHINES, compute
from .table import table

_NAME = "artefact-design"


def run(out: Path, draws: int, seed: int, progress: Progress) -> Path:
    """Compute everything and write it into `out`; returns the path of the page.

    Raises `StudyError` for a folder with other things in it, and for too few machines or a negative
    seed.
    """
    check_place(_NAME, out)
    if draws < LEAST or seed < 0:
        raise StudyError(
            f"found draws = {draws}, seed = {seed}, expected at least {LEAST} draws, so that the "
            "machines have a spread, and a seed of at least 0; correct them"
        )
    results = compute(draws, seed, progress)
    progress("drawing the pictures")
    rows, drawn = table(results), pictures(results)
    flat = [picture for group in drawn.values() for picture in group]
    return write(_NAME, out, page(results, rows, drawn), rows, record(results), flat)


ARTEFACT_DESIGN = Reproduction(
    name=_NAME,
    summary="A ball artefact and its poses designed for a machine tool: Aguirre et al. 2019",
    run=run,
    draws=MACHINES,
)
