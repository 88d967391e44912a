"""Pictures of the axes and angles of every instrument, computed from the instruments themselves.

    python notebooks/how-to/pictures.py [FOLDER]

draws one SVG for each instrument that `vcal init` knows, from the study to start from. Places,
angles, beams and signs come out of the classes that compute the readings, so that a picture cannot
say another convention than the program has.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure

import vcal
from vcal.demo import STARTS
from vcal.instruments.follow import followed
from vcal.instruments.laser_frame import beam_path
from vcal.instruments.laser_tracker import LaserTracker
from vcal.instruments.nest import Nest
from vcal.numerics.rigid import IDENTITY, Vector
from vcal.numerics.spatial import euler_xyz

HERE = Path(__file__).resolve().parent
INK, SOFT, PALE = "#1f2933", "#7b8794", "#e4e7eb"
BLUE, RED, GREEN = "#0072B2", "#D55E00", "#21918c"
_DEG = np.pi / 180.0


class Scene:
    """Drawing in space: parallel projection onto the page, seen from (azimuth, elevation) in
    degrees.
    """

    def __init__(self, width: float, height: float, azimuth: float, elevation: float):
        self.figure = Figure(figsize=(width, height))
        self.axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.axes.set_aspect("equal")
        self.axes.axis("off")
        a, e = azimuth * _DEG, elevation * _DEG
        right = [-np.sin(a), np.cos(a), 0.0]
        upward = [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]
        self.page = np.array([right, upward])

    def at(self, points) -> np.ndarray:
        """Places on the page (..., 2) of places in space (..., 3)."""
        return np.asarray(points, float) @ self.page.T

    def line(self, points, color=INK, width=1.2, style="-", zorder=2.0) -> None:
        """A polygonal line."""
        self.axes.plot(*self.at(points).T, color=color, lw=width, ls=style, zorder=zorder,
                       solid_capstyle="round")  # fmt: skip

    def area(self, points, color=PALE, alpha=1.0, edge="none", zorder=1.0) -> None:
        """A polygon."""
        self.axes.fill(*self.at(points).T, fc=color, alpha=alpha, ec=edge, lw=0.8, zorder=zorder)

    def dot(self, place, size=5.0, color=INK, edge="white", zorder=4.0) -> None:
        """A point."""
        self.axes.plot(*self.at(place), "o", ms=size, mfc=color, mec=edge, mew=0.8, zorder=zorder)

    def arrow(self, start, end, color=INK, width=1.4, zorder=3.0) -> None:
        """An arrow."""
        a, b = self.at(start), self.at(end)
        look = {"arrowstyle": "-|>,head_width=0.22,head_length=0.5", "shrinkA": 0, "shrinkB": 0}
        self.axes.annotate("", b, a, arrowprops={**look, "color": color, "lw": width},
                           zorder=zorder, annotation_clip=False)  # fmt: skip

    def text(self, place, text, color=INK, shift=(0.0, 0.0), size=9.5, ha="center") -> None:
        """Words at a place, moved by `shift` in points."""
        box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.7}
        self.axes.annotate(text, self.at(place), shift, textcoords="offset points", ha=ha,
                           va="center", color=color, fontsize=size, bbox=box, zorder=6,
                           annotation_clip=False)  # fmt: skip

    def frame(self, origin, rotation, length, color, names=("x", "y", "z"), size=9.5) -> None:
        """Three axes of a frame, the columns of `rotation`, with their names."""
        for direction, name in zip(np.asarray(rotation).T, names, strict=True):
            end = np.asarray(origin) + length * direction
            self.arrow(origin, end, color)
            self.text(np.asarray(origin) + 1.16 * length * direction, name, color, size=size)

    def arc(self, centre, first, second, radius, color, head=True, width=1.4) -> np.ndarray:
        """The angle from the direction `first` to `second`; the place in its middle."""
        first, second = (np.asarray(v) / np.linalg.norm(v) for v in (first, second))
        angle = np.arccos(np.clip(first @ second, -1.0, 1.0))
        across = second - (first @ second) * first
        across /= np.linalg.norm(across)
        t = np.linspace(0.0, angle, 40)[:, None]
        points = np.asarray(centre) + radius * (np.cos(t) * first + np.sin(t) * across)
        self.line(points, color, width)
        if head:
            self.arrow(points[-3], points[-1], color, width)
        return points[len(points) // 2]

    def turn(self, centre, axis, radius, color, start=-2.2, end=2.2) -> np.ndarray:
        """The positive sense of a rotation about `axis`, as an arc; the place of its head."""
        axis = np.asarray(axis) / np.linalg.norm(axis)
        first = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        t = np.linspace(start, end, 60)[:, None]
        points = np.asarray(centre) + radius * (
            np.cos(t) * first + np.sin(t) * np.cross(axis, first)
        )
        self.line(points, color)
        self.arrow(points[-4], points[-1], color)
        return points[-1]

    def box(self, low, high, color=SOFT, floor=PALE) -> None:
        """A work space: its edges and its floor."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        corner = lambda x, y, z: np.where([x, y, z], high, low)  # noqa: E731
        self.area([corner(0, 0, 0), corner(1, 0, 0), corner(1, 1, 0), corner(0, 1, 0)], floor)
        for a in (0, 1):
            for b in (0, 1):
                for ends in (
                    (corner(0, a, b), corner(1, a, b)),
                    (corner(a, 0, b), corner(a, 1, b)),
                    (corner(a, b, 0), corner(a, b, 1)),
                ):
                    self.line(ends, color, 0.7)

    def save(self, path: Path) -> None:
        """As SVG, the same bytes every time."""
        self.axes.margins(0.04)
        settings = {"svg.fonttype": "none", "svg.hashsalt": "vcal", "font.family": "sans-serif"}
        with matplotlib.rc_context(settings):
            self.figure.savefig(
                path, format="svg", metadata={"Date": None}, bbox_inches="tight", pad_inches=0.08
            )


