"""A laser tracker verifies a milling machine: Aguado et al. (2017), MESIC, Vigo.

Tests as the publication makes them, and the answer to its claim that the GUM cannot be used.
"""

from ..registry import Reproduction
from .page import page
from .pictures import pictures
from .record import record
from .results import CAMPAIGN, LEAST, compute
from .table import table

TRACKER_VERIFICATION = Reproduction(
    name="tracker-verification",
    summary="A laser tracker verifies a milling machine, and what that leaves: Aguado et al. 2017",
    compute=compute,
    table=table,
    pictures=pictures,
    record=record,
    page=page,
    counted="tests",
    draws=CAMPAIGN,
    least=LEAST,
)

__all__ = ["TRACKER_VERIFICATION"]
