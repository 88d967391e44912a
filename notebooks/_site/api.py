"""One page for every public module of vcal, from its docstrings."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from sphinx.application import Sphinx

import vcal

from .written import Written

FOLDER = Path("reference", "api")
_PACKAGE = vcal.__name__


def modules() -> Iterator[ModuleType]:
    """vcal and everything below it but what begins with an underscore."""
    yield vcal
    for found in pkgutil.walk_packages(vcal.__path__, f"{_PACKAGE}."):
        if not any(part.startswith("_") for part in found.name.split(".")):
            yield importlib.import_module(found.name)


def first_sentence(thing: object) -> str:
    """The first sentence of a docstring, in one line."""
    paragraph = (inspect.getdoc(thing) or "").split("\n\n")[0]
    head, dot, _ = " ".join(paragraph.split()).partition(". ")
    return head + dot.strip()


def _page(module: ModuleType, below: list[ModuleType]) -> str:
    name = module.__name__
    parents = name.split(".")[:-1]
    # Rooms stand at the side of every page; with all modules that list would be too long.
    lines = [] if len(parents) < 2 else [":orphan:", ""]
    lines += [name, "=" * len(name), ""]
    if parents:
        way = (".".join(parents[: i + 1]) for i in range(len(parents)))
        lines += [" / ".join(f":doc:`{one}`" for one in way), ""]
    lines += [f".. automodule:: {name}", "   :members:", "   :ignore-module-all:", ""]
    handed = [
        each
        for each in getattr(module, "__all__", ())
        if below and getattr(getattr(module, each), "__module__", name) != name
    ]
    if handed:
        lines += _table("Names", [(_home(getattr(module, n), n), n) for n in handed])
    if below:
        lines += _table("Modules", [(one.__name__, one.__name__) for one in below], "mod")
    if not parents:
        lines += [".. toctree::", "   :hidden:", "", *(f"   {one.__name__}" for one in below)]
    return "\n".join(lines) + "\n"


def _home(thing: object, name: str) -> str:
    """Where something that a package hands on is documented."""
    return f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', name)}"


def _table(title: str, names: list[tuple[str, str]], role: str = "obj") -> list[str]:
    lines = [title, "-" * len(title), "", ".. list-table::", "   :widths: auto", ""]
    for target, shown in names:
        said = first_sentence(_thing(target)) or shown
        # As in a docstring: `said` is plain text.
        lines += [f"   * - :py:{role}:`{shown} <{target}>`", f"     - .. plain:: {said}"]
    return [*lines, ""]


def _thing(target: str) -> object:
    """What a dotted name stands for; None where it is an alias or a value without a docstring."""
    parts = target.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        for part in parts[cut:]:
            found = getattr(found, part, None)
        return found
    return None


def _write(app: Sphinx) -> None:
    every = list(modules())
    pages = {}
    for module in every:
        name = module.__name__
        below = [m for m in every if m.__name__.rpartition(".")[0] == name]
        pages[f"{name}.rst"] = _page(module, below)
    Written(Path(app.srcdir) / FOLDER).update(pages)


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before they are read."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
