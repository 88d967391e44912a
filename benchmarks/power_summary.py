"""The summary of the lines of power.py: results/power.json, and the picture of the power curves.

The outcome of a set is one of OUTCOMES. A name is right when it is that of the effect that is in
the data, or when the loop itself states that these data cannot distinguish the two (`equivalent`).
"""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path

import numpy as np
from power_cases import ENTRIES, GROUPS, INSTRUMENTS, OWN_NOISE

OUTCOMES = (
    "right",
    "right first",
    "one of two",
    "another first",
    "wrong",
    "unexplained",
    "nothing",
    "not detectable",
    "failed",
)
"""*right*: every effect in the data is named and nothing else is; *right first*: the same, but the
right name is the first of several alternatives for at least one effect; *one of two*: no wrong
name, but an effect is missing; *another first*: a wrong name is the first of several alternatives;
*wrong*: a wrong name is the only one; *unexplained* and *nothing*: no name. Beside a name the rest
of the residual may still be called unexplained."""
FAR = 3.0
"""Size in detection limits from which a name must be right."""
DISTINGUISHED = 9.0
"""Excess chi-square (three standard deviations) from which the readings favour the true model."""
CERTAIN = {"right", "right first"}
SAME_P = 1e-2
"""Relative difference within which two p-values count as equal. The screening of the commit that
made a set may differ a little, and 500 draws give a p-value to a tenth at best."""


def is_of(key: str, found: dict) -> bool:
    """Whether a finding of the loop is this effect, or is stated to be equivalent to it."""
    return key == found["key"] or key in found["equivalent"]


def named(line: dict) -> list[dict]:
    """What the loop found, without hints of what is as likely chance (`FoundEffect`)."""
    return [found for found in line["found"] if not found.get("perhaps_chance")]


def outcome(line: dict) -> str:
    """One of OUTCOMES."""
    if line["verdict"] in ("failed", "not detectable"):
        return line["verdict"]
    truth, found = [t[0] for t in line["truth"]], named(line)
    if not found:
        return "unexplained" if line["verdict"] == "unexplained" else "nothing"
    off = [f for f in found if not any(is_of(key, f) for key in truth)]
    if any(f["status"] == "named" for f in off):
        return "wrong"
    if off:
        return "another first"
    if not all(any(is_of(key, f) for f in found) for key in truth):
        return "one of two"
    return "right" if all(f["status"] == "named" for f in found) else "right first"


def is_beyond(line: dict) -> bool:
    """Whether a size is above the regular sizes of its entry."""
    return line["multiple"] > max(ENTRIES[line["case"]].multiples)


def other_component(line: dict) -> bool:
    """Whether a right name holds for another component of the effect than the true one."""
    if outcome(line) not in CERTAIN:
        return False
    return any(
        f["key"] == key and wanted and not set(wanted) & set(f["parameters"])
        for key, *wanted in line["truth"]
        for f in named(line)
    ) and not any(
        f["key"] == key and set(wanted) & set(f["parameters"])
        for key, *wanted in line["truth"]
        for f in named(line)
    )


def listed_as_rival(line: dict) -> bool:
    """Whether every true effect is among the alternatives that the loop lists."""
    rivals = {name for f in named(line) for name, _ in f["rivals"]}
    return all(key in rivals or any(is_of(key, f) for f in named(line))
               for key, *_ in line["truth"])  # fmt: skip


def something_else_too(line: dict) -> bool:
    """Whether all right names are found, and a wrong one beside them."""
    truth, found = [t[0] for t in line["truth"]], named(line)
    return outcome(line) in {"wrong", "another first"} and all(
        any(is_of(key, f) for f in found) for key in truth
    )


def pointed(line: dict) -> bool:
    """Whether the first covariate of an *unexplained* is one on which the true error depends."""
    wanted = set(line["covariates"])
    return bool(wanted & set(line.get("unexplained", {}).get("depends_on", [])[:1]))


def distinguished(line: dict) -> bool:
    """Whether the readings favour the true model: the loop's model has a chi-square that is larger
    by more than DISTINGUISHED.
    """
    return line["chi2_over_told"] > DISTINGUISHED


def ratio(line: dict) -> float | None:
    """Error after the loop, divided by that of the fit of the true model."""
    rms = line.get("rms", {})
    return rms["after"][0] / rms["told"][0] if "told" in rms else None


def worse_than_nothing(line: dict) -> bool:
    """Whether the error after exceeds the uncompensated one by more than its u."""
    rms = line.get("rms", {})
    return bool(rms) and rms["after"][0] > rms["uncompensated"][0] + rms["after"][1]


