"""Writers of exports, from numpy and the standard library alone: what `vcal import` reads."""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

LENGTH = {"mm": 1.0, "m": 1e-3, "inch": 1 / 25.4, "um": 1e3}
"""Number in a unit per millimetre."""
ANGLE = {"deg": 180 / math.pi, "rad": 1.0, "gon": 200 / math.pi}
"""Number in a unit per radian."""
OFFSET = np.array([0.0, 0.0, -150.0])
STATION = np.array([-900.0, 350.0, 420.0])


def text_of(value, decimal="."):
    """All digits of a number, with a decimal mark."""
    return repr(float(value)).replace(".", decimal)


def lines_of(rows, separator=",", decimal="."):
    """Lines of cells, which are texts or numbers."""
    return [
        separator.join(cell if isinstance(cell, str) else text_of(cell, decimal) for cell in row)
        for row in rows
    ]


def write(path: Path, lines, encoding="utf-8", newline="\n"):
    """A text file."""
    path.write_bytes(newline.join([*lines, ""]).encode(encoding))
    return path


def tracker_case(rows=40, seed=0, noise_mm=2e-3):
    """Positions of a machine w X b Y Z t and the points that a tracker sees in its frame, mm."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform([0, 0, 0], [1000, 600, 500], (rows, 3))
    turn = Rotation.from_euler("XYZ", [3.0, -2.0, 25.0], degrees=True).as_matrix()
    seen = (positions + OFFSET - STATION) @ turn + noise_mm * rng.standard_normal((rows, 3))
    return positions, seen


def polar(seen):
    """Range, azimuth and elevation of points."""
    r = np.sqrt((seen**2).sum(1))
    return r, np.arctan2(seen[:, 1], seen[:, 0]), np.arcsin(seen[:, 2] / r)


def coordinates(seen, system):
    """Three columns of a coordinate system, mm and rad, and whether each is an angle."""
    r, azimuth, elevation = polar(seen)
    if system == "cartesian":
        return seen.T, ("X", "Y", "Z"), (False, False, False)
    if system == "cylindrical":
        level = np.hypot(seen[:, 0], seen[:, 1])
        return (level, azimuth, seen[:, 2]), ("R", "Theta", "Z"), (False, True, False)
    if system == "zenith":
        names = ("Distance", "Hz", "Zenith")
        return (r, azimuth, np.pi / 2 - elevation), names, (False, True, True)
    return (r, azimuth, elevation), ("Range", "Azimuth", "Elevation"), (False, True, True)


def sphere_contacts(centre, radius, count, rng):
    """Points on a sphere that a probe touches from above and from the sides."""
    azimuth = 2 * np.pi * np.arange(count - 1) / (count - 1) + rng.uniform(0, 1)
    tilt = rng.uniform(0.0, 0.4, count - 1)
    around = np.column_stack(
        [np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)]
    )
    return centre + radius * np.vstack([[0, 0, 1], around])
