"""Whole synthetic cases: draw a machine, plan, measure, and write the folder that vcal reads."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .ball_bar import BallBar, bar_plan, measure_bar
from .effects import Effect, Run, checked, recorded, tool_point
from .frame import Frame, frame_plan, measure_frame
from .instruments import (
    BallNoise,
    Tracker,
    draw_arm_errors,
    measure_balls,
    measure_reflectors,
    measure_tracker,
    tracker_noise,
)
from .interferometer import (
    COLUMNS,
    Laser,
    LinePlan,
    instrument_lines,
    laser_noise,
    line_plan,
    measure_lines,
    reading_columns,
)
from .kinematics import (
    AXES,
    TABLE,
    TABLE_COLUMNS,
    Arm,
    Array,
    ErrorTable,
    Machine,
    Smooth,
    draw_machine,
    draw_smooth,
    nominal_machine,
)
from .multilateration import Stations, draw_stations, lateration_plan, measure_ranges, range_noise
from .plans import (
    ArmPlan,
    BallPlan,
    arm_plan,
    ball_plan,
    check_plan,
    conditions,
    example_arm,
    tracker_plan,
)
from .r_test import EXTERNAL_SIGMA, INTERNAL_SIGMA, RADIUS, measure_circles
from .touch_probe import GaugeProbe, gauge_plan, measure_gauge

# travel (m) and tool offset (m) by chain, as in the practice cases; anything else takes the first
SIZES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "w X b Y Z t": ((2.0, 1.0, 0.6), (0.0, 0.0, -0.15)),
    "w b X Y Z t": ((3.0, 1.5, 1.3), (0.0, 0.0, -0.2)),
    "w Y b X Z t": ((1.2, 0.8, 0.5), (0.0, 0.0, -0.12)),
}
FRAME_SIZES = {
    "w b X Y Z t": ((0.5, 0.4, 0.35), (0.0, 0.0, -0.1)),
    "w X b Y Z t": ((0.8, 0.5, 0.4), (0.0, 0.0, -0.15)),
    "w Y b X Z t": ((0.6, 0.5, 0.45), (0.0, 0.0, -0.12)),
}
SMALL = ("laser_frame", "double_ball_bar", "touch_probe")  # measured on a machine of these sizes
# What changes of a machine between two runs of a laser frame, as a smooth and as a Fourier family.
FRAME_SMOOTH = Smooth(translation=6e-6, rotation=8e-6, squareness=10e-6)
FRAME_TABLE: ErrorTable = {
    name: tuple(
        v if c.startswith("n") else 0.25 * v for c, v in zip(TABLE_COLUMNS, row, strict=True)
    )
    for name, row in TABLE.items()
}
EULER_DEG = (0.034, 0.034, 59.5)
Columns = dict[str, Array]


@dataclass(frozen=True)
class Case:
    """One synthetic study: what is declared, what was measured, and what is true.

    Exactly one of the pairs (tracker, run), (balls, run), (frame, run), (bar, run), (probe, run),
    (laser, lines), (arm, arm_run) is set beside the rest, and none of an R-test.
    """

    name: str
    instrument: str
    effects: list[dict[str, Any]]
    """Undeclared effects, as they were given."""
    data: Columns
    """data.csv: column name -> values, in the units of the name."""
    check: Columns | None = None
    """check.csv, likewise."""
    artefact: Columns | None = None
    """artefact.csv, likewise."""
    machine: Machine | None = None
    """The true machine; its nominal values and table are what is declared."""
    run: Run | None = None
    """Positions as in data.csv (found, for a ball array), SI."""
    readings: Array | None = None
    """Tracker: (n, 3) range, azimuth, elevation; reflectors: (n, m, 3); SI, with noise."""
    check_run: Run | None = None
    check_tcp: Array | None = None
    """True tool points in the workpiece frame at the check points (k, 3), m."""
    tracker: Tracker | None = None
    """The true station."""
    station_mm: tuple[float, ...] = ()
    """The nominal station that is declared."""
    euler_xyz_deg: tuple[float, ...] = ()
    stations: Stations | None = None
    """Of multilateration: the true stations, and the tools."""
    balls: BallPlan | None = None
    """True balls, poses and nominal positions."""
    ball_noise: BallNoise | None = None
    frame: Frame | None = None
    """What the frame really did."""
    bar: BallBar | None = None
    """Declared noise of a ball bar."""
    laser: Laser | None = None
    """The true interferometer, with its set-ups."""
    lines: LinePlan | None = None
    """Its rows."""
    probe: GaugeProbe | None = None
    """Declared probe and step gauge."""
    arm: Arm | None = None
    """The true arm."""
    arm_run: ArmPlan | None = None
    declared: list[dict[str, Any]] = field(default_factory=list)
    """Rows for [[model.effect]]."""
    sigma: float = 0.0
    """Declared noise of a reflector's coordinate, m."""
    link_sizes: tuple[float, float] = (5e-4, 2e-3)
    """Declared one-sigma sizes of an arm's constant link errors, m and rad."""
    truth: dict[str, Any] = field(default_factory=dict)
    """Further true values for truth.json."""

    @property
    def nominal(self) -> Machine:
        """The machine as declared, without errors."""
        if self.machine is None:
            raise ValueError(f"a case of {self.instrument!r} has no three-axis machine")
        m = self.machine
        return replace(nominal_machine(m.chain, m.travel, m.tool_offset), table=m.table)

    @property
    def noise(self) -> Columns:
        """One-sigma noise of every column of readings, in its unit."""
        data = self.data
        if self.tracker is not None:
            names = ("range_mm", "azimuth_rad", "elevation_rad")
            read = np.stack([data[n] for n in names], axis=1) * [1e-3, 1, 1]
            sigma = tracker_noise(self.tracker, read) * [1e3, 1, 1]
            return {n: sigma[:, i] for i, n in enumerate(names)}
        if self.stations is not None:
            own = self.stations
            far = 1e-3 * data["range_mm"] + own.dead_paths[own.station]
            return {"range_mm": 1e3 * range_noise(far, own.sigma, own.sigma_per_m)}
        if self.ball_noise is not None:
            return {f"{a}_mm": np.full(n_rows(data), 1e3 * self.ball_noise.probe_sigma)
                    for a in "xyz"}  # fmt: skip
        if self.frame is not None:
            return {n: np.full(n_rows(data), 1e6 * self.frame.sigma) for n in ("u_um", "v_um")}
        if self.bar is not None:
            return {"deviation_um": np.full(n_rows(data), 1e6 * self.bar.sigma)}
        if self.laser is not None and self.lines is not None:
            sigma = 1e6 * laser_noise(self.laser, self.lines)
            return {n: sigma[:, i] for i, n in enumerate(COLUMNS) if n in data}
        if self.probe is not None:
            return {f"{a}_mm": np.full(n_rows(data), 1e3 * self.probe.sigma) for a in "xyz"}
        if self.instrument == "r_test":
            return {f"{a}_ext_mm": np.full(n_rows(data), 1e3 * EXTERNAL_SIGMA) for a in "xyz"}
        if self.instrument == "reflectors":
            return {name: np.full(n_rows(data), 1e3 * self.sigma) for name in data
                    if name.startswith("smr")}  # fmt: skip
        raise ValueError(f"no noise by column for a case of {self.instrument!r}")


