"""The loop on measurements with known and unknown causes, as a user runs it: verdicts and errors.

It needs the measurement data beside the checkout and copies nothing of it. The cases differ in no
setting but the override that is printed.

    python benchmarks/practice.py --data ../shared/data
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from records import parser_of, write

CASES: list[tuple[str, str, str, float | None]] = [
    ("practice/01_tracker_clean", "", "check", 0.82),
    ("practice/02_tracker_backlash", "", "check", 1.08),
    ("practice/03_tracker_screw", "", "check", 1.36),
    ("practice/04_balls_scale_growth", "", "check", 4.2),
    ("practice/05_balls_clean", "", "check", 4.8),
    ("practice/06_tracker_dent", "", "check", None),
    ("practice/07_balls_two_effects", "", "check", 5.0),
    ("practice/08_rtest_crosstalk", "", "heldout", None),
    ("practice/09_rtest_reversal", "", "heldout", None),
    ("practice/10_frame_head_growth", "", "check", None),
    ("real/irb120", "", "heldout", 115.0),
    ("real/irb120", "instrument.joints=read", "heldout", None),
]
"""Folder, override of the study file, error that is compared, and its limit in um."""


def run(folder: Path, override: str, error: str, limit: float | None) -> dict:
    """The verdict, effects and errors that `vcal loop` reports for one study."""
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "vcal", "loop", str(folder / "setup.toml")]
        command += ["--out", scratch + "/out", *(["--set", override] if override else [])]
        subprocess.run(command, check=True, capture_output=True, text=True)
        report = json.loads((Path(scratch) / "out" / "report.json").read_text(encoding="utf-8"))
    key = f"{error}_rms_um"
    return {
        "study": folder.name,
        "override": override,
        "verdict": report["verdict"],
        "effects": [
            {
                "key": f"{e['effect']} {e['placement']}".strip(),
                "status": e["status"],
                "parameters": e["parameters"],
                "p_value": e["p_value"],
                "heldout_gain": e["heldout_gain"],
                "alternatives": e["alternatives"],
            }
            for e in report["effects"]
        ],
        "unexplained": report["unexplained"],
        "error": error,
        "before_um": report["errors"]["before"][key],
        "after_um": report["errors"]["after"][key],
        "limit_um": limit,
        "seconds": report["seconds"],
    }


def main() -> None:
    """Run every case and write the results."""
    parser = parser_of(__doc__, "practice")
    parser.add_argument("--data", type=Path, required=True)
    options = parser.parse_args()
    results = []
    for name, *settings in CASES:
        found = run(options.data / name, *settings)
        results.append(found)
        keys = ", ".join(e["key"] for e in found["effects"])
        print(
            f"{found['study']:24s} {found['override']:24s} {found['verdict']:16s} "
            f"{found['before_um']:8.3f} -> {found['after_um']:8.3f} um  {keys}",
            flush=True,
        )
    write(options.out, {"rows": results})


if __name__ == "__main__":
    main()
