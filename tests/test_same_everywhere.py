"""The same study, seed and version give the same report, wherever and whenever it is computed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

_SCRIPT = """
import json, os, sys, time
cores, shift, study, out = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3], sys.argv[4]
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
if shift:
    own = time.time
    time.time = lambda: own() + shift
import vcal
from vcal.report.loop.record import record
vcal.enable_float64()
found = vcal.load_study(study, {"loop.draws": 25, "loop.effects": ["backlash", "scale_growth"]})
closure = vcal.close_loop(
    found.model, found.measurement, check=found.check,
    effects=found.tried, draws=found.options.draws, seed=found.options.seed,
)
with open(out, "w", encoding="utf-8") as file:
    json.dump(record(closure, found, seconds=0.0), file, sort_keys=True)
"""
_USUAL = {"TZ": "UTC", "LC_ALL": "C.UTF-8", "PYTHONHASHSEED": "1", "OMP_NUM_THREADS": "1"}
_TWO = 2 if len(getattr(os, "sched_getaffinity", lambda _: {0, 1})(0)) > 1 else 1
_YEARS = 20 * 365.25 * 86400.0


def record(study, out: Path, environment, *, cores=1, shift=0.0, options=(), **changed) -> str:
    """The record of the loop on a study, as text, from a process of its own."""
    subprocess.run(
        [sys.executable, *options, "-c", _SCRIPT, str(cores), str(shift), str(study), str(out)],
        env=os.environ | environment | _USUAL | changed,
        check=True,
        capture_output=True,
    )
    return out.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def usual(few_points, programs, tmp_path_factory):
    return record(few_points, tmp_path_factory.mktemp("usual") / "record.json", programs)


@pytest.mark.thorough
def test_all_changes_at_once(usual, few_points, programs, tmp_path):
    """Two threads, another zone, locale, order of sets and home, no docstrings, 20 years on."""
    again = record(
        few_points,
        tmp_path / "record.json",
        programs,
        cores=_TWO,
        shift=_YEARS,
        options=("-OO",),
        TZ="Pacific/Auckland",
        LC_ALL="tr_TR.UTF-8",
        PYTHONHASHSEED="77",
        OMP_NUM_THREADS="2",
        HOME=str(tmp_path),
        USER="somebody",
    )
    assert json.loads(usual)["schema"] and len(usual) > 3000
    assert again == usual


CHANGES = {
    "two threads": {"cores": _TWO, "OMP_NUM_THREADS": "2"},
    "another time zone": {"TZ": "Pacific/Auckland"},
    "another locale": {"LC_ALL": "de_DE.UTF-8"},
    "without docstrings and assertions": {"options": ("-OO",)},
    "another order of sets": {"PYTHONHASHSEED": "77"},
    "the clock 20 years on": {"shift": _YEARS},
}


@pytest.mark.thorough
@pytest.mark.parametrize("change", CHANGES)
def test_one_change(usual, few_points, programs, tmp_path, change):
    assert record(few_points, tmp_path / "record.json", programs, **CHANGES[change]) == usual


@pytest.mark.thorough
def test_another_user(usual, few_points, programs, tmp_path):
    """As nobody, where the tests run as root and Python is not in a folder of root's own."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("only root can become another user")
    tmp_path.chmod(0o777)
    for path in (*few_points.parents, few_points):
        if str(path).startswith("/tmp/") and path != Path("/tmp"):
            path.chmod(path.stat().st_mode | 0o055)
    probe = [sys.executable, "-c", "import jax"]
    try:
        failed = subprocess.run(probe, user=65534, capture_output=True, check=False).returncode
    except PermissionError:
        failed = 1
    if failed:
        pytest.skip("another user cannot read this Python")
    out = tmp_path / "record.json"
    subprocess.run(
        [sys.executable, "-c", _SCRIPT, "1", "0", str(few_points), str(out)],
        env=os.environ | programs | _USUAL | {"HOME": str(tmp_path)},
        user=65534, check=True, capture_output=True,
    )  # fmt: skip
    assert out.read_text(encoding="utf-8") == usual
