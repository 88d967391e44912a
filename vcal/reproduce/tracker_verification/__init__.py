"""A laser tracker verifies a milling machine: Aguado et al. (2017), MESIC, Vigo.

Tests as the publication makes them, and the answer to its claim that the GUM cannot be used.
"""

from .description import TRACKER_VERIFICATION

__all__ = ["TRACKER_VERIFICATION"]