def _study(kind: str) -> vcal.Study:
    return vcal.load_study(STARTS / kind)


def laser_tracker(path: Path) -> None:
    """Range, azimuth and elevation as the model reads them, of a station that is turned."""
    study = _study("laser_tracker")
    chain = study.chain
    scene = Scene(7.2, 4.6, -62.0, 24.0)
    offset = 1e3 * np.asarray(chain.tool_offset)
    low, high = (1e3 * chain.travel[:, i] + offset for i in (0, 1))
    scene.box(low, high)
    station = np.array([-420.0, -480.0, -150.0])
    turn = np.asarray(euler_xyz(jnp.array([0.0, 0.0, -25.0]) * _DEG))
    command = np.array([330.0, 380.0, 490.0])
    tool = 1e3 * chain.tool_point(1e-3 * command[None])[0]
    instrument = LaserTracker(
        station=1e-3 * station,
        orientation=turn,
        range_sigma=1e-6,
        range_sigma_per_m=0.0,
        angle_sigma=1e-6,
    )
    still = {"frame": [0.0] * 6, "read": [0.0] * 3}
    read = instrument.observe((), IDENTITY, Vector.of(jnp.asarray(1e-3 * tool)), still)
    distance, azimuth, elevation = (float(v) for v in read)
    level = [np.cos(azimuth), np.sin(azimuth), 0.0]
    seen = np.array([*np.multiply(np.cos(elevation), level[:2]), np.sin(elevation)])
    assert np.allclose(station + 1e3 * distance * (turn @ seen), tool)
    flat = turn @ (1e3 * distance * np.cos(elevation) * np.array(level))
    scene.line([station, station + flat], SOFT, 0.9, "--")
    scene.line([station + flat, tool], SOFT, 0.9, ":")
    scene.line([station, tool], RED, 1.8)
    scene.frame(station, turn, 260.0, BLUE)
    middle = scene.arc(station, turn[:, 0], flat, 330.0, GREEN)
    scene.text(middle, f"azimuth {azimuth:+.3f} rad", GREEN, (64, -5))
    scene.arc(station, flat, tool - station, 620.0, GREEN)
    scene.text(station + 0.72 * flat, f"elevation {elevation:+.3f} rad", GREEN, (30, -16))
    scene.text(station + 0.6 * (tool - station), f"range {1e3 * distance:.0f} mm", RED, (-46, 8))
    scene.dot(station, 9, BLUE)
    scene.text(station, "tracker", BLUE, (-30, -6))
    scene.dot(tool, 9, RED)
    scene.text(tool, "reflector", RED, (34, 6))
    scene.frame([0.0, 0.0, 0.0], np.eye(3), 200.0, INK, ("X", "Y", "Z"))
    scene.text([0.0, 0.0, 0.0], "workpiece\nframe", INK, (22, -16), 8.5)
    scene.save(path)


