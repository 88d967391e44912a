"""Units and column names as they are printed on pictures and pages."""

import re

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_UNITS = {
    "um": "µm",
    "urad": "µrad",
    "mrad": "mrad",
    "degC": "°C",
    "deg": "°",
    "1": "",
    "%": "%",
}
_COLUMN_UNITS = {
    **{unit: unit for unit in (
        "mm", "um", "nm", "s", "ms", "rad", "mrad", "urad", "deg", "degC", "K", "kg", "N", "kN",
        "kW", "bar", "mbar", "Pa", "hPa", "kPa", "MPa", "Hz", "kHz",
    )},
    **{f"{a}_{b}": f"{a}/{b}" for a in ("l", "m", "mm") for b in ("min", "s")},
    "m_s2": "m/s2",
    "rpm": "1/min",
    "pct": "%",
}  # fmt: skip
"""Units at the end of column names. A and m are left out, because they may be names."""
_COLUMN_UNITS |= {
    f"{a}_per_{b}": f"{_COLUMN_UNITS[a]}/{b}" for a in _COLUMN_UNITS for b in ("m", "K", "min", "s")
}


def pretty_unit(unit: str) -> str:
    """A unit as it is printed: ``"um/(m K)"`` gives ``"µm/(m K)"``, ``"s2"``
    ``"s²"``, ``"1"`` nothing.
    """
    words = re.sub(r"[A-Za-z%]+|^1$", lambda m: _UNITS.get(m[0], m[0]), unit)
    return re.sub(r"(?<=[A-Za-z])-?\d+", lambda m: m[0].translate(SUPERSCRIPTS), words)


def column_label(column: str) -> str:
    """A column as an axis label: ``"tracker: x_mm"`` gives ``"tracker: x, mm"``."""
    owner, colon, plain = column.partition(": ")
    if colon:
        return f"{owner}: {column_label(plain)}"
    if match := re.fullmatch(r"dir_(\w+)", column):
        joint = re.fullmatch(r"q(\d+)", match[1])
        return f"direction of travel of {f'joint {joint[1]}' if joint else match[1].upper()}"
    if match := re.fullmatch(r"(a|v|since)_([a-cx-z])_\w+", column):
        words = {
            "a": "acceleration of {}, m/s²",
            "v": "velocity of {}, m/s",
            "since": "travel of {} since its reversal, mm",
        }
        if match[2] in "abc":
            words = {
                "a": "angular acceleration of {}, rad/s²",
                "v": "angular velocity of {}, rad/s",
                "since": "turn of {} since its reversal, °",
            }
        return words[match[1]].format(match[2].upper())
    if match := re.fullmatch(r"q(\d+)_(cmd|read)_deg", column):
        return f"joint {match[1]}, {'commanded' if match[2] == 'cmd' else 'read back'}, °"
    if match := re.fullmatch(r"T_(\w+)_degC", column):
        return f"temperature of {match[1] if len(match[1]) > 1 else match[1].upper()}, °C"
    # The longest ending that is a unit: m_s in load_m_s, not s.
    words = column.split("_")
    for k in range(1, len(words)):
        if unit := _COLUMN_UNITS.get("_".join(words[k:])):
            name = "_".join(words[:k])
            return f"{'time' if name == 't' else name}, {pretty_unit(unit)}"
    return {"pose": "pose number", "ball": "ball number", "tilt": "tilt, rad"}.get(column, column)
