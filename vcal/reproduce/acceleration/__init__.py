"""Acceleration-correlated errors of machine tools: Nguyen, Weikert, Wegener (2013), IWF.

The machine, the movements and the measurement of the publication, of which it prints little more
than what came out.
"""
