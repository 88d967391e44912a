"""The tables of benchmarks/README.md, made from results/*.json.

    python benchmarks/tables.py              # renew every table of the README
    python benchmarks/tables.py power_cases  # print tables that are too long for it

A table stands below a line `<!-- table NAME -->` and is replaced up to the next empty line.
"""

import argparse
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from records import HERE, RESULTS

SPEED = {
    "import": "`import vcal`",
    "demo": "`vcal demo`",
    "practice_02": "`vcal loop`, tracker with backlash (630 readings)",
    "irb120": "`vcal loop`, arm and tracker (785 poses)",
    "loop_504": "`vcal.close_loop` alone, tracker with backlash (504 readings)",
}
COMMANDS = {
    "campaigns_gpu": "batch.py --campaigns 100000 1000000",
    "batch_gpu": "batch.py --host-draws 3 --draws 16384 --repeats 3 --campaigns",
    "dynamics_gpu": "dynamics.py --repeats 2",
    "power": "power.py --sets 20 --jobs 2 --minutes 60",
    "power_fresh": "power.py --own-machines --first-seed 400000 --sets 3 --multiples 3 5",
    "power_new": "power.py --own-machines --first-seed 400000 --sets 3 --multiples 3 5",
    "smallest_sizes": "smallest_sizes.py --first-seed 600000 --sets 24",
    "several": "several.py --sets 20 --jobs 2 --minutes 60",
    "declared_sizes": "declared_sizes.py --first-seed 400000 --sets 50",
    "large_sizes": "large_sizes.py --first-seed 400000 --sets 1",
    "aliases": "aliases.py --first-seed 400000",
    "five_axes": "five_axes.py --sets 30 --jobs 2 --minutes 20",
    "within_u": "within_u.py --sets 90 --jobs 2",
    "within_u_new": "within_u.py --first-seed 400000 --sets 60",
    "practice": "practice.py --data ../shared/data",
    "speed": "speed.py --data ../shared/data",
    "uncertainty_peers": "uncertainty_peers.py --peers PYTHON",
    "linuxcnc": "linuxcnc.py --first-seed 53000 --sets 3",
    "fuzz": "fuzz.py --inputs 10000 --computed 200 --batch 250 --seed 60000",
    "signals": "signals.py --signals 200 --seed 6",
    "two_level": "two_level.py --draws 200000 --repeats 200",
}
"""Commands of the results that are not those of the script of the same name without options."""
POWER = (
    ("one effect, from three limits on (>= 97 %, <= 1 %)", "far_right", "far_wrong"),
    ("- sets with independent noise (>= 97 %, <= 1 %)", "own_right", "own_wrong"),
    ("- at 10 and 30 limits", "beyond_right", "beyond_wrong"),
    ("- while the machine only warms up", "warming_right", "warming_wrong"),
    ("two effects (>= 90 %)", "pairs_both", ""),
    ("- at 10 and 30 limits", "beyond_both", ""),
    ("three or four effects", "several_all", "several_wrong"),
    ("error that no catalogue holds (>= 80 %, <= 5 %)", "outside_pointed", "outside_wrong"),
    ("- at 10 and 30 limits", "beyond_outside_pointed", "beyond_outside_wrong"),
    ("clean: with a name (0.3 to 2 %)", "", "clean_named"),
    ("clean: unexplained", "", "clean_unexplained"),
    ("one effect: another name first of several", "", "far_another_first"),
    ("one effect: a second name that is wrong", "", "far_something_else_too"),
    ("one effect, at the limit: screening significant (50 %)", "at_the_limit", ""),
    ("warming up: true name among the alternatives", "warming_listed", ""),
    ("warming up, not right: true model has chi2 lower by 9", "", "warming_told_apart"),
    ("all: error after above uncompensated by more than u (none)", "", "far_worse_than_nothing"),
)
"""Label with required shares; keys in power.json of what is right and what is wrong."""
NOISE = {"clean": "as declared", "noisier": "1.1 times as declared"}
RIGHT = ("right", "right first")


