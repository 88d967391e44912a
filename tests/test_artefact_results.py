"""The folder that `vcal reproduce artefact-design` leaves, with little of everything."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from vcal.cli import app
from vcal.reproduce import REPRODUCTIONS, reproduction
from vcal.reproduce.artefact_design.results import Effort, Results

FEW = (("N", 5), ("N", 11), ("N", 17))
LITTLE = Effort(
    drawn={"S": FEW, "P": (), "B": ()},
    searched=("poses", "poses, balls within 60 mm", "poses, artefact within 250 mm"),
    starts=1,
    steps=4,
    shapes={7: (4, 6)},
)


@pytest.mark.campaign
def test_the_folder(tmp_path, monkeypatch):
    def little(draws, seed, progress):
        return Results(draws, seed, progress, LITTLE)

    few = replace(reproduction("artefact-design"), compute=little)
    monkeypatch.setitem(REPRODUCTIONS, few.name, few)
    out = tmp_path / "out"
    done = CliRunner().invoke(
        app, ["reproduce", "artefact-design", "--out", str(out), "--draws", "200"]
    )
    assert done.exit_code == 0, done.output
    record = json.loads((out / "result.json").read_text())
    assert {p.name for p in out.iterdir()} == set(record["files"])
    rows = {row["quantity"]: row for row in record["table"]}
    # Closed forms of the family: 33.8 um as measured by hand in test_artefact_design.
    assert rows["rms before compensation"]["vcal"] == pytest.approx(33.76, abs=0.01)
    for known in "SPB":
        nominal = rows[f"rms, nominal design, {known}"]["vcal"]
        drawn = record["nominal"][known]["rms_um"]
        assert drawn == pytest.approx(nominal, rel=0.08)  # 400 machines
        for name, one in record["searched"][known].items():
            assert one["rms_um"] < nominal, name
            assert one["gain"] == pytest.approx(1.0 - one["rms_um"] / nominal)
            assert one["machines"]["failed"] == 0
        sweep = {(s["varied"], s["value"]): s["aligned_um"] for s in record["sweeps"][known]}
        assert len(sweep) == 21
        for varied in "Nab":
            line = [v for (name, _), v in sorted(sweep.items()) if name == varied]
            assert (np.diff(line) < 0.0).all()
    page = (out / "index.html").read_text()
    assert all(f"{section}</h2>" in page for section in ("Error against time", "A star stylus"))


def test_too_few_machines(tmp_path):
    done = CliRunner().invoke(
        app, ["reproduce", "artefact-design", "--out", str(tmp_path / "out"), "--draws", "10"]
    )
    assert done.exit_code == 2
    assert "found draws = 10, seed = 0, expected at least 100 draws" in done.output
    assert not (tmp_path / "out").exists()