def ball_array(path: Path) -> None:
    """Artefact in three of its set-ups, with its own frame and gravity."""
    study = _study("ball_array")
    chain, plan = study.chain, study.plan
    instrument = study.instrument.start(chain, plan, np.zeros((plan.rows, 3)))
    scene = Scene(7.2, 4.8, -60.0, 26.0)
    offset = 1e3 * np.asarray(chain.tool_offset)
    low, high = (1e3 * chain.travel[:, i] + offset for i in (0, 1))
    scene.box(low, high)
    balls = 1e3 * instrument.centres
    for pose, color in ((0, SOFT), (1, SOFT), (8, BLUE)):
        turn, origin = instrument.pose_rotation[pose], 1e3 * instrument.pose_origin[pose]
        places = balls @ turn.T + origin
        ends = np.array([[balls[0, 0], 0, 0], [balls[-1, 0], 0, 0]]) @ turn.T + origin
        scene.line(ends, color, 3.0)
        for number, place in zip(instrument.numbers, places, strict=True):
            scene.dot(place, 8, color)
            if pose == 8:
                scene.text(place, f"{number}", BLUE, (0, 11), 8)
        label = f"pose {instrument.pose_numbers[pose]}"
        scene.text(ends[1], label, color, (26, -8))
        if pose == 8:
            scene.frame(origin, turn, 150.0, GREEN)
            tip = places[6]
    scene.line([tip, tip + [0, 0, 150]], RED, 2.0)
    scene.line([tip + [0, 0, 150], tip + [0, 0, 260]], RED, 7.0)
    scene.dot(tip, 6, RED)
    scene.text(tip + [0, 0, 260], "probe: x_mm, y_mm, z_mm\nwhere it finds the ball", RED, (8, 18))
    scene.arrow([1160, -120, 200], [1160, -120, 20], INK)
    scene.text([1160, -120, 200], "gravity", INK, (0, 9))
    scene.frame([0.0, 0.0, 0.0], np.eye(3), 200.0, INK, ("X", "Y", "Z"))
    scene.text([0.0, 0.0, 0.0], "workpiece frame", INK, (-48, -10), 8.5)
    scene.save(path)


def laser_frame(path: Path) -> None:
    """The beam path over the travel, and along which axes every segment reads u and v."""
    chain = _study("laser_frame").chain
    travel = {axis: chain.joint(axis).travel.tolist() for axis in "XYZ"}
    scene = Scene(7.2, 4.8, -60.0, 24.0)
    scene.box(1e3 * chain.travel[:, 0], 1e3 * chain.travel[:, 1])
    shown = {1: 0.4, 2: 0.45, 5: 0.5, 3: 0.3, 4: 0.45}
    for segment in beam_path("3d", travel):
        start, end = 1e3 * np.array(segment.start), 1e3 * np.array(segment.end)
        scene.line([start, end], RED, 2.0, zorder=3)
        place = start + shown[segment.number] * (end - start)
        scene.arrow(place, place + 70.0 * segment.direction, RED, 2.0)
        number = start + 0.75 * (end - start)
        scene.text(number, f"segment {segment.number}", RED, 
                   (34, 8) if segment.number in (3, 5) else (0, 10))  # fmt: skip
        middle = start + 0.12 * (end - start)
        for name, i in zip("uv", segment.across, strict=True):
            arm = 75.0 * np.eye(3)[i]
            scene.arrow(middle, middle + arm, BLUE)
            scene.text(middle + 1.35 * arm, f"{name} = {'xyz'[i]}", BLUE, size=8.5)
        scene.dot(middle, 5, BLUE)
    source = 1e3 * np.array(beam_path("3d", travel)[0].start)
    scene.dot(source, 9, RED)
    scene.text(source, "laser", RED, (-20, -9))
    scene.frame([620.0, -60.0, 0.0], np.eye(3), 80.0, INK, ("X", "Y", "Z"))
    scene.save(path)


