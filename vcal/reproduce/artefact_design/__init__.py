"""Optimal design of artefacts for machine tool calibration: Aguirre et al. (2019), IDEKO.

The publication sweeps three numbers of a ball artefact by Monte Carlo; here the same sweeps come
from theory and from campaigns, and the design then follows the gradient of the expected error.
"""

from .description import ARTEFACT_DESIGN

__all__ = ["ARTEFACT_DESIGN"]
