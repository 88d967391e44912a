"""Numerical ground: least squares, rigid motions, compiled programs, caches, reproducible draws.

Nothing here knows of machines or measurements; only jax, numpy and scipy. Every room above may use
it.
"""
