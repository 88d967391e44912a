"""Recorded times that run backwards from row to row."""

import numpy as np

from ...machine.plan import Plan, of_set
from ...model.measurement import rows_in_words


def backward_rows(plan: Plan) -> dict[str, list[int]]:
    """Rows (from 0) whose time is earlier than that of the row before, by data set.

    Every run may start anew where the data number the runs.
    """
    found = {}
    for name, inside in plan.parts.items():
        time, run = (of_set(name, key) if name else key for key in ("t", "run"))
        if not plan.has(time):
            continue
        rows, t = np.flatnonzero(inside), plan.values(time)
        runs = plan.values(run)[rows] if plan.has(run) else np.zeros(len(rows))
        found[name] = []
        for index in np.unique(runs):
            own = rows[runs == index]
            found[name] += own[1:][np.diff(t[own]) < 0.0].tolist()
    return {name: sorted(rows) for name, rows in found.items() if rows}


def backwards(plan: Plan) -> list[str]:
    """A sentence for every data set whose times run backwards."""
    return [
        f"t_s runs backwards at {rows_in_words([plan.place(row)[1] + 1 for row in rows])}"
        + (f" of {name}" if name else "")
        + ": effects of time follow these times; correct the column, sort the rows by time, or "
        "number the runs in a column run if the clock restarts"
        for name, rows in backward_rows(plan).items()
    ]