def n_rows(columns: Columns) -> int:
    """Return how many rows columns have."""
    return len(next(iter(columns.values())))


def with_strays(case: Case, share: float, seed: int, sizes: tuple[float, float] = (15, 60)) -> Case:
    """Return the case with a share of its rows gone astray: one reading of each is off by some
    `sizes` of its noise, either way. truth["strays"] lists the rows.
    """
    rng = np.random.default_rng([seed, 7])
    noise, n = case.noise, n_rows(case.data)
    rows = np.sort(rng.choice(n, round(share * n), replace=False))
    data = {name: values.copy() for name, values in case.data.items()}
    names = list(noise)
    for row, which in zip(rows, rng.integers(0, len(names), len(rows)), strict=True):
        off = rng.choice([-1.0, 1.0]) * rng.uniform(*sizes)
        data[names[which]][row] += off * noise[names[which]][row]
    return replace(case, data=data, truth=case.truth | {"strays": rows.tolist()})


def with_other_zero(case: Case, degrees: float) -> Case:
    """Return the case as recorded by sensors that all read so much more, in K: the temperature at
    which an effect is zero is 20 degC plus as much in the data.
    """

    def moved(table: Columns) -> Columns:
        return {k: v + degrees if k.endswith("_degC") else v for k, v in table.items()}

    check = None if case.check is None else moved(case.check)
    return replace(case, data=moved(case.data), check=check)


