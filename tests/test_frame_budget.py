"""The budget of the laser frame, figure by figure as printed."""

import math

import numpy as np
import pytest

from vcal.reproduce.laser_frame.budget import (
    PSD_RANGES,
    Facts,
    combined,
    figures,
    point_budget,
    psd_u,
    refraction,
    refraction_by_snell,
)


@pytest.mark.parametrize("figure", figures(), ids=lambda f: f.quantity)
def test_every_printed_figure(figure):
    """To one unit of its last digit without rounding, and as printed with its roundings."""
    unit = 10.0**-figure.digits
    assert abs(figure.exact - figure.published) <= unit * (1 + 1e-9)
    assert figure.rounded == pytest.approx(figure.published, abs=1e-9)


def test_unrounded_it_is_less():
    assert 2.0 * float(point_budget(1.3, 1.5).u[0]) == pytest.approx(2.25, abs=0.005)
    assert combined() == pytest.approx(1.126, abs=0.001)


def test_the_budget_by_hand():
    """Root of the sum of squares, with every half-width over the square root of three."""
    f, r = Facts(), math.sqrt(3.0)
    parts = {
        "refraction": 5e3 * (math.tan(math.atan(0.025) + 110e-6) - 0.025) / r,
        "resolution": 0.1 / r,
        "frame": 0.066 * 1.7 * 1.7 / r,
        "head alpha": 0.193 * 0.425 * 2.0 / r,
        "head length": 0.05e-3 * 1.7 * 2.0 / r,
        "head sensor": 0.193 * 1.7 * 0.25 / r,
        "head chain": 0.193 * 1.7 * 0.1 / r,
        "tool interface": 0.26 / math.sqrt(7),
        "psd repeatability": 0.05,
        "deflection": 0.7**2 / 3.0,
        "psd linearity": 0.4 / r,
    }
    found = point_budget(0.4, 0.7, f)
    named = dict(zip(found.source.labels, found.contribution[0], strict=True))
    assert named == pytest.approx(parts, rel=1e-9)
    assert float(found.u[0]) == pytest.approx(math.sqrt(sum(u * u for u in parts.values())))
    assert float(found.value[0]) == pytest.approx(0.193 * 1.7 * 2.0)  # what is corrected


def test_it_depends_on_the_place():
    middle, end = point_budget(0.0, 0.0), point_budget(1.3, 1.05)
    assert float(middle.u[0]) < 0.4 < float(end.u[0])
    assert psd_u(0.0) == pytest.approx(0.05)
    assert len(PSD_RANGES) == 10


def test_the_safe_side():
    """Without the glass the shift is n / (n - 1) times as large, about."""
    assert refraction() / refraction_by_snell() == pytest.approx(3.0, rel=0.01)
    assert np.isclose(refraction_by_snell(Facts(glass=1.0 + 1e-9)), 0.0, atol=1e-6)
