"""Published campaigns, done again: each is a leaf that is entered here by its name."""

from typing import Any

from .acceleration import ACCELERATION
from .artefact_design import ARTEFACT_DESIGN
from .laser_frame import LASER_FRAME
from .registry import Reproduction, known
from .tracker_verification import TRACKER_VERIFICATION

REPRODUCTIONS: dict[str, Reproduction[Any]] = {
    one.name: one for one in (ACCELERATION, ARTEFACT_DESIGN, LASER_FRAME, TRACKER_VERIFICATION)
}
"""Every reproduction by the name that the command line takes."""


def reproduction(name: str) -> Reproduction[Any]:
    """A reproduction by name; raises `StudyError` if there is none of that name."""
    return known(name, REPRODUCTIONS)


__all__ = ["REPRODUCTIONS", "Reproduction", "reproduction"]