def counted(lines: Iterable[dict]) -> dict[str, int]:
    """Number of sets by outcome."""
    found = Counter(map(outcome, lines))
    return {name: found[name] for name in OUTCOMES if found[name]}


def median(values: Iterable[float | None]) -> float | None:
    """The median of the finite values, to four digits."""
    kept = [v for v in values if v is not None and math.isfinite(v)]
    return float(f"{np.median(kept):.4g}") if kept else None


def limits(lines: Sequence[dict], place: int) -> dict | None:
    """Median and range over the seeds of the detection limit of one effect of a case."""
    found = {x["seed"]: x["limit"][place] for x in lines if len(x["limit"]) > place}
    kept = [v for v in found.values() if math.isfinite(v)]
    if not kept:
        return None
    low, middle, high = (float(f"{v:.3g}") for v in np.quantile(kept, [0, 0.5, 1]))
    return {"median": middle, "low": low, "high": high, "seen": len(kept), "sets": len(found)}


def case_row(name: str, lines: list[dict]) -> dict:
    """Outcomes and detection limits of one case."""
    entry = ENTRIES[name]
    by_multiple = {}
    for multiple in sorted({x["multiple"] for x in lines}):
        part = [x for x in lines if x["multiple"] == multiple]
        by_multiple[f"{multiple:g}"] = {
            "sets": len(part),
            "outcomes": counted(part),
            "other_component": sum(map(other_component, part)),
            "error_ratio": median(map(ratio, part)),
            "pointed": sum(outcome(x) == "unexplained" and pointed(x) for x in part),
        }
    return {
        "case": name,
        "instrument": entry.instrument,
        "group": entry.group,
        "kinds": [kind.name for kind in entry.kinds],
        "units": [kind.unit for kind in entry.kinds],
        "limits": [limits(lines, i) for i in range(len(entry.kinds))],
        "multiples": by_multiple,
    }


def wilson(k: float, n: float) -> tuple[float, float]:
    """95 % interval of a share (Wilson)."""
    z, p = 1.96, k / n
    centre, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = (centre - half) / (1 + z * z / n), (centre + half) / (1 + z * z / n)
    return max(low, 0.0), min(high, 1.0)


def machine(line: dict) -> tuple[str, int]:
    """The machine of a set, which all entries of an instrument with that seed share. What of its
    errors resembles an effect is in all these sets.
    """
    return line["case"].split("/")[0], line["seed"]


def effective(hits: Sequence[bool], draws: Sequence[Hashable]) -> float:
    """The effective number of independent sets: the number of sets divided by the design effect.

    The design effect is the variance of the share from the scatter between draws, divided by that
    of as many independent sets (Kish, Survey Sampling, 1965, 5.4 and 8.2). The result is at most
    the number of sets, and equals it where all sets agree, because nothing can be estimated then.
    """
    n, p = len(hits), float(np.mean(hits))
    of: dict = defaultdict(list)
    for hit, one in zip(hits, draws, strict=True):
        of[one].append(hit - p)
    between = sum(sum(part) ** 2 for part in of.values())
    if len(of) < 2 or between == 0:
        return float(n)
    between *= len(of) / (len(of) - 1)
    return n * min(n * p * (1 - p) / between, 1.0)


def counts(hits: Iterable[bool], part: Sequence[dict]) -> list[float]:
    """Hits, sets, and the 95 % interval of the share (Wilson, `effective` number of sets)."""
    hits = [bool(hit) for hit in hits]
    k, n = sum(hits), len(hits)
    if not n:
        return [k, n]
    much = effective(hits, [machine(x) for x in part])
    return [k, n, *(float(f"{v:.3g}") for v in wilson(k / n * much, much))]


def share(part: Sequence[dict], wanted: set[str]) -> list[float]:
    """`counts` of the sets with one of the wanted outcomes."""
    return counts((outcome(x) in wanted for x in part), part)


CURVES = (
    ("right name", ("right", "right first"), "tab:green"),
    ("another name first of several", ("another first",), "tab:orange"),
    ("wrong name", ("wrong",), "tab:red"),
    ("unexplained", ("unexplained",), "tab:purple"),
    ("nothing", ("nothing",), "0.4"),
)


def curve_rows(lines: Sequence[dict], instrument: str) -> dict:
    """Shares of the outcomes by size, of the sets of an instrument with one catalogue effect."""
    part = [x for x in lines if ENTRIES[x["case"]].instrument == instrument]
    seen = [x for x in part if outcome(x) != "not detectable"]
    by_size = {
        f"{m:g}": [x for x in seen if x["multiple"] == m]
        for m in sorted({x["multiple"] for x in seen})
    }
    return {
        "instrument": instrument,
        "effects": len({x["case"] for x in part}),
        "sets": len(seen),
        "curves": {
            label: {m: share(at, set(names)) for m, at in by_size.items()}
            for label, names, _ in CURVES
        },
    }