def r_test(path: Path) -> None:
    """Circles in three planes of positive sense as in the data, and three probes at the sphere."""
    study = _study("r_test")
    plan = study.plan
    scene = Scene(7.2, 4.0, -58.0, 24.0)
    run, sense = np.asarray(plan.groups["run"]), np.asarray(plan.covariate("sense"))
    plane = np.asarray(plan.groups["plane"])
    for number, (color, name) in enumerate(((BLUE, "XY"), (GREEN, "YZ"), (RED, "ZX"))):
        mine = run == run[(plane == number) & (sense > 0)][0]
        place = 1e3 * np.asarray(plan.position)[mine]
        place = place - 0.5 * (place.max(0) + place.min(0))
        place = np.concatenate([place, place[:1]])
        scene.line(place, color, 1.6)
        at = len(place) // 8
        scene.arrow(place[at], place[at + 2], color, 1.8)
        scene.text(
            place[at], f"plane {name},\nsense +1", color, ((30, 6), (4, 16), (-34, 4))[number]
        )
    scene.frame([0.0, 0.0, 0.0], np.eye(3), 2.6, INK, ("X", "Y", "Z"))
    scene.text([0, 0, 0], "centre of the run", INK, (-4, -14), 8.5)
    directions = ((0.8, 0.0, 0.6), (-0.4, 0.69, 0.6), (-0.4, -0.69, 0.6))
    nest = Nest(directions=np.array(directions), distance=None)
    _nest(scene, nest, np.array([6.6, 3.8, -0.6]), 1.0)
    scene.save(path)


def _nest(scene: Scene, nest: Nest, centre: np.ndarray, size: float) -> None:
    """Sphere and probes: what a displacement along a probe does to its reading."""
    sphere = 0.9 * size
    t = np.linspace(0.0, 2.0 * np.pi, 80)
    around = scene.at(centre) + sphere * np.column_stack([np.cos(t), np.sin(t)])
    scene.axes.fill(*around.T, fc=PALE, ec=INK, lw=1.0, zorder=3)
    for k, n in enumerate(nest.directions, start=1):
        n = n / np.linalg.norm(n)
        read = nest.read(Vector.of(jnp.asarray(0.1 * n)))
        assert float(read[k - 1]) > 0.0  # towards the probe counts as positive
        scene.line([centre + 1.0 * sphere * n, centre + 2.6 * sphere * n], BLUE, 5.0, zorder=2.5)
        scene.text(centre + 2.95 * sphere * n, f"p{k}_mm", BLUE, size=9)
    scene.frame(centre, np.eye(3), 1.7 * sphere, RED, ("x_ext", "y_ext", "z_ext"), 8.5)
    scene.text(centre - [0, 0, 1.6 * sphere], "sphere between three probes", INK, (0, -8), 9)


def static_r_test(path: Path) -> None:
    """A sphere on the table at four angles of C: where the linear axes follow it."""
    chain = _study("static_r_test").chain
    scene = Scene(7.2, 4.8, -64.0, 28.0)
    axes, tilt = chain.axes, -20.0
    q = np.zeros((5, len(axes)))
    q[:, axes.index("C")] = np.array([0.0, 60.0, 120.0, 180.0, 270.0]) * _DEG
    q[:, axes.index("A")] = tilt * _DEG
    point = np.array([160.0, 0.0, -110.0])
    position = 1e3 * np.asarray(followed(chain, q, jnp.asarray(np.tile(1e-3 * point, (5, 1)))))
    linear = position[:, [axes.index(a) for a in "XYZ"]]
    spots = linear + 1e3 * np.asarray(chain.tool_offset)  # the tool point as seen from the bed
    turns = np.linspace(0.0, 2.0 * np.pi, 73)
    q = np.zeros((len(turns), len(axes)))
    q[:, axes.index("C")], q[:, axes.index("A")] = turns, tilt * _DEG
    rim = 1e3 * np.asarray(followed(chain, q, jnp.asarray(np.tile([0.25, 0.0, -0.2], (73, 1)))))
    rim = rim[:, [axes.index(a) for a in "XYZ"]] + 1e3 * np.asarray(chain.tool_offset)
    scene.area(rim, PALE, edge=SOFT)
    way = 1e3 * np.asarray(followed(chain, q, jnp.asarray(np.tile(1e-3 * point, (73, 1)))))
    way = way[:, [axes.index(a) for a in "XYZ"]] + 1e3 * np.asarray(chain.tool_offset)
    scene.line(way, GREEN, 1.2, "--")
    for k, spot in enumerate(spots):
        scene.dot(spot, 9, GREEN if k else RED)
        c = position[k, axes.index("C")] / _DEG * 1e-3
        shift = ((16, -12), (30, 0), (24, 8), (-24, 6), (-20, -10))[k]
        scene.text(spot, f"C = {c:.0f}°", GREEN if k else RED, shift, 8.5)
    scene.line([spots[0], spots[0] + [0, 0, 70]], RED, 2.0)
    scene.line([spots[0] + [0, 0, 70], spots[0] + [0, 0, 190]], RED, 8.0)
    scene.text(spots[0] + [0, 0, 190], "probes in the spindle,\nsphere on the table", RED, (10, 16))
    normal = np.cross(rim[0] - rim[20], rim[40] - rim[20])
    normal /= np.linalg.norm(normal) * np.sign(normal[2])
    middle = rim[:-1].mean(0)
    for name, axis, ends in (
        ("A", np.array([1.0, 0.0, 0.0]), (np.array([-390.0, 0, -120]), np.array([390.0, 0, -120]))),
        ("C", normal, (middle - 60.0 * normal, middle + 260.0 * normal)),
    ):
        scene.line(ends, BLUE, 1.1, "-.")
        # An axis that carries the workpiece turns against its own command.
        scene.turn(ends[1] - 40.0 * axis, chain.joint(name).sign * axis, 52.0, BLUE)
        scene.text(ends[1], f"{name} +", BLUE, (12, 7), 11)
    scene.frame([-330.0, -200.0, -320.0], np.eye(3), 100.0, INK, ("X", "Y", "Z"))
    scene.save(path)


