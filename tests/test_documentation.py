"""Every code block of the documentation runs and prints what the page shows below it."""

from pathlib import Path

import jsonschema
import pytest

from pages import NOTEBOOKS, PageError, alike, blocks, differences, pages, run, tier
from report_schema import SCHEMA
from vcal import StudyError
from vcal.effects import CATALOGUE
from vcal.instruments import INSTRUMENTS

RUNS = ("sh", "python", "toml")
RUNNING = [page for page in pages() if any(block.kind in RUNS for block in blocks(page))]


def name_of(page: Path) -> str:
    """`how-to/design`, say."""
    root = NOTEBOOKS if NOTEBOOKS in page.parents else NOTEBOOKS.parent
    return page.relative_to(root).with_suffix("").as_posix()


@pytest.fixture
def own_classes_forgotten():
    """What a page registers is forgotten after it."""
    before = dict(CATALOGUE), dict(INSTRUMENTS)
    yield
    for catalogue, known in zip((CATALOGUE, INSTRUMENTS), before, strict=True):
        catalogue.clear()
        catalogue.update(known)


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # a page may leave a file to the collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(
            page,
            id=f"{page.parent.name}/{page.stem}",
            marks=getattr(pytest.mark, tier(page)) if tier(page) else (),
        )
        for page in RUNNING
    ],
)
def test_blocks_of_a_page(page, tmp_path, programs, own_classes_forgotten):
    folder = tmp_path / "page"
    folder.mkdir()
    printed = run(page, folder, programs | {"XDG_CACHE_HOME": str(tmp_path / "cache")})
    assert not (found := differences(page, printed)), "\n".join(found)


def test_no_block_is_of_an_unknown_kind():
    """Only these are run, checked or meant for the eye; `text` and `powershell` are neither."""
    known = {"sh", "python", "toml", "text", "powershell", "csv", "json", "mermaid"}
    kinds = {block.kind: page.name for page in pages() for block in blocks(page)}
    assert kinds.keys() <= known, kinds


# --- the runner itself ---------------------------------------------------------------------------


def page_of(tmp_path: Path, text: str) -> Path:
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    (tmp_path / "folder").mkdir(exist_ok=True)
    return page


def test_blocks_share_a_folder_and_a_namespace(tmp_path):
    page = page_of(
        tmp_path,
        """
<!-- python
import json
-->

<!-- file: deep/one.toml -->
```toml
value = 3
```

```sh
wc -l < deep/one.toml
```

```text
1
```

:::{note}
```python
from pathlib import Path
print(json.dumps({"value": int(Path("deep/one.toml").read_text().split()[-1])}))
```
```text
{"value": 4}
```
:::
""",
    )
    printed = run(page, tmp_path / "folder")
    assert [b.kind for b in blocks(page)] == ["python", "toml", "sh", "text", "python", "text"]
    assert printed[4] == '{"value": 3}\n'
    (said,) = differences(page, printed)
    assert said.startswith("page.md, line 25:") and '{"value": 4}' in said


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("```sh\nfalse\n```\n", r"page.md, line 2: exit code 1"),
        ("```toml\na = \n```\n", "found no TOML"),
        ("```toml\nmachine.chian = ''\ninstrument.kind = 'r_test'\n```\n", "machine.chian"),
        ("```sh\ntrue\n", "line 1: found no end of the block"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, message):
    with pytest.raises((PageError, StudyError), match=message):
        run(page_of(tmp_path, text), tmp_path / "folder")


@pytest.mark.parametrize(
    ("said", "printed", "same"),
    [
        ("size = 11.98 um", "size  =\n11.97 um", True),
        ("size = 11.98 um", "size = 12.98 um", False),
        ("p = 1e-53", "p = 9.9e-54", True),
        ("48 rows", "49 rows", False),
        ("a\n...\nz", "a b c z", True),
        ("a\n...\nz", "a b c", False),
        ("...\nz", "z", True),
        ("a\n...\nm\n...\nz", "a m b z", True),
        ("a\n...\nm\n...\nz", "a b z", False),
        ("", "something", False),
    ],
)
def test_output_is_compared_up_to_last_digits(said, printed, same):
    assert alike(said, printed) == same


# --- what is made from the source -----------------------------------------------------------------


@pytest.mark.slow
def test_every_effect_has_a_page_with_a_picture():
    """The site shows these pages; it need not make them again."""
    pytest.importorskip("sphinx")
    from _site import effects

    effects.write(NOTEBOOKS)
    assert effects.is_written(NOTEBOOKS / effects.FOLDER)
    for name in CATALOGUE:
        page = (NOTEBOOKS / effects.FOLDER / f"{name}.rst").read_text(encoding="utf-8")
        assert f".. figure:: {name}.png" in page and "Parameters" in page
        assert (NOTEBOOKS / effects.FOLDER / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_every_key_of_a_study_file_has_a_meaning():
    pytest.importorskip("sphinx")
    from _site import study_keys

    tables = study_keys.tables()
    paths = [one.path for one in tables]
    assert len({one.label for one in tables}) == len(paths)
    for kind in INSTRUMENTS:
        assert f'[instrument] kind = "{kind}"' in paths
    assert all(key.meaning and key.holds for one in tables for key in one.keys)


def test_docstrings_are_read_as_plain_text():
    pytest.importorskip("sphinx")
    from _site.docstrings import to_rst

    text = """First *word* of 2 * x_ and |v|, `Name` and ``a = 1`` and `k = 2`s:

    f = a * b

- one, which
  goes on
- two"""
    assert to_rst(text.split("\n")) == [
        "First *word* of 2 \\* x\\_ and \\|v\\|, :py:obj:`Name` and ``a = 1`` and ``k = 2``\\ s:",
        "",
        ".. code-block:: text",
        "",
        "   f = a * b",
        "",
        "- one, which",
        "  goes on",
        "",
        "- two",
        "",
    ]


@pytest.mark.parametrize(
    ("page", "addresses"),
    [
        ('<script src="https://x.org/a.js">', ["https://x.org/a.js"]),
        ('<link rel="stylesheet" href="//x.org/a.css">', ["//x.org/a.css"]),
        ('<img alt="" src="http://x.org/a.png">', ["http://x.org/a.png"]),
        ('<a href="https://x.org">x</a> <img src="_images/a.png">', []),
        ('<link rel="canonical" href="https://x.org/">', []),
    ],
)
def test_what_a_page_would_fetch(page, addresses):
    pytest.importorskip("sphinx")
    from _site.offline import fetched

    assert fetched(page) == addresses


# --- the schema of report.json ------------------------------------------------------------------


def test_the_schema_of_a_report_describes_every_key():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)

    def described(part, path):
        if "properties" in part:
            assert part.get("additionalProperties") is False or path.endswith("study"), path
        for key, one in part.get("properties", {}).items():
            said = one.get("description") or "$ref" in one
            assert said, f"{path}.{key}"
            described(one, f"{path}.{key}")
        for one in [part.get("items", {}), *part.get("anyOf", [])]:
            if one:
                described(one, f"{path}[]")

    described(SCHEMA, "report")
    for name, part in SCHEMA["$defs"].items():
        described(part, name)
