"""NC programs with corrected positions, for any control (ISO 6983-1, RS-274/NGC).

- `blocks`: lines as words with their places; `codes`: what G and M codes do to a position;
- `modal`: the modal state of a control; `interpreter`: the moves of each block (`moves`);
- `arcs`: circular arcs and helices;
- `solve`: the command whose displaced tool point is the wanted one;
- `split`: where moves are split, with a bound on the deviation in between;
- `write`: corrected blocks as text; `report`: what was corrected and what was not;
- `program`: all of it, from bytes to bytes and from file to file.

It depends on a displacement alone, a function of axis positions and directions (`Displacement`).
"""

from .options import Displacement, NcOptions
from .program import CorrectedProgram, correct_file, correct_program
from .report import NcReport, NcWarning

__all__ = [
    "CorrectedProgram",
    "Displacement",
    "NcOptions",
    "NcReport",
    "NcWarning",
    "correct_file",
    "correct_program",
]
