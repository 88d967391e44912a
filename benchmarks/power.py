"""How well the loop finds what is missing: right names, wrong names and none, by size of effect.

Machines are drawn from the declared family and measured by the independent numpy generator of the
tests, with one effect of the table in power_cases.py, with two, with one that is in no catalogue,
with stray readings, or with nothing. A size counts in detection limits of its own set: the size at
which the corrected p-value of the screening is alpha in the median.

    python benchmarks/power.py --sets 20 --minutes 60

appends one line per set to results/power.jsonl and leaves out the sets that are there already;
`python benchmarks/power_summary.py` makes results/power.json and the picture from the lines.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
LINES = HERE / "results" / "power.jsonl"
ALPHA = 0.01
DRAWS = 500
LIMIT_DRAWS = 200
FIRST_SEED = 20_000

Job = tuple[str, float, int]
"""Entry, multiple of the detection limit, seed."""


def jobs(names: Sequence[str], multiples: Sequence[float], sets: range) -> Iterator[Job]:
    """Every set in an order in which all entries grow together: seed by seed, multiple by multiple;
    of clean ones, which take more sets, ten with every seed of the others, spread among them. Of
    the `multiples` asked for an entry has those of its own, and those above all of them.
    """
    from power_cases import ENTRIES

    entries = [ENTRIES[name] for name in names]
    clean = [entry.name for entry in entries if entry.clean]
    others = [entry for entry in entries if not entry.clean]
    sizes = {
        entry.name: [
            *(m for m in entry.multiples if not multiples or not entry.kinds or m in multiples),
            *(m for m in multiples if entry.kinds and m > max(entry.multiples)),
        ]
        for entry in others
    }
    for place, seed in enumerate(sets):
        wanted = [
            (name, its[i], seed)
            for i in range(max(map(len, sizes.values()), default=0))
            for name, its in sizes.items()
            if i < len(its)
        ]
        between = [(name, 0.0, sets.start + 10 * place + k) for k in range(10) for name in clean]
        # By how far along its own list each of them is.
        spread = [((i + 0.5) / len(part), job) for part in (wanted, between)
                  for i, job in enumerate(part)]  # fmt: skip
        yield from (job for _, job in sorted(spread, key=lambda item: item[0]))


def known(path: Path) -> list[dict]:
    """The lines that are there."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if line.strip()]


