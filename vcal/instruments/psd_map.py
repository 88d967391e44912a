"""Calibrated error of a position-sensitive diode on a grid, interpolated between its points."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..errors import RowError, StudyError
from ..numerics.record import Record
from .base import Column, Loader


class PsdMap(Record):
    """Error of both readings, bilinear between the points (u, v) of a rectangular grid, m."""

    u: Float[np.ndarray, " i"]
    v: Float[np.ndarray, " j"]
    error: Float[np.ndarray, "i j 2"]
    name: str = eqx.field(static=True, default="psd_map")

    @classmethod
    def read(cls, name: str, load: Loader) -> "PsdMap":
        """From a table with one row per grid point, in any order.

        Raises `StudyError` where points of the grid are missing or repeated.
        """
        places = [Column(name=c, low=-1e3, high=1e3) for c in ("u_mm", "v_mm")]
        errors = [Column(name=c, low=-1e4, high=1e4) for c in ("error_u_um", "error_v_um")]
        table = load(name, places + errors)
        u, i = np.unique(table["u_mm"], return_inverse=True)
        v, j = np.unique(table["v_mm"], return_inverse=True)
        count = np.zeros((len(u), len(v)), int)
        np.add.at(count, (i, j), 1)
        if len(u) < 2 or len(v) < 2 or (count != 1).any():
            wrong = "at least two values of each"
            if len(u) > 1 and len(v) > 1:
                a, b = np.argwhere(count != 1)[0]
                wrong = (
                    f"every point once, but ({u[a]:g}, {v[b]:g}) mm is there {count[a, b]} times"
                )
            raise StudyError(
                f"{name}: found {len(i)} rows on a grid of {len(u)} x {len(v)} values of u_mm and "
                f"v_mm, expected {wrong}; complete the table"
            )
        error = np.zeros((len(u), len(v), 2))
        error[i, j] = np.column_stack([table["error_u_um"], table["error_v_um"]]) * 1e-6
        return cls(u * 1e-3, v * 1e-3, error, name)

    def __call__(self, place: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Error of both readings at positions (n, 2) on the diode, m.

        Raises `StudyError` for a position outside the grid.
        """
        low = np.array([self.u[0], self.v[0]])
        high = np.array([self.u[-1], self.v[-1]])
        outside = ((place < low) | (place > high)).any(1)
        if outside.any():
            row = int(np.argmax(outside))
            where = ", ".join(f"{1e3 * x:g}" for x in place[row])
            raise RowError(
                row,
                "",
                f"the beam at ({where}) mm on the diode",
                f"a place within the calibrated {1e3 * low[0]:g} to {1e3 * high[0]:g} and "
                f"{1e3 * low[1]:g} to {1e3 * high[1]:g} mm of {self.name}",
                "the beam misses the diode's range: correct psd_u_mm and psd_v_mm, or calibrate "
                "further out",
            )
        i = np.clip(np.searchsorted(self.u, place[:, 0]) - 1, 0, len(self.u) - 2)
        j = np.clip(np.searchsorted(self.v, place[:, 1]) - 1, 0, len(self.v) - 2)
        s = ((place[:, 0] - self.u[i]) / (self.u[i + 1] - self.u[i]))[:, None]
        t = ((place[:, 1] - self.v[j]) / (self.v[j + 1] - self.v[j]))[:, None]
        low_v = (1.0 - s) * self.error[i, j] + s * self.error[i + 1, j]
        high_v = (1.0 - s) * self.error[i, j + 1] + s * self.error[i + 1, j + 1]
        return (1.0 - t) * low_v + t * high_v
