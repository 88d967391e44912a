"""The plans behind the bundled studies; ``python -m vcal.demo.plans FOLDER`` writes them as CSV.

They are the input of `vcal simulate`, which made the data in this folder (README.md).
"""

import sys
from pathlib import Path

import numpy as np

from ..instruments.laser_frame import beam_path
from ..machine.chain import chain_from_string
from ..numerics.spatial import euler_xyz
from ..study import write_table

Columns = dict[str, np.ndarray]


def layers(counts: tuple[int, int, int], travel: np.ndarray, margin: float) -> np.ndarray:
    """Positions (n, 3) of a grid in mm, layer by layer, every other line reversed."""
    x, y, z = (
        np.linspace(margin, length - margin, count)
        for length, count in zip(travel, counts, strict=True)
    )
    points = []
    for k, height in enumerate(z):
        for j, depth in enumerate(y if k % 2 == 0 else y[::-1]):
            line = x if (k * len(y) + j) % 2 == 0 else x[::-1]
            points += [(along, depth, height) for along in line]
    return np.array(points)


def conditions(position: np.ndarray, t: np.ndarray, pause: tuple[float, float]) -> Columns:
    """Columns of directions, times and temperatures for positions (mm) visited at times `t` (s).

    Axes warm up while they move, each with its own gain and time constant, and cool in the `pause`
    (start and end, s). The air temperature oscillates slowly.
    """
    move = np.sign(np.diff(position, axis=0, prepend=position[:1] - 1.0))
    seconds = np.arange(t[-1] + 1.0)
    running = (seconds < pause[0]) | (seconds > pause[1])
    air = 20.2 + 0.3 * np.sin(2.0 * np.pi * seconds / 5400.0)
    columns = {f"{c}_mm": position[:, i].round(3) for i, c in enumerate("xyz")}
    columns |= {f"dir_{c}": np.where(move[:, i] < 0, -1, 1) for i, c in enumerate("xyz")}
    columns["t_s"] = t.round(1)
    for axis, gain, tau in (("x", 1.2, 700.0), ("y", 3.5, 900.0), ("z", 1.8, 400.0)):
        warmth = np.full(len(seconds), 20.1)
        for i in range(1, len(seconds)):
            goal = air[i] + gain * running[i]
            warmth[i] = warmth[i - 1] + (goal - warmth[i - 1]) / tau
        columns[f"T_{axis}_degC"] = np.interp(t, seconds, warmth).round(2)
    columns["T_air_degC"] = np.interp(t, seconds, air).round(2)
    return columns


