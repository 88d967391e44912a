"""Motion of the axes on the circles of a double ball bar, from their positions and the feed."""

import numpy as np
from jaxtyping import Float

from ..errors import RowError
from ..machine.chain import Chain
from ..machine.circles import Circle, circle_through
from ..machine.plan import Plan
from .conditions import file_column

FEED = "feed_mm_min"
"""Column of the feed along the path."""
MM_MIN = 1e-3 / 60.0
"""One mm/min in m/s."""
_AGAINST = 0.5
"""Share of rows whose directions contradict the positions, above which the column is refused."""
_CLEAR = 0.2
"""Speed relative to the highest one, below which a direction is not compared: near reversals."""
_APART = 2.0
"""Least ratio of two accelerations on circles that separates them from errors of the shape."""


def motion(chain: Chain, plan: Plan) -> dict[str, np.ndarray]:
    """Covariates of the motion that follow from the positions of every run, and from the feed.

    Raises `RowError` for directions in the plan that contradict the order of its positions.
    """
    run, position = np.asarray(plan.groups["run"]), np.asarray(plan.position)
    shape = position.shape
    way, since, v, a = (np.zeros(shape) for _ in range(4))
    feed = np.asarray(plan.covariates.get(FEED, np.zeros(plan.rows)), float) * MM_MIN
    if (feed < 0.0).any():
        row = int(np.argmax(feed < 0.0))
        raise RowError(row, f"column {FEED}", "a negative feed", "mm/min", "correct the column")
    circles, pace = chain.linear, []
    for k in np.unique(run):
        mine = np.flatnonzero(run == k)
        found = circle_through(position[mine]) if chain.linear else None
        if found is None:
            way[mine] = _ways(position[mine])
            circles = False
            continue
        circle, angle = found
        way[mine] = circle.direction(angle)
        since[mine] = circle.since_reversal(angle)
        omega = (feed[mine] / np.linalg.norm(circle.cosine))[:, None]
        v[mine] = omega * circle.velocity(angle)
        a[mine] = omega**2 * circle.acceleration(angle)
        pace.append(float(np.linalg.norm(a[mine], axis=1).mean()))
        _check_directions(plan, mine, circle, angle)
    kinds = {"dir": way}
    if circles:
        kinds["since"] = since
        if plan.has(FEED):
            kinds["v"] = v
            if max(pace) > _APART * min(pace):
                kinds["a"] = a
    moving = [axis for i, axis in enumerate(plan.axes) if way[:, i].any()]
    return {
        f"{kind}_{axis}": values[:, plan.axes.index(axis)]
        for kind, values in kinds.items()
        for axis in (moving if kind == "dir" else plan.axes)
    }


def directed_at_rest(plan: Plan, axis: str) -> bool:
    """Whether a plan has directions of an axis in runs in which it does not move: these do not
    follow from the positions.
    """
    if not plan.has(f"dir_{axis}"):
        return False
    run, x = np.asarray(plan.groups["run"]), np.asarray(plan.x(axis))
    way = np.asarray(plan.covariate(f"dir_{axis}"))
    return any(way[run == k].any() and np.ptp(x[run == k]) == 0.0 for k in np.unique(run))


def _ways(position: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, "n axes"]:
    """Direction of approach of every position in a run, from the positions before it; of the first
    position, that in which it is left. Zero for an axis that does not move in the run.
    """
    step = np.diff(position, axis=0)
    still = np.abs(step) <= 1e-6 * np.ptp(position, axis=0)
    way = np.zeros(position.shape)
    for i in range(1, len(position)):
        way[i] = np.where(still[i - 1], way[i - 1], np.sign(step[i - 1]))
    for i in range(len(position) - 2, -1, -1):
        way[i] = np.where(way[i] == 0.0, way[i + 1], way[i])
    return way


def _check_directions(
    plan: Plan, rows: np.ndarray, circle: Circle, angle: Float[np.ndarray, " n"]
) -> None:
    """Raise `RowError` for a column of directions that contradicts the order of the positions."""
    speed = circle.velocity(angle)
    for i, axis in enumerate(plan.axes):
        if not plan.has(f"dir_{axis}") or not circle.moving[i]:
            continue
        clear = np.abs(speed[:, i]) > _CLEAR * np.abs(speed).max()
        wrong = clear & (np.asarray(plan.covariate(f"dir_{axis}"))[rows] != np.sign(speed[:, i]))
        if wrong.sum() > _AGAINST * clear.sum():
            run = int(np.asarray(plan.groups["run"])[rows[0]])
            raise RowError(
                int(rows[np.argmax(wrong)]),
                f"run {run}, column {file_column(f'dir_{axis}', plan.axes)[0]}",
                "directions against the order of the positions",
                "those in which the rows of a run follow each other",
                "correct the column or the order of the rows, or leave the column out: it follows "
                "from the positions",
            )