def clean_row(lines: list[dict], group: str, instrument: str) -> dict:
    """False alarms of an instrument in sets where nothing is missing."""
    found = Counter(map(outcome, lines))
    count = sum(bool(named(x)) for x in lines)
    return {
        "instrument": instrument,
        "group": group,
        "sets": len(lines),
        "named": count,
        "unexplained": found["unexplained"],
        "p_below_alpha": sum(x["p"] <= 0.01 for x in lines),
        "strays": sum("strays" in x for x in lines),
        "seconds": median(x["loop_s"] for x in lines),
    }


def undisturbed(lines: Sequence[dict]) -> dict[tuple[str, float, int], dict]:
    """Lines by case, multiple and seed."""
    return {(x["case"], x["multiple"], x["seed"]): x for x in lines}


def verdict_of(line: dict) -> tuple[str, list[str]]:
    """The verdict and the names that were found."""
    return line["verdict"], [f["key"] for f in named(line)]


def stray_row(
    name: str, lines: list[dict], every: dict, p_without: Callable[[dict], float]
) -> dict:
    """Sets with outliers: verdicts compared with those of the same sets without, and the outliers
    that the loop lists; `p_without` computes the p-value of a set without its outliers.
    """
    entry = ENTRIES[name]
    base = f"{entry.instrument}/" + (entry.kinds[0].name if entry.kinds else "clean")
    pairs = [(x, every.get((base, x["multiple"], x["seed"]))) for x in lines]
    compared = [(x, b) for x, b in pairs if b is not None and "found" in x and "found" in b]
    others = [x for x, b in compared if verdict_of(x) != verdict_of(b)]
    strays = np.array([x["strays"] for x in lines if "strays" in x]).reshape(-1, 3)
    return {
        "case": name,
        "sets": len(lines),
        "compared": len(compared),
        "same": len(compared) - len(others),
        "as_without_the_rows": sum(
            math.isclose(x["p"], p_without(x), rel_tol=SAME_P) for x in others
        ),
        "astray": int(strays[:, 0].sum()),
        "listed": int(strays[:, 1].sum()),
        "listed_wrongly": int(strays[:, 2].sum()),
        "outcomes": counted(lines),
    }


