"""How well the loop finds what is missing on machines with rotary axes.

A static R-test, a ball array and a laser tracker measure machines that are drawn from the declared
family, by the independent numpy machine of the tests (tests/oracle/rotary.py). Chains change from
seed to seed. Sizes are those of real machines, not detection limits.

    python benchmarks/five_axes.py --sets 20 --jobs 2
    python benchmarks/five_axes.py --summary

The first command appends one line per set to lines/five_axes.jsonl and skips the sets that are
there. The second makes results/five_axes.json from the lines.
"""

import argparse
import csv
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from records import HERE, campaign, campaign_parser, make_sets, share

sys.path.insert(0, str(HERE.parent / "tests"))

from oracle.rotary import ROTARY, Drawn, FiveAxis  # noqa: E402

FIRST_SEED = 50_000
INSTRUMENTS = ("static_r_test", "ball_array", "laser_tracker")
SIZES = {"translation_um": 4.0, "rotation_urad": 8.0, "squareness_urad": 20.0, "location_um": 15.0}
TOOL = (0.0, 0.0, -0.15)
TURN = (0.0, 2.0 * math.pi)
MACHINES = (
    ("w C A b Y X Z t", {"A": (0.0, 0.0, -0.12), "C": (0.0, 0.0, -0.2)}, {"A": 60.0}),
    ("w C b X Y Z B t", {"C": (0.0, 0.0, -0.2), "B": (0.0, 0.0, 0.15)}, {"B": 50.0}),
    ("w b X Y Z C A t", {"C": (0.0, 0.0, 0.3), "A": (0.0, 0.0, 0.1)}, {"A": 50.0}),
    ("w B X b Y Z t", {"B": (0.0, 0.0, -0.1)}, {}),
)
"""Chains, points on their rotary axes, and the range of those that only tilt, +- deg."""
LINEAR_TRAVEL = (-0.6, 0.6)
BALLS = np.array([[120, 0, 40], [-60, 110, 0], [-70, -90, 80], [20, 10, 150]]) * 1e-3 + TOOL


@dataclass(frozen=True)
class Case:
    """The undeclared effect of a machine, or none, and the names that are right for it."""

    name: str
    names: tuple[str, ...]
    """Effect and placement, the latter empty where any placement is right."""
    needs: str = ""
    """Instruments that are tried; all by default."""


CASES = (
    Case("nothing", ()),
    Case("backlash of a rotary axis, 25 urad", ("backlash {turning}",)),
    Case("backlash of X, 4 um", ("backlash X",)),
    Case("worm of a rotary axis, 15 urad", ("screw_cyclic {turning}", "gear_harmonic {turning}")),
    Case("screw of X, 2 um", ("screw_cyclic X",)),
    Case("spindle warms up, 12 um", ("warm_up",)),
    Case("the tool slips, 8 um", ("jump tool", "jump frame", "jump place", "jump target")),
    Case("what is on the table slips, 8 um", ("jump place", "jump target", "jump frame"),
         "static_r_test ball_array"),
)  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """Positions in order of time, with the directions of the last moves."""

    q: np.ndarray
    way: np.ndarray
    t: np.ndarray
    run: np.ndarray
    target: np.ndarray
    """Nominal place of the tool point in the frame of the workpiece, m."""
    ball: np.ndarray


def settings(machine: FiveAxis, tilts: dict[str, float], rng: np.random.Generator) -> np.ndarray:
    """Angles (n, rotary axes), rad: at every tilt the other axis turns round in both directions,
    in irregular steps.
    """
    turning = [axis for axis in machine.axes if axis in ROTARY]
    (around,) = (i for i, axis in enumerate(turning) if axis not in tilts)
    rows = []
    angles = np.arange(12) * 30.0
    for tilt in np.linspace(-1.0, 1.0, 4) if tilts else (0.0, 0.0, 0.0, 0.0):
        for c in (*angles, *(angles[::-1] + 15.0)):
            row = np.zeros(len(turning))
            row[around] = (c + rng.uniform(0.0, 12.0)) % 360.0
            for axis, most in tilts.items():
                row[turning.index(axis)] = tilt * most
            rows.append(row)
    return np.radians(np.round(rows, 4))


