"""The tables of benchmarks/README.md, made from results/*.json.

    python benchmarks/tables.py

Every table stands below a line `<!-- table NAME -->` and is replaced up to the next empty line.
"""

import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path

HERE = Path(__file__).resolve().parent
NAMES = {
    "import": "`import vcal`",
    "demo": "`vcal demo`",
    "practice_02": "`vcal loop`, tracker with backlash (630 readings)",
    "irb120": "`vcal loop`, arm and tracker (785 poses)",
    "loop_504": "`vcal.close_loop` alone, tracker with backlash (504 readings)",
}


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    head = list(head)
    lines = [head, ["---"] * len(head), *map(list, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _of(pair: list[float]) -> str:
    """k of n, with the share and its 95 % interval."""
    k, n, *interval = pair
    if not n:
        return "not made"
    low, high = (100 * v for v in interval)
    return f"{k} of {n}: {100 * k / n:.1f} % ({low:.1f} to {high:.1f} %)"


def power(found: dict) -> str:
    s = found["summary"]
    rows = [
        ["clean sets that get a name", "0.3 to 2 %", _of(s["clean_named"])],
        ["clean sets called unexplained", "", _of(s["clean_unexplained"])],
        ["from three limits on: right name", ">= 97 %", _of(s["far_right"])],
        ["for certain a wrong one", "<= 1 %", _of(s["far_wrong"])],
        ["draws of the noise with a wrong one", "", "{} of {}".format(*s["far_wrong_draws"])],
        ["where every set has its own noise: right name", ">= 97 %", _of(s["own_right"])],
        ["for certain a wrong one", "<= 1 %", _of(s["own_wrong"])],
        ["from three limits on: another first of several", "", _of(s["far_another_first"])],
        ["the right one, and a second that is not", "", _of(s["far_something_else_too"])],
        ["unexplained", "", _of(s["far_unexplained"])],
        ["nothing", "", _of(s["far_nothing"])],
        ["while the machine just warms up: right name", "", _of(s["warming_right"])],
        ["for certain a wrong one", "", _of(s["warming_wrong"])],
        ["the true one among those it may be", "", _of(s["warming_listed"])],
        [
            "not right, though the readings fit the truth better by more than 9 in chi2",
            "",
            _of(s["warming_told_apart"]),
        ],
        [
            "at the limit: the screening says that something is missing",
            "50 %",
            _of(s["at_the_limit"]),
        ],
        ["outside the catalogue: a wrong name", "<= 5 %", _of(s["outside_wrong"])],
        ["one that is called one of several", "", _of(s["outside_another_first"])],
        ["unexplained, the right covariate first", ">= 80 %", _of(s["outside_pointed"])],
        ["two effects, both found", ">= 90 %", _of(s["pairs_both"])],
        ["three or four effects, all found", "", _of(s["several_all"])],
        ["a wrong one for certain among them", "", _of(s["several_wrong"])],
        ["at ten and at thirty limits: right name", "", _of(s["beyond_right"])],
        ["for certain a wrong one", "", _of(s["beyond_wrong"])],
        ["both of two", "", _of(s["beyond_both"])],
        ["outside the catalogue: a wrong name", "", _of(s["beyond_outside_wrong"])],
        ["unexplained, the right covariate first", "", _of(s["beyond_outside_pointed"])],
        [
            "error after / that of a fit that was told, median",
            "<= 1.1",
            _number(s["far_error_ratio"]),
        ],
        ["after above uncompensated by more than u", "none", _of(s["far_worse_than_nothing"])],
    ]
    rows.append(["made by the commits", "", ", ".join(found["commits"])])
    return table(["", "wanted", "found"], rows)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def power_clean(found: dict) -> str:
    rows = (
        [
            r["instrument"],
            POWER_GROUPS[r["group"]],
            str(r["sets"]),
            str(r["named"]),
            str(r["unexplained"]),
            str(r["strays"]),
            _number(r["seconds"]),
        ]
        for r in found["clean"]
    )
    head = "instrument,noise and effects,clean sets,named,unexplained,some readings left out"
    return table([*head.split(","), "median s per loop"], rows)


POWER_GROUPS = {
    "clean": "as declared",
    "noisier": "noise 1.1 times as declared",
}


def _limits(case: dict) -> str:
    parts = []
    for limit, unit in zip(case["limits"], case["units"], strict=True):
        parts.append("not seen" if limit is None else f"{limit['median']:.2g} {unit}")
    return ", ".join(parts)


def _outcomes(part: dict | None) -> str:
    if part is None:
        return ""
    counts = part["outcomes"]
    n = part["sets"] - counts.get("not detectable", 0)
    right = counts.get("right", 0) + counts.get("right first", 0)
    others = {
        k: v for k, v in counts.items() if k not in ("right", "right first", "not detectable")
    }
    return f"{right}/{n}" + "".join(f", {v} {k}" for k, v in others.items()) if n else ""


def power_cases(found: dict) -> str:
    groups = ("catalogue", "warming up", "pairs", "several")
    multiples = ("0.5", "1", "2", "3", "5", "10", "30")
    rows = (
        [
            c["case"].replace("/", ": "),
            _limits(c),
            *(_outcomes(c["multiples"].get(m)) for m in multiples),
            _number(c["multiples"].get("3", c["multiples"].get("5", {})).get("error_ratio")),
        ]
        for c in found["cases"]
        if c["group"] in groups
    )
    return table(["case", "limit", *multiples, "error / told"], rows)


def power_outside(found: dict) -> str:
    sizes = ("3", "5", "10", "30")
    rows = (
        [
            c["case"].replace("/", ": "),
            _limits(c),
            *(_outside(c["multiples"][m]) if m in c["multiples"] else "" for m in sizes),
        ]
        for c in found["cases"]
        if c["group"] == "outside"
    )
    return table(["case", "limit", *sizes], rows)


def _outside(part: dict) -> str:
    counts = {k: v for k, v in part["outcomes"].items() if k != "not detectable"}
    n = sum(counts.values())
    return f"{part['pointed']}/{n}" + "".join(f", {v} {k}" for k, v in counts.items()) if n else ""


def power_strays(found: dict) -> str:
    rows = (
        [
            r["case"].replace("/", ": "),
            str(r["sets"]),
            f"{r['same']} of {r['compared']}",
            f"{r['as_without_the_rows']} of {r['compared'] - r['same']}",
            f"{r['listed']} of {r['astray']}",
            str(r["listed_wrongly"]),
        ]
        for r in found["strays"]
    )
    head = "case,sets,same verdict as without,others as without their rows,listed,listed wrongly"
    return table(head.split(","), rows)


def several(found: dict) -> str:
    outcomes = ["right", "right first", "another first", "wrong", "unexplained", "nothing"]
    rows = (
        [r["case"], str(r["sets"]), *(str(r["outcomes"].get(o, 0)) for o in outcomes),
         str(r["data_set_consistency"])]
        for r in found["rows"]
    )  # fmt: skip
    return table(["case", "sets", *outcomes, "told not to fit one machine"], rows)


def five_axes(found: dict) -> str:
    outcomes = ["right", "not certain", "ambiguous", "unexplained", "wrong", "nothing"]
    rows = (
        [r["instrument"], r["case"], _of(r["good"]),
         *(str(r["outcomes"].get(o, 0)) for o in outcomes), f"{r['median_s']:.1f}"]
        for r in found["rows"]
    )  # fmt: skip
    head = ["instrument", "in the machine", "as it should be", *outcomes, "loop, s"]
    return table(head, rows)


def within_u(found: dict) -> str:
    rows = [
        [
            r["case"],
            f"{r['named']} of {r['sets']}",
            str(len(r["parameters"])),
            _of(r["within_U"]),
            f"{r['sd_of_pulls']:.2f}",
            _of(r["jointly_beyond_5_percent"]),
            f"{r['largest_distance']:.1f}",
        ]
        for r in found["cases"]
    ]
    for name, r in found["measured"].items():
        n = len(r["pulls"])
        inside = sum(abs(pull) <= 2.0 for pull in r["pulls"].values())
        chance = f"chance of as far off: {r['chance']:.2g}"
        rows.append([name, "1 of 1", str(n), f"{inside} of {n}", "", chance,
                     f"{r['distance']:.1f}"])  # fmt: skip
    head = "case,named,parameters,within U,sd of error / u,all together beyond 95 %,farthest chi2"
    return table(head.split(","), rows)


def speed(found: dict) -> str:
    rows = (
        [
            NAMES[name],
            f"{r['cold']['wall_s']:.1f}",
            f"{r['limit_s']:g}",
            f"{r['warm_median_wall_s']:.1f}",
            f"{r['peak_mib']:.0f}" if "peak_mib" in r else "",
        ]
        for name, r in found["results"].items()
    )
    machine = f"{found['machine']['cores']} cores, Python {found['machine']['python']}"
    return table([machine, "cold, s", "limit, s", "warm, s", "peak memory, MiB"], rows)


def practice(found: list[dict]) -> str:
    def effects(case: dict) -> str:
        return ", ".join(e["key"] for e in case["effects"]) or "none"

    def left(case: dict) -> str:
        rest = case["unexplained"]
        if rest is None:
            return ""
        where = "; ".join(f"{w['column']} {w['low']:.0f} to {w['high']:.0f}" for w in rest["where"])
        parts = [", ".join(rest["depends_on"]), where, rest["direction"]]
        return "; ".join(filter(None, parts))

    rows = (
        [
            f"{c['study']} {c['override']}".strip(),
            c["verdict"],
            effects(c),
            left(c),
            c["error"],
            f"{c['before_um']:.3f}",
            f"{c['after_um']:.3f}",
            "" if c["limit_um"] is None else f"{c['limit_um']:g}",
        ]
        for c in found
    )
    head = "study,verdict,named,not explained,rms,before um,after um,limit um"
    return table(head.split(","), rows)


def batch(found: dict) -> str:
    times = found["seconds_per_draw"]
    rows = (
        [name, f"{1e3 * seconds:.3g}", f"{seconds / times['vcal']:,.1f}"]
        for name, seconds in times.items()
    )
    machine = found["machine"]
    return table([f"{machine['device']}, {machine['cores']} cores", "ms per draw", "/ vcal"], rows)


def campaigns(found: dict) -> str:
    rows = (
        [f"{c['draws']:,}", f"{c['peak_mib']:.0f}", f"{c['wall_s']:.0f}", c["quantiles"]]
        for c in found["campaigns"]
    )
    return table(["draws", "peak memory, MiB", "whole run, s", "quantiles"], rows)


def strd(found: dict) -> str:
    rows = (
        [
            start.removeprefix("start"),
            str(r["sets"]),
            str(r["eight_digits_and_six_of_sd"]),
            str(r["silently_wrong"]),
            f"{r['minpack']['eight_digits']}, {r['minpack']['silently_wrong']}",
            f"{r['optimistix']['eight_digits']}, {r['optimistix']['silently_wrong']}",
        ]
        for start, r in found["summary"].items()
    )
    head = "from start,sets,8 digits and 6 of sd,silently wrong"
    others = "(8 digits, silently wrong)"
    return table([*head.split(","), f"MINPACK {others}", f"optimistix {others}"], rows)


def interrupted(found: dict) -> str:
    rows = (
        [str(i), f"{life['from']:,}", f"{life['to']:,}"]
        for i, life in enumerate(found["killed"], start=1)
    )
    same = "all" if all(found["same"].values()) else "not all"
    last = ["end", f"{found['draws']:,} draws", f"{same} arrays the same bit for bit"]
    return table(["kill", "first block told", "last block told"], [*rows, last])


def laser_frame(found: dict) -> str:
    rows = (
        [
            r["case"],
            f"{r['cycles']:,}",
            f"{r['cold_s']:.1f}",
            f"{r['warm_s']:.1f}",
            str(r["failed"]),
            "" if r["rms_ln_ratio"] is None else f"{r['rms_ln_ratio']:.3f}",
        ]
        for r in found["rows"]
    )
    head = "path and truth,cycles,cold s,warm s,failed,rms of ln(vcal / printed)"
    return table(head.split(","), rows)


def artefact_design(found: dict) -> str:
    rows = (
        [r["case"], f"{r['cold_s']:.1f}", f"{r['warm_s']:.1f}", r["found"]] for r in found["rows"]
    )
    return table([f"{found['draws']} machines per design", "cold s", "warm s", "found"], rows)


def dynamics(found: dict) -> str:
    rows = (
        [
            r["model"],
            r["way"],
            f"{r['cold_s']:.2f}",
            f"{r['simulated_s'] / r['warm_s']:.3g}",
            f"{r['off_nm']:.1g}",
        ]
        for r in found["simulations"]
    )
    head = "model,way,first call s,simulated s per s,off by nm"
    return table(head.split(","), rows)


def r_tests(found: dict) -> str:
    rows = (
        [
            r["run"],
            f"{r['machines']:,}",
            f"{r['circles']}",
            f"{r['wall_s']:.0f}",
            f"{r['stable']:,}",
            f"{r['converged']:,}",
            f"{r['sd_of_pulls']:.2f}",
            f"{100 * r['within_U']:.1f}",
        ]
        for r in found["campaigns"]
    )
    head = "run,machines,circles each,whole run s,stable,converged,sd of error / u,within U %"
    return table(head.split(","), rows)


TABLES: dict[str, tuple[str, Callable[..., str]]] = {
    "power": ("power", power),
    "power_clean": ("power", power_clean),
    "power_cases": ("power", power_cases),
    "power_outside": ("power", power_outside),
    "power_strays": ("power", power_strays),
    "several": ("several", several),
    "five_axes": ("five_axes", five_axes),
    "within_u": ("within_u", within_u),
    "practice": ("practice", practice),
    "speed": ("speed", speed),
    "batch": ("batch", batch),
    "batch_gpu": ("batch_gpu", batch),
    "campaigns": ("batch", campaigns),
    "campaigns_gpu": ("campaigns_gpu", campaigns),
    "interrupted": ("interrupted", interrupted),
    "strd": ("strd", strd),
    "laser_frame": ("laser_frame", laser_frame),
    "artefact_design": ("artefact_design", artefact_design),
    "dynamics": ("dynamics", dynamics),
    "r_tests": ("dynamics", r_tests),
    "dynamics_gpu": ("dynamics_gpu", dynamics),
    "r_tests_gpu": ("dynamics_gpu", r_tests),
}
"""Name of the table: the file in results/ and how it is laid out."""


def main() -> None:
    """Renew every table of the README."""
    readme = HERE / "README.md"
    text = readme.read_text(encoding="utf-8")
    for name, (file, make) in TABLES.items():
        found = json.loads((HERE / "results" / f"{file}.json").read_text(encoding="utf-8"))
        pattern = rf"(<!-- table {name} -->\n\n).*?(?=\n\n|\n?\Z)"
        places = list(re.finditer(pattern, text, re.DOTALL))
        if len(places) != 1:
            raise SystemExit(f"{readme}: {len(places)} lines '<!-- table {name} -->', expected 1")
        text = text[: places[0].end(1)] + make(found) + text[places[0].end() :]
    readme.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
