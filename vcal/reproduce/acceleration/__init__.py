"""Acceleration-correlated errors of machine tools: Nguyen, Weikert, Wegener (2013), IWF.

The machine, the movements and the measurement of the publication, of which it prints little more
than the results; and what it left for later: the identification of the machine from its circles.
"""

from .description import ACCELERATION

__all__ = ["ACCELERATION"]
