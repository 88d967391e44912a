"""The volumetric errors that a page of a closed loop shows, as numbers and as a scene."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ... import plots
from ...geometry.error_field import ErrorField, error_field
from ...loop.outcome.closure import Closure
from ..html.scene import Layer, Places, Scene

LEAST_CHANGE_UM = 1e-3
"""Largest change of the error by closing the loop below which it is not shown."""
_FEWEST = 3
"""Check points that an alignment needs."""
_STAGES = {
    "uncompensated": "not compensated",
    "before": "compensated with the declared model",
    "after": "compensated with the identified effects",
}


@dataclass(frozen=True)
class VolumetricErrors:
    """What the pictures of the volumetric error show, computed once."""

    field: ErrorField | None
    """On a grid over the travel; None where the machine has no such grid."""
    check: Mapping[str, Float[np.ndarray, "n 3"]]
    """At the check points, um: ``uncompensated``, ``before`` and ``after``; empty without any."""

    @property
    def changed(self) -> float:
        """Largest change of the field by closing the loop in the mid-planes, um."""
        if self.field is None:
            return 0.0
        planes = (self.field.plane(self.field.change, *plane) for plane in ("XY", "XZ", "YZ"))
        return max(float(np.linalg.norm(one, axis=-1).max()) for one in planes)


def volumetric_errors(closure: Closure) -> VolumetricErrors:
    """The volumetric errors of a closed loop."""
    fits = {"uncompensated": closure.nominal, "before": closure.before, "after": closure.after}
    check = closure.check
    field = error_field(closure.before, closure.after, check, closure.alternatives)
    if check is None or check.tool_point.shape[0] < _FEWEST:
        return VolumetricErrors(field, {})
    return VolumetricErrors(field, plots.check_errors(fits, check))


def scenes(closure: Closure, errors: VolumetricErrors) -> list[Scene]:
    """The error field and the errors at the check points as a scene; none without either."""
    places: list[Places] = []
    layers: list[Layer] = []
    chain = closure.after.model.chain
    if errors.field is not None:
        nodes = [1e3 * errors.field.nodes[axis] for axis in "XYZ"]
        places.append(Places(_points(nodes), tuple(map(len, nodes))))
        layers.append(Layer("Travel: identified error, before compensation", 0,
                            vectors=_rows(errors.field.error)))  # fmt: skip
        if errors.changed > LEAST_CHANGE_UM:
            layers.append(Layer("Travel: left by compensation with the declared model", 0,
                                vectors=_rows(errors.field.change)))  # fmt: skip
        layers.append(Layer("Travel: standard uncertainty, after compensation", 0,
                            sizes=errors.field.u.ravel()))  # fmt: skip
    if errors.check:
        assert closure.check is not None
        places.append(Places(1e3 * np.asarray(closure.check.tool_point)))
        at = len(places) - 1
        layers += [
            Layer(f"Check points: {words}", at, vectors=errors.check[name])
            for name, words in _STAGES.items()
        ]
    if not layers:
        return []
    words = []
    if errors.field is not None:
        words.append(
            "Over the travel: the error that the identified machine has, what a compensation with "
            "the declared model alone would leave of it, and the standard uncertainty of the "
            "identified error, which remains after compensation and has no direction. Effects of "
            "direction, temperature or time are not included."
        )
    if errors.check:
        words.append(
            "At the check points: the measured tool points against the nominal machine, the "
            "declared model and the identified machine."
        )
    caption = (
        f"{' '.join(words)} All after the best rigid alignment; the numbers are those of the "
        "pictures below. Drag, or use the arrow keys, to turn."
    )
    return [Scene("Volumetric error in space", caption, places, layers, chain.up)]


def _points(nodes: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(np.meshgrid(*nodes, indexing="ij"), -1).reshape(-1, 3)


def _rows(vectors: np.ndarray) -> np.ndarray:
    return vectors.reshape(-1, 3)