def run_columns(run: Run) -> Columns:
    """Return a run's columns x_mm ... T_air_degC and further ones in file units."""
    out: Columns = {f"{a.lower()}_mm": 1e3 * run.q[:, i] for i, a in enumerate(AXES)}
    out |= {f"dir_{a.lower()}": run.direction[:, i] for i, a in enumerate(AXES)}
    out["t_s"] = run.t
    out |= {f"T_{a.lower()}_degC": run.temperature[:, i] for i, a in enumerate(AXES)}
    return out | {"T_air_degC": run.air} | dict(run.extra)


def make_case(
    instrument: str,
    chain: str = "w X b Y Z t",
    seed: int = 0,
    effects: Sequence[Effect] = (),
    noise_factor: float = 1.0,
    *,
    travel: ArrayLike | None = None,
    tool_offset: Sequence[float] | None = None,
    table: ErrorTable = TABLE,
    error_size: float = 1.0,
    plan: Mapping[str, Any] | None = None,
    n_check: int = 400,
    recording: Sequence[str] = (),
    family: Smooth | None = None,
    declared: Sequence[Mapping[str, Any]] = (),
    name: str | None = None,
    folder: str | Path | None = None,
    noise_seed: int | None = None,
    **noise: Any,
) -> Case:
    """Draw a machine, plan, measure, and write the study if a folder is given.

    Machine, plan, noise, check points, station and further conditions come from six streams of the
    seed: two cases with the same seed differ by what was asked to differ, e.g. by their effects,
    only.

    Args:
        instrument: "laser_tracker", "multilateration", "ball_array", "laser_frame",
            "double_ball_bar", "touch_probe", "interferometer"; "r_test" or "reflectors" (the chain
            is then unused).
        effects: undeclared effects, see the table in effects.py.
        noise_factor: true noise / declared noise.
        travel: upper ends (3,) or both ends (3, 2) of the travels, m.
        tool_offset: m.
        table: declared half widths, um and urad; error_size scales the drawn errors only.
        plan: keyword arguments of tracker_plan, lateration_plan, ball_plan, frame_plan, bar_plan,
            line_plan, measure_circles, arm_plan.
        recording: further columns, see plans.conditions; of reflectors "t_s".
        family: the smooth family to declare and draw from instead of the table's.
        declared: rows for [[model.effect]] with their units in the keys (written, not applied).
        noise_seed: another seed for the stream of the noise alone.
        noise: laser_tracker: range_sigma, range_sigma_per_m, angle_sigma, station_mm,
            euler_xyz_deg, station_scatter (m, rad) about the nominal; multilateration: sigma,
            sigma_per_m, scatter of the declared places (m); ball_array: probe_sigma,
            ball_position_u, supports; double_ball_bar: sigma, length_u, scatter (m); laser_frame:
            sigma, scatter of its pose (m, rad);
            interferometer: as interferometer.Laser;
            reflectors: arm, sigma, link_sizes (m, rad).
    """
    streams = np.random.SeedSequence(seed).spawn(6)
    for_machine, for_plan, for_noise, for_check, for_station, for_more = map(
        np.random.default_rng, streams
    )
    if noise_seed is not None:
        for_noise = np.random.default_rng(np.random.SeedSequence(noise_seed).spawn(3)[2])
    given = [dict(e) for e in effects]
    si, plan = checked(given, instrument), dict(plan or {})
    name = name or f"{instrument}_{seed}"
    truth: dict[str, Any] = {"seed": seed, "noise_factor": noise_factor}
    if noise_seed is not None:
        truth["noise_seed"] = noise_seed
    rows = [dict(d) for d in declared]

    if instrument == "r_test":
        if noise:
            raise TypeError(f"unexpected arguments for an R-test: {', '.join(noise)}")
        data = measure_circles(si, for_noise, noise_factor=noise_factor, **plan)
        case = Case(name, instrument, given, data, declared=rows, truth=truth)
        if folder is not None:
            write_study(folder, case)
        return case

    if instrument == "reflectors":
        arm = noise.pop("arm", None) or example_arm()
        sigma, sizes = noise.pop("sigma", 10e-6), noise.pop("link_sizes", (5e-4, 2e-3))
        if noise:
            raise TypeError(f"unexpected arguments for reflectors: {', '.join(noise)}")
        arm = draw_arm_errors(arm, for_machine, *np.multiply(error_size, sizes))
        arm_run = arm_plan(arm, for_plan, **plan)
        got = measure_reflectors(arm, arm_run, for_noise, sigma, si, noise_factor)
        data: Columns = {"pose": np.arange(len(arm_run.t), dtype=float)}
        if "t_s" in recording:
            data["t_s"] = arm_run.t
        for kind, q in (("cmd", arm_run.q), ("read", got.read)):
            data |= {f"q{j + 1}_{kind}_deg": np.rad2deg(q[:, j]) for j in range(arm.joints)}
        for kind, p in (("smr", got.tool), ("base", got.base)):
            for m in range(p.shape[1]):
                for i, a in enumerate("xyz"):
                    data[f"{kind}{m + 1}_{a}_mm"] = 1e3 * p[:, m, i]
        links = {"link_translation_um": arm.translation, "link_rotation_urad": arm.rotation}
        truth |= {k: (1e6 * v).tolist() for k, v in links.items() if v is not None}
        truth |= {"tool_mm": (1e3 * arm_run.tool).tolist()}
        case = Case(
            name, instrument, given, data, readings=got.tool, arm=arm, arm_run=arm_run,
            declared=rows, sigma=sigma, link_sizes=sizes, truth=truth,
        )  # fmt: skip
        if folder is not None:
            write_study(folder, case)
        return case

    sizes = FRAME_SIZES if instrument in SMALL else SIZES
    size, offset = sizes.get(chain, sizes["w X b Y Z t"])
    nominal = nominal_machine(
        chain,
        size if travel is None else travel,
        offset if tool_offset is None else tool_offset,
    )
    if family is not None:
        machine = draw_smooth(nominal, for_machine, family)
    else:
        machine = draw_machine(nominal, for_machine, table, error_size)
    laser = Laser(**noise) if instrument == "interferometer" else None
    if laser is not None:
        plan, noise = {"lines": laser.lines, **plan}, {}
    planned: Any = {
        "laser_tracker": tracker_plan, "ball_array": ball_plan, "laser_frame": frame_plan,
        "double_ball_bar": bar_plan, "touch_probe": gauge_plan,
        "multilateration": lateration_plan, "interferometer": line_plan,
    }[instrument](machine, for_plan, **plan)  # fmt: skip
    if instrument == "multilateration":
        run, station, tool = planned
    else:
        run = planned if isinstance(planned, Run) else planned.run
    check_run = check_plan(machine, for_check, n_check)
    more, there = conditions((run, check_run), for_more, recording)
    run = replace(run, extra=dict(run.extra) | more)
    check_run = replace(check_run, extra=there)
    if laser is not None:
        check_run = replace(check_run, extra=there | {"T_material_degC": np.full(n_check, 20.6)})
    check_tcp = tool_point(machine, check_run, si)
    check = run_columns(check_run)
    check |= {f"tcp_{a.lower()}_mm": 1e3 * check_tcp[:, i] for i, a in enumerate(AXES)}
    truth["error_motions"] = machine.coefficients()
    shared: dict[str, Any] = {
        "check": check, "machine": machine, "check_run": check_run, "check_tcp": check_tcp,
        "declared": rows, "truth": truth,
    }  # fmt: skip

    if instrument == "laser_tracker":
        length = machine.travel[:, 1]
        place = np.round(1e3 * length * [-0.45, 0.3, 1.2] - [0, 0, 20], -2)
        station_mm = tuple(noise.pop("station_mm", place.tolist()))
        euler_xyz_deg = tuple(noise.pop("euler_xyz_deg", EULER_DEG))
        scatter = noise.pop("station_scatter", (5e-4, 2e-4))
        off, tilt = np.reshape(scatter, (2, 1)) * for_station.standard_normal((2, 3))
        tracker = Tracker(
            np.multiply(1e-3, station_mm) + off, np.deg2rad(euler_xyz_deg) + tilt, **noise
        )
        readings = measure_tracker(machine, run, tracker, for_noise, si, noise_factor)
        data = {"point": np.arange(len(run.t), dtype=float)} | run_columns(recorded(run, si))
        data |= {
            "range_mm": 1e3 * readings[:, 0],
            "azimuth_rad": readings[:, 1],
            "elevation_rad": readings[:, 2],
        }
        truth["station_mm"] = (1e3 * tracker.station).tolist()
        truth["euler_xyz_deg"] = np.rad2deg(tracker.euler).tolist()
        case = Case(
            name, instrument, given, data, run=run, readings=readings, tracker=tracker,
            station_mm=station_mm, euler_xyz_deg=euler_xyz_deg, **shared,
        )  # fmt: skip
    elif instrument == "multilateration":
        at = draw_stations(machine, for_station, station, tool, **noise)
        ranges = measure_ranges(machine, run, at, for_noise, si, noise_factor)
        data = {"point": np.arange(len(run.t), dtype=float)}
        data |= {"station": np.array(at.names)[at.station]}
        data |= {"tool": np.array(at.tool_names)[at.tool]}
        data |= run_columns(recorded(run, si)) | {"range_mm": 1e3 * ranges}
        truth["stations_mm"] = (1e3 * at.places).tolist()
        truth["dead_paths_mm"] = (1e3 * at.dead_paths).tolist()
        case = Case(
            name, instrument, given, data, run=run, readings=ranges[:, None], stations=at, **shared
        )
    elif laser is not None:
        lines = replace(planned, run=run)
        laser = laser.with_errors(for_station)
        readings = measure_lines(machine, lines, laser, for_noise, si, noise_factor)
        data = {"line": lines.line, "run": lines.number} | run_columns(recorded(run, si))
        data |= reading_columns(readings)
        truth["set_ups"] = {name: v.tolist() for name, v in laser.drawn.items()}
        case = Case(
            name, instrument, given, data, run=run, readings=readings, laser=laser, lines=lines,
            **shared,
        )  # fmt: skip
    elif instrument == "laser_frame":
        far, turned = np.reshape(noise.pop("scatter", (5e-6, 1e-5)), (2, 1))
        off, tilt = for_station.standard_normal((2, 3))
        frame = Frame(far * off, turned * tilt, **noise)
        readings = measure_frame(machine, run, frame, for_noise, si, noise_factor)
        data = run_columns(recorded(run, si))
        data |= {"u_um": 1e6 * readings[:, 0], "v_um": 1e6 * readings[:, 1]}
        case = Case(
            name, instrument, given, data, run=run, readings=readings, frame=frame, **shared
        )
    elif instrument == "double_ball_bar":
        bar = BallBar(**noise)
        read, there = measure_bar(machine, planned, bar, for_noise, si, noise_factor)
        truth |= {"ball_um": (1e6 * there["ball"]).tolist()}
        truth |= {"length_um": (1e6 * there["length"]).tolist()}
        data = {"run": planned.number.astype(float), "length_mm": 1e3 * planned.length}
        data["feed_mm_min"] = 6e4 * planned.feed
        data |= {f"{a.lower()}_mm": 1e3 * run.q[:, i] for i, a in enumerate(AXES)}
        data["deviation_um"] = 1e6 * read
        kept = ("x_mm", "y_mm", "z_mm", "tcp_x_mm", "tcp_y_mm", "tcp_z_mm")
        shared["check"] = {name: check[name] for name in kept}
        case = Case(name, instrument, given, data, run=run, bar=bar, **shared)
    elif instrument == "touch_probe":
        probe = GaugeProbe(**noise)
        found, certificate = measure_gauge(machine, planned, probe, for_noise, si, noise_factor)
        run = run.at(found)
        data = {"setup": planned.setup, "run": planned.turn}
        data |= {"face": planned.face, "approach": planned.way}
        data = {name: values.astype(float) for name, values in data.items()}
        data |= {f"{a.lower()}_mm": 1e3 * run.q[:, i] for i, a in enumerate(AXES)}
        gauge = {"face": np.arange(len(certificate), dtype=float)}
        gauge["position_mm"] = 1e3 * certificate
        kept = ("x_mm", "y_mm", "z_mm", "tcp_x_mm", "tcp_y_mm", "tcp_z_mm")
        shared["check"] = {name: check[name] for name in kept}
        case = Case(name, instrument, given, data, run=run, probe=probe, artefact=gauge, **shared)
    else:
        balls, ball_noise = replace(planned, run=run), BallNoise(**noise)
        found, _, calibrated = measure_balls(
            machine, balls, ball_noise, for_noise, si, noise_factor
        )
        run = balls.run.at(found)
        data = {"pose": np.asarray(run.pose, float), "ball": np.asarray(run.ball, float)}
        data |= run_columns(recorded(run, si))
        artefact = {"ball": np.arange(len(calibrated), dtype=float)}
        artefact |= {f"{a}_mm": 1e3 * calibrated[:, i] for i, a in enumerate("xyz")}
        truth["balls_mm"] = (1e3 * balls.balls).tolist()
        case = Case(
            name, instrument, given, data, artefact=artefact, run=run, balls=balls,
            ball_noise=ball_noise, **shared,
        )  # fmt: skip
    if folder is not None:
        write_study(folder, case)
    return case


