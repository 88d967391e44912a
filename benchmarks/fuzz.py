"""Broken studies: how many are refused, how many can be computed, whether anything else happens.

    python benchmarks/fuzz.py --inputs 10000 --computed 200 --seed 0

It reads mutations of the start studies (tests/broken_studies.py, made by hypothesis), and runs the
loop to the end on some of those that are accepted. The counts go to results/fuzz.json. An exception
other than a message ends the campaign: the input is written to build/fuzz for a test of its own.
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

import hypothesis

import vcal
from vcal.errors import StudyError

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests"))
from broken_studies import Outcome, read, studies  # noqa: E402

SLOW = 10.0
"""Seconds of CPU in which a study has to be read."""


def main() -> int:
    """Run a campaign; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--computed", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--batch", type=int, default=500, help="inputs per run of hypothesis")
    given = parser.parse_args()
    vcal.enable_float64()
    outcome, more = Outcome(), Counter()
    slowest, batch, failed = 0.0, 0, 0
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        while outcome.counts["inputs"] < given.inputs:
            size = min(given.batch, given.inputs - outcome.counts["inputs"])

            def one(made: tuple) -> None:
                nonlocal slowest, failed
                if outcome.counts["inputs"] >= given.inputs:
                    return
                began = time.process_time()
                try:
                    study = read(folder, *made, outcome)
                    if study is not None and more["computed"] < given.computed:
                        compute(study, more)
                except Exception:
                    failed += 1
                    keep(folder, failed)
                    return
                seconds = time.process_time() - began
                more["slow"] += study is None and seconds > SLOW
                slowest = max(slowest, seconds if study is None else 0.0)

            settings = hypothesis.settings(
                max_examples=size,
                deadline=None,
                database=None,
                phases=[hypothesis.Phase.generate],
                suppress_health_check=list(hypothesis.HealthCheck),
            )
            seeded = hypothesis.seed(given.seed + batch)
            seeded(settings(hypothesis.given(studies())(one)))()
            batch += 1
            print(dict(outcome.counts), dict(more), f"exceptions {failed}", flush=True)
    result = {
        "seed": given.seed,
        "counts": dict(sorted(outcome.counts.items())),
        "loop": dict(sorted(more.items())),
        "exceptions": failed,
        "slowest_refusal_s": round(slowest, 2),
    }
    (HERE / "results" / "fuzz.json").write_text(json.dumps(result, indent=2) + "\n")
    return 1 if failed or more["slow"] else 0


def compute(study: vcal.Study, more: Counter) -> None:
    """Close the loop with few draws and few effects."""
    if study.measurement is None:
        more["plans"] += 1
        return
    more["computed"] += 1
    try:
        closure = vcal.close_loop(
            study.model, study.measurement, check=study.check, draws=25, max_effects=2
        )
    except StudyError as error:
        assert len(str(error)) <= 1500, str(error)[:300]
        more["refused by the loop"] += 1
        return
    more["named an effect" if closure.found else "named none"] += 1


def keep(folder: Path, number: int) -> None:
    """Keep an input that raised an exception, with the traceback."""
    to = HERE.parent / "build" / "fuzz" / f"{number:03d}"
    shutil.rmtree(to, ignore_errors=True)
    shutil.copytree(folder, to)
    (to / "traceback.txt").write_text(traceback.format_exc(), encoding="utf-8")
    print(f"kept {to}: {traceback.format_exc().splitlines()[-1]}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
