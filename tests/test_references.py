"""References to modules, names and files of vcal in docstrings and documentation exist."""

import importlib
import inspect
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAME = re.compile(r"`(vcal(?:\.[A-Za-z_]\w*)+)(?:\([^`]*\))?`")
"""A dotted name in backticks, with or without a call."""
PATH = re.compile(r"(?<![\w/.-])vcal/[\w./-]*\w\.\w+")
"""A file of the package by its path."""


def texts() -> list[Path]:
    """Source files, tests, and pages of the documentation."""
    found = [ROOT / "README.md"]
    for folder, endings in (("vcal", "py j2"), ("tests", "py"), ("notebooks", "md ipynb")):
        for ending in endings.split():
            found += sorted((ROOT / folder).rglob(f"*.{ending}"))
    return [path for path in found if path != Path(__file__).resolve() and not _built(path)]


def _built(path: Path) -> bool:
    """Whether a file is in a folder of build results or of checkpoints."""
    return any(part.startswith((".", "_")) for part in path.relative_to(ROOT).parts[:-1])


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one, of a class or of its instances."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            fields = (inspect.get_annotations(kind) for kind in _bases(found))
            if not hasattr(found, part) and not any(part in own for own in fields):
                return False
            found = getattr(found, part, None)
        return True
    return False


def _bases(thing: object) -> tuple[type, ...]:
    return thing.__mro__ if isinstance(thing, type) else ()


def places(pattern: re.Pattern[str]) -> dict[str, list[str]]:
    """Every match of a pattern, with the files and lines where it is found."""
    found: dict[str, list[str]] = {}
    for path in texts():
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            for match in pattern.finditer(line):
                text = match[match.re.groups and 1]
                found.setdefault(text, []).append(f"{path.relative_to(ROOT)}:{number}")
    return found


def test_every_name_exists():
    found = places(NAME)
    assert len(found) > 20
    assert {name: at for name, at in found.items() if not exists(name)} == {}


def test_every_file_exists():
    found = places(PATH)
    assert found
    assert {path: at for path, at in found.items() if not (ROOT / path).is_file()} == {}


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("vcal.machine.chain", True),
        ("vcal.machine.chain.Joint.sign", True),
        ("vcal.model.Terms.offset", True),  # a field without a default
        ("vcal.identification.fit.Fit.theta", True),
        ("vcal.chain", False),
        ("vcal.machine.chain.Joint.sing", False),
        ("vcal.identify.nothing", False),
    ],
)
def test_a_name_that_is_gone_is_found(name, there):
    assert exists(name) is there


@pytest.mark.parametrize(("name", "most"), [("README.md", 130), ("benchmarks/README.md", 250)])
def test_a_readme_is_no_manual(name, most):
    assert len((ROOT / name).read_text(encoding="utf-8").splitlines()) <= most
