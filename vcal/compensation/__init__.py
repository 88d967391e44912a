"""The way out: from an identified machine to files that a control takes, and what they will do.

`IdentifiedMachine` states the displacement of the tool point for any position, direction of
approach and condition. A `Format` turns it into the tables of one control, and computes what these
tables correct (`Tables.applied`); what they cannot carry follows from that by simulation
(`Compensation`). `nc` corrects the positions of an NC program, for any control. Knows geometry and
identification; nothing of the loop, of studies or of reports.
"""

from .base import Compensation, Format, Kept, Options, Tables, compensate
from .expected import Expected, Verified, verify
from .formats import FORMATS
from .machine import IdentifiedMachine, Range, Rival
from .volume import Use, working_volume

__all__ = [
    "FORMATS",
    "Compensation",
    "Expected",
    "Format",
    "IdentifiedMachine",
    "Kept",
    "Options",
    "Range",
    "Rival",
    "Tables",
    "Use",
    "Verified",
    "compensate",
    "verify",
    "working_volume",
]
