"""Corrections of a machine whose errors are known.

- `nc`: NC programs with corrected positions, for any control.
"""