def table(head: str, rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table; the head is separated by commas."""
    names = head.split(",")
    lines = [
        names,
        ["---"] * len(names),
        *([str(v).replace("|", "\\|") for v in row] for row in rows),
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _of(pair: Sequence[float]) -> str:
    """k of n, with the share and its 95 % interval."""
    k, n, *interval = pair
    if not n:
        return "not made"
    low, high = (100 * v for v in interval)
    return f"{k} of {n}: {100 * k / n:.1f} % ({low:.1f} to {high:.1f} %)"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def results() -> str:
    rows = []
    for path in sorted(RESULTS.glob("*.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
        many = found.get("commits", {})
        commit = found.get("commit") or (
            ", ".join(many) if len(many) < 5 else f"{len(many)} commits"
        )
        sets = f"{found['sets']:,}" if many else ""
        command = COMMANDS.get(path.stem, f"{path.stem}.py")
        rows.append([f"`{path.name}`", f"`{command}`", commit, sets])
    return table("result,script,commit,sets", rows)


def power(found: dict) -> str:
    s = found["summary"]
    rows = [[label, *(_of(s[key]) if key else "" for key in keys)] for label, *keys in POWER]
    ratio = f"{_number(s['far_error_ratio'])} (median)"
    rows.append(["one effect: error after / that of the true model (<= 1.1)", ratio, ""])
    return table("sets,right,wrong", rows)


def power_made(*founds: dict) -> str:
    """The rows of `power` for sets that were made, and those of another zero of temperature; for
    several campaigns side by side.
    """
    every = [found["summary"] for found in founds]
    shown = (
        *POWER,
        ("temperatures off by 5, 10 or -8 K (>= 95 %, <= 1 %)", "zero_right", "zero_wrong"),
    )
    rows = [
        [label, *(_of(s[key]) if key else "" for s in every for key in keys)]
        for label, *keys in shown
        if any(s[key][1] for s in every for key in keys if key)
        # Where every set has noise of its own, that row would repeat the first one.
        and not (keys[0] == "own_right" and all(s["own_right"] == s["far_right"] for s in every))
    ]
    later = ",later instruments: right,wrong" if len(founds) > 1 else ""
    return table(f"sets,right,wrong{later}", rows)


def power_clean(found: dict) -> str:
    rows = (
        [r["instrument"], NOISE[r["group"]], *(r[key] for key in ("sets", "named", "unexplained")),
         r["strays"], _number(r["seconds"])]
        for r in found["clean"]
    )  # fmt: skip
    head = "instrument,noise,clean sets,named,unexplained,with outliers listed,median s per loop"
    return table(head, rows)


def power_instruments(found: dict) -> str:
    clean = {r["instrument"]: r for r in found["clean"] if r["group"] == "clean"}
    rows = []
    curves = [r for r in found["curves"] if r["instrument"] in clean]
    for r in curves:
        right, wrong = r["curves"]["right name"], r["curves"]["wrong name"]
        cells = (f"{k}/{n}, {wrong[m][0]}" for m, (k, n, *_) in right.items())
        its = clean[r["instrument"]]
        alarms = f"{its['named']} + {its['unexplained']} of {its['sets']}"
        rows.append([r["instrument"], r["effects"], *cells, alarms, _number(its["seconds"])])
    sizes = ",".join(curves[0]["curves"]["right name"])
    return table(f"instrument,effects,{sizes},clean: named + unexplained,median s per loop", rows)


def _limits(case: dict) -> str:
    return ", ".join(
        "not detected" if limit is None else f"{limit['median']:.2g} {unit}"
        for limit, unit in zip(case["limits"], case["units"], strict=True)
    )


def _outcomes(part: dict | None, outside: bool = False) -> str:
    """Right or pointed sets of all, then the other outcomes."""
    counts = {
        k: v for k, v in (part or {"outcomes": {}})["outcomes"].items() if k != "not detectable"
    }
    if part is None or not counts:
        return ""
    good = part["pointed"] if outside else sum(counts.pop(k, 0) for k in RIGHT)
    n = part["sets"] - part["outcomes"].get("not detectable", 0)
    return f"{good}/{n}" + "".join(f", {v} {k}" for k, v in counts.items())


def power_cases(found: dict) -> str:
    multiples = ("0.5", "1", "2", "3", "5", "10", "30")
    rows = (
        [
            c["case"].replace("/", ": "),
            _limits(c),
            *(_outcomes(c["multiples"].get(m)) for m in multiples),
            _number(c["multiples"].get("3", c["multiples"].get("5", {})).get("error_ratio")),
        ]
        for c in found["cases"]
        if c["group"] in ("catalogue", "warming up", "pairs", "several")
    )
    return table(f"case,limit,{','.join(multiples)},error / true model", rows)


def power_outside(found: dict) -> str:
    sizes = ("3", "5", "10", "30")
    rows = (
        [c["case"].replace("/", ": "), _limits(c)]
        + [_outcomes(c["multiples"].get(m), outside=True) for m in sizes]
        for c in found["cases"]
        if c["group"] == "outside"
    )
    return table(f"case,limit,{','.join(sizes)}", rows)


def power_strays(found: dict) -> str:
    rows = (
        [
            r["case"].replace("/", ": "),
            r["sets"],
            f"{r['same']} of {r['compared']}",
            f"{r['as_without_the_rows']} of {r['compared'] - r['same']}",
            f"{r['listed']} of {r['astray']}",
            r["listed_wrongly"],
        ]
        for r in found["strays"]
    )
    return table("case,sets,same verdict,others as without the rows,listed,listed wrongly", rows)


def several(found: dict) -> str:
    outcomes = ["right", "right first", "another first", "wrong", "unexplained", "nothing"]
    totals: dict[str, Counter] = {}
    for r in found["rows"]:
        kind = r["case"]
        if kind.startswith("clean"):
            kind = "nothing missing"
        elif kind != "two machines":
            kind = f"effect of {'one instrument' if ' of ' in kind else 'the machine'}"
        its = {"sets": r["sets"], "contradiction": r["contradiction"], **r["outcomes"]}
        totals.setdefault(kind, Counter()).update(its)
    keys = ["sets", *outcomes, "contradiction"]
    rows = ([kind, *(total[key] for key in keys)] for kind, total in totals.items())
    return table(f"case,sets,{','.join(outcomes)},reported not to fit one machine", rows)


def large_sizes(found: dict) -> str:
    rows = (
        [f"{row['times']:g}", *("{} of {}".format(*row[key][:2]) for key in ("right", "wrong"))]
        for row in found["sizes"]
    )
    return table("times the expected size,right name,wrong for certain", rows)


def smallest_sizes(found: dict) -> str:
    rows = [
        *([r["case"].replace("/", ": "), _of(r["named"]), r["not_stated"]] for r in found["rows"]),
        ["all", _of(found["all"]), sum(row["not_stated"] for row in found["rows"])],
    ]
    return table("effect,named (95 %),no size stated", rows)


def smallest_size_of_all(found: dict) -> str:
    rows = [[_of(found["all"]), sum(row["not_stated"] for row in found["rows"])]]
    return table("named (95 %),no size stated", rows)


def declared_sizes(found: dict) -> str:
    keys = ("misfit said", "false names", "anything")
    rows = (
        [f"{row['factor']:.2g}", *("{} of {}".format(*row[key][:2]) for key in keys)]
        for row in found["rows"]
        if row["case"] == "all"
    )
    return table("declared size / true size,said not to fit,false names,any finding", rows)


def five_axes(found: dict) -> str:
    cases = dict.fromkeys(r["case"] for r in found["rows"])
    by_place = {(r["instrument"], r["case"]): r for r in found["rows"]}
    rows = (
        [instrument]
        + [
            f"{its['good'][0]}/{its['good'][1]}"
            if (its := by_place.get((instrument, case)))
            else ""
            for case in cases
        ]
        for instrument in dict.fromkeys(r["instrument"] for r in found["rows"])
    )
    return table("instrument," + ",".join(case.replace(",", "") for case in cases), rows)


def aliases(found: dict) -> str:
    seen, named = found["seen"], found["named"]
    rows = [
        ["a screw is named, as a class of pitches", f"{named} of {seen}"],
        ["- the true pitch is in the class", f"{found['true_in_class']} of {named}"],
        ["- the class stands among the alternatives", f"{found['class_as_alternative']} of {seen}"],
        ["another name, also beside it", f"{found['other_names']} of {seen}"],
        ["error at check points larger by more than its u", f"{found['worse_by_more_than_u']} of "
         f"{found['sets']}"],
        ["pitch of which the step is a multiple: a name", f"{found['unseen_named']} of "
         f"{found['unseen']}"],
    ]  # fmt: skip
    return table("outcome,sets", rows)


def within_u(*founds: dict) -> str:
    cases = [case for found in founds for case in found["cases"]]
    rows = [
        [
            r["case"],
            f"{r['named']} of {r['sets']}",
            len(r["parameters"]),
            _of(r["within_U"]),
            f"{r['sd_of_pulls']:.2f}",
            _of(r["jointly_beyond_5_percent"]) if "largest_distance" in r else "",
            f"{r['largest_distance']:.1f}" if "largest_distance" in r else "",
        ]
        for r in cases
    ]
    for name, r in founds[0]["measured"].items():
        n = len(r["pulls"])
        inside = sum(abs(pull) <= 2.0 for pull in r["pulls"].values())
        p = f"p = {r['chance']:.2g}"
        rows.append([name, "1 of 1", n, f"{inside} of {n}", "", p, f"{r['distance']:.1f}"])
    head = "case,named,parameters,within U,sd of error / u,jointly beyond 95 %,largest chi2"
    return table(head, rows)


def within_u_of_all(*founds: dict) -> str:
    """The cases of simulated data together, and the range over them."""
    cases = [case for found in founds for case in found["cases"]]
    inside, of = (sum(c["within_U"][i] for c in cases) for i in (0, 1))
    shares = [100 * c["within_U"][0] / c["within_U"][1] for c in cases]
    spread = [c["sd_of_pulls"] for c in cases]
    row = [
        len(cases),
        f"{inside:,} of {of:,}: {100 * inside / of:.1f} %",
        f"{min(shares):.1f} to {max(shares):.1f} %",
        f"{min(spread):.2f} to {max(spread):.2f}",
    ]
    return table("cases,within U,from case to case,sd of error / u", [row])


def practice(found: dict) -> str:
    def left(rest: dict | None) -> str:
        if rest is None:
            return ""
        where = "; ".join(f"{w['column']} {w['low']:.0f} to {w['high']:.0f}" for w in rest["where"])
        return "; ".join(filter(None, [", ".join(rest["depends_on"]), where, rest["direction"]]))

    rows = (
        [
            f"{c['study']} {c['override']}".strip(),
            c["verdict"],
            ", ".join(e["key"] for e in c["effects"]) or "none",
            left(c["unexplained"]),
            c["error"],
            f"{c['before_um']:.3f}",
            f"{c['after_um']:.3f}",
            "" if c["limit_um"] is None else f"{c['limit_um']:g}",
        ]
        for c in found["rows"]
    )
    return table("study,verdict,named,not explained,rms,before um,after um,limit um", rows)


def speed(found: dict) -> str:
    rows = (
        [
            SPEED[name],
            f"{r['cold']['wall_s']:.1f}",
            f"{r['limit_s']:g}",
            f"{r['warm_median_wall_s']:.1f}",
            f"{r['peak_mib']:.0f}" if "peak_mib" in r else "",
        ]
        for name, r in found["results"].items()
    )
    machine = f"{found['machine']['cores']} cores Python {found['machine']['python']}"
    return table(f"{machine},cold s,limit s,warm s,peak memory MiB", rows)


def batch(*founds: dict) -> str:
    def both(times: dict[str, float], name: str) -> list[str]:
        return [f"{1e3 * times[name]:.3g}", f"{times[name] / times['vcal']:,.1f}"]

    every = [found["seconds_per_draw"] for found in founds]
    devices = (f"{f['machine']['device']} {f['machine']['cores']} cores" for f in founds)
    head = ",".join(f"{device}: ms per draw,/ vcal" for device in devices)
    rows = ([name, *sum((both(times, name) for times in every), [])] for name in every[0])
    return table(f"method,{head}", rows)


def campaigns(*founds: dict) -> str:
    def cell(c: dict) -> str:
        return f"{c['peak_mib']:.0f} MiB; {c['wall_s']:.0f} s; {c['quantiles']}"

    lengths = (f"{c['draws']:,}".replace(",", " ") for c in founds[0]["campaigns"])
    head = ",".join(f"{draws} draws: peak memory; whole run; quantiles" for draws in lengths)
    rows = ([f["machine"]["device"], *map(cell, f["campaigns"])] for f in founds)
    return table(f"device,{head}", rows)


def interrupted(found: dict) -> str:
    same, arrays = sum(found["same"].values()), len(found["same"])
    kills = ", ".join(f"{life['to']:,}" for life in found["killed"])
    return table("draws,killed after,arrays equal bit for bit",
                 [[f"{found['draws']:,}", kills, f"{same} of {arrays}"]])  # fmt: skip


def faults(disk: dict, signals: dict, fuzz: dict) -> str:
    counts, loops, sent = fuzz["counts"], fuzz["loops"], signals["signals"]
    names = ", ".join(signals["next_runs"])
    held = min(signals[key] for key in ("honoured", "told", "whole", "nothing left"))
    rows = [
        ["disk full from a write on", f"{disk['faults']} writes of {disk['commands']} commands",
         disk["faults"] - disk["bad"], disk["bad"]],
        ["Ctrl-C or SIGTERM", f"{sent} moments of {names}", held, sent - held],
        ["- ends within 2 s", f"the slowest takes {signals['slowest_s']:.1f} s; load average "
         f"{signals['load_average'][0]:g}", signals["in_time"], sent - signals["in_time"]],
        ["broken study", f"{counts['inputs']:,}: {counts['refused']:,} refused in one message, "
         f"{counts['accepted']:,} accepted", f"{counts['inputs'] - fuzz['exceptions']:,}",
         f"{fuzz['exceptions']}, hangs: {fuzz['hangs']}"],
        ["loop on an accepted one", loops["run"], sum(loops.values()) - loops["run"],
         2 * loops["run"] - sum(loops.values())],
    ]  # fmt: skip
    return table("fault,cases,held,not", rows)


def detail_of_disk_full(found: dict) -> str:
    rows = [[f"`{r['command']}`", r["writes"], len(r["bad"])] for r in found["rows"]]
    return table("command,writes,bad", rows)


def strd(found: dict) -> str:
    rows = (
        [
            start.removeprefix("start"),
            r["sets"],
            r["eight_digits_and_six_of_sd"],
            r["silently_wrong"],
            *(
                f"{r[o]['eight_digits']} / {r[o]['silently_wrong']}"
                for o in ("minpack", "optimistix")
            ),
        ]
        for start, r in found["summary"].items()
    )
    others = "MINPACK 8 digits / silently wrong,optimistix 8 digits / silently wrong"
    return table(f"start,sets,8 digits and 6 of sd,silently wrong,{others}", rows)


def laser_frame(found: dict) -> str:
    rows = (
        [
            r["case"],
            f"{r['cycles']:,}",
            f"{r['cold_s']:.1f}",
            f"{r['warm_s']:.1f}",
            r["failed"],
            "" if r["rms_ln_ratio"] is None else f"{r['rms_ln_ratio']:.3f}",
        ]
        for r in found["rows"]
    )
    return table("path and truth,cycles,cold s,warm s,failed,rms of ln(vcal / printed)", rows)


def artefact_design(found: dict) -> str:
    by_case: dict[str, list[str]] = {}
    for r in found["rows"]:
        text = f"{r['cold_s']:.1f} / {r['warm_s']:.1f}; {r['found']}"
        by_case.setdefault(r["case"].rpartition(", ")[0], []).append(text)
    known = dict.fromkeys(r["case"].rpartition(", ")[2] for r in found["rows"])
    head = ",".join(f"{name}: cold / warm s; result" for name in known)
    return table(f"case,{head}", ([case, *its] for case, its in by_case.items()))


def dynamics(*founds: dict) -> str:
    def cells(r: dict) -> list[str]:
        pace = r["simulated_s"] / r["warm_s"]
        return [f"{r['cold_s']:.2f}", f"{pace:.3g}", f"{r['off_nm']:.1g}"]

    head = ",".join(f"{f['device']}: first call s,simulated s per s,off by nm" for f in founds)
    rows = (
        [same[0]["model"], same[0]["way"], *sum(map(cells, same), [])]
        for same in zip(*(found["simulations"] for found in founds), strict=True)
    )
    return table(f"model,method,{head}", rows)


def r_tests(*founds: dict) -> str:
    rows = (
        [
            f"{found['device']}, {r['run']}",
            f"{r['machines']:,}",
            r["circles"],
            f"{r['wall_s']:.0f}",
            f"{r['stable']:,}",
            f"{r['converged']:,}",
            f"{r['sd_of_pulls']:.2f}",
            f"{100 * r['within_U']:.1f}",
        ]
        for found in founds
        for r in found["campaigns"]
    )
    head = "run,machines,circles each,whole run s,stable,converged,sd of error / u,within U %"
    return table(head, rows)


def compensation(found: dict) -> str:
    names = {"without": "without compensation"}
    rows = (
        [
            names.get(name, f"`{name}`"),
            f"{one['expected_um']:.3f}",
            f"{one['realised_um']:.3f}",
            f"{one['realised_over_expected']:.3f}",
            f"{100.0 * one['within_2u']:.1f}",
            f"{100.0 * one['at_most_1.1']:.1f}",
        ]
        for name, one in found["summary"].items()
    )
    head = "format,expected rms um,realised rms um,ratio,within 2 u %,at most 1.1 times %"
    return table(head, rows)


def linuxcnc(found: dict) -> str:
    rows = (
        [
            row["kind"],
            f"`{row['format']}`",
            row["machines"],
            *(f"{row[key]:.3f}" for key in ("before_um", "foretold_um", "after_um")),
            f"{row['after_over_foretold']:.3f}",
        ]
        for row in found["drives"]
    )
    return table("effect,format,machines,before um,foretold um,after um,after / foretold", rows)


def two_level(found: dict) -> str:
    seconds = found["seconds"]
    row = [
        f"{found['draws']:,}",
        f"{seconds['exact']['wall_s']:.1f}",
        f"{seconds['two-level']['wall_s']:.1f}",
        f"{found['times_faster']:.1f}",
        f"{found['linear']:,} + {found['exact']:,}",
        f"{100 * min(found['within_3_standard_errors'].values()):.2f}",
        found["repeats"],
    ]
    head = "draws,exact s,two-level s,times faster,linear + exact,within 3 s.e. %,repeats"
    return table(head, [row])


def uncertainty_peers(found: dict) -> str:
    rows = []
    for one in found["rows"]:
        gum = one["work"] == "gum"
        rows.append(
            [
                one["tool"],
                "GUM" if gum else f"{found['draws']:,} draws",
                f"{1e3 * one['first_s']:.3g}",
                f"{1e3 * one['warm_s']:.3g}",
                f"{1e3 * one['warm_cpu_s']:.3g}",
                "" if gum else f"{one['first_of_numpy']:.2f}",
                "" if gum else f"{one['warm_of_numpy']:.2f}",
                "" if gum else f"{one['warm_cpu_of_numpy']:.2f}",
            ]
        )
    head = "program,work,first ms,warm ms,warm CPU ms,first / numpy,warm / numpy,warm CPU / numpy"
    return table(head, rows)


def growth(found: dict) -> str:
    rows = (
        [
            f"{r['number']:,} {r['kind']}",
            f"{r['rows']:,}",
            *(f"{r[key]:.1f}" for key in ("read_cpu_s", "loop_cpu_s")),
            f"{r['peak_mib']:.0f}",
            f"{r['exponent']:.2f}" if "exponent" in r else "",
            ", ".join(r["named"]),
        ]
        for r in found["rows"]
    )
    return table("study,rows,reading CPU s,loop CPU s,peak memory MiB,exponent,named", rows)


TABLES: dict[str, tuple[Callable[..., str], tuple[str, ...]]] = {
    "results": (results, ()),
    **{
        f.__name__: (f, (f.__name__,))
        for f in (
            large_sizes,
            declared_sizes,
            aliases,
            practice,
            speed,
            compensation,
            linuxcnc,
            two_level,
        )
    },
    "smallest_size_of_all": (smallest_size_of_all, ("smallest_sizes",)),
    "within_u_of_all": (within_u_of_all, ("within_u", "within_u_new")),
    "power_fresh": (power_made, ("power_fresh", "power_new")),
    "batch": (batch, ("batch", "batch_gpu")),
    "faults": (faults, ("disk_full", "signals", "fuzz")),
}
"""Function and result files of every table of the README."""
LONG = {
    "within_u": (within_u, ("within_u", "within_u_new")),
    "uncertainty_peers": (uncertainty_peers, ("uncertainty_peers",)),
    **{
        f.__name__: (f, ("power",))
        for f in (
            power,
            power_instruments,
            power_cases,
            power_outside,
            power_clean,
            power_strays,
        )
    },
    **{
        f.__name__: (f, (f.__name__,))
        for f in (
            smallest_sizes,
            several,
            five_axes,
            laser_frame,
            artefact_design,
            interrupted,
            growth,
            strd,
        )
    },
    "disk_full": (detail_of_disk_full, ("disk_full",)),
    "power_each_new": (power_instruments, ("power_new",)),
    "campaigns": (campaigns, ("batch", "campaigns_gpu")),
    "dynamics": (dynamics, ("dynamics", "dynamics_gpu")),
    "r_tests": (r_tests, ("dynamics", "dynamics_gpu")),
}
"""The same of tables that are printed only."""


def made(name: str) -> str:
    """The text of a table."""
    make, files = (TABLES | LONG)[name]
    texts = ((RESULTS / f"{file}.json").read_text(encoding="utf-8") for file in files)
    return make(*map(json.loads, texts))


def renewed(text: str) -> str:
    """The text of the README with every table made again."""
    for name in TABLES:
        pattern = rf"(<!-- table {name} -->\n).*?(?=\n\n|\n?\Z)"
        places = list(re.finditer(pattern, text, re.DOTALL))
        if len(places) != 1:
            raise SystemExit(f"{len(places)} lines '<!-- table {name} -->', expected 1")
        text = text[: places[0].end(1)] + made(name) + text[places[0].end() :]
    return text


def main() -> None:
    """Renew the README, or print the tables that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    every = sorted(TABLES | LONG)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(every)}")
    names = parser.parse_args().names
    for name in names:
        if name not in every:
            parser.error(f"found the table {name!r}, expected one of {', '.join(every)}")
    if names:
        print("\n\n".join(map(made, names)))
        return
    readme = HERE / "README.md"
    readme.write_text(renewed(readme.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