def planned(kind: str, machine: FiveAxis, tilts: dict, rng: np.random.Generator) -> Plan:
    """Two spheres one after the other, four balls at every second setting of the rotary axes, or a
    reflector at random places of the work space.
    """
    angles = settings(machine, tilts, rng)
    n = len(angles)
    if kind == "static_r_test":
        ball = np.repeat([0, 1], n)
        angles = np.tile(angles, (2, 1))
    elif kind == "ball_array":
        angles = np.repeat(angles[::2], 4, axis=0)
        ball = np.tile(np.arange(4), n // 2)
    else:
        angles = np.tile(angles, (2, 1))
        ball = np.zeros(2 * n, int)
    target = BALLS[ball]
    if kind == "laser_tracker":
        target = rng.uniform([-0.15, -0.15, -0.1], [0.15, 0.15, 0.15], (len(angles), 3))
    q = np.column_stack([np.zeros((len(angles), 3)), angles])
    q = np.round(machine.plan_next(target, q, machine.still), 7)
    step = np.diff(q, axis=0, prepend=q[:1] - 1e-3)
    way = np.ones_like(q)
    for k in range(1, len(q)):
        way[k] = np.where(step[k] == 0.0, way[k - 1], np.sign(step[k]))
    t = 12.0 * np.arange(len(q)) + rng.uniform(0.0, 1.0, len(q))
    run = ball if kind == "static_r_test" else np.zeros(len(q), int)
    return Plan(q, way, np.round(t, 2), run, target, ball)


def disturbed(
    case: Case, machine: FiveAxis, plan: Plan, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The undeclared errors of the axes (n, axes, 6) and of the tool point (n, 3), SI."""
    axes, n = machine.axes, len(plan.q)
    more, tool = np.zeros((n, len(axes), 6)), np.zeros((n, 3))
    turning = turning_axis(machine)
    i, own = axes.index(turning), 3 + ROTARY.index(turning)
    x = axes.index("X")
    late = plan.t > rng.uniform(0.3, 0.7) * plan.t[-1]
    phase = rng.uniform(0.0, 2.0 * math.pi)
    if case.name.startswith("backlash of a rotary"):
        more[:, i, own] = 0.5 * 25e-6 * plan.way[:, i]
    elif case.name.startswith("backlash of X"):
        more[:, x, 0] = 0.5 * 4e-6 * plan.way[:, x]
    elif case.name.startswith("worm"):
        teeth = rng.choice([36, 60, 90, 120])
        more[:, i, own] = 15e-6 * np.sin(teeth * plan.q[:, i] + phase)
    elif case.name.startswith("screw"):
        more[:, x, 0] = 2e-6 * np.sin(2.0 * math.pi * plan.q[:, x] / 0.01 + phase)
    elif case.name.startswith("spindle"):
        tool[:, 2] = -12e-6 * (1.0 - np.exp(-plan.t / rng.uniform(500.0, 1000.0)))
    elif case.name.startswith("the tool"):
        tool[late] = 8e-6 * unit(rng)
    return more, tool


def unit(rng: np.random.Generator) -> np.ndarray:
    """A random direction."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def turning_axis(machine: FiveAxis) -> str:
    """The rotary axis that turns round."""
    return next(axis for axis in "CB" if axis in machine.axes)


def write(folder: Path, kind: str, case: Case, seed: int) -> FiveAxis:
    """Write a study of a machine with the effect of the case; returns the machine."""
    rng = np.random.default_rng([seed, INSTRUMENTS.index(kind), CASES.index(case)])
    chain, at, tilts = MACHINES[seed % len(MACHINES)]
    machine = FiveAxis(chain, at, TOOL)
    travel = dict.fromkeys("XYZ", LINEAR_TRAVEL)
    for axis in machine.axes[3:]:
        far = math.radians(tilts.get(axis, 0.0) + 10.0)
        travel[axis] = (-far, far) if axis in tilts else TURN
    sizes = [1e-6 * v for v in SIZES.values()]
    errors = Drawn(machine, travel, *sizes, rng)
    plan = planned(kind, machine, tilts, rng)
    more, tool = disturbed(case, machine, plan, rng)
    slipped = np.zeros((len(plan.q), 3))
    if case.name.startswith("what is on"):
        late = plan.t > rng.uniform(0.2, 0.4) * plan.t[-1]
        slipped[late] = 8e-6 * unit(rng)
    place = rng.normal(0.0, 20e-6, (4, 3))[plan.run] + slipped
    columns: dict[str, np.ndarray] = {"t_s": plan.t}
    noise = rng.standard_normal((len(plan.q), 3))
    q = plan.q

    def point(q: np.ndarray) -> np.ndarray:
        frame = machine.frame(q, errors(q) + more)
        return frame[:, :3, 3] + np.einsum("nij,nj->ni", frame[:, :3, :3], TOOL + tool)

    if kind == "static_r_test":
        frame = machine.frame(q, errors(q) + more)[:, :3, :3]
        p = np.einsum("nji,nj->ni", frame, plan.target + place - point(q)) + 0.4e-6 * noise
        columns |= {"run": plan.run} | {f"{c}_ext_mm": 1e3 * p[:, i] for i, c in enumerate("xyz")}
    elif kind == "ball_array":
        q = found_at(point, q, plan.target + slipped)
        q[:, :3] += 0.7e-6 * noise
        columns |= {"pose": plan.run, "ball": plan.ball}
    else:
        station = np.array([-0.9, 0.2, 0.4])
        v = point(q) - station
        r = np.linalg.norm(v, axis=1)
        columns |= {
            "range_mm": 1e3 * r + 1.3e-3 * noise[:, 0],
            "azimuth_rad": np.arctan2(v[:, 1], v[:, 0]) + 2.5e-6 * noise[:, 1],
            "elevation_rad": np.arcsin(v[:, 2] / r) + 2.5e-6 * noise[:, 2],
        }
    for i, axis in enumerate(machine.axes):
        unit_of, factor = ("mm", 1e3) if i < 3 else ("deg", math.degrees(1.0))
        columns[f"{axis.lower()}_{unit_of}"] = factor * q[:, i]
        columns[f"dir_{axis.lower()}"] = plan.way[:, i].astype(int)
    folder.mkdir(exist_ok=True)
    (folder / "setup.toml").write_text(setup(kind, machine, travel))
    table(folder / "data.csv", columns)
    table(folder / "artefact.csv", {"ball": np.arange(4)} | {
        f"{c}_mm": 1e3 * BALLS[:, i] for i, c in enumerate("xyz")})  # fmt: skip
    return machine


def found_at(
    point: Callable[[np.ndarray], np.ndarray], q: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Positions near q at which the tool point is at the centres of the balls."""
    q = q.copy()
    for _ in range(6):
        off = point(q) - target
        slopes = [(point(q + 1e-4 * np.eye(q.shape[1])[i]) - target - off) / 1e-4 for i in range(3)]
        q[:, :3] -= np.linalg.solve(np.stack(slopes, axis=2), off[:, :, None])[:, :, 0]
    return q


def setup(kind: str, machine: FiveAxis, travel: dict[str, tuple[float, float]]) -> str:
    """The study file."""
    linear = ", ".join(f"{a} = [{1e3 * travel[a][0]:g}, {1e3 * travel[a][1]:g}]" for a in "XYZ")
    rotary = "\n".join(
        f"{a} = {{ at_mm = {[1e3 * float(v) for v in np.asarray(machine.at[a])]}, travel_deg = "
        f"{np.degrees(travel[a]).round(6).tolist()} }}"
        for a in machine.axes[3:]
    )
    instrument = {
        "static_r_test": 'nest = "spindle"\nexternal_sigma_um = 0.4\nzero_u_um = 1',
        "ball_array": 'artefact = "artefact.csv"\nprobe_sigma_um = 0.7',
        "laser_tracker": "range_sigma_um = 1.3\nangle_sigma_urad = 2.5\n"
        "station_mm = [-900, 200, 400]",
    }[kind]
    sizes = "\n".join(f"{key} = {value}" for key, value in SIZES.items())
    return (
        f'[machine]\nchain = "{machine.chain}"\ntool_offset_mm = [0, 0, -150]\n'
        f"travel_mm = {{ {linear} }}\n[machine.rotary]\n{rotary}\n"
        f'[instrument]\nkind = "{kind}"\n{instrument}\n'
        f'[model.geometric]\nfamily = "smooth"\n{sizes}\n'
    )


def table(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write columns as CSV."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(v.tolist() for v in columns.values()), strict=True))


def one_set(kind: str, name: str, seed: int) -> dict[str, Any]:
    """Draw a machine, measure it, close the loop, and compare."""
    import vcal

    (case,) = (case for case in CASES if case.name == name)
    with tempfile.TemporaryDirectory() as folder:
        machine = write(Path(folder), kind, case, seed)
        study = vcal.load_study(Path(folder))
    start = time.perf_counter()
    closure = vcal.close_loop(study.model, study.measurement, seed=seed)
    took = time.perf_counter() - start
    found = [e.effect.key for e in closure.effects]
    wanted = [name.format(turning=turning_axis(machine)) for name in case.names]
    return {
        "instrument": kind, "case": case.name, "seed": seed, "outcome": outcome(closure, wanted),
        "found": found, "verdict": closure.verdict, "seconds": round(took, 1),
    }  # fmt: skip


def outcome(closure: Any, wanted: Sequence[str]) -> str:
    """*right*: a single name, which is wanted or equivalent to a wanted one; *not certain*: such a
    name as the first of several alternatives; *wrong*: any other single name.
    """
    if closure.verdict == "nothing_missing":
        return "nothing"
    right = [any(fits(key, want) for key in called(e) for want in wanted) for e in closure.effects]
    if closure.verdict == "named":
        return "right" if right == [True] else "wrong"
    return "not certain" if right[:1] == [True] else closure.verdict


def called(effect: Any) -> Iterator[str]:
    """Names of an effect at all placements that are equivalent on these data."""
    for key in (effect.effect.key, *effect.equivalent):
        name, _, places = key.partition(" ")
        yield from (f"{name} {place}" for place in places.split("|"))
    yield from (f"{effect.effect.name} {place}" for place in effect.placement.split("|"))


def fits(key: str, wanted: str) -> bool:
    """Whether a name is the wanted one; a wanted name without placement fits at any."""
    return key == wanted or key.split(" ")[0] == wanted


def jobs(sets: int, first: int, patterns: Sequence[str]) -> Iterator[tuple[str, str, int]]:
    """Every set, seed by seed; four clean ones with each of the others."""
    for seed in range(first, first + sets):
        for kind in INSTRUMENTS:
            for case in CASES:
                if case.needs and kind not in case.needs.split():
                    continue
                if any(fnmatch(f"{kind}: {case.name}", p) for p in patterns):
                    more = 4 if not case.names else 1
                    yield from ((kind, case.name, more * seed + k) for k in range(more))


def work(options: argparse.Namespace) -> None:
    """Make this worker's share of the sets."""
    every = jobs(options.sets, options.first_seed, options.cases)
    make_sets(options, every, ("instrument", "case", "seed"), one_set)


def summed(lines: Sequence[dict]) -> dict:
    """Outcomes by instrument and case."""
    rows = []
    for kind in INSTRUMENTS:
        for case in CASES:
            its = [x for x in lines if (x["instrument"], x["case"]) == (kind, case.name)]
            if not its:
                continue
            counts = {
                o: sum(x["outcome"] == o for x in its) for o in sorted({x["outcome"] for x in its})
            }
            good = counts.get("right" if case.names else "nothing", 0)
            rows.append(
                {"instrument": kind, "case": case.name, "sets": len(its), "outcomes": counts,
                 "good": share(good, len(its)),
                 "median_s": float(np.median([x["seconds"] for x in its]))}
            )  # fmt: skip
    return {"rows": rows}


def main() -> None:
    """Run the campaign in single-threaded processes, or summarise it."""
    options = campaign_parser(__doc__, "five_axes", FIRST_SEED).parse_args()
    campaign(__file__, options, work, summed)


if __name__ == "__main__":
    main()
