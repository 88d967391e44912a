"""The folder that the laser frame's reproduction leaves."""

import json

import pytest

import vcal.reproduce.laser_frame.results as computing
from vcal.errors import StudyError
from vcal.reproduce import reproduction
from vcal.reproduce.laser_frame import better as search
from vcal.reproduce.laser_frame.better import Better, Step
from vcal.reproduce.laser_frame.cycles import cycles
from vcal.reproduce.laser_frame.setting import Layout


def few(layout, machine, fitted, *, draws, seed, effects=None, known={}):  # noqa: B006
    """One real campaign per path stands for all of them: most of a campaign is compilation."""
    del machine, effects
    path = layout if isinstance(layout, str) else "3d"
    if path not in known:
        known[path] = cycles(path, "none", fitted, draws=draws, seed=seed)
    return known[path]


def unrefined(progress):
    """Layouts that are only judged: the search has tests of its own."""
    progress("beam paths")
    start = Layout.named("3d")
    judged = search.judge("as published", start)
    steps = [Step(name, start, judged.U, judged.tool) for name in ("as published", "a", "b", "c")]
    bound = search._Edges().bound(search._corners(start.segments), 51)
    return Better(tuple(steps), steps[-1], (bound,), (bound,), (192, 384))


@pytest.mark.slow
def test_the_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(computing, "cycles", few)
    monkeypatch.setattr(computing, "better", unrefined)
    out, said = tmp_path / "out", []
    frame = reproduction("laser-frame")
    page = frame.run(out, 300, 1, said.append)
    assert page == out / "index.html" and len(said) == len(set(said)) > 10
    record = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert record["name"] == "laser-frame" and (record["draws"], record["seed"]) == (300, 1)
    assert {p.name for p in out.iterdir()} == set(record["files"])
    rows = {row["quantity"]: row for row in record["table"]}
    assert rows["expanded (k = 2), largest"]["seed"] == 2.26
    assert rows["U of EAX"]["seed"] == 8.2
    assert rows["U of EAX"]["vcal"] == record["cycles"]["planar, noise"]["by_beams_U_um"]["EAX"]
    assert rows["rms of ln(vcal / printed), EXZ and EZY exchanged"]["vcal"] <= 0.12
    assert len(record["budget"]) == 36
    text = page.read_text(encoding="utf-8")
    assert "nan" not in text.split("<main>")[1].split("data:image")[0]
    assert text.count("data:image/png;base64,") == 7
    with pytest.raises(StudyError, match="expected at least 200 draws"):
        frame.run(out, 20, 1, print)
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(StudyError, match=r"found other files \(mine.txt"):
        frame.run(tmp_path, 300, 1, print)
