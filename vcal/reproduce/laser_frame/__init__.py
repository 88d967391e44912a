"""A laser frame measures thermo-elastic errors: Brecher et al. (2022), MM Science Journal.

The budget figure by figure, the Monte Carlo of thirteen errors, the check by a second device; then
what the beams cannot see, and where the points had better be.
"""

from ..registry import Reproduction
from .page import page
from .pictures import pictures
from .record import record
from .results import CYCLES, LEAST, compute
from .table import table

LASER_FRAME = Reproduction(
    name="laser-frame",
    summary="A laser frame measures thermo-elastic errors, and its budget: Brecher et al. 2022",
    compute=compute,
    table=table,
    pictures=pictures,
    record=record,
    page=page,
    counted="cycles",
    draws=CYCLES,
    least=LEAST,
)

__all__ = ["LASER_FRAME"]
