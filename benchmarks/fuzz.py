"""Broken studies: how many are refused, how many can be computed, whether anything else happens.

It reads mutations of the start studies (tests/broken_studies.py, made by hypothesis), and runs the
loop to the end on some of those that are accepted. Each input may take ten seconds of CPU. An
exception other than a message, or an input that takes longer, is kept in build/fuzz for a test of
its own. The result is written after every batch; a repeated command goes on from there.

    python benchmarks/fuzz.py --inputs 10000 --computed 200
"""

import json
import math
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import hypothesis
from records import commit_of, forget_programs, parser_of, write

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import vcal  # noqa: E402
from broken_studies import Outcome, read, studies  # noqa: E402
from quick_programs import compile_quickly  # noqa: E402
from vcal.errors import StudyError  # noqa: E402

_LIMIT_S = 10.0
"""CPU time in which a study has to be read, s."""
_LOOP_LIMIT_S = 120.0
_KEPT = Path(__file__).resolve().parents[1] / "build" / "fuzz"


class HangError(Exception):
    """An input took more CPU time than it may."""


@contextmanager
def limited(seconds: float):
    """Context that raises `HangError` after that CPU time of this process."""

    def late(*_):
        raise HangError(f"more than {seconds:g} s of CPU")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


class Campaign:
    """Reads inputs one by one, and counts what becomes of them, beside those of `earlier`."""

    def __init__(self, folder: Path, inputs: int, computed: int, earlier: dict):
        self.folder, self.inputs, self.computed = folder, inputs, computed
        self.outcome, self.loops = Outcome(), Counter(earlier.get("loops"))
        self.outcome.counts.update(earlier.get("counts", {}))
        self.kept = Counter({kind: earlier.get(kind, 0) for kind in ("exceptions", "hangs")})
        self.slowest = earlier.get("slowest_s", {"refused": 0.0, "accepted": 0.0, "loop": 0.0})
        self.commits = Counter(earlier.get("commits"))
        self.cpu_s = earlier.get("cpu_s", 0.0) - time.process_time()

    @property
    def left(self) -> int:
        """Number of inputs that are still to be read."""
        return self.inputs - self.outcome.counts["inputs"]

    def batch(self, seed: int, size: int) -> None:
        """Read a batch of inputs, made by hypothesis from a seed."""
        before = self.outcome.counts["inputs"]
        settings = hypothesis.settings(
            max_examples=min(size, self.left),
            deadline=None,
            database=None,
            phases=[hypothesis.Phase.generate],
            suppress_health_check=list(hypothesis.HealthCheck),
        )
        hypothesis.seed(seed)(settings(hypothesis.given(studies())(self.one)))()
        self.commits[commit_of()] += self.outcome.counts["inputs"] - before

    def record(self) -> dict:
        """Everything that was counted."""
        return {
            "commits": dict(self.commits),
            "sets": self.outcome.counts["inputs"],
            "counts": dict(sorted(self.outcome.counts.items())),
            "loops": dict(sorted(self.loops.items())),
            **self.kept,
            "slowest_s": {name: round(value, 2) for name, value in self.slowest.items()},
            "cpu_s": round(self.cpu_s + time.process_time()),
        }

    def one(self, made: tuple) -> None:
        """Read one input, and run the loop on it while there are loops to run."""
        if self.left <= 0:
            return
        if self.outcome.counts["inputs"] % 20 == 0:
            forget_programs()
        began = time.process_time()
        try:
            with limited(_LIMIT_S):
                study = read(self.folder, *made, self.outcome)
            self._took("refused" if study is None else "accepted", began)
            if study is None or study.measurement is None or self.loops["run"] >= self.computed:
                return
            began = time.process_time()
            with limited(_LOOP_LIMIT_S):
                self.loops["run"] += 1
                self.loops[ended(study)] += 1
            self._took("loop", began)
        except HangError:
            self._keep("hangs")
        except Exception:
            self._keep("exceptions")

    def _took(self, what: str, began: float) -> None:
        self.slowest[what] = max(self.slowest[what], time.process_time() - began)

    def _keep(self, kind: str) -> None:
        """Keep an input that raised an exception, with the traceback."""
        self.kept[kind] += 1
        to = _KEPT / f"{sum(self.kept.values()):03d}"
        shutil.rmtree(to, ignore_errors=True)
        shutil.copytree(self.folder, to)
        (to / "traceback.txt").write_text(traceback.format_exc(), encoding="utf-8")
        print(f"kept {to}: {traceback.format_exc().splitlines()[-1][:300]}", flush=True)


def ended(study: vcal.Study) -> str:
    """Close the loop with few draws and few effects; how it ended."""
    try:
        closure = vcal.close_loop(
            study.model, study.measurement, check=study.check, draws=25, max_effects=2
        )
    except StudyError as error:
        assert len(str(error)) <= 1500, str(error)[:300]
        return "refused"
    return "with an effect" if closure.found else "without an effect"


def main() -> None:
    """Run a campaign."""
    parser = parser_of(__doc__, "fuzz")
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--computed", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--batch", type=int, default=500, help="inputs per run of hypothesis")
    parser.add_argument("--minutes", type=float, default=math.inf)
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    compile_quickly()
    vcal.enable_float64()
    head = {"seed": options.seed, "batch": options.batch}
    earlier = {}
    if options.out.is_file():
        found = json.loads(options.out.read_text(encoding="utf-8"))
        earlier = found if head.items() <= found.items() else {}
    number = earlier.get("batches", 0)
    with tempfile.TemporaryDirectory() as work:
        campaign = Campaign(Path(work), options.inputs, options.computed, earlier)
        while campaign.left > 0 and time.monotonic() < end:
            campaign.batch(options.seed + number, options.batch)
            number += 1
            write(options.out, {**head, "batches": number, **campaign.record()})
            print(campaign.record(), flush=True)
    raise SystemExit(1 if any(campaign.kept.values()) else 0)


if __name__ == "__main__":
    main()
