"""Pages: pictures in pieces, scenes as data that harm nobody, and printing by a browser."""

import io
import json
import os
import re

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from vcal import CATALOGUE, StudyError
from vcal.cli import app
from vcal.demo import FOLDER as DEMO
from vcal.plots import cut
from vcal.plots.panels import Panel, mark, panels
from vcal.plots.style import DPI, figure, grid
from vcal.report import Section, sheet
from vcal.report.effects.related import related
from vcal.report.html import pdf
from vcal.report.html.folder import Contents, ReportFolder
from vcal.report.html.picture import LEAST_PX, Picture
from vcal.report.html.scene import Layer, Places, Scene
from vcal.words import printable


def pixels(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)))


def whole(found) -> np.ndarray:
    """The pieces side by side and row below row."""
    return np.vstack([np.hstack([pixels(one.data) for one in row]) for row in found.rows])


def test_pieces_are_the_figure():
    """Every pixel, in two rows of three panels with a title each."""
    rows = [[Panel(f"{r} {c}", "x, mm", "y", [mark("plot", [0, 1], [0, c])]) for c in range(3)]
            for r in range(2)]  # fmt: skip
    found = cut(panels(*rows, width=9.6, height=5.4))
    assert [len(row) for row in found.rows] == [3, 3] and not found.colours
    np.testing.assert_array_equal(whole(found), pixels(found.whole))
    assert found.text_px == pytest.approx(9.0 * DPI / 72.0)  # the labels of the ticks
    assert not any(piece.strip for row in found.rows for piece in row)
    for row in found.rows:
        for piece in row:  # nothing is drawn where it was cut
            assert (pixels(piece.data)[:, [0, -1]] == 255).all()


def test_shared_labels_are_repeated_and_shared_columns_stay_together():
    drawn = figure(9.6, 5.4)
    margins = {"left": 0.8, "right": 0.2, "top": 0.3, "bottom": 0.5, "wspace": 0.4, "hspace": 0.4}
    table = grid(drawn, 2, 2, margins, sharey=True)
    for ax in table.flat:
        ax.plot([0, 1], [0, 1])
    for ax in table[0]:
        ax.tick_params(labelbottom=False)
    found = cut(drawn)
    ((first, second),) = found.rows  # one row: the upper panels have no labels of x
    assert not first.strip and second.strip
    strip = pixels(second.strip)
    np.testing.assert_array_equal(strip, pixels(found.whole)[:, : second.strip_width])
    assert (strip != 255).any()
    np.testing.assert_array_equal(whole(found), pixels(found.whole))


def test_a_colour_bar_stays_with_its_panel():
    drawn = figure(9.6, 3.0)
    margins = {"left": 0.8, "right": 1.2, "top": 0.3, "bottom": 0.5, "wspace": 0.8}
    row = grid(drawn, 1, 2, margins)[0]
    image = [ax.imshow(np.eye(3), aspect="auto") for ax in row][-1]
    place = row[-1].get_position()
    drawn.colorbar(image, cax=drawn.add_axes((place.x1 + 0.02, place.y0, 0.02, place.height)))
    found = cut(drawn)
    assert [len(one) for one in found.rows] == [2] and found.colours
    np.testing.assert_array_equal(whole(found), pixels(found.whole))


def test_a_picture_does_not_shrink_below_readable_text():
    drawn = figure(4.0, 2.0)
    drawn.text(0.5, 0.5, "words", fontsize=7.2)
    picture = Picture.of("one", "", "caption", drawn)
    assert picture.least == pytest.approx(LEAST_PX / 11.0)
    page = sheet("t", "s", [Section("p", pictures=(picture,))])
    assert f'style="--m:{picture.least:.4f}"' in page and 'data-text="11.00"' in page
    assert page.count("<script") == 0 and "script-src" not in page


def test_a_scene_is_data_that_ends_no_script():
    words = "</script><!--<img onerror=x>& \u2028"
    vectors = np.array([[3.0, -4.0, 0.0], [np.nan, 1.0, 1.0], [0.0, 0.0, 0.0123]])
    points = np.array([[0.0, 1.0, 2.0], [1e3, 0, 0], [123456.78, 0, 0]])
    scene = Scene(words, words, [Places(points)], [Layer(words, 0, vectors=vectors)])
    assert not re.search("[<>&\u2028]", scene.json)
    content = json.loads(scene.json)
    (layer,), (places,) = content["layers"], content["places"]
    assert content["title"] == layer["name"] == words
    assert places["points"] == [0, 1, 2, 1000, 0, 0, 123460, 0, 0]
    values = [np.nan if v is None else v * layer["step"] for v in layer["values"]]
    np.testing.assert_allclose(np.reshape(values, (3, 3)), vectors, atol=0.0041)
    page = sheet(words, words, [Section(words, (words,), scenes=(scene,))])
    assert re.findall("<script[^>]*>", page) == ['<script type="application/json">', "<script>"]
    assert "<img" not in page


