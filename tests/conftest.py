"""Small valid study folders, written from code: nominal readings and a little noise."""

import ctypes
import gc
import os
import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (so that its BLAS is there to be limited)
from threadpoolctl import threadpool_limits

from quick_programs import compile_quickly
from vcal.cli.start_studies import write_start

jax.config.update("jax_enable_x64", True)

_HOME = pytest.StashKey[tempfile.TemporaryDirectory]()


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled programs, small ones too: most of the time goes into compilation, often of the
    same program.

    All processes share them, without a lock: a cache that has one looks at each of its files
    whenever it takes another. Of two that compile the same at the same time one may find the file
    of the other half written; it is then told to be unreadable, and compiles for itself. Where
    there is a process for every core, one core is what each of them has.
    """
    # Most objects of a program stay: going through them again and again took 4 % of the time.
    gc.set_threshold(20_000, 10, 10)
    unreadable = "ignore:Error reading persistent compilation cache entry:UserWarning"
    config.addinivalue_line("filterwarnings", unreadable)
    if hasattr(config, "workerinput"):
        threadpool_limits(1)
    else:
        compile_quickly()
    # What a test trusts is not trusted by the user who runs it, whose settings change no test.
    home = config.stash.setdefault(_HOME, tempfile.TemporaryDirectory(prefix="vcal-home-"))
    for kind in ("CONFIG", "STATE"):
        os.environ[f"XDG_{kind}_HOME"] = str(Path(home.name).resolve() / kind.lower())
    for name, value in _programs(config).items():
        jax.config.update(name, value)


def _programs(config: pytest.Config) -> dict[str, str | int | float]:
    """Nowhere without the cache of pytest (`-p no:cacheprovider`)."""
    cache = getattr(config, "cache", None)
    if cache is None:
        return {}
    return {
        "jax_compilation_cache_dir": str(cache.mkdir("xla")),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": 0,
    }


@pytest.fixture(scope="session")
def programs(pytestconfig) -> dict[str, str]:
    """Environment in which another process keeps its compiled programs where the tests do, and has
    one core.
    """
    kept = {name.upper(): str(value) for name, value in _programs(pytestconfig).items()}
    return kept | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@pytest.fixture(autouse=True, scope="module")
def _room_for_programs():
    """Forget compiled programs before they fill the memory of a small machine, and before the
    process has as many mappings as Linux allows (65530): the compiler would end it.

    Without `malloc_trim` the C library keeps for itself what is freed.
    """
    yield
    pages, maps = Path("/proc/self/statm"), Path("/proc/self/maps")
    if not pages.is_file():
        return
    held = int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    if held > 2.5e9 or maps.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()
        gc.collect()
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # not every C library has it
        if trim is not None:
            trim(0)


MACHINE = """\
name = "small"

[machine]
chain = "w X b Y Z t"
tool_offset_mm = [0, 0, -150]
[machine.travel_mm]
X = [0, 2000]
Y = [0, 1000]
Z = [0, 600]
"""
GEOMETRIC = """
[model.geometric]
family = "fourier"
table = "errors.csv"
"""
TRACKER = """
[instrument]
kind = "laser_tracker"
range_sigma_um = 1.3
range_sigma_um_per_m = 0.27
angle_sigma_urad = 2.5
station_mm = [-900.0, 300.0, 700.0]
"""
BALLS = """
[instrument]
kind = "ball_array"
artefact = "artefact.csv"
probe_sigma_um = 0.7
ball_position_u_um = 0.8
"""
ARM = """\
name = "small arm"

[machine]
base = "somewhere"
[[machine.joint]]
type = "revolute"
alpha_deg = -90
d_mm = 290
low_deg = -170
high_deg = 170
[[machine.joint]]
type = "revolute"
a_mm = 270
theta_deg = -90
[[machine.joint]]
type = "revolute"
a_mm = 70
alpha_deg = -90
d_mm = 300

