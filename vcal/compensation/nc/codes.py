"""What the G and M codes of ISO 6983-1, RS-274/NGC and usual controls mean for a position.

Codes are in tenths: 381 is G38.1. A code that is in none of these tables is refused, because it may
move an axis or change how coordinates are read.
"""

PLANES = {170: 17, 180: 18, 190: 19}
UNITS = {200: 25.4, 210: 1.0, 700: 25.4, 710: 1.0}
"""Millimetres per unit; G70 and G71 as in ISO 6983-1."""
MOTIONS = {0: 0, 10: 1, 20: 2, 30: 3}
OFFSETS = {540: "G54", 550: "G55", 560: "G56", 570: "G57", 580: "G58", 590: "G59"}
OFFSETS |= {591: "G59.1", 592: "G59.2", 593: "G59.3"}
EXTENDED_OFFSETS = {541: "G54.1", 1540: "G154"}
"""Their number is in a word P."""

HARMLESS = frozenset(
    # exact stop and path modes, spindle modes, stroke limits, levels of canned cycles
    [90, 600, 610, 611, 620, 630, 640, 960, 970, 961, 980, 990, 110, 230, 250, 260, 401, 1030]
    + [281, 301]  # the reference position is stored, nothing moves
)
NOT_MOVES = frozenset([40, 220])
"""Their axis words are no positions: dwell (G4 X1.5) and stroke limits (G22)."""

CYCLES = frozenset([730, 740, 760, *range(810, 900, 10), 841, 842, 843])
"""Canned cycles, modal until G80 or a code of motion."""

MOVES_OF_THE_CONTROL = {
    270: "reference position check",
    280: "move to the reference position",
    290: "return from the reference position",
    300: "move to a reference position",
    310: "skip function (probing)",
    370: "automatic tool length measurement",
    380: "probing",
    382: "probing",
    383: "probing",
    384: "probing",
    385: "probing",
    530: "move in machine coordinates",
    330: "thread cutting",
    331: "rigid tapping",
    50: "spline",
    51: "spline",
    52: "spline",
    53: "spline",
    120: "circular pocket",
    130: "circular pocket",
    450: "tool offset",
    460: "tool offset",
    470: "tool offset",
    480: "tool offset",
}
"""Moves of one block that are left as they are, and whose axes are unknown afterwards."""
OFTEN_WITHOUT_AXES = frozenset([50, 51, 52, 53])
"""Without axis words they set a mode of the control (high-speed machining), and nothing moves."""

MODES = {
    410: ("cutter", "cutter radius compensation"),
    420: ("cutter", "cutter radius compensation"),
    411: ("cutter", "cutter radius compensation"),
    421: ("cutter", "cutter radius compensation"),
    510: ("scaling", "scaling"),
    511: ("mirror", "mirror image"),
    1010: ("mirror", "mirror image"),
    680: ("rotation", "rotated coordinates"),
    682: ("rotation", "tilted plane"),
    683: ("rotation", "tilted plane"),
    684: ("rotation", "tilted plane"),
    160: ("polar", "polar coordinates"),
    121: ("interpolation", "polar interpolation"),
    1120: ("interpolation", "polar interpolation"),
    71: ("cylinder", "cylindrical interpolation"),
    1070: ("cylinder", "cylindrical interpolation"),
    70: ("diameter", "diameter programming"),
    434: ("tool centre point", "tool centre point control"),
    435: ("tool centre point", "tool centre point control"),
    660: ("macro", "modal macro call"),
    661: ("macro", "modal macro call"),
    171: ("plane", "plane of secondary axes"),
    181: ("plane", "plane of secondary axes"),
    191: ("plane", "plane of secondary axes"),
}
"""Modes in which the control makes other moves than are programmed: key of the mode, its name."""
ENDS_OF_MODES = {
    400: "cutter",
    500: "scaling",
    501: "mirror",
    1000: "mirror",
    690: "rotation",
    150: "polar",
    131: "interpolation",
    1130: "interpolation",
    80: "diameter",
    490: "tool centre point",
    670: "macro",
    170: "plane",
    180: "plane",
    190: "plane",
}
SHIFTS = {520: "local coordinate system", 920: "coordinate system shift", 923: "restored shift"}
ENDS_OF_SHIFTS = frozenset([921, 922])
TOOL_LENGTHS = frozenset([430, 440, 431, 432, 490])
SETTING = 100
"""G10: writes work offsets, tool lengths or parameters of the control."""
CANCEL = 800
"""G80: no motion."""
MACRO_CALL = frozenset([650, 651])
CALLS = frozenset([97, 98, 198])
ENDS = frozenset([2, 30, 99])
TOOL_CHANGE = 6
BEFORE_MOTION = frozenset([3, 4, 6, 7, 8])
"""M codes that act before the move of their block, as S, T and F do."""
AFTER_MOTION = frozenset([0, 1, 2, 5, 9, 30, 60])
"""M codes that act after it, or on some controls; later than with the move does no harm."""


def code_of(tenths: int) -> str:
    """`code_of(381)` is ``"G38.1"``."""
    return f"G{tenths // 10}" + (f".{tenths % 10}" if tenths % 10 else "")
