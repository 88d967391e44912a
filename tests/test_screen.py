"""Screening: its statistic against refits, its p-values against chance, and what it finds."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from known import Known
from vcal import CATALOGUE, Effect, Measurement, Parameter, identify
from vcal.effects.events import Jump
from vcal.loop.candidates import candidates
from vcal.loop.rivals import refit_all, weigh
from vcal.loop.screen import Screen, minus_log_chi2_tail, screen
from vcal.loop.stray import stray_rows

KINDS = ("laser_tracker", "ball_array")
FEW = ("backlash", "lateral_reversal", "thermal_offset", "thermal_tilt", "drift", "cross_axis")


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> dict[str, Known]:
    folder = tmp_path_factory.mktemp("known")
    return {kind: Known(kind, folder) for kind in KINDS}


def noisy(it: Known, rng, *effects: Effect, theta=None, factor: float = 1.0) -> Measurement:
    """Readings with noise; for a ball array the noise of the residual, which is the same."""
    theta = it.theta if theta is None else theta
    sign = -1.0 if it.case.balls is not None else 1.0  # residual zero at the true effects
    ideal = it.readings(*effects, theta=theta)
    if sign < 0:
        ideal = 2.0 * it.readings(theta=theta) - ideal
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    return Measurement(it.plan, ideal + factor * sigma * rng.standard_normal(sigma.shape))
