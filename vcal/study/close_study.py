"""Closing the loop with the settings of a study file."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ..loop.close_loop import close_loop
from ..loop.outcome.closure import Closure
from ..loop.screening.candidates import UntestableError
from ..model.measurement import Measurement
from ..words import unsolvable
from .discrete_changes import check_declared
from .messages import listed, refusal
from .study import Study


def close_study(
    study: Study,
    measurement: Measurement,
    progress: Callable[[str], None],
    known: Callable[[list[dict[str, Any]]], None] = lambda found: None,
) -> Closure:
    """Close the loop on a measurement with the study's model, check points and settings; `known`
    receives what is found, as in `close_loop`.

    Raises `StudyError` where the data allow none of the requested effects to be tested, and where
    the equations of a fit have no solution.
    """
    try:
        return close_loop(
            study.model,
            measurement,
            check=study.check,
            effects=study.tried,
            **study.options.model_dump(exclude={"effects"}),
            require_testable=bool(study.options.effects),
            declared=partial(check_declared, study),
            progress=progress,
            known=known,
        )
    except UntestableError as error:
        raise refusal(
            study.path.name,
            "key loop.effects",
            f"none that could be tested ({'; '.join(error.reasons) or 'no place for them'})",
            "at least one for which the data have the columns that it needs",
            "record the missing columns, or name other effects",
        ) from error
    except np.linalg.LinAlgError as error:
        raise refusal(
            listed([*(one.file for one in study.sets), study.path.name]),
            "columns of positions and readings, tables instrument and model",
            f"equations that have no solution ({unsolvable(error)})",
            "readings that follow the positions, and declared noise, errors and effects of the "
            "size that they have, all in the units of their names",
            "compare the first rows with the measurement protocol, and the declared sizes with the "
            "machine; values that are wrong by many powers of ten are a common cause",
        ) from error
