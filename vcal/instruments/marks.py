"""What a picture of the declared machine shows of an instrument: places and frames as numbers."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float


class Mark(NamedTuple):
    """Places of one kind that an instrument knows, such as its station or the balls of an artefact.

    Places are in the frame of the workpiece (of an arm: of its base) or, on the tool, from the tool
    point in the frame of the tool.
    """

    name: str
    """What is there, such as ``"station"``."""
    places: Float[np.ndarray, "k 3"]
    """Places, m."""
    on: Literal["workpiece", "tool"] = "workpiece"
    frame: Float[np.ndarray, "3 3"] | None = None
    """Axes x, y, z (columns) of a frame at the only place; None without a frame."""
    azimuth: bool = False
    """Whether x of the frame is the zero of an azimuth, which is positive towards y."""
    joined: bool = False
    """Whether a line joins the places in their order, such as a beam or the balls of a bar."""
    free: bool = False
    """Whether the place is not declared, but a starting value for its identification."""
