"""Closing the loop as a study file asks for it."""

from collections.abc import Callable

from ..io import Study
from ..loop.close_loop import close_loop
from ..loop.closure import Closure
from ..measurement import Measurement


def close_study(study: Study, measurement: Measurement, progress: Callable[[str], None]) -> Closure:
    """Close the loop on a measurement with the study's model, check points and settings."""
    return close_loop(
        study.model,
        measurement,
        check=study.check,
        effects=study.tried,
        **study.options.model_dump(exclude={"effects"}),
        progress=progress,
    )
