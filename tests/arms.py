"""Studies of arms with prismatic and revolute joints, from numpy alone."""

import csv
import math

import numpy as np

COLUMN = (
    {"type": "prismatic", "low_mm": 0, "high_mm": 2000, "alpha_deg": 90, "d_mm": 91},
    {"type": "revolute", "alpha_deg": -90, "d_mm": 250},
    {"type": "revolute", "a_mm": 620, "theta_deg": -90},
    {"type": "revolute", "a_mm": 80, "alpha_deg": 90},
    {"type": "revolute", "alpha_deg": -90, "d_mm": 560},
    {"type": "revolute", "alpha_deg": 90},
    {"type": "revolute", "d_mm": 120},
)
"""A column that carries a six-axis arm; mm and degrees, as in a study file."""
STATION = np.array([3.0, -2.0, 0.4])
REFLECTOR = np.array([0.05, -0.02, 0.1])


def about(axis, angle):
    """Rotations (n, 3, 3) about a coordinate axis."""
    angle = np.atleast_1d(np.asarray(angle, float))
    c, s, r = np.cos(angle), np.sin(angle), np.tile(np.eye(3), (len(angle), 1, 1))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    r[:, i, i], r[:, i, j], r[:, j, i], r[:, j, j] = c, -s, s, c
    return r


def moved(frames, rotation=None, translation=None):
    """Frames (R, t) followed by a translation and a rotation in their own axes."""
    r, t = frames
    if translation is not None:
        t = t + np.einsum("nij,nj->ni", r, np.broadcast_to(translation, t.shape))
    return (r if rotation is None else r @ rotation), t


def flange(rows, q, errors=None, modified=False):
    """Pose of the flange (n, 3, 3), (n, 3), m, of Denavit-Hartenberg rows at joint variables (n, k)
    in m and rad; `errors` are twists (n, k, 6) in the frames of the joints.
    """
    n, k = q.shape
    errors = np.zeros((n, k, 6)) if errors is None else np.broadcast_to(errors, (n, k, 6))
    frames = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    for j, row in enumerate(rows):
        a, d = (1e-3 * row.get(key, 0.0) for key in ("a_mm", "d_mm"))
        alpha, theta = (math.radians(row.get(f"{key}_deg", 0.0)) for key in ("alpha", "theta"))
        slides = row["type"] == "prismatic"
        if modified:
            frames = moved(moved(frames, about("x", alpha)), None, [a, 0, 0])
            # Rx(alpha) Tx(a): x is the axis of the rotation, so that their order does not matter.
        turn = np.full(n, theta) if slides else theta + q[:, j]
        frames = moved(frames, about("z", turn))
        if slides:
            frames = moved(frames, None, q[:, j, None] * [0.0, 0.0, 1.0])
        shift, w = errors[:, j, :3], errors[:, j, 3:]
        frames = moved(frames, None, shift)
        frames = moved(frames, np.array([_exp(v) for v in w]))
        frames = moved(frames, None, [0.0, 0.0, d])
        if not modified:
            frames = moved(moved(frames, None, [a, 0, 0]), about("x", alpha))
    return frames


def _exp(w):
    angle = np.linalg.norm(w)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = w / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


def written(value):
    """A value as TOML."""
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, int | float) else str([*value])


def write_arm(
    folder,
    rows,
    q,
    *,
    errors=None,
    machine="",
    instrument="",
    geometric="",
    more="",
    sigma=20e-6,
    modified=False,
    commands=None,
    extra=None,
    reflector=REFLECTOR,
    seed=0,
):
    """A study folder of one reflector on the tool; readings v = R'(p - s) with a station that is
    turned by 91 degrees.
    """
    folder.mkdir(parents=True, exist_ok=True)
    joints = ""
    for row in rows:
        joints += "[[machine.joint]]\n" + "".join(f"{k} = {written(v)}\n" for k, v in row.items())
    (folder / "setup.toml").write_text(
        f"[machine]\n{machine}\n{joints}\n[instrument]\nkind = 'reflectors'\n"
        f"tool_reflectors = 1\nsigma_um = {1e6 * sigma}\n{instrument}\n"
        "[model.geometric]\nlink_translation_um = 300\nlink_rotation_urad = 500\n"
        f"{geometric}\n{more}\n",
        encoding="utf-8",
    )
    rng = np.random.default_rng(seed)
    r, t = flange(rows, q, errors, modified)
    points = t + r @ reflector
    turn = about("z", math.radians(91.0))[0]
    seen = (points - STATION) @ turn + sigma * rng.standard_normal(points.shape)
    data = {"pose": np.arange(len(q))}
    given = q if commands is None else commands
    for j, row in enumerate(rows):
        slides = row["type"] == "prismatic"
        factor = 1e3 if slides else math.degrees(1.0)
        data[f"q{j + 1}_cmd_{'mm' if slides else 'deg'}"] = given[:, j] * factor
    data |= {f"smr1_{c}_mm": 1e3 * seen[:, i] for i, c in enumerate("xyz")}
    data |= extra or {}
    with (folder / "data.csv").open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(data)
        out.writerows(
            [
                repr(float(v)) if name != "pose" else int(v)
                for name, v in zip(data, row, strict=True)
            ]
            for row in zip(*data.values(), strict=True)
        )
    return folder


def poses(rows, count, seed=1, reach_deg=60.0):
    """Random joint variables (count, k): slides over their travel, angles within the reach."""
    rng = np.random.default_rng(seed)
    q = np.empty((count, len(rows)))
    for j, row in enumerate(rows):
        if row["type"] == "prismatic":
            q[:, j] = 1e-3 * rng.uniform(row["low_mm"], row["high_mm"], count)
        else:
            q[:, j] = np.deg2rad(rng.uniform(-reach_deg, reach_deg, count))
    return q