# --- files ---------------------------------------------------------------------------------------


def write_csv(path: Path, columns: Columns) -> None:
    """Write columns, numbers with 10 significant digits."""
    formats = ["%s" if values.dtype.kind == "U" else "%.10g" for values in columns.values()]
    words = [np.char.mod(f, values) for f, values in zip(formats, columns.values(), strict=True)]
    lines = [",".join(columns), *map(",".join, zip(*words, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_study(folder: str | Path, case: Case) -> Path:
    """Write setup.toml, data.csv, truth.json and, as they apply, errors, check, artefact.csv.

    truth.json lists the undeclared effects as they were given (SI where a key has no unit).
    """
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    (out / "setup.toml").write_text(setup_text(case), encoding="utf-8")
    write_csv(out / "data.csv", case.data)
    for name, columns in (("check", case.check), ("artefact", case.artefact)):
        if columns is not None:
            write_csv(out / f"{name}.csv", columns)
    if case.machine is not None and case.machine.smooth is None:
        rows = [",".join(("component", *TABLE_COLUMNS))]
        rows += [",".join([k, *(f"{v:g}" for v in row)]) for k, row in case.machine.table.items()]
        (out / "errors.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    truth = {"undeclared": case.effects, **case.truth}
    text = json.dumps(truth, indent=1, default=lambda a: np.asarray(a).tolist())
    (out / "truth.json").write_text(text + "\n", encoding="utf-8")
    return out


def setup_text(case: Case) -> str:
    """Return setup.toml of a case."""
    lines = [f"name = {json.dumps(case.name)}", ""]
    if case.arm is not None:
        lines += _arm_lines(case)
    else:
        lines += _circle_lines() if case.instrument == "r_test" else _machine_lines(case)
    for row in case.declared:
        lines += ["", "[[model.effect]]"]
        lines += [f"{k} = {json.dumps(v)}" for k, v in row.items()]
    return "\n".join(lines) + "\n"


def _numbers(values: ArrayLike) -> str:
    return "[" + ", ".join(f"{v:.10g}" for v in np.asarray(values)) + "]"


def _machine_lines(case: Case) -> list[str]:
    machine = case.machine
    assert machine is not None
    lines = [
        "[machine]",
        f"chain = {json.dumps(machine.chain)}",
        f"tool_offset_mm = {_numbers(1e3 * machine.tool_offset)}",
        "[machine.travel_mm]",
        *(f"{a} = {_numbers(1e3 * machine.travel[i])}" for i, a in enumerate(AXES)),
        "",
        "[instrument]",
        f"kind = {json.dumps(case.instrument)}"
        if case.stations is None
        else 'kind = "laser_tracker"\nreadings = "range"',
    ]
    if case.stations is not None:
        at = case.stations
        lines += [
            f"range_sigma_um = {1e6 * at.sigma:.6g}",
            f"range_sigma_um_per_m = {1e6 * at.sigma_per_m:.6g}",
            "[instrument.tools]",
            *(f"{k} = {_numbers(1e3 * v)}" for k, v in zip(at.tool_names, at.tools, strict=True)),
            "[instrument.stations]",
            *(
                f"{k} = {{ station_mm = {_numbers(1e3 * v)} }}"
                for k, v in zip(at.names, at.declared, strict=True)
            ),
        ]
    if case.tracker is not None:
        lines += [
            f"range_sigma_um = {1e6 * case.tracker.range_sigma:.6g}",
            f"range_sigma_um_per_m = {1e6 * case.tracker.range_sigma_per_m:.6g}",
            f"angle_sigma_urad = {1e6 * case.tracker.angle_sigma:.6g}",
            f"station_mm = {_numbers(case.station_mm)}   # nominal, to be identified",
            f"euler_xyz_deg = {_numbers(case.euler_xyz_deg)}   # nominal, to be identified",
        ]
    if case.ball_noise is not None:
        lines += [
            'artefact = "artefact.csv"',
            f"probe_sigma_um = {1e6 * case.ball_noise.probe_sigma:.6g}",
            f"ball_position_u_um = {1e6 * case.ball_noise.ball_position_u:.6g}"
            "   # standard uncertainty of a calibrated coordinate",
            f"supports = {_numbers(case.ball_noise.supports)}   # of its length",
        ]
    if case.bar is not None:
        lines += [
            "length_mm = 150   # nominal; data.csv has that of every row",
            f"length_u_um = {1e6 * case.bar.length_u:.6g}",
            f"sigma_um = {1e6 * case.bar.sigma:.6g}",
        ]
    if case.probe is not None:
        lines += [
            'artefact = "step_gauge"',
            'gauge = "artefact.csv"',
            f"face_u_um = {1e6 * case.probe.face_u:.6g}",
            f"stylus_radius_mm = {1e3 * case.probe.stylus:.6g}",
            f"stylus_u_um = {1e6 * case.probe.stylus_u:.6g}",
            f"probe_sigma_um = {1e6 * case.probe.sigma:.6g}",
        ]
    if case.frame is not None:
        lines += [f"sigma_um = {1e6 * case.frame.sigma:.6g}", 'beam_path = "3d"']
    if case.laser is not None:
        lines += instrument_lines(case.laser)
    return [*lines, "", "[model.geometric]", *_family_lines(machine.smooth)]


def _family_lines(smooth: Smooth | None) -> list[str]:
    if smooth is None:
        return ['family = "fourier"', 'table = "errors.csv"']
    return [
        'family = "smooth"',
        f"translation_um = {1e6 * smooth.translation:.6g}",
        f"rotation_urad = {1e6 * smooth.rotation:.6g}",
        f"squareness_urad = {1e6 * smooth.squareness:.6g}",
        f"smoothness = {smooth.smoothness:.6g}",
    ]


def _circle_lines() -> list[str]:
    return [
        "[instrument]",
        'kind = "r_test"',
        f"radius_mm = {1e3 * RADIUS:.6g}",
        f"external_sigma_um = {1e6 * EXTERNAL_SIGMA:.6g}",
        f"internal_sigma_um = {1e6 * INTERNAL_SIGMA:.6g}",
    ]


def _arm_lines(case: Case) -> list[str]:
    arm, plan = case.arm, case.arm_run
    assert arm is not None
    assert plan is not None
    lines = ["[machine]", 'base = "unknown pose in the tracker\'s frame, to be identified"']
    for j in range(arm.joints):
        slides = arm.prismatic is not None and arm.prismatic[j]
        lines += [
            "[[machine.joint]]",
            f"type = {json.dumps('prismatic' if slides else 'revolute')}",
            f"a_mm = {1e3 * arm.a[j]:.10g}",
            f"alpha_deg = {np.rad2deg(arm.alpha[j]):.10g}",
            f"d_mm = {1e3 * arm.d[j]:.10g}",
            f"theta_deg = {np.rad2deg(arm.theta[j]):.10g}",
        ]
    return [
        *lines,
        "",
        "[instrument]",
        'kind = "reflectors"',
        f"tool_reflectors = {len(plan.tool)}",
        f"base_reflectors = {len(plan.base)}",
        f"sigma_um = {1e6 * case.sigma:.6g}",
        'joints = "commanded"',
        "",
        "[model.geometric]",
        'family = "smooth"',
        f"link_translation_um = {1e6 * case.link_sizes[0]:.6g}",
        f"link_rotation_urad = {1e6 * case.link_sizes[1]:.6g}",
    ]


@dataclass(frozen=True)
class Study:
    """A three-axis study read back from its folder, SI."""

    setup: dict[str, Any]
    nominal: Machine
    """Without errors; its table is what is declared."""
    run: Run
    data: Columns
    check_run: Run
    check_tcp: Array
    artefact: Array | None
    """Calibrated balls (b, 3), m."""


def read_csv(path: str | Path) -> Columns:
    """Return the numeric columns of a file by name."""
    table = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
    return {n: np.atleast_1d(table[n]) for n in table.dtype.names or ()}


def read_study(folder: str | Path) -> Study:
    """Read a tracker or ball-array study with the oracle's own reader."""
    home = Path(folder)
    setup = tomllib.loads((home / "setup.toml").read_text(encoding="utf-8"))
    machine = setup["machine"]
    travel = 1e-3 * np.array([machine["travel_mm"][a] for a in AXES], dtype=float)
    nominal = nominal_machine(machine["chain"], travel, 1e-3 * np.array(machine["tool_offset_mm"]))
    rows = (home / "errors.csv").read_text(encoding="utf-8").split()[1:]
    table = {r.split(",")[0]: tuple(float(v) for v in r.split(",")[1:]) for r in rows}
    nominal = replace(nominal, table=table)
    data, check = read_csv(home / "data.csv"), read_csv(home / "check.csv")

    def xyz(columns: Columns, pattern: str) -> Array:
        return np.stack([columns[pattern.format(a)] for a in "xyz"], axis=1)

    def run(columns: Columns) -> Run:
        groups = [columns[g].astype(int) if g in columns else None for g in ("pose", "ball")]
        return Run(
            1e-3 * xyz(columns, "{}_mm"), xyz(columns, "dir_{}"), columns["t_s"],
            xyz(columns, "T_{}_degC"), columns["T_air_degC"], *groups,
        )  # fmt: skip

    artefact = None
    if (home / "artefact.csv").exists():
        artefact = 1e-3 * xyz(read_csv(home / "artefact.csv"), "{}_mm")
    tcp = 1e-3 * xyz(check, "tcp_{}_mm")
    return Study(setup, nominal, run(data), data, run(check), tcp, artefact)


def as_study(case: Case) -> Study:
    """Return what a reader of the case's folder would have, without writing it."""
    if case.machine is None or case.run is None:
        raise ValueError(f"a case of {case.instrument!r} has no three-axis study")
    assert case.check_run is not None
    assert case.check_tcp is not None
    balls = None
    if case.artefact is not None:
        balls = 1e-3 * np.stack([case.artefact[f"{a}_mm"] for a in "xyz"], axis=1)
    setup = tomllib.loads(setup_text(case))
    return Study(setup, case.nominal, case.run, case.data, case.check_run, case.check_tcp, balls)
