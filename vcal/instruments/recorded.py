"""Recorded accelerometers and inclinometers: columns that respond to a tilt and cause none.

- ``base_ax_m_s2``: the specific force along x of the bed that an accelerometer named ``base`` reads
  at rest. A tilt w turns its axes, and the reading changes by -g (w x up) . x.
- ``base_rx_urad``: the rotation about x that an inclinometer named ``base`` reads, w . x.

x, y and z are the axes of the bed, or of an arm's base. A column ``a_x_m_s2`` without a name is the
acceleration of the axis X, and no response.
"""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_RESPONSE = re.compile(r"[A-Za-z]\w*_(?:a([xyz])_m_s2|r([xyz])_urad)")
STANDARD_GRAVITY = 9.80665
"""m/s^2."""


@dataclass(frozen=True)
class ResponseColumn:
    """What a recorded response measures."""

    name: str
    along: tuple[float, float, float]
    """Direction of its axis in the frame of the bed."""
    accelerates: bool
    """Whether it is an accelerometer; else an inclinometer."""
    unit: str

    def reading(
        self, tilt: Float[np.ndarray, "n 3"], up: tuple[float, float, float]
    ) -> Float[np.ndarray, " n"]:
        """Change of the reading, in its unit, by tilts (n, 3), rad, in the frame of the bed."""
        along = np.array(self.along)
        if self.accelerates:
            return -STANDARD_GRAVITY * np.cross(tilt, np.array(up)) @ along
        return 1e6 * tilt @ along


def response_column(name: str) -> ResponseColumn | None:
    """The response that a column records, by its name; None for any other column.

    In a study of several data sets, the name of the data set may precede that of the column.
    """
    found = _RESPONSE.fullmatch(name.rpartition(":")[2])
    if found is None:
        return None
    x, y, z = np.eye(3)["xyz".index(found[1] or found[2])].tolist()
    return ResponseColumn(name, (x, y, z), bool(found[1]), "m/s^2" if found[1] else "urad")
