"""Acceleration-correlated errors of machine tools: Nguyen, Weikert, Wegener (2013), IWF.

The machine, the movements and the measurement of the publication, of which it prints little more
than what came out; and what it left for later: the identification of the machine from its circles.
"""

from ..registry import Reproduction
from .page import page
from .pictures import pictures
from .record import record
from .results import CAMPAIGN, LEAST, compute
from .table import table

ACCELERATION = Reproduction(
    name="acceleration",
    summary="What acceleration does to a machine, and which machine does that: Nguyen et al. 2013",
    compute=compute,
    table=table,
    pictures=pictures,
    record=record,
    page=page,
    counted="machines",
    draws=CAMPAIGN,
    least=LEAST,
)

__all__ = ["ACCELERATION"]
