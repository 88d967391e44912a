"""A laser frame measures thermo-elastic errors: Brecher et al. (2022), MM Science Journal.

The budget figure by figure, the Monte Carlo of thirteen errors, the check by a second device; then
the errors that the beams cannot see, and better places for the points.
"""

from .description import LASER_FRAME

__all__ = ["LASER_FRAME"]
