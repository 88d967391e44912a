"""Many studies at once: the loop is closed on each, in processes that cannot harm each other.

`one_study` closes the loop on one study and writes its report, or finds that its report is up to
date; `jobs` gives every study a folder; the workers are processes of this computer or those of
`dask`; `index` is the page that lists all studies, and the same for programs. Uses studies, reports
and everything below; `cli` stands on it.
"""

from .fleet import Fleet, close_fleet
from .one_study import Job, Member, Settings

__all__ = ["Fleet", "Job", "Member", "Settings", "close_fleet"]
