"""Identification: the fit of a model to readings, its covariance, rank and alternatives.

Uses `model` and `numerics`. `geometry`, `loop`, `design`, `uncertainty` and `dynamics` stand on
it.
"""
