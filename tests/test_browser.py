"""Pages in a browser: at three widths, dark, printed, and without a byte from elsewhere."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import vcal
from browser import Browser, find
from vcal import CATALOGUE, close_loop, load_study
from vcal.demo import FOLDER
from vcal.fleet.index import write_index
from vcal.fleet.one_study import Job, Member
from vcal.report import Section, Table, sheet, write_report
from vcal.report.check.write import write_check
from vcal.report.effects.write import write_effects
from vcal.report.html.pdf import print_page
from vcal.report.html.scene import Layer, Places, Scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find() is None, reason="no Chromium or Chrome is installed"),
    pytest.mark.skipif(os.name == "nt", reason="the browser is driven over POSIX pipes"),
]
WIDTHS = (390, 768, 1200)
A4_PX = 673
"""Width between the margins of a printed page, CSS pixels."""
HOSTILE = "</script><script>window.harm = 1</script><img src=x onerror='window.harm = 2'>"

TOO_SMALL = """(() => {
  const found = [], walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const one = walk.currentNode.parentElement;
    if (!walk.currentNode.data.trim() || one.tagName === 'SCRIPT' || !one.getClientRects().length)
      continue;
    const size = parseFloat(getComputedStyle(one).fontSize);
    if (size < 8) found.push([one.tagName, walk.currentNode.data.slice(0, 40), size]);
  }
  for (const one of document.images) {
    if (one.matches('.strip')) continue;
    const scale = one.getBoundingClientRect().width / one.naturalWidth;
    const size = parseFloat(one.dataset.text) * scale;
    if (!(size >= 7.99)) found.push(['IMG', one.alt.slice(0, 40), size]);
  }
  return found;
})()"""
TOO_WIDE = """[document.documentElement.scrollWidth - document.documentElement.clientWidth,
  ...[...document.querySelectorAll('main *')].filter(one => !one.closest('.scroll, .pieces')
    && one.getBoundingClientRect().right > document.documentElement.clientWidth + 0.5)
    .map(one => one.outerHTML.slice(0, 60))]"""
CONTRASTS = """(() => {
  const rgb = text => text.match(/[\\d.]+/g).slice(0, 3).map(Number);
  const light = text => rgb(text).map(c => c / 255)
    .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = one => {
    const back = getComputedStyle(one).backgroundColor;
    return /, 0\\)$/.test(back) ? behind(one.parentElement) : back;
  };
  const texts = 'p, td, th, h1, h2, h3, a, figcaption, .badge, summary, label';
  return [...document.querySelectorAll(texts)]
    .filter(one => one.textContent.trim() && one.getClientRects().length).map(one => {
      const both = [light(getComputedStyle(one).color), light(behind(one))].sort((a, b) => b - a);
      return [(both[0] + 0.05) / (both[1] + 0.05), one.outerHTML.slice(0, 60)];
    }).filter(one => one[0] < 4.5);
})()"""
CANVAS = """(() => {
  const canvas = document.querySelector('.scene canvas'), context = canvas.getContext('2d');
  const data = context.getImageData(0, 0, canvas.width, canvas.height).data;
  let sum = 0;
  for (let i = 0; i < data.length; i += 1) sum = (sum * 31 + data[i]) >>> 0;
  return sum;
})()"""
STATUS = "document.querySelector('.scene [role=status]').textContent"


def control(words: str) -> str:
    """The control of a scene with this label, as an expression."""
    return (
        f"[...document.querySelectorAll('.scene label')].find(l => l.textContent.startsWith("
        f"{json.dumps(words)})).querySelector('select, input')"
    )


def put(words: str, value: object) -> str:
    """A script that changes a control as a reader does."""
    return (
        f"(c => {{ c.value = {json.dumps(value)}; for (const name of ['input', 'change']) "
        f"c.dispatchEvent(new Event(name, {{bubbles: true}})); }})({control(words)})"
    )


@pytest.fixture(scope="module")
def browser():
    one = Browser(find() or "")
    yield one
    one.close()


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The report of the demo with a short search."""
    vcal.enable_float64()
    study = load_study(FOLDER / "setup.toml")
    assert study.measurement is not None
    effects = [CATALOGUE["thermal_tilt"], CATALOGUE["backlash"]]
    closure = close_loop(
        study.model, study.measurement, check=study.check, effects=effects, draws=100
    )
    return write_report(closure, study, tmp_path_factory.mktemp("loop") / "report")