def test_a_grid_is_stored_by_its_axes():
    nodes = [np.array([0.0, 50.0, 100.0]), np.array([0.0, 1.0]), np.array([-5.0, 5.0])]
    points = np.stack(np.meshgrid(*nodes, indexing="ij"), -1).reshape(-1, 3)
    sizes = np.arange(12.0)
    scene = Scene("", "", [Places(points, (3, 2, 2))], [Layer("u", 0, sizes=sizes)])
    content = json.loads(scene.json)
    assert content["places"] == [{"nodes": [line.tolist() for line in nodes]}]
    (layer,) = content["layers"]
    assert not layer["vectors"]
    np.testing.assert_allclose(np.array(layer["values"]) * layer["step"], sizes, atol=0.0111)


def test_control_characters_of_a_long_text():
    assert printable("a\x1b[2J\n\tb\u202e", lines=True) == "a\\x1b[2J\n\tb\\u202e"
    assert printable("a\nb µ", lines=False) == "a\\nb µ"


# --- printing ----------------------------------------------------------------------------------

FOLDER = ReportFolder("r.json", "r/")


def written(out):
    """A small report; returns its page."""
    return FOLDER.publish(out, lambda work: Contents({"schema": "r/1"}, {"index.html": "page"}))


def pretend(path, monkeypatch, body: str):
    """A browser that does what this shell script says."""
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{path.parent}:/usr/bin:/bin")
    monkeypatch.setattr(pdf, "_NAMES", (path.name,))
    monkeypatch.setattr(pdf, "_places", lambda: iter(()))


posix = pytest.mark.skipif(os.name == "nt", reason="the browser is a shell script")
PRINTS = """for one in "$@"; do case $one in --print-to-pdf=*) out=${one#*=};; esac; done
printf '%s' "%PDF-1.4 $one" > "$out" """


@posix
def test_the_pdf_is_a_file_of_the_report(tmp_path, monkeypatch):
    pretend(tmp_path / "browser", monkeypatch, PRINTS)
    page = written(tmp_path / "out")
    printed = pdf.print_page(page)
    assert printed.read_text() == f"%PDF-1.4 {page.resolve().as_uri()}"
    assert FOLDER.files(page.parent) == ["r.json", "index.html", "index.pdf"]
    pdf.print_page(page)  # again
    FOLDER.check(page.parent)
    printed.write_text("my notes")
    with pytest.raises(StudyError, match="index.pdf, not as the earlier report left it"):
        FOLDER.check(page.parent)
    pdf.print_page(page)
    written(page.parent)  # without a PDF: that of the earlier page goes
    assert sorted(p.name for p in page.parent.iterdir()) == ["index.html", "r.json"]


@posix
def test_a_file_of_the_user_is_not_printed_over(tmp_path, monkeypatch):
    pretend(tmp_path / "browser", monkeypatch, PRINTS)
    page = written(tmp_path / "out")
    page.with_suffix(".pdf").write_text("mine")
    with pytest.raises(StudyError, match="found index.pdf, which is no part of the report"):
        pdf.print_page(page)
    assert page.with_suffix(".pdf").read_text() == "mine"


@posix
def test_a_browser_that_fails_leaves_the_report(tmp_path, monkeypatch):
    pretend(tmp_path / "browser", monkeypatch, "echo no display >&2; exit 1")
    page = written(tmp_path / "out")
    with pytest.raises(StudyError, match="printed nothing .no display.*print it to a PDF there"):
        pdf.print_page(page)
    FOLDER.check(page.parent)
    assert page.is_file()


@posix
@pytest.mark.parametrize("words", [["check", "SETUP"], ["effects", "backlash"]])
def test_commands_with_a_page_print_it(words, tmp_path, monkeypatch):
    pretend(tmp_path / "browser", monkeypatch, PRINTS)
    words = [str(DEMO / "setup.toml") if word == "SETUP" else word for word in words]
    out = tmp_path / "out"
    done = CliRunner().invoke(app, [*words, "--out", str(out), "--pdf"])
    assert done.exit_code == 0, done.output
    (printed,) = out.glob("*.pdf")
    assert printed.read_text().startswith("%PDF-") and str(printed.name) in done.output
    done = CliRunner().invoke(app, [*words, "--pdf"])
    assert done.exit_code == 2 and "found no --out" in done.output


def test_without_a_browser_the_message_says_what_to_do(monkeypatch):
    monkeypatch.setattr(pdf, "_NAMES", ())
    monkeypatch.setattr(pdf, "_places", lambda: iter(()))
    with pytest.raises(StudyError, match="apt install chromium.*print it to a PDF there"):
        pdf.find_browser()


# --- related effects ---------------------------------------------------------------------------


def test_effects_of_one_cause_are_related_to_one_another():
    names = ("thermal_tilt", "scale_growth", "base_compliance", "column_compliance", "backlash")
    found = related([CATALOGUE[name] for name in names], dict.fromkeys(names))
    assert found["thermal_tilt"].family == ("scale_growth",)
    assert found["base_compliance"].family == ("column_compliance",)  # by their base class
    assert found["backlash"] == ((), (), "")
    for one, others in found.items():
        assert all(one in found[other].family for other in others.family)
