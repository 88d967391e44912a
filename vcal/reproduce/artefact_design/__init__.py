"""Optimal design of artefacts for machine tool calibration: Aguirre et al. (2019), IDEKO.

The publication sweeps three numbers of a ball artefact by Monte Carlo; here the same sweeps come
from theory and from campaigns, and the design then follows the gradient of the expected error.
"""

from ..registry import Reproduction
from .page import page
from .pictures import pictures
from .record import record
from .results import LEAST, MACHINES, compute
from .table import table

ARTEFACT_DESIGN = Reproduction(
    name="artefact-design",
    summary="A ball artefact and its poses designed for a machine tool: Aguirre et al. 2019",
    compute=compute,
    table=table,
    pictures=pictures,
    record=record,
    page=page,
    counted="machines",
    draws=MACHINES,
    least=LEAST,
)

__all__ = ["ARTEFACT_DESIGN"]
