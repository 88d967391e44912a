"""Pictures in three dimensions that the reader of a page can turn.

A scene is data: places, and layers of errors at them. The script `scene.js` draws it on a canvas,
from the JSON that the page holds. Without a script, and in print, the pictures below the scene show
the same numbers.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

_STEPS = 500
"""Numbers of a layer are multiples of its largest one over this: more cannot be seen."""
_DIGITS = 5
"""Significant digits of a place."""


@dataclass(frozen=True)
class Places:
    """Points at which errors are shown."""

    points: Float[np.ndarray, "n 3"]
    """mm."""
    shape: tuple[int, ...] = ()
    """Points along X, Y and Z where they are a grid; empty: they are none."""


@dataclass(frozen=True)
class Layer:
    """Errors at the points of one of the places of a scene: vectors, or sizes without direction."""

    name: str
    places: int
    """Index of the places."""
    vectors: Float[np.ndarray, "n 3"] | None = None
    """um."""
    sizes: Float[np.ndarray, " n"] | None = None
    """um."""


@dataclass(frozen=True)
class Scene:
    """Layers of errors that are shown one at a time."""

    title: str
    caption: str
    places: Sequence[Places]
    layers: Sequence[Layer]
    up: Sequence[float] = (0.0, 0.0, 1.0)
    """Direction against gravity."""

    @property
    def json(self) -> Markup:
        """The scene as JSON in which no character ends a script or begins a tag."""
        content = {
            "title": self.title,
            "up": [float(x) for x in self.up],
            "places": [_places(one) for one in self.places],
            "layers": [_layer(one) for one in self.layers],
        }
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        for sign in "<>&\u2028\u2029":
            text = text.replace(sign, f"\\u{ord(sign):04x}")
        return Markup(text)


def _places(places: Places) -> dict[str, Any]:
    """Coordinates of a grid along its axes, or of every point."""
    points = np.array([float(f"{x:.{_DIGITS}g}") for x in np.ravel(places.points)]).reshape(-1, 3)
    if not places.shape:
        return {"points": points.ravel().tolist()}
    grid = points.reshape(*places.shape, 3)
    first: list[Any] = [grid[:, 0, 0, 0], grid[0, :, 0, 1], grid[0, 0, :, 2]]
    return {"nodes": [line.tolist() for line in first]}


def _layer(layer: Layer) -> dict[str, Any]:
    """Whole numbers, and the step in um that they are multiples of; None where there is none."""
    values = layer.vectors if layer.vectors is not None else layer.sizes
    assert values is not None
    known = np.isfinite(values)
    step = float(f"{float(np.abs(values).max(initial=0.0, where=known)) / _STEPS or 1.0:.6g}")
    whole = np.rint(np.where(known, values, 0.0) / step).astype(int).ravel().tolist()
    return {
        "name": layer.name,
        "places": layer.places,
        "vectors": layer.vectors is not None,
        "step": step,
        "values": [v if k else None for v, k in zip(whole, known.ravel(), strict=True)],
    }
