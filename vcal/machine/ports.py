"""Ports: the quantities through which effects act on an observation.

All effects act on the readings through a short vector of *ports* per observation: six numbers per
joint (ISO 230-1: three error translations, three error rotations, in the joint's own moving frame),
six at the tool, and those that the instrument declares (its frame, its targets, its readings). The
derivative of one observation with respect to its ports is a small matrix that is compiled once per
chain and instrument. The derivative with respect to any parameter of any effect is that matrix
times the response of the effect. Adding an effect therefore compiles nothing.
"""

from dataclasses import dataclass

COMPONENTS = ("X", "Y", "Z", "A", "B", "C")
"""Order of the six components of a twist: translations along, then rotations about x, y, z."""


@dataclass(frozen=True)
class PortLayout:
    """Names of the ports and their position in the port vector."""

    names: tuple[str, ...]

    @classmethod
    def of(cls, axes: tuple[str, ...], instrument_ports: tuple[str, ...]) -> "PortLayout":
        """Six ports per axis named as in ISO 230-1 (``"EXY"``: translation along x of axis Y),
        six for the tool (``"tool.X"`` ... ``"tool.C"``), then the instrument's own.
        """
        joints = tuple(f"E{c}{axis}" for axis in axes for c in COMPONENTS)
        tool = tuple(f"tool.{c}" for c in COMPONENTS)
        return cls(joints + tool + instrument_ports)

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def index(self, name: str) -> int:
        """Position of a port. Raises `ValueError` that lists the known ports."""
        try:
            return self.names.index(name)
        except ValueError:
            raise ValueError(
                f"no port named {name!r}; this model has {', '.join(self.names)}"
            ) from None

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the port groups, without the names of data sets."""
        named = (name.rpartition(":")[2].partition(".") for name in self.names)
        return tuple(dict.fromkeys(head for head, dot, _ in named if dot))

    def slice(self, group: str) -> slice:
        """The contiguous ports named ``group.*``. Raises `ValueError` where there are none."""
        inside = [i for i, name in enumerate(self.names) if name.startswith(group + ".")]
        if not inside:
            raise ValueError(f"no ports named {group!r}.*; this model has {', '.join(self.names)}")
        return slice(inside[0], inside[-1] + 1)


def group(name: str, components: tuple[str, ...] = COMPONENTS) -> tuple[str, ...]:
    """Port names of a group: ``group("frame")`` is ``("frame.X", ..., "frame.C")``."""
    return tuple(f"{name}.{c}" for c in components)
