"""The history of one machine over several reports: series of results, and what has changed.

`reports` reads the reports below a folder and refuses those of another machine, `dates` says when
each was measured, `series` puts the same quantities of all reports together, `change_points` and
`changes` test them for steps and drifts. Uses studies and identified machines; `plots`, `report`
and `cli` stand on it.
"""

from .change_points import Sample, Size, Tested, against_constant, effective_number
from .changes import Appearance, Change, Outcome, Segment, Since, outcomes
from .dates import read_dates
from .machine_history import ALPHA, History, read_history
from .reports import Report, read_reports
from .series import Entry, Part, Series

__all__ = [
    "ALPHA",
    "Appearance",
    "Change",
    "Entry",
    "History",
    "Outcome",
    "Part",
    "Report",
    "Sample",
    "Segment",
    "Series",
    "Since",
    "Size",
    "Tested",
    "against_constant",
    "effective_number",
    "outcomes",
    "read_dates",
    "read_history",
    "read_reports",
]