[instrument]
kind = "reflectors"
tool_reflectors = 3
base_reflectors = 3
sigma_um = 10

[model.geometric]
link_translation_um = 500
link_rotation_urad = 2000
"""
OFFSET = np.array([0.0, 0.0, -150.0])


def write_csv(path: Path, columns: dict) -> None:
    """Write columns of numbers or texts."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(v if isinstance(v, str) else f"{v:.10g}" for v in row) for row in rows]
    path.write_text("\n".join([",".join(columns), *lines]) + "\n", encoding="utf-8")


def conditions(position: np.ndarray) -> dict:
    """Columns of positions (n, 3) in mm, visited in this order."""
    move = np.sign(np.diff(position, axis=0, prepend=position[:1] - 1.0))
    n = len(position)
    columns = {f"{c}_mm": position[:, i] for i, c in enumerate("xyz")}
    columns |= {f"dir_{c}": np.where(move[:, i] < 0, -1, 1) for i, c in enumerate("xyz")}
    columns |= {"t_s": 10.0 * np.arange(n)}
    columns |= {f"T_{c}_degC": np.linspace(20.0, 20.5, n) for c in ("x", "y", "z", "air")}
    return columns


def family_table() -> dict:
    """A Fourier family for X, Y and Z."""
    motions = [f"E{c}{axis}" for axis in "XYZ" for c in "XYZABC"]
    names = [*motions, "EC0Y", "EB0Z", "EA0Z"]
    wide = [float(name in motions) for name in names]
    columns = {"component": names, "a0": [40.0 - 40.0 * w for w in wide]}
    sizes = {"a1": 20.0, "n1": 0.5, "b1": 15.0, "c1": 15.0, "n2": 1.0, "b2": 3.0, "c2": 3.0}
    return columns | {key: [size * w for w in wide] for key, size in sizes.items()}


def write_linear(folder: Path, instrument: str, data: dict, rng: np.random.Generator) -> Path:
    """Setup, data, family and check points of a three-axis study."""
    folder.mkdir()
    (folder / "setup.toml").write_text(MACHINE + instrument + GEOMETRIC, encoding="utf-8")
    write_csv(folder / "data.csv", data)
    write_csv(folder / "errors.csv", family_table())
    position = rng.uniform([0, 0, 0], [2000, 1000, 600], (5, 3))
    tool = {f"tcp_{c}_mm": (position + OFFSET)[:, i] for i, c in enumerate("xyz")}
    write_csv(folder / "check.csv", conditions(position) | tool)
    return folder


@pytest.fixture
def small_tracker_study(tmp_path: Path) -> Path:
    """48 points of a three-axis machine, seen by a laser tracker."""
    rng = np.random.default_rng(1)
    axes = [np.linspace(100, 1900, 4), np.linspace(50, 950, 4), np.linspace(50, 550, 3)]
    position = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    v = position + OFFSET - [-900.0, 300.0, 700.0]
    r = np.linalg.norm(v, axis=1)
    noise = rng.standard_normal((len(r), 3)) * [1.5e-3, 2.5e-6, 2.5e-6]
    data = {"point": np.arange(len(r))} | conditions(position)
    data["range_mm"] = r + noise[:, 0]
    data["azimuth_rad"] = np.arctan2(v[:, 1], v[:, 0]) + noise[:, 1]
    data["elevation_rad"] = np.arcsin(v[:, 2] / r) + noise[:, 2]
    return write_linear(tmp_path / "tracker", TRACKER, data, rng)


