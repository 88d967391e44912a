"""A laser frame measures thermo-elastic errors: Brecher et al. (2022), MM Science Journal.

The budget figure by figure, the Monte Carlo of thirteen errors, the check by a second device; then
what the beams cannot see, and where the points had better be.
"""

from .run import LASER_FRAME

__all__ = ["LASER_FRAME"]