def append(path: Path, line: dict) -> None:
    """Add a line, whole, whoever else is writing."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line, separators=(",", ":")) + "\n")


# --- a set ---------------------------------------------------------------------------------------


def load(case):
    """The study as vcal reads it from files."""
    import vcal
    from oracle import write_study

    with tempfile.TemporaryDirectory() as folder:
        write_study(Path(folder), case)
        return vcal.load_study(Path(folder) / "setup.toml")


def screened(study, fit, draws: int, seed: int):
    """The first screening of the loop, of a fit of the declared model."""
    import vcal
    from vcal.loop.empirical import EMPIRICAL
    from vcal.loop.screening.candidates import candidates
    from vcal.loop.screening.score_test import ScoreTest
    from vcal.loop.screening.screening import screen

    tried, _ = candidates(study.model, study.measurement, vcal.CATALOGUE.values())
    empirical, _ = candidates(study.model, study.measurement, EMPIRICAL, tried)
    return screen(ScoreTest(fit, draws, seed), [*tried, *empirical])


def limit_of(entry, world, sized, kind) -> float:
    """Detection limit of one effect of a set, in its unit: the size at which the median statistic
    is that of a corrected p-value of alpha. Found from the screening of a large effect without
    noise, whose statistic grows with the square of the size; infinite where even that is below.
    That of the effect by itself, without strays: the same in every entry that has the effect.
    """
    from power_cases import make
    from scipy.optimize import brentq
    from scipy.special import gammainccinv
    from scipy.stats import ncx2

    from vcal.identification.identify import identify
    from vcal.loop.weighing.cross_validation import folds_of

    alone = replace(entry, kinds=(kind,), strays=0.0)
    made = make(alone, world, [sized], [kind.large], noise=0.0)
    study = load(made.case)
    keep = ~folds_of(study.model, study.measurement)[1]  # what the loop never fits tells it nothing
    fit = identify(study.model, study.measurement, keep=keep, room=len(study.model.entries) + 16)
    screening = screened(study, fit, LIMIT_DRAWS, world.seed)
    over_kinds = -math.expm1(math.log1p(-ALPHA) / screening.trials)
    own, ratios = made.terms[0].key, [0.0]
    for found in screening.kinds:
        peaks = [p for p in found.peaks if not own or p.effect.key == own]
        if not peaks:
            continue
        best = max(peaks, key=lambda peak: peak.statistic)
        p = -math.expm1(math.log1p(-over_kinds) / found.trials)
        # As the tests studentise: -dof ln(1 - stat/chi2), where chi2 is dof without the effect.
        needed = fit.dof * math.expm1(2 * gammainccinv(0.5 * best.rank, p) / fit.dof)

        def missing(x: float, rank: int = best.rank, needed: float = needed) -> float:
            return float(ncx2.median(rank, x)) - needed

        ratios.append(best.statistic / brentq(missing, 1e-9, 10 * needed))
    return kind.large / math.sqrt(max(ratios)) if max(ratios) > 1.0 else math.inf


def told(study, before, terms, keep):
    """The fit that was told the truth: `before` with the true effects added, free in size."""
    from vcal.effects import Setup, effect_class
    from vcal.loop.screening.score_test import Peak, ScoreTest
    from vcal.loop.weighing.rivals import refit

    model, measurement = study.model, study.measurement
    setup = Setup(model.chain, model.layout, measurement.plan, model.effects,
                  model.instrument.artefact)  # fmt: skip
    fit, room = before, len(model.entries) + 16
    for term in terms:
        name = term.key.split(" ")[0]
        fitting = [
            e
            for e in effect_class(name).candidates(setup)
            if e.key == term.key and set(term.parameters) <= {p.name for p in e.parameters}
        ]
        # A drive that yields, without the bearing beside it.
        effect = min(fitting, key=lambda e: len(e.parameters))
        shape, state = dict(term.shape or {}), ScoreTest(fit, 1, 0)
        columns = state.columns(effect, shape)
        start = np.linalg.lstsq(state.information(columns), columns.T @ fit.whitened, rcond=1e-8)[0]
        fit = refit(fit, Peak(effect, shape, start, 0.0, 0.0, len(start)), keep, room)
    return fit


def over_told(after, fit) -> float:
    """Chi-square with the declared noise of what was found, above that of the fit that was told,
    over the readings that both use.
    """
    from vcal.identification.identify import identify

    keep, room = after.used & fit.used, len(after.model.entries) + 16
    after, fit = (
        identify(f.model, f.measurement, theta=f.theta, shapes=f.shapes, keep=keep, room=room)
        for f in (after, fit)
    )
    return after.chi2 - fit.chi2


def one_set(entry, multiple: float, seed: int, limits: dict) -> dict:
    """Make a set, close the loop on it, and compare with a fit that was told the truth."""
    from power_cases import drawn, make, noise_seed, world_of

    import vcal
    from vcal.loop.close_loop import errors
    from vcal.loop.weighing.cross_validation import folds_of

    start = time.perf_counter()
    world = world_of(entry.instrument, seed)
    sized = drawn(entry, world)
    line: dict = {"case": entry.name, "multiple": multiple, "seed": seed}
    sizes = []
    for kind, its in zip(entry.kinds, sized, strict=True):
        key = entry.instrument, kind.name, entry.warming, seed
        if key not in limits:
            limits[key] = limit_of(entry, world, its, kind)
        sizes.append(multiple * limits[key])
    line["limit"] = [s / multiple for s in sizes] if multiple else []
    if not np.isfinite(sizes).all():
        return line | {"verdict": "not detectable", "seconds": time.perf_counter() - start}
    made = make(entry, world, sized, sizes, noise_seed=noise_seed(entry, multiple, seed))
    study = load(made.case)
    begun = time.perf_counter()
    closure = vcal.close_loop(
        study.model,
        study.measurement,
        check=study.check,
        alpha=ALPHA,
        draws=DRAWS,
        seed=seed,
    )
    line["loop_s"] = round(time.perf_counter() - begun, 2)
    line["truth"] = [[t.key, *t.parameters] for t in made.terms if t.key]
    line["covariates"] = sorted({c for t in made.terms for c in t.covariates})
    line["verdict"] = closure.verdict
    line["found"] = [
        {
            "key": e.effect.key,
            "status": e.status,
            "parameters": {name: float(f"{v:.4g}") for name, v, _, _ in e.parameters},
            "equivalent": e.equivalent,
            "probability": round(1.0 - sum(p for *_, p in e.alternatives), 4),
            "rivals": [[f"{n} {place}".strip(), round(p, 4)] for n, place, p in e.alternatives[:3]],
        }
        for e in closure.effects
    ]
    line["p"] = closure.screenings[0].p_value
    line["p_rounds"] = [float(f"{s.p_value:.4g}") for s in closure.screenings]
    line["rejected"] = [
        [f"{r.effect} {r.placement}".strip(), r.reason] for r in closure.rejected[:4]
    ]
    if what := closure.unexplained:
        line["unexplained"] = {
            "depends_on": what.depends_on[:3],
            "joint": bool(what.joint),
            "where": [[w.covariate, round(w.low, 4), round(w.high, 4)] for w in what.where],
            "p": what.p_value,
        }
    before = closure.errors["before"]
    line["chi2"] = [before.chi2_per_dof, closure.errors["after"].chi2_per_dof]
    which = "heldout" if before.check is None else "check"
    line["error"] = which

    def rms(found) -> list[float]:
        value = getattr(found, which)
        return [float(f"{value.value:.5g}"), float(f"{value.u:.3g}")]

    line["rms"] = {name: rms(found) for name, found in closure.errors.items()}
    strays = made.case.truth.get("strays", [])
    if all(t.key for t in made.terms):
        keep = ~folds_of(study.model, study.measurement)[1]
        keep[strays] = False
        fit = told(study, closure.before, made.terms, keep)
        line["rms"]["told"] = rms(errors(fit, study.check))
        line["chi2_over_told"] = round(over_told(closure.after, fit), 3)
    if strays:
        listed = {s.row for s in closure.suspected}
        line["strays"] = [len(strays), len(listed & set(strays)), len(listed - set(strays))]
    elif closure.suspected:
        line["strays"] = [0, 0, len(closure.suspected)]
    return line | {"seconds": round(time.perf_counter() - start, 2)}


def p_without(line: dict) -> float:
    """The corrected p-value of the first screening of a set with strays, had the readings that are
    off not gone astray and their rows not been used: what the loop should find with them in place.
    """
    from power_cases import ENTRIES, drawn, make, noise_seed, world_of

    from vcal.identification.identify import identify
    from vcal.loop.weighing.cross_validation import folds_of

    entry, multiple, seed = ENTRIES[line["case"]], line["multiple"], line["seed"]
    world = world_of(entry.instrument, seed)
    given = world, drawn(entry, world), [multiple * limit for limit in line["limit"]]
    noise = noise_seed(entry, multiple, seed)
    astray = make(entry, *given, noise_seed=noise).case.truth["strays"]
    study = load(make(replace(entry, strays=0.0), *given, noise_seed=noise).case)
    keep = ~folds_of(study.model, study.measurement)[1]
    keep[astray] = False
    room = len(study.model.entries) + 16
    fit = identify(study.model, study.measurement, keep=keep, room=room)
    return screened(study, fit, DRAWS, seed + 1).p_value


# --- the campaign --------------------------------------------------------------------------------


def limits_in(lines: Sequence[dict]) -> dict:
    """Detection limits that are known, by instrument, kind, how it is tried, and seed."""
    from power_cases import ENTRIES

    found = {}
    for line in lines:
        entry = ENTRIES.get(line["case"])
        if entry is not None:
            for kind, limit in zip(entry.kinds, line["limit"], strict=False):
                found[entry.instrument, kind.name, entry.warming, line["seed"]] = limit
    return found


def commit_of(root: Path) -> str:
    """The commit checked out there, with a + where its programs differ; empty without git."""
    git = ["git", "-C", str(root)]
    head = subprocess.run(
        [*git, "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=False
    )
    if head.returncode:
        return ""
    programs = ["vcal", "tests/oracle", "benchmarks/*.py"]
    same = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", *programs], check=False)
    return head.stdout.strip() + ("+" if same.returncode else "")


def forget_programs() -> None:
    """Before the process has more mappings than Linux allows, which would end it."""
    import jax

    maps = Path("/proc/self/maps")
    if maps.is_file() and maps.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()


def work(options: argparse.Namespace, part: int) -> None:
    """Every `jobs`-th of the sets that are not there yet, until the time is over."""
    from power_cases import ENTRIES, GROUPS

    import vcal

    vcal.enable_float64()
    end = time.monotonic() + 60 * options.minutes
    lines = known(options.lines)
    done = {(line["case"], line["multiple"], line["seed"]) for line in lines}
    limits = limits_in(lines)
    names = [
        name
        for name, entry in ENTRIES.items()
        if any(fnmatch(name, pattern) for pattern in options.cases)
        and entry.group in (options.groups or GROUPS)
    ]
    sets = range(options.first_seed, options.first_seed + options.sets)
    waiting = [job for job in jobs(names, options.multiples, sets) if job not in done]
    commit = commit_of(HERE.parent)
    # All sets of one seed and case by one worker: they share detection limits.
    mine = [job for job in waiting if hash((job[0].split("/")[0], job[2])) % options.jobs == part]
    for name, multiple, seed in mine:
        if time.monotonic() > end:
            break
        try:
            line = one_set(ENTRIES[name], multiple, seed, limits)
        except Exception as error:  # a set that fails is a finding, and must not end the campaign
            line = {"case": name, "multiple": multiple, "seed": seed, "limit": [],
                    "verdict": "failed", "why": f"{type(error).__name__}: {error}"}  # fmt: skip
        append(options.lines, line | {"commit": commit})
        forget_programs()
        found = [f["key"] for f in line.get("found", [])]
        print(name, multiple, seed, line["verdict"], found, line.get("seconds"), flush=True)


def main() -> None:
    """Run the campaign in single-threaded processes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=["*"], help="patterns such as 'r_test/*'")
    parser.add_argument("--groups", nargs="+", default=[], help="such as clean, catalogue, outside")
    parser.add_argument("--multiples", nargs="+", type=float, default=[])
    parser.add_argument("--sets", type=int, default=20, help="of every case and multiple; ten times"
                        " as many clean ones")  # fmt: skip
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--lines", type=Path, default=LINES)
    parser.add_argument("--part", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part is not None:
        work(options, options.part)
        return
    options.lines.parent.mkdir(parents=True, exist_ok=True)
    in_parallel(__file__, options.jobs)


def in_parallel(script: str, jobs: int) -> None:
    """Run a script again, in single-threaded processes that are each told their --part."""
    environment = dict(
        os.environ,
        PYTHONHASHSEED="0",
        OPENBLAS_NUM_THREADS="1",
        OMP_NUM_THREADS="1",
        XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    )
    command = [sys.executable, script, *sys.argv[1:]]
    running = [
        subprocess.Popen([*command, "--part", str(part)], env=environment) for part in range(jobs)
    ]
    try:
        codes = [process.wait() for process in running]
    except KeyboardInterrupt:
        for process in running:
            process.terminate()
        raise
    if any(codes):
        raise SystemExit(f"workers ended with {codes}")


if __name__ == "__main__":
    main()