@pytest.fixture(scope="module")
def pages(reported, tmp_path_factory) -> dict[str, Path]:
    """A page of every kind that costs little to make."""
    folder = tmp_path_factory.mktemp("pages")
    study = load_study(FOLDER / "setup.toml")
    setup = study.model.setup(study.plan)
    effects = [CATALOGUE[name] for name in ("thermal_tilt", "scale_growth")]
    examples = {effect.name: (next(iter(effect.candidates(setup))), setup) for effect in effects}
    scene = Scene(
        HOSTILE,
        HOSTILE,
        [Places(np.eye(3))],
        [Layer(HOSTILE, 0, vectors=np.array([[1.0, 2.0, 2.0], [np.nan, 0, 0], [0, 0, 0.5]]))],
    )
    table = Table((HOSTILE, *map(str, range(9))), [(HOSTILE * 3, *["1.234 ± 0.056"] * 9)])
    hostile = folder / "hostile.html"
    section = Section(HOSTILE, (HOSTILE,), tables=(table,), scenes=(scene,))
    hostile.write_text(sheet(HOSTILE, HOSTILE, [section]), encoding="utf-8")
    return {
        "loop": reported,
        "check": write_check(study, [("label", "text")], folder / "check"),
        "effects": write_effects(effects, examples, folder / "effects"),
        "effect": folder / "effects" / "thermal_tilt.html",
        "hostile": hostile,
        "fleet": _fleet(folder),
    }


def _fleet(folder: Path) -> Path:
    """The list of five studies, one of which is broken and has a hostile name."""
    given = {"b 2": (4.0, 1.25), "a": (12.0, 11.0), "b 10": (0.5, 0.5), "c": (None, None)}
    members = [
        Member(
            Job(folder / name, name, folder / name), "closed",
            content={
                "verdict": "named", "sentence": "", "effects": [],
                "errors": {
                    stage: {"check_rms_um": value, "u_check_rms_um": 0.1}
                    for stage, value in (("uncompensated", before), ("after", after))
                },
            },
        )
        for name, (before, after) in given.items()
    ]  # fmt: skip
    members.append(Member(Job(folder, HOSTILE, folder), "refused", HOSTILE * 3))
    return write_index(members, folder / "fleet")


@pytest.mark.parametrize("name", ["loop", "check", "effects", "effect", "hostile", "fleet"])
def test_pages_are_readable_at_every_width_and_in_print(browser, pages, name):
    browser.media(width=WIDTHS[0])
    browser.open(pages[name])
    for width, kind in (*((width, "screen") for width in WIDTHS), (A4_PX, "print")):
        browser.media(width=width, kind=kind)
        assert browser.run(TOO_WIDE) == [0], (width, kind)
        assert browser.run(TOO_SMALL) == [], (width, kind)
    for scheme in ("light", "dark"):
        browser.media(scheme=scheme)
        assert browser.run(CONTRASTS) == [], scheme
    assert browser.troubles == []
    assert browser.run("window.harm") is None


def test_a_narrow_page_shows_the_panels_of_a_picture_below_one_another(browser, reported):
    tops = """[...document.querySelectorAll('.row')].filter(row => row.children.length > 1)
      .map(row => new Set([...row.children].map(one => one.getBoundingClientRect().top)).size)"""
    browser.media(width=1200)
    browser.open(reported)
    assert set(browser.run(tops)) == {1}
    browser.media(width=390)
    assert min(browser.run(tops)) > 1


def test_print_shows_folded_tables_and_keeps_headings_with_what_follows(browser, reported):
    folded = """[...document.querySelectorAll('details')].map(one =>
      [one.open, one.querySelector('table').checkVisibility()])"""
    browser.media(width=1200)
    browser.open(reported)
    assert browser.run(folded) and {tuple(one) for one in browser.run(folded)} == {(False, False)}
    assert browser.run("document.querySelector('.scene').getClientRects().length") == 1
    browser.media(width=A4_PX, kind="print")
    assert {tuple(one) for one in browser.run(folded)} == {(False, True)}
    assert browser.run("document.querySelector('.scene').getClientRects().length") == 0
    kept = (
        "[...document.querySelectorAll('h2, h3, thead')].map(o => getComputedStyle(o).breakAfter)"
    )
    assert set(browser.run(kept)) == {"avoid"}
    assert browser.pdf().startswith(b"%PDF-")


