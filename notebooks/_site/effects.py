"""A page with a picture for every effect, and ``.. vcal-effects::``, the list of them."""

import hashlib
import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from sphinx.application import Sphinx

import vcal
from vcal.cli.start_studies import example
from vcal.effects import CATALOGUE
from vcal.report.effects.page import needs, use
from vcal.report.effects.pictures import picture
from vcal.report.effects.related import Related, related
from vcal.report.html.sheet import Section
from vcal.study.study import looked_for

from . import rst
from .package import BUILD, PACKAGE, package_hash
from .written import Written

FOLDER = Path("reference", "effects")
_KEY = BUILD / "effects.key"


def effects() -> str:
    """A table of all effects by what they disturb."""
    found = ""
    for where in dict.fromkeys(effect.where for effect in CATALOGUE.values()):
        rows = [
            (
                f":doc:`{effect.name} </{FOLDER.as_posix()}/{effect.name}>`",
                rst.text(effect.summary),
                effect.kind,
                "yes" if looked_for(effect) else "no",
            )
            for effect in CATALOGUE.values()
            if effect.where == where
        ]
        found += rst.heading(f"Effects on the {where}", "-")
        found += rst.table(("effect", "what it is", "kind", "the loop looks for it"), rows)
    return found


def _pages() -> Iterator[tuple[str, str | bytes]]:
    """File names with their content."""
    vcal.enable_float64()
    examples = {name: example(effect) for name, effect in CATALOGUE.items()}
    others = related(list(CATALOGUE.values()), examples)
    for effect in CATALOGUE.values():
        # The list at the side of every page names what there is to read, not every effect.
        text = ":orphan:\n\n" + rst.heading(effect.name, "=")
        text += ":doc:`/reference/effects`\n\n"
        text += rst.text(f"{effect.summary[:1].upper()}{effect.summary[1:]}.") + "\n\n"
        text += f"Disturbs the {effect.where}; {effect.kind}.\n\n"
        text += rst.text(inspect.cleandoc(effect.__doc__ or "")) + "\n\n"
        found = examples[effect.name]
        if found is not None:
            instance, setup = found
            drawn = picture(instance, setup)
            text += _section(needs(instance, setup))
            text += rst.heading("How it shows", "-")
            text += f".. figure:: {drawn.file}\n   :alt: {effect.name}\n\n   {drawn.caption}\n\n"
            text += _section(use(instance, looked_for(effect)))
            yield drawn.file, drawn.data
        text += _related(others[effect.name])
        yield f"{effect.name}.rst", text


def _related(others: Related) -> str:
    """Links to the related effects."""
    by_column = f"Effects that depend on the same column, {others.column}"
    found = rst.heading("Related effects", "-") if others.rivals or others.family else ""
    for words, names in ((by_column, others.rivals), ("Of the same cause", others.family)):
        links = ", ".join(f":doc:`{name} </{FOLDER.as_posix()}/{name}>`" for name in names)
        found += f"{rst.text(words)}: {links}.\n\n" if names else ""
    return found


def _section(section: Section) -> str:
    found = rst.heading(section.title, "-")
    for paragraph in section.paragraphs:
        found += rst.text(paragraph) + "\n\n"
    for table in section.tables:
        rows = ([rst.text(cell) for cell in row] for row in table.rows)
        found += rst.table(table.header, rows)
    for point in section.points:
        head, mark, command = point.partition(": ")
        is_command = mark and command.startswith("vcal ")
        found += f"- {rst.text(head)}: ``{command}``\n" if is_command else f"- {rst.text(point)}\n"
    return found + "\n"


def write(source: Path) -> bool:
    """Write the pages below the folder of all pages unless those there are of this vcal; whether
    they had to be written.
    """
    folder = source / FOLDER
    if is_written(folder):
        return False
    Written(folder).update(dict(_pages()))
    _KEY.parent.mkdir(parents=True, exist_ok=True)
    _KEY.write_text(_key(), encoding="utf-8")
    return True


def is_written(folder: Path) -> bool:
    """Whether the pages in a folder are those of this vcal."""
    return folder.is_dir() and _KEY.is_file() and _KEY.read_text(encoding="utf-8") == _key()


def _key() -> str:
    return package_hash().hex() + hashlib.sha256(Path(__file__).read_bytes()).hexdigest()


def _write(app: Sphinx) -> None:
    if is_written(Path(app.srcdir) / FOLDER):
        return
    # In another process, so that the one that builds starts no threads of JAX and may fork.
    command = [sys.executable, "-m", __name__, str(app.srcdir)]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[1], env=_here())


def _here() -> dict[str, str]:
    """The environment of a process that finds the same vcal."""
    paths = [str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before they are read."""
    app.add_directive("vcal-effects", rst.directive(effects))
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


if __name__ == "__main__":
    write(Path(sys.argv[1]))