def summary(lines: Sequence[dict], p_without: Callable[[dict], float]) -> dict:
    """All that the tables and the picture need; `p_without` as in `stray_row`."""
    lines = [x for x in lines if x["case"] in ENTRIES]
    of = {name: [x for x in lines if x["case"] == name] for name in ENTRIES}
    group = {g: [x for x in lines if ENTRIES[x["case"]].group == g] for g in GROUPS}
    clean = []
    for name in GROUPS:
        for at in INSTRUMENTS:
            part = [x for x in group[name] if ENTRIES[x["case"]].clean]
            part = [x for x in part if ENTRIES[x["case"]].instrument == at]
            good = [x for x in part if x["verdict"] != "failed"]
            if good:
                clean.append(clean_row(good, name, at))
    # Sizes above the regular ones are tried in some campaigns only, and have rows of their own.
    beyond = {g: [x for x in group[g] if is_beyond(x) and outcome(x) != "not detectable"]
              for g in GROUPS}  # fmt: skip
    group = {g: [x for x in group[g] if not is_beyond(x)] for g in GROUPS}
    far = [x for x in group["catalogue"] if x["multiple"] >= FAR]
    seen = [x for x in far if outcome(x) != "not detectable"]
    own = [x for x in seen if x["seed"] >= OWN_NOISE]
    warming = [x for x in group["warming up"] if x["multiple"] >= FAR]
    warming = [x for x in warming if outcome(x) != "not detectable"]
    other = [x for x in warming if outcome(x) not in CERTAIN and "chi2_over_told" in x]
    outside = [x for x in group["outside"] if x["multiple"] >= FAR]
    outside = [x for x in outside if outcome(x) != "not detectable"]
    pairs = [x for x in group["pairs"] if outcome(x) != "not detectable"]
    several = [x for x in group["several"] if outcome(x) != "not detectable"]
    zero = [x for x in group["zero"] if outcome(x) != "not detectable"]
    nothing = [x for x in group["clean"] if x["verdict"] != "failed"]
    every = undisturbed(lines)
    ratios = [ratio(x) for x in seen]
    at_limit = [x for x in group["catalogue"] if x["multiple"] == 1.0 and "p" in x]
    return {
        "not_detectable": sum(x["verdict"] == "not detectable" for x in lines),
        "summary": {
            "clean_named": counts((bool(named(x)) for x in nothing), nothing),
            "clean_unexplained": share(nothing, {"unexplained"}),
            "far_right": share(seen, CERTAIN),
            "far_wrong": share(seen, {"wrong"}),
            "far_wrong_machines": [
                len({machine(x) for x in seen if outcome(x) == "wrong"}),
                len({machine(x) for x in seen}),
            ],
            "own_right": share(own, CERTAIN),
            "own_wrong": share(own, {"wrong"}),
            "far_another_first": share(seen, {"another first"}),
            "far_something_else_too": counts(map(something_else_too, seen), seen),
            "far_unexplained": share(seen, {"unexplained"}),
            "far_nothing": share(seen, {"nothing"}),
            "far_failed": share(seen, {"failed"}),
            "far_other_component": counts(map(other_component, seen), seen),
            "warming_right": share(warming, CERTAIN),
            "warming_wrong": share(warming, {"wrong"}),
            "warming_listed": counts(
                (bool(named(x)) and listed_as_rival(x) for x in warming), warming
            ),
            "warming_told_apart": counts(map(distinguished, other), other),
            "far_error_ratio": median(ratios),
            "far_worse_than_nothing": counts(map(worse_than_nothing, lines), lines),
            "outside_wrong": share(outside, {"wrong"}),
            "outside_another_first": share(outside, {"another first"}),
            "outside_unexplained": share(outside, {"unexplained"}),
            "outside_pointed": counts(
                (outcome(x) == "unexplained" and pointed(x) for x in outside), outside
            ),
            "pairs_both": share(pairs, CERTAIN),
            "several_all": share(several, CERTAIN),
            "several_wrong": share(several, {"wrong"}),
            "zero_right": share(zero, CERTAIN),
            "zero_wrong": share(zero, {"wrong"}),
            "beyond_right": share(beyond["catalogue"], CERTAIN),
            "beyond_wrong": share(beyond["catalogue"], {"wrong"}),
            "beyond_both": share(beyond["pairs"], CERTAIN),
            "beyond_outside_wrong": share(beyond["outside"], {"wrong"}),
            "beyond_outside_pointed": counts(
                (outcome(x) == "unexplained" and pointed(x) for x in beyond["outside"]),
                beyond["outside"],
            ),
            "at_the_limit": counts((x["p"] <= 0.01 for x in at_limit), at_limit),
        },
        "clean": clean,
        "curves": [curve_rows(group["catalogue"], at) for at in INSTRUMENTS],
        "cases": [
            case_row(name, of[name]) for name in sorted(of) if of[name] and not ENTRIES[name].clean
        ],
        "strays": [
            stray_row(name, of[name], every, p_without)
            for name in sorted(of)
            if of[name] and ENTRIES[name].group == "strays"
        ],
    }  # fmt: skip


# --- the picture ---------------------------------------------------------------------------------


def picture(found: dict, path: Path) -> None:
    """Draw the shares of the outcomes by size, one panel per instrument."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    across = math.ceil(len(found["curves"]) / 2)
    figure, panels = plt.subplots(2, across, figsize=(4.5 * across, 7), sharex=True, sharey=True)
    for panel in panels.flat[len(found["curves"]) :]:
        panel.set_axis_off()
    for panel, row in zip(panels.flat, found["curves"], strict=False):
        for label, _, colour in CURVES:
            points = [
                (float(m), k / n, low, high)
                for m, (k, n, low, high) in row["curves"][label].items()
            ]
            if points:
                x, y, low, high = np.array(points).T
                panel.plot(x, 100 * y, "o-", color=colour, label=label)
                panel.fill_between(x, 100 * low, 100 * high, color=colour, alpha=0.15, lw=0)
        panel.set_title(
            f"{row['instrument']}: {row['effects']} effects, {row['sets']} sets", fontsize=10
        )
        panel.axvline(1.0, color="0.8", lw=1, zorder=0)
        panel.grid(alpha=0.3)
        panel.set_ylim(-3, 103)
    for panel in panels[1]:
        panel.set_xlabel("size / detection limit")
    for panel in panels[:, 0]:
        panel.set_ylabel("share of the sets, %")
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, fontsize=9, loc="lower center", ncols=len(CURVES), frameon=False)
    figure.tight_layout(rect=(0, 0.04, 1, 1))
    figure.savefig(path, dpi=110, metadata={"Software": None})
