"""The folder that `vcal reproduce acceleration` leaves, with few machines."""

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from vcal.cli import app


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("acceleration") / "out"
    done = CliRunner().invoke(
        app, ["reproduce", "acceleration", "--out", str(out), "--draws", "20", "--seed", "3"]
    )
    assert done.exit_code == 0, done.output
    return out


@pytest.mark.campaign
def test_the_table(folder):
    record = json.loads((folder / "result.json").read_text())
    assert {p.name for p in folder.iterdir()} == set(record["files"])
    rows = {row["quantity"]: row["vcal"] for row in record["table"]}
    # Closed form: S = 20 mm, J = 250 m/s^3.
    peak = (0.02 * 250.0**2 / 2.0) ** (1.0 / 3.0)
    assert rows["positioning, peak of the set acceleration"] == pytest.approx(peak, rel=1e-9)
    assert rows["positioning, peak of the actual acceleration"] == pytest.approx(7.9, rel=0.03)
    assert rows["EXZ, simulated, circle in YZ"] == pytest.approx(-0.55, abs=0.005)
    u = 1.0 * np.array(record["joint"]["u"])[0, 2]
    assert rows["EXZ, measured, all circles at once"] == pytest.approx(-1.55, abs=0.01 + 2 * u)
    found = [i for i in record["identified"] if i["name"] == "stiffness of carriages of Z"]
    low, high = found[0]["interval"]
    factor = record["carriages_over_catalogue"]["carriages of Z"]
    assert low - 0.002 < factor < high + 0.002
    assert record["chi2"] == pytest.approx(record["readings"], rel=0.3)
    foretold = rows["the same as the identified machine foretells it"]
    seen = rows["positioning, cross-talk at the peak, machine that is measured"]
    assert foretold == pytest.approx(seen, rel=0.02)
    assert rows["positioning, cross-talk at that peak"] < 0.5 * seen
    # Low accelerations scatter more, as the publication says.
    scatter = record["evaluated"]["measured"]["actual"]["dispersion"]
    assert scatter["0.5"] > 3 * scatter["4.5"]
    for name, one in record["compensated"]["by circles"].items():
        assert one["after_um"] < 0.1 * one["before_um"] or one["before_um"] < 1.0, name
    assert record["campaign"]["converged"] >= 19


@pytest.mark.campaign
def test_the_page(folder):
    page = (folder / "index.html").read_text()
    for title in ("From circles to the matrix", "From circles to the machine", "Many machines"):
        assert f"{title}</h2>" in page
    words = re.sub(r"<[^>]*>", " ", page)  # pictures are attributes
    assert not re.search(r"\bnan\b|\d\.?\d*e-\d", words)


def test_too_few_machines(tmp_path):
    out = str(tmp_path / "out")
    done = CliRunner().invoke(app, ["reproduce", "acceleration", "--out", out, "--draws", "5"])
    assert done.exit_code == 2 and "expected at least 20 draws" in " ".join(done.output.split())
