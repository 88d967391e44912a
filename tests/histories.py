"""Reports of one machine over time, made from records without any measurement.

Every report has a squareness, a straightness, a backlash, a thermal coefficient, the volumetric
error and the error at check points, with values drawn about a constant.
"""

import hashlib
import json
from pathlib import Path

import numpy as np

from vcal.machine.chain import chain_from_string
from vcal.numerics.stored import Writer

DATES = ("2024-03-11", "2024-09-02", "2025-03-10", "2025-09-15", "2026-03-16")
SQUARENESS, U_SQUARENESS = 14.0, 0.8
STEP = 9.0
"""Step of the squareness after the third report, urad."""


def records(
    seed=1,
    *,
    squareness=SQUARENESS,
    backlash=None,
    smallest=1.5,
    chain="w X b Y Z t",
    serial_number=None,
    date=None,
    name="machining centre",
):
    """Contents of report.json and machine.json; `backlash` is None where it is not named."""
    random = np.random.default_rng(seed)
    about = {} if serial_number is None else {"machine": {"serial_number": serial_number}}
    about |= {} if date is None else {"measurement": {"date": date}}
    named = [] if backlash is None else [_effect("backlash", "Y", [("size", backlash, "um", 0.5)])]
    errors = {
        "check_rms_um": 9.0 + 0.2 * random.standard_normal(),
        "u_check_rms_um": 0.2,
    }
    report = {
        "schema": "vcal-report/1",
        "name": name,
        "sentence": "The declared model explains the measurement.",
        "effects": named,
        "declared": [],
        "geometry": [
            _deviation("EC(0X)Y", "squareness of Y to X", squareness, U_SQUARENESS, "urad", random),
            _deviation("EYX", "straightness", 4.0, 0.5, "um", random),
            _deviation("EXX", "positioning, range", 12.0, 0.6, "um", random, information=0.01),
        ],
        "errors": {"uncompensated": errors, "after": {k: v / 9.0 for k, v in errors.items()}},
        "volumetric_error": {
            "before": {
                "rms_um": 11.0 + 0.3 * random.standard_normal(),
                "rms_standard_uncertainty_um": 0.3,
                "largest_um": 24.0 + 0.6 * random.standard_normal(),
                "largest_standard_uncertainty_um": 0.6,
            }
        },
        "settings": {
            "effects": ["backlash", "thermal_tilt"],
            "study": {"data": {"file": None, "data": "data.csv"}},
        },
        "input_files": {"data.csv": hashlib.sha256(f"{seed}".encode()).hexdigest()},
        "untestable": [],
        "cannot_be_seen": [],
        "smallest_sizes": [
            {"effect": "backlash", "placement": "Y", "parameter": "size", "unit": "um",
             "size": smallest, "rivals": []}
        ],
        "interrupted": False,
        "stated": about,
    }  # fmt: skip
    tilt = 3.0 + 0.4 * random.standard_normal()
    report["declared"] = [_effect("thermal_tilt", "Y", [("k_EAY", tilt, "urad/K", 0.4)])]
    writer = Writer()
    parts = [
        ("geometric", "EXX.a1", 1.0, "um", 0.3),
        ("thermal_tilt Y", "k_EAY", tilt, "urad/K", 0.4),
    ]
    parts += [] if backlash is None else [("backlash Y", "size", backlash, "um", 0.5)]
    made = chain_from_string(chain, tool_offset_m=(0.0, 0.0, -0.1))
    machine = {
        "schema": "vcal-machine/1",
        "name": name,
        "date": "2026-11-30",
        "machine": chain,
        "working_volume": [
            {"axis": axis, "low": 0.0, "high": 0.5, "unit": "m"} for axis in made.axes
        ],
        "tool_offset_mm": [0.0, 0.0, -100.0],
        "parameters": [
            {"effect": e, "parameter": p, "unit": unit, "value": value, "standard_uncertainty": u}
            for e, p, value, unit, u in parts
        ],
        "covariance": [[0.0] * i + [u**2] for i, (*_, u) in enumerate(parts)],
        "objects": {
            "chain": writer.plain(made),
            "check": writer.plain({"position": np.zeros((2, len(made.axes)))}),
            "records": writer.records,
            "arrays": writer.arrays,
        },
    }
    return report, machine


def write_report(folder: Path, report, machine):
    """Write the two records into a folder."""
    folder.mkdir(parents=True)
    (folder / "report.json").write_text(json.dumps(report), encoding="utf-8")
    (folder / "machine.json").write_text(json.dumps(machine), encoding="utf-8")


def write_reports(folder: Path, step=STEP, backlash=6.0):
    """Five reports: after the third, the squareness is larger by `step`, and from the fourth on
    there is a backlash.
    """
    for i, date in enumerate(DATES):
        late = i > 2
        write_report(
            folder / f"measurement {i + 1}",
            *records(
                i,
                squareness=SQUARENESS + step * late,
                backlash=backlash if late else None,
                date=date,
                serial_number="A 17",
            ),
        )


def _deviation(name, what, value, u, unit, random, information=0.97):
    return {
        "name": name,
        "what": what,
        "axis": name[-1],
        "value": value + u * random.standard_normal(),
        "unit": unit,
        "standard_uncertainty": u,
        "information_share": information,
    }


def _effect(name, placement, parameters):
    return {
        "effect": name,
        "placement": placement,
        "fitted_placement": placement,
        "status": "named",
        "found": True,
        "parameters": [
            {"name": key, "value": value, "unit": unit, "standard_uncertainty": u}
            for key, value, unit, u in parameters
        ],
    }
