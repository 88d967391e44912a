"""One page for every public module of vcal, from its docstrings."""

import importlib
import inspect
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType

from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

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


def first_sentence(docstring: str | None) -> str:
    """The first sentence of a docstring, in one line."""
    head, dot, _ = " ".join((docstring or "").split("\n\n")[0].split()).partition(". ")
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
        if below and not inspect.ismodule(getattr(module, each)) and _home(module, each) != name
    ]
    if handed:
        lines += _table("Names", [(f"{_home(module, n)}.{n}", n) for n in handed])
    if below:
        lines += _table("Modules", [(one.__name__, one.__name__) for one in below], "mod")
    if not parents:
        lines += [".. toctree::", "   :hidden:", "", *(f"   {one.__name__}" for one in below)]
    return "\n".join(lines) + "\n"


def _home(module: ModuleType, name: str) -> str:
    """The module in which something that a package hands on is documented."""
    thing = getattr(module, name)
    if inspect.isclass(thing) or inspect.isroutine(thing):
        home = getattr(sys.modules.get(thing.__module__), name, None)
        return thing.__module__ if home is thing else module.__name__
    below = (m for n, m in sorted(sys.modules.items()) if n.startswith(f"{_PACKAGE}."))
    values = (m for m in below if getattr(m, name, None) is thing)
    return next((m.__name__ for m in values if ("", name) in _values(m)), module.__name__)


def _values(module: ModuleType) -> Mapping[tuple[str, str], list[str]]:
    """Docstrings below the values of a module."""
    return ModuleAnalyzer.for_module(module.__name__).find_attr_docs()


def _table(title: str, names: list[tuple[str, str]], role: str = "obj") -> list[str]:
    lines = [title, "-" * len(title), "", ".. list-table::", "   :widths: auto", ""]
    for target, shown in names:
        said = _said(target) or shown  # plain text, as a docstring
        lines += [f"   * - :py:{role}:`{shown} <{target}>`", f"     - .. plain:: {said}"]
    return [*lines, ""]


def _said(target: str) -> str:
    """The first sentence about what a dotted name stands for; empty where there is none."""
    if target in sys.modules:
        return first_sentence(sys.modules[target].__doc__)
    home, _, name = target.rpartition(".")
    value = _values(sys.modules[home]).get(("", name))
    return first_sentence("\n".join(value) if value else getattr(sys.modules[home], name).__doc__)


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