def tracker(travel: tuple[float, float, float], counts: tuple[int, int, int], seed: int) -> Columns:
    """A grid with a little scatter, forward and return with a pause, ten seconds per point."""
    rng = np.random.default_rng(seed)
    there = layers(counts, np.array(travel), 25.0)
    position = np.concatenate([there, there[::-1]])
    position += rng.uniform(-20.0, 20.0, position.shape)
    n = len(position)
    late = np.arange(n) >= n // 2
    t = 10.0 * np.arange(n) + 1500.0 * late + rng.uniform(0.0, 1.0, n)
    return {"point": np.arange(n)} | conditions(position, t, (t[n // 2 - 1], t[n // 2] - 10.0))


def balls(seed: int) -> tuple[Columns, Columns]:
    """Plan and artefact: twelve set-ups of a beam with eight balls in 1000 x 600 x 500 mm.

    A set-up is given by its centre in mm and rotations about x, y and z in degrees.
    """
    rng = np.random.default_rng(seed)
    along = np.linspace(-240.0, 240.0, 8)
    centres = np.column_stack([along, 15.0 * (-1.0) ** np.arange(8), np.zeros(8)])
    centres += rng.uniform(-0.05, 0.05, centres.shape)
    setups = [
        (300, 150, 120, 0, 0, 0), (700, 450, 120, 0, 0, 0), (500, 300, 380, 0, 0, 5),
        (150, 300, 120, 0, 0, 90), (850, 300, 250, 0, 0, 95), (500, 300, 380, 0, 0, 85),
        (350, 300, 250, 0, 0, 45), (650, 300, 250, 0, 0, -45), (300, 300, 250, 0, 40, 0),
        (700, 300, 250, 0, -40, 0), (400, 300, 250, 0, 40, 90), (600, 300, 250, 0, -35, 50),
    ]  # fmt: skip
    found, pose = [], []
    for k, (x, y, z, a, b, c) in enumerate(setups):
        turn = np.asarray(euler_xyz(np.deg2rad(np.array([a, b, c], float))))
        found.append(centres @ turn.T + [x, y, z])
        pose += [k] * len(centres)
    index = np.array(pose)
    # Half a minute per ball, ten minutes to set the beam up again.
    t = 30.0 * np.arange(len(index)) + 600.0 * index
    columns = {"pose": index, "ball": np.tile(np.arange(8), len(setups))}
    columns |= conditions(np.concatenate(found), t, (t[44], t[48] - 30.0))
    artefact = {"ball": np.arange(8)} | {f"{c}_mm": centres[:, i] for i, c in enumerate("xyz")}
    return columns, artefact


def arm(seed: int) -> Columns:
    """Eighty random poses of a six-joint arm, commanded and read back."""
    rng = np.random.default_rng(seed)
    low = np.array([-90.0, -40.0, -60.0, -120.0, -90.0, -170.0])
    high = np.array([90.0, 60.0, 40.0, 120.0, 90.0, 170.0])
    q = rng.uniform(low, high, (80, 6)).round(3)
    columns = {"pose": np.arange(len(q))}
    columns |= {f"q{j + 1}_cmd_deg": q[:, j] for j in range(6)}
    read = (q + rng.normal(0.0, 1e-3, q.shape)).round(4)
    return columns | {f"q{j + 1}_read_deg": read[:, j] for j in range(6)}


def lifted_arm(seed: int) -> Columns:
    """A hundred random poses of a six-joint arm on a lifting column, at five heights."""
    rng = np.random.default_rng(seed)
    low = np.array([-90.0, -40.0, -60.0, -120.0, -90.0, -170.0])
    high = np.array([90.0, 60.0, 40.0, 120.0, 90.0, 170.0])
    q = rng.uniform(low, high, (100, 6)).round(3)
    columns = {"pose": np.arange(len(q))}
    columns["q1_cmd_mm"] = rng.choice(np.linspace(600.0, 1600.0, 5), len(q))
    return columns | {f"q{j + 2}_cmd_deg": q[:, j] for j in range(6)}


def frame(travel: tuple[float, float, float], runs: int, seed: int) -> Columns:
    """Runs along the five beams of a laser frame, five seconds per point, one per twenty minutes.

    The head warms up from run to run and cools in the last one, and so does the air above the
    table.
    """
    rng = np.random.default_rng(seed)
    ends = {axis: (0.0, length * 1e-3) for axis, length in zip("XYZ", travel, strict=True)}
    path = beam_path("3d", ends)
    position = np.tile(np.concatenate([one.positions for one in path]) * 1e3, (runs, 1))
    segment = np.tile(np.repeat([one.number for one in path], [one.points for one in path]), runs)
    count = len(position) // runs
    run = np.repeat(np.arange(runs), count)
    t = 1200.0 * run + 5.0 * np.tile(np.arange(count), runs)
    columns = {"run": run, "segment": segment} | conditions(position, t, (1e9, 1e9))
    warm = np.array([0.3, 1.8, 2.9, 1.1])[run % 4]
    columns["T_head_degC"] = (20.0 + warm + 0.02 * rng.standard_normal(len(t))).round(2)
    gradient = np.array([0.1, 0.5, 0.8, 0.3])[run % 4]
    columns["T_gradient_z_K_per_m"] = (gradient + 0.01 * rng.standard_normal(len(t))).round(3)
    return columns


def circles(radius: float, accelerations: tuple[float, ...], samples: int, seed: int) -> Columns:
    """One turn per run of an R-test in three planes and both senses; `radius` in mm, m/s^2.

    The amplitude of the closed loop decreases by a few per cent for faster circles.
    """
    rng = np.random.default_rng(seed)
    runs = [(p, s, a) for p in ("XY", "YZ", "ZX") for s in (1, -1) for a in accelerations]
    found: dict[str, list] = {name: [] for name in ("run", "plane", "sense", "a_set_m_s2", "t_s")}
    position = []
    for number, (plane, sense, a) in enumerate(runs):
        omega = np.sqrt(a / (1e-3 * radius))
        t = (np.arange(samples) + 0.5) / samples * 2.0 * np.pi / omega
        ratio = 1.0 - 1e-5 * omega**2
        place = rng.normal(0.0, 2e-5, (samples, 3))
        place[:, "XYZ".index(plane[0])] += radius * ratio * np.cos(omega * t)
        place[:, "XYZ".index(plane[1])] += radius * ratio * sense * np.sin(omega * t)
        position.append(place)
        for name, value in zip(found, (number, plane, sense, a, t), strict=True):
            found[name] += list(np.broadcast_to(value, samples))
    columns = {name: np.array(values) for name, values in found.items()}
    internal = np.concatenate(position).round(8)
    return columns | {f"{c}_int_mm": internal[:, i] for i, c in enumerate("xyz")}


def turned_spheres(seed: int) -> Columns:
    """A static R-test on a trunnion table with two positions of the sphere.

    C turns forward and back at four angles of A; eight seconds per position.
    """
    rng = np.random.default_rng(seed)
    spheres = np.array([[160.0, 0.0, -60.0], [-90.0, 130.0, 20.0]])
    rows = [
        (run, a, c)
        for run, tilts in enumerate(((-60, -20, 20, 60), (60, 20, -20, -60)))
        for a in tilts
        for c in (*range(0, 360, 30), *range(345, -1, -30))
    ]
    run, a, c = (np.array(column) for column in zip(*rows, strict=True))
    places = {"A": (0.0, 0.0, -0.12), "C": (0.0, 0.0, -0.2)}
    chain = chain_from_string("w C A b Y X Z t", None, (0.0, 0.0, -0.15), places)
    angles = np.column_stack([np.zeros((len(rows), 3)), np.deg2rad(a), np.deg2rad(c)])
    # The tool point at rest plus the travel of the linear axes in the workpiece frame.
    away = 1e-3 * spheres[run] - chain.tool_point(angles)
    position = np.einsum("nij,ni->nj", chain.turn(angles), away) * 1e3
    way = lambda angle: np.where(np.diff(angle, prepend=angle[:1] - 1) < 0, -1, 1)  # noqa: E731
    t = 8.0 * np.arange(len(rows)) + 300.0 * run + rng.uniform(0.0, 1.0, len(rows))
    columns: Columns = {"run": run, "t_s": t.round(1)}
    columns |= {f"{k}_mm": position[:, i].round(6) for i, k in enumerate("xyz")}
    columns |= {"a_deg": a, "c_deg": c, "dir_c": way(c)}
    return columns


def ball_bar() -> Columns:
    """Circles and arcs of a double ball bar about two positions of its ball, both senses.

    In every set-up, the bar travels a circle in XY and arcs of 220 degrees above the table in YZ
    and ZX, six degrees from row to row; the second set-up has a shorter bar and a higher feed.
    """
    found: dict[str, list] = {n: [] for n in ("run", "setup", "length_mm", "feed_mm_min")}
    position, run = [], 0
    setups = (((300.0, 250.0, 225.0), 150.0, 1000.0), ((420.0, 180.0, 150.0), 100.0, 4000.0))
    for setup, (ball, length, feed) in enumerate(setups):
        for first, second, low, high in ((0, 1, 0, 360), (1, 2, -20, 200), (2, 0, -110, 110)):
            angle = np.deg2rad(np.arange(low + 3, high, 6))
            for sense in (1, -1):
                place = np.tile(ball, (len(angle), 1))
                place[:, first] += length * np.cos(angle[::sense])
                place[:, second] += length * np.sin(angle[::sense])
                position.append(place)
                for name, value in zip(found, (run, setup, length, feed), strict=True):
                    found[name] += [value] * len(angle)
                run += 1
    columns = {name: np.array(values) for name, values in found.items()}
    place = np.concatenate(position).round(6)
    return columns | {f"{c}_mm": place[:, i] for i, c in enumerate("xyz")}


def probed_sphere(radius: float, stylus: float) -> Columns:
    """A sphere on a trunnion table at two places, touched from five sides and above, in mm.

    C turns forward and back at three angles of A. The sides turn by 13 degrees from setting to
    setting, so that lobes of the probe differ from reversal errors of the axes.
    """
    spheres = np.array([[160.0, 0.0, -60.0], [-90.0, 130.0, 20.0]])
    rows = [
        (setup, a, c, side)
        for setup in range(2)
        for a in (-50, 0, 50)
        for c in (*range(0, 360, 60), *range(330, -1, -60))
        for side in range(6)
    ]
    setup, a, c, side = (np.array(column) for column in zip(*rows, strict=True))
    places = {"A": (0.0, 0.0, -0.12), "C": (0.0, 0.0, -0.2)}
    chain = chain_from_string("w C A b Y X Z t", None, (0.0, 0.0, -0.15), places)
    angles = np.column_stack([np.zeros((len(rows), 3)), np.deg2rad(a), np.deg2rad(c)])
    # The tool point at rest plus the travel of the linear axes in the workpiece frame.
    away = 1e-3 * spheres[setup] - chain.tool_point(angles)
    centre = np.einsum("nij,ni->nj", chain.turn(angles), away) * 1e3
    around = np.deg2rad(72.0 * side + 13.0 * (np.arange(len(rows)) // 6))
    out = np.column_stack([np.cos(around), np.sin(around), 0.0 * around])
    out[side == 5] = [0.0, 0.0, 1.0]
    position = centre + (radius + stylus) * out
    way = np.sign(np.diff(c, prepend=c[:1] - 1))
    for i in range(1, len(way)):
        way[i] = way[i] or way[i - 1]
    columns: Columns = {"setup": setup}
    columns |= {f"{k}_mm": position[:, i].round(6) for i, k in enumerate("xyz")}
    return columns | {"a_deg": a, "c_deg": c, "dir_c": way}


def lines(travel: tuple[float, float, float], counts: tuple[int, int, int], seed: int) -> Columns:
    """Three lines through the middle of the work space, one per axis, three runs of each forward
    and backward over targets at irregular distances (ISO 230-2), eight seconds per position.
    """
    rng = np.random.default_rng(seed)
    found: dict[str, list] = {name: [] for name in ("line", "run", "way")}
    position, t, clock = [], [], 0.0
    for axis, (length, count) in enumerate(zip(travel, counts, strict=True)):
        step = (length - 40.0) / (count - 1)
        targets = 20.0 + step * (np.arange(count) + rng.uniform(-0.3, 0.3, count))
        targets = np.clip(targets, 20.0, length - 20.0).round(1)
        for run in range(3):
            for way, places in ((1, targets), (-1, targets[::-1])):
                rows = np.tile(0.5 * np.array(travel), (count, 1))
                rows[:, axis] = places
                position.append(rows)
                t += (clock + 8.0 * np.arange(count)).tolist()
                clock += 8.0 * count + 20.0
                for name, value in zip(found, (axis, run, way), strict=True):
                    found[name] += [value] * count
        clock += 1500.0
    way = np.array(found.pop("way"))
    columns: Columns = {name: np.array(values) for name, values in found.items()}
    columns |= conditions(np.concatenate(position), np.array(t), (1e9, 1e9))
    for axis, name in enumerate("xyz"):
        columns[f"dir_{name}"] = np.where(columns["line"] == axis, way, 1)
    drift = 0.6 * (columns["T_air_degC"] - 20.2)
    columns["T_material_degC"] = (20.4 + drift + 0.01 * rng.standard_normal(len(t))).round(2)
    return columns


def main(folder: Path) -> None:
    """Write all plans to a folder with the layout of this one."""
    plan, artefact = balls(2)
    tables = {
        "data.csv": tracker((800.0, 500.0, 450.0), (8, 5, 4), 20),
        "start/laser_tracker/data.csv": tracker((1000.0, 600.0, 500.0), (5, 4, 3), 1),
        "start/ball_array/data.csv": plan,
        "start/ball_array/artefact.csv": artefact,
        "start/reflectors/data.csv": arm(3),
        "start/pose_probe/data.csv": lifted_arm(7),
        "start/laser_frame/data.csv": frame((500.0, 400.0, 350.0), 4, 4),
        "start/r_test/data.csv": circles(2.0, (0.5, 1.5, 3.0, 4.5), 40, 5),
        "start/static_r_test/data.csv": turned_spheres(6),
        "start/double_ball_bar/data.csv": ball_bar(),
        "start/touch_probe/data.csv": probed_sphere(12.5, 3.0),
        "start/interferometer/data.csv": lines((1000.0, 600.0, 500.0), (21, 13, 11), 8),
    }
    for name, columns in tables.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_table(folder / name, columns)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
