"""Dynamics of machines: rigid bodies on springs under their controllers.

`vcal.study.dynamic_machine.load_machine` reads a description of a machine. `assemble` gives its
matrices, `modes` its natural frequencies, `compliance` its deflection under acceleration and
`controlled` the machine under its controllers. `run` and `run_circle` simulate set points.
`identify_machine` identifies stiffness, damping, centres of gravity and delay from the circles of
an R-test, and `campaign` does so for many simulated machines. Uses `identification` and what lies
below; knows nothing of `geometry`. `study`, `reproduce` and the rooms between may stand on it.
"""

from .bodies import Body, Drive, Machine, Scale, Spring, ToolPoint
from .circles import Phasors, measured_phasors, predicted, set_phasors
from .closed_loop import ClosedLoop, Response, check_stable, controlled, run, run_circle, steady
from .control import Controller
from .ellipse_evaluation import Evaluated, evaluate
from .gains import propose
from .harmonic_response import response
from .identify import Identified, identify_machine, task
from .modal_analysis import Modes, check_supported, modes
from .monte_carlo import Campaign, Noise, campaign
from .quasi_static import compliance
from .setpoints import Limits, Profile, SetCircle, circle_set, positioning
from .structure import Structure, assemble
from .unknowns import CentreShift, DampingFactor, Delay, DriveFactor, SpringFactor, Unknown, applied

__all__ = [
    "Body",
    "Campaign",
    "CentreShift",
    "ClosedLoop",
    "Controller",
    "DampingFactor",
    "Delay",
    "Drive",
    "DriveFactor",
    "Evaluated",
    "Identified",
    "Limits",
    "Machine",
    "Modes",
    "Noise",
    "Phasors",
    "Profile",
    "Response",
    "Scale",
    "SetCircle",
    "Spring",
    "SpringFactor",
    "Structure",
    "ToolPoint",
    "Unknown",
    "applied",
    "assemble",
    "campaign",
    "check_stable",
    "check_supported",
    "circle_set",
    "controlled",
    "compliance",
    "evaluate",
    "identify_machine",
    "measured_phasors",
    "modes",
    "positioning",
    "predicted",
    "propose",
    "response",
    "run",
    "run_circle",
    "set_phasors",
    "steady",
    "task",
]
