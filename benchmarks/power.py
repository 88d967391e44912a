"""How well the loop finds what is missing: right names, wrong names and none, by size.

Machines are drawn from the declared family and measured by the independent numpy generator of the
tests, with one effect of the table in power_cases.py, with several, with an error that no catalogue
holds, with outliers, or with nothing. Sizes count in detection limits of the set: the size at which
the median of the screening's corrected p-value is alpha.

    python benchmarks/power.py --sets 20 --jobs 2 --minutes 60
    python benchmarks/power.py --summary

The first command appends one line per set to lines/power.jsonl and skips the sets that are there.
The second makes results/power.json and results/power.png from the lines (power_summary.py).
"""

import argparse
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from records import campaign, campaign_parser, known, make_sets

ALPHA = 0.01
DRAWS = 500
LIMIT_DRAWS = 200
FIRST_SEED = 20_000

_APART = 1000
"""Seeds from the machines of one effect to those of the next (`--own-machines`)."""

Job = tuple[str, float, int]
"""Entry, multiple of the detection limit, seed."""


def jobs(
    names: Sequence[str], multiples: Sequence[float], sets: range, own_machines: bool = False
) -> Iterator[Job]:
    """Every set, seed by seed and multiple by multiple, so that all entries grow together.

    Entries of an instrument share the machine of a seed. With `own_machines`, those of another
    effect have other seeds, and so other machines: what resembles an effect in one of them is then
    in few sets.

    Clean entries need more sets: ten of them are spread among the sets of each seed. An entry takes
    those of the requested `multiples` that are its own or that lie above all of its own.
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
    apart = dict.fromkeys(names, 0)
    if own_machines:
        # An effect alone, with strays or with others has one detection limit for all.
        kinds = {e.name: e.kinds[0].name if e.kinds else "" for e in entries}
        order = {kind: k for k, kind in enumerate(dict.fromkeys(kinds.values()))}
        apart = {name: _APART * order[kind] for name, kind in kinds.items()}
    for place, seed in enumerate(sets):
        wanted = [
            (name, its[i], seed + apart[name])
            for i in range(max(map(len, sizes.values()), default=0))
            for name, its in sizes.items()
            if i < len(its)
        ]
        between = [
            (name, 0.0, sets.start + 10 * place + k + apart[name])
            for k in range(10)
            for name in clean
        ]
        # Sorted by the relative place of each set in its own list.
        spread = [((i + 0.5) / len(part), job) for part in (wanted, between)
                  for i, job in enumerate(part)]  # fmt: skip
        yield from (job for _, job in sorted(spread, key=lambda item: item[0]))


# --- a set ---------------------------------------------------------------------------------------


def load(case):
    """A case of the oracle as a study that vcal has read from files."""
    import vcal
    from oracle import write_study

    with tempfile.TemporaryDirectory() as folder:
        write_study(Path(folder), case)
        return vcal.load_study(Path(folder) / "setup.toml")


def screened(study, fit, draws: int, seed: int):
    """The first screening of the loop, from a fit of the declared model."""
    import vcal
    from vcal.loop.empirical import EMPIRICAL
    from vcal.loop.screening.candidates import candidates
    from vcal.loop.screening.score_test import ScoreTest
    from vcal.loop.screening.screening import screen

    tried, _ = candidates(study.model, study.measurement, vcal.CATALOGUE.values())
    empirical, _ = candidates(study.model, study.measurement, EMPIRICAL, tried)
    return screen(ScoreTest(fit, draws, seed), [*tried, *empirical])


def limit_of(entry, world, sized, kind) -> float:
    """The detection limit of one effect of a set, in the unit of the effect.

    It is the size at which the median statistic has a corrected p-value of alpha. It follows from
    the screening of a large effect without noise, because the statistic grows with the square of
    the size, and is infinite where the large effect lies below it. The effect is alone and there
    are no outliers, so that the limit is the same in every entry that has the effect.
    """
    from power_cases import make
    from scipy.optimize import brentq
    from scipy.special import gammainccinv
    from scipy.stats import ncx2

    from vcal.identification.identify import identify
    from vcal.loop.weighing.cross_validation import folds_of

    alone = replace(entry, kinds=(kind,), strays=0.0, zero=False)
    made = make(alone, world, [sized], [kind.large], noise=0.0)
    study = load(made.case)
    keep = ~folds_of(study.model, study.measurement)[1]  # the loop never fits the other rows
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
        # The studentised statistic is -dof ln(1 - stat/chi2), with chi2 = dof without the effect.
        needed = fit.dof * math.expm1(2 * gammainccinv(0.5 * best.rank, p) / fit.dof)

        def missing(x: float, rank: int = best.rank, needed: float = needed) -> float:
            return float(ncx2.median(rank, x)) - needed

        ratios.append(best.statistic / brentq(missing, 1e-9, 10 * needed))
    return kind.large / math.sqrt(max(ratios)) if max(ratios) > 1.0 else math.inf


def known_limit(limits: dict, entry, world, sized, kind) -> float:
    """The detection limit from `limits`, to which it is added where it is missing."""
    key = entry.instrument, kind.name, entry.warming, world.seed
    if key not in limits:
        limits[key] = limit_of(entry, world, sized, kind)
    return limits[key]


def true_fit(study, before, terms, keep, zero: bool = False):
    """The fit of the true model: `before` with the true effects added, their sizes free, and with
    `zero` their reference values too.
    """
    from vcal.effects import Setup, effect_class
    from vcal.effects.reference import with_free_reference
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
        # For joint_compliance this is the drive without the bearing.
        effect = min(fitting, key=lambda e: len(e.parameters))
        effect = (zero and with_free_reference(effect)) or effect
        shape, state = dict(term.shape or {}), ScoreTest(fit, 1, 0)
        columns = state.columns(effect, shape)
        start = np.linalg.lstsq(state.information(columns), columns.T @ fit.whitened, rcond=1e-8)[0]
        fit = refit(fit, Peak(effect, shape, start, 0.0, 0.0, len(start)), keep, room)
    return fit


def excess_chi2(after, fit) -> float:
    """Chi-square of the loop's fit minus that of the true model, with the declared noise, over the
    readings that both use.
    """
    from vcal.identification.identify import identify

    keep, room = after.used & fit.used, len(after.model.entries) + 16
    after, fit = (
        identify(f.model, f.measurement, theta=f.theta, shapes=f.shapes, keep=keep, room=room)
        for f in (after, fit)
    )
    return after.chi2 - fit.chi2


def one_set(entry, multiple: float, seed: int, limits: dict) -> dict:
    """Make a set, close the loop on it, and compare it with the fit of the true model."""
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
        sizes.append(multiple * known_limit(limits, entry, world, its, kind))
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
            "chance": float(f"{e.chance:.3g}"),
            "perhaps_chance": e.perhaps_chance,
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
        fit = true_fit(study, closure.before, made.terms, keep, entry.zero)
        line["rms"]["told"] = rms(errors(fit, study.check))
        line["chi2_over_told"] = round(excess_chi2(closure.after, fit), 3)
    if strays:
        listed = {s.row for s in closure.suspected}
        line["strays"] = [len(strays), len(listed & set(strays)), len(listed - set(strays))]
    elif closure.suspected:
        line["strays"] = [0, 0, len(closure.suspected)]
    return line | {"seconds": round(time.perf_counter() - start, 2)}


def p_without(line: dict) -> float:
    """The corrected p-value of the first screening of a set with outliers, of the same readings
    without outliers and without the rows that have them: what robust weighting should achieve.
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
    """The detection limits in the lines, by instrument, kind, warming up or not, and seed."""
    from power_cases import ENTRIES

    found = {}
    for line in lines:
        entry = ENTRIES.get(line["case"])
        if entry is not None:
            for kind, limit in zip(entry.kinds, line["limit"], strict=False):
                found[entry.instrument, kind.name, entry.warming, line["seed"]] = limit
    return found


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the sets."""
    from power_cases import ENTRIES, GROUPS

    limits = limits_in(known(options.lines))
    names = [
        name
        for name, entry in ENTRIES.items()
        if any(fnmatch(name, pattern) for pattern in options.cases)
        and entry.group in (options.groups or GROUPS)
    ]

    def made(name: str, multiple: float, seed: int) -> dict:
        try:
            return one_set(ENTRIES[name], multiple, seed, limits)
        except Exception as error:  # a set that fails is a finding, and must not end the campaign
            return {"case": name, "multiple": multiple, "seed": seed, "limit": [],
                    "verdict": "failed", "why": f"{type(error).__name__}: {error}"}  # fmt: skip

    sets = range(options.first_seed, options.first_seed + options.sets)
    # All sets of one instrument and seed go to one worker, because they share detection limits.
    every = jobs(names, options.multiples, sets, options.own_machines)
    make_sets(options, every, ("case", "multiple", "seed"), made,
              together=lambda name, _, seed: (name.split("/")[0], seed))  # fmt: skip


def summed(options: argparse.Namespace, lines: list[dict]) -> dict:
    """The summary of the lines, with the settings of the campaign; draws the picture beside it."""
    from power_summary import picture, summary

    import vcal

    vcal.enable_float64()
    settings = {"alpha": ALPHA, "draws": DRAWS, "limit_draws": LIMIT_DRAWS}
    record = {"settings": settings, **summary(lines, p_without)}
    picture(record, options.out.with_suffix(".png"))
    for name, value in record["summary"].items():
        print(name, value)
    return record


def main() -> None:
    """Run the campaign in single-threaded processes, or summarise it."""
    parser = campaign_parser(__doc__, "power", FIRST_SEED)
    parser.add_argument("--groups", nargs="+", default=[], help="such as clean, catalogue, outside")
    parser.add_argument("--own-machines", action="store_true", help="for every kind of effect")
    parser.add_argument("--multiples", nargs="+", type=float, default=[])
    options = parser.parse_args()
    campaign(__file__, options, work, lambda lines: summed(options, lines))


if __name__ == "__main__":
    main()