def test_a_click_on_the_head_of_a_column_sorts_the_rows(browser, pages):
    browser.media(width=1200)
    browser.open(pages["fleet"])
    order = "[...document.querySelectorAll('.sortable tbody tr')].map(r => r.cells[0].textContent)"
    head = "document.querySelectorAll('.sortable th')[{}]"
    assert browser.run(order) == ["b 2", "a", "b 10", "c"]
    for column, way, expected in (
        (3, "ascending", ["b 10", "b 2", "a", "c"]),  # a dash comes after all numbers
        (3, "descending", ["c", "a", "b 2", "b 10"]),
        (0, "ascending", ["a", "b 2", "b 10", "c"]),
    ):
        browser.run(f"{head.format(column)}.click()")
        assert browser.run(order) == expected
        assert browser.run(f"{head.format(column)}.getAttribute('aria-sort')") == way
    browser.run(f"{head.format(5)}.focus()")
    browser.press("Enter")
    assert browser.run(order) == ["b 10", "b 2", "a", "c"]
    assert browser.troubles == []


def test_the_scene_has_the_numbers_of_the_report(browser, reported):
    record = json.loads(reported.with_name("report.json").read_text(encoding="utf-8"))
    browser.media(motion="reduce")
    browser.open(reported)
    names = browser.run(f"[...{control('Shown')}.options].map(o => o.textContent)")
    stages = ("uncompensated", "before", "after")
    for name, stage in zip(names[-3:], stages, strict=True):
        browser.run(put("Shown", names.index(name)))
        (rms,) = browser.run(rf"{STATUS}.match(/rms ([\d.]+)/).slice(1).map(Number)")
        assert rms == pytest.approx(record["errors"][stage]["check_rms_um"], rel=0.01), name


def test_the_scene_follows_keys_and_controls(browser, reported):
    browser.media(width=1200, motion="reduce")
    browser.open(reported)
    browser.run("document.querySelector('.scene canvas').focus()")
    seen = [browser.run(CANVAS)]
    for key in ("ArrowLeft", "ArrowUp", "+"):
        browser.press(key)
        seen.append(browser.run(CANVAS))
    for change in (
        put("Part", "2"), put("Position", 0), put("Drawn as", "grid"), put("Magnification", 10),
        put("Shown", 1),
    ):  # fmt: skip
        browser.run(change)
        seen.append(browser.run(CANVAS))
    assert len(set(seen)) == len(seen)
    browser.press("Home")
    assert "Z = 0 mm" in browser.run("document.querySelector('.scene .controls').textContent")
    label = browser.run("document.querySelector('.scene canvas').getAttribute('aria-label')")
    assert "largest" in label and "µm at X" in label


def test_only_motion_that_the_reader_wants(browser, reported):
    """From one layer to the next in steps, or at once."""
    steps = f"(() => {{ {put('Shown', 1)}; return {CANVAS}; }})()"
    later = f"new Promise(done => setTimeout(() => done({CANVAS}), 600))"
    for motion, same in (("reduce", True), ("no-preference", False)):
        browser.media(motion=motion)
        browser.open(reported)
        assert (browser.run(steps) == browser.run(later)) is same


def test_no_other_script_runs(browser, reported):
    browser.open(reported)
    browser.run("""{ const s = document.createElement('script'); s.textContent = 'window.harm = 1';
      document.body.append(s); document.body.insertAdjacentHTML('beforeend',
      '<img src=x onerror="window.harm = 2">'); }""")
    assert browser.run("new Promise(done => setTimeout(() => done(window.harm), 200))") is None


def test_a_page_is_printed_beside_itself(reported):
    printed = print_page(reported)
    assert printed == reported.with_suffix(".pdf")
    assert printed.read_bytes().startswith(b"%PDF-")
    record = json.loads(reported.with_name("report.json").read_text(encoding="utf-8"))
    assert "index.pdf" in record["files"]