@pytest.fixture
def small_ball_study(tmp_path: Path) -> Path:
    """Six balls in four poses, found by a three-axis machine."""
    rng = np.random.default_rng(2)
    balls = np.column_stack([np.linspace(0, 500, 6), rng.uniform(-20, 20, (6, 2))])
    found, pose, ball = [], [], []
    for k, turn in enumerate(np.deg2rad([0, 40, 90, 130])):
        c, s = np.cos(turn), np.sin(turn)
        r = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        found.append(balls @ r.T + [900, 300, 100.0 * k])
        pose += [k] * len(balls)
        ball += range(len(balls))
    position = np.concatenate(found) - OFFSET + rng.normal(0, 0.7e-3, (len(ball), 3))
    folder = write_linear(
        tmp_path / "balls", BALLS, {"pose": pose, "ball": ball} | conditions(position), rng
    )
    artefact = {"ball": range(6)} | {f"{c}_mm": balls[:, i] for i, c in enumerate("xyz")}
    write_csv(folder / "artefact.csv", artefact)
    return folder


@pytest.fixture
def small_arm_study(tmp_path: Path) -> Path:
    """Sixteen poses of a three-joint arm, three reflectors on its tool and three on its base."""
    rng = np.random.default_rng(3)
    q = rng.uniform(-60, 60, (16, 3))
    a, d = [0, 270, 70], [290, 0, 300]
    alpha, theta = np.deg2rad([-90, 0, -90]), np.deg2rad([0, -90, 0])
    reflectors = np.array([[50.0, 0, 80], [-50, 40, 80], [0, -60, 120]])
    base = np.array([[400.0, 0, 0], [0, 400, 0], [-300, -300, 50]])
    data = {"pose": np.arange(16)}
    data |= {f"q{j + 1}_cmd_deg": q[:, j] for j in range(3)}
    data |= {f"q{j + 1}_read_deg": q[:, j] + rng.normal(0, 1e-3, 16) for j in range(3)}
    points = np.empty((16, 3, 3))
    for n in range(16):
        r, t = np.eye(3), np.zeros(3)
        for j in range(3):
            c, s = np.cos(theta[j] + np.deg2rad(q[n, j])), np.sin(theta[j] + np.deg2rad(q[n, j]))
            ca, sa = np.cos(alpha[j]), np.sin(alpha[j])
            t = t + r @ [a[j] * c, a[j] * s, d[j]]
            r = r @ [[c, -s * ca, s * sa], [s, c * ca, -c * sa], [0, sa, ca]]
        points[n] = reflectors @ r.T + t + [2500, 100, -300] + rng.normal(0, 0.01, (3, 3))
    for k in range(3):
        data |= {f"smr{k + 1}_{c}_mm": points[:, k, i] for i, c in enumerate("xyz")}
    for k in range(3):
        seen = base[k] + [2500, 100, -300] + rng.normal(0, 0.01, (16, 3))
        data |= {f"base{k + 1}_{c}_mm": seen[:, i] for i, c in enumerate("xyz")}
    folder = tmp_path / "arm"
    folder.mkdir()
    (folder / "setup.toml").write_text(ARM, encoding="utf-8")
    write_csv(folder / "data.csv", data)
    return folder


@pytest.fixture(scope="module")
def kept_programs(tmp_path_factory):
    """Programs are compiled once for all commands of a file, whichever process they run in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("VCAL_NO_CACHE", raising=False)
        before = jax.config.jax_compilation_cache_dir
        yield
        jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture(scope="module")
def few_poses(tmp_path_factory):
    """Four poses of the ball array to start from, with an artefact that may expand."""
    folder = tmp_path_factory.mktemp("given") / "balls"
    write_start("ball_array", folder)
    lines = (folder / "data.csv").read_text().splitlines()
    kept = [lines[0], *(line for line in lines[1:] if int(line.split(",")[0]) < 4)]
    (folder / "data.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def few_points(tmp_path_factory):
    """Twenty-four points of the laser tracker to start from."""
    folder = tmp_path_factory.mktemp("given") / "tracker"
    write_start("laser_tracker", folder)
    lines = (folder / "data.csv").read_text().splitlines()
    kept = [lines[0], *lines[1::5]]
    (folder / "data.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
    return folder
