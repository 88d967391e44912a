"""A laser-frame study written by plain numpy: a machine with translations only, and a head that
grows.
"""

from pathlib import Path

import numpy as np

BOX = (500.0, 400.0, 350.0)
"""Travel of X, Y and Z, mm."""
FRAME = """\
name = "frame"

[machine]
chain = "w b X Y Z t"
[machine.travel_mm]
X = [0, 500]
Y = [0, 400]
Z = [0, 350]

[instrument]
kind = "laser_frame"
sigma_um = 0.5
beam_path = "3d"

[model.geometric]
family = "smooth"
translation_um = 6
rotation_urad = 8
squareness_urad = 10
"""
_CORNERS = {1: ("---", "-+-"), 2: ("-+-", "++-"), 5: ("++-", "+++"), 3: ("+++", "+-+"),
            4: ("+-+", "--+")}  # fmt: skip


def write_frame(folder: Path, growth: float, runs: int = 3, seed: int = 0) -> Path:
    """Write the study; `growth` of the head in um/K, against z."""
    rng = np.random.default_rng(seed)
    a = rng.normal(0.0, 4.0, (3, 3))
    lines = ["run,segment,x_mm,y_mm,z_mm,t_s,T_head_degC,u_um,v_um"]
    for run in range(runs):
        t = 600.0 * run
        for number, ends in _CORNERS.items():
            start, end = (
                np.array([size * (s == "+") for s, size in zip(corner, BOX, strict=True)])
                for corner in ends
            )
            across = np.flatnonzero(start == end)
            for share in np.linspace(0.0, 1.0, 7 if number == 1 else 11):
                q = start + share * (end - start)
                # Every axis bends, in all three directions, by a parabola of its own.
                moved = a @ (q / BOX * (1.0 - q / BOX)) + rng.normal(0.0, 0.5, 3)
                warm = 20.0 + 3.0 * np.sin(1.0 + t / 700.0)
                moved[2] -= growth * (warm - 20.0)
                u, v = moved[across]
                lines.append(
                    f"{run},{number},{q[0]:g},{q[1]:g},{q[2]:g},{t:g},{warm:.3f},{u:.4f},{v:.4f}"
                )
                t += 5.0
    folder.mkdir(parents=True)
    (folder / "setup.toml").write_text(FRAME, encoding="utf-8")
    (folder / "data.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