def reflectors(path: Path) -> None:
    """The arm of the study at one pose, joints by their Denavit-Hartenberg frames."""
    study = _study("reflectors")
    chain = study.chain
    scene = Scene(7.2, 5.0, -50.0, 20.0)
    q = np.array([20.0, 10.0, -25.0, 30.0, 50.0, 0.0]) * _DEG
    turns, origins = (np.asarray(v) for v in chain.frames(jnp.asarray(q)))
    origins = 1e3 * origins
    still = jnp.zeros((len(q), 6))
    turn, flange = (np.asarray(v) for v in chain.pose_as_arrays(jnp.asarray(q), still))
    flange = 1e3 * flange
    line = np.concatenate([origins, flange[None]])
    scene.line(line, SOFT, 9.0, zorder=1.5)
    for k, (frame, origin) in enumerate(zip(turns, origins, strict=True), start=1):
        axis = frame[:, 2]
        shift = {4: 45.0, 6: 100.0}.get(k, 0.0)
        at = origin + shift * axis
        scene.line([at - 40 * axis, at + 80 * axis], BLUE, 1.0, "-.")
        scene.turn(at + 50 * axis, axis, 34.0, BLUE)
        scene.text(at + 104 * axis, f"q{k}", BLUE, (0, 3), 9)
    for k, place in enumerate(1e3 * study.instrument.points, start=1):
        spot = flange + turn @ place
        scene.line([flange, spot], INK, 1.2)
        scene.dot(spot, 8, RED)
        out = scene.at(spot) - scene.at(flange)
        scene.text(spot, f"smr{k}", RED, tuple(20.0 * out / np.linalg.norm(out)), 8.5)
    for k, spot in enumerate(
        ([330.0, -180.0, 0.0], [-120.0, -330.0, 0.0], [-220, 200, 0.0]), start=1
    ):
        scene.dot(spot, 8, GREEN)
        scene.text(spot, f"base{k}", GREEN, (0, -12), 8.5)
    ground = np.array([[-280, -400, 0], [420, -400, 0], [420, 280, 0], [-280, 280, 0]])
    scene.area(ground, PALE)
    scene.frame([0.0, 0.0, 0.0], np.eye(3), 130.0, INK, ("x", "y", "z"))
    tracker = np.array([750.0, -350.0, 250.0])
    scene.frame(tracker, np.asarray(euler_xyz(jnp.array([0.0, 0.0, 140.0]) * _DEG)), 130.0, GREEN)
    scene.dot(tracker, 9, GREEN)
    scene.text(tracker, "tracker: every coordinate\nis in this frame", GREEN, (0, -22))
    scene.save(path)


PICTURES: tuple[Callable[[Path], None], ...] = (
    laser_tracker,
    ball_array,
    laser_frame,
    r_test,
    static_r_test,
    reflectors,
)


def draw_all(folder: Path | str) -> list[Path]:
    """Draw every picture into a folder; the files that were written."""
    vcal.enable_float64()
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    drawn = []
    for picture in PICTURES:
        drawn.append(folder / f"{picture.__name__}.svg")
        picture(drawn[-1])
    return drawn


def main(arguments: Sequence[str]) -> None:
    """Draw into the folder that is named, or into the one of the documentation."""
    for path in draw_all(arguments[0] if arguments else HERE / "images"):
        print(path)


if __name__ == "__main__":
    main(sys.argv[1:])
