"""Time and peak memory of the commands that a user runs, cold and warm, and time of one loop.

Cold is a run with an empty cache of compiled programs, warm one with the cache that the cold run
left. Of the loop on 504 tracker points with the whole catalogue only `close_loop` is timed: the
first in a process without any compiled program, and further ones in it. Needs a POSIX system.

    python benchmarks/speed.py --data ../shared/data
"""

import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

from records import HERE, parser_of, write

LIMITS = {"import": 1.5, "demo": 20.0, "practice_02": 25.0, "irb120": 90.0, "loop_504": 20.0}
"""Seconds that a cold run may take on two cores."""
POINTS = (7, 6, 6)
"""Grid of the loop's plan, measured in both directions."""
BACKLASH = {"effect": "backlash", "axis": "X", "size_um": 6}


def timed(command: list[str], cache: Path) -> dict[str, float]:
    """Wall seconds, processor seconds and peak memory (MiB) of one command.

    The peak is that of the largest child so far, so every command runs in a fresh measuring
    process.
    """
    script = (
        "import json,resource,subprocess,sys,time\n"
        "t=time.perf_counter()\n"
        "p=subprocess.run(sys.argv[1:],stdout=subprocess.DEVNULL,stderr=subprocess.PIPE,text=True)\n"
        "w=time.perf_counter()-t\n"
        "u=resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "print(json.dumps(dict(rc=p.returncode,err=p.stderr[-500:],wall_s=w,"
        "cpu_s=u.ru_utime+u.ru_stime,peak_mib=u.ru_maxrss/1024)))\n"
    )
    environment = dict(os.environ, XDG_CACHE_HOME=str(cache))
    done = subprocess.run(
        [sys.executable, "-c", script, *command],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    found = json.loads(done.stdout)
    if found.pop("rc"):
        raise SystemExit(f"{' '.join(command)} failed: {found['err']}")
    found.pop("err")
    return found


def loops(runs: int) -> list[float]:
    """Seconds of successive loops on a tracker study of the tests' generator."""
    script = (
        "import json,sys,tempfile,time\n"
        "from pathlib import Path\n"
        "sys.path.insert(0,sys.argv[1])\n"
        "import vcal\n"
        "from oracle import make_case,write_study\n"
        "vcal.enable_float64()\n"
        "effect,shape,runs=json.loads(sys.argv[2])\n"
        "case=make_case('laser_tracker',seed=5,effects=[effect],plan={'shape':shape})\n"
        "folder=tempfile.TemporaryDirectory()\n"
        "write_study(Path(folder.name),case)\n"
        "study=vcal.load_study(Path(folder.name)/'setup.toml')\n"
        "found=[]\n"
        "for _ in range(runs):\n"
        "    t=time.perf_counter()\n"
        "    closure=vcal.close_loop(study.model,study.measurement,check=study.check)\n"
        "    found.append(time.perf_counter()-t)\n"
        "assert [e.effect.key for e in closure.effects]==['backlash X'],closure.sentence\n"
        "print(json.dumps(found))\n"
    )
    tests = str(HERE.parent / "tests")
    command = [sys.executable, "-c", script, tests, json.dumps([BACKLASH, POINTS, runs])]
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ, XDG_CACHE_HOME=cache)
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise SystemExit(f"the loop failed: {done.stderr[-500:]}")
    return json.loads(done.stdout)


def main() -> None:
    """Run every command cold once and warm `--runs` times."""
    parser = parser_of(__doc__, "speed")
    parser.add_argument("--data", type=Path, help="folder with practice/ and real/, if present")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    vcal = [sys.executable, "-m", "vcal"]
    commands = {"import": [sys.executable, "-c", "import vcal"], "demo": [*vcal, "demo"]}
    if options.data:
        cases = {
            "practice_02": options.data / "practice" / "02_tracker_backlash",
            "irb120": options.data / "real" / "irb120",
        }
        for name, folder in cases.items():
            commands[name] = [*vcal, "loop", str(folder / "setup.toml")]
    results = {}
    for name, command in commands.items():
        with tempfile.TemporaryDirectory() as scratch:
            cache = Path(scratch) / "cache"
            runs = []
            for i in range(options.runs + 1):
                out = [] if name == "import" else ["--out", str(Path(scratch) / f"out{i}")]
                runs.append(timed([*command, *out], cache))
        cold, warm = runs[0], runs[1:]
        results[name] = {
            "cold": cold,
            "warm_median_wall_s": sorted(run["wall_s"] for run in warm)[len(warm) // 2],
            "peak_mib": max(run["peak_mib"] for run in runs),
            "limit_s": LIMITS[name],
        }
        print(
            f"{name:12s} cold {cold['wall_s']:6.1f} s (limit {LIMITS[name]:g}), "
            f"warm {results[name]['warm_median_wall_s']:6.1f} s, "
            f"peak {results[name]['peak_mib']:.0f} MiB",
            flush=True,
        )
    cold_s, *warm_s = loops(options.runs + 1)
    results["loop_504"] = {
        "cold": {"wall_s": cold_s},
        "warm_median_wall_s": sorted(warm_s)[len(warm_s) // 2],
        "limit_s": LIMITS["loop_504"],
    }
    print(f"loop_504     cold {cold_s:6.1f} s (limit {LIMITS['loop_504']:g}), "
          f"warm {results['loop_504']['warm_median_wall_s']:6.1f} s", flush=True)  # fmt: skip
    machine = {
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "system": platform.system(),
        "date": str(datetime.date.today()),
    }
    write(options.out, {"machine": machine, "results": results})


if __name__ == "__main__":
    main()
