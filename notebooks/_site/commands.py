"""``.. vcal-commands::``: every command with its arguments and options, from the command line."""

import typer
from sphinx.application import Sphinx

from vcal.cli import app as command_line

from . import rst


def commands() -> str:
    """A section for each command, in the order of ``vcal --help``."""
    group = typer.main.get_command(command_line)
    top = typer.Context(group, info_name="vcal")
    found = rst.table(
        ("command", "what it does"),
        [
            (f":ref:`vcal {name} <command-{name}>`", rst.text(_first(command.help)))
            for name, command in group.commands.items()
        ],
    )
    for name, command in group.commands.items():
        context = typer.Context(command, info_name=name, parent=top)
        usage = command.get_usage(context).removeprefix("Usage: ")
        found += rst.heading(f"vcal {name}", "-", f"command-{name}")
        found += f".. code-block:: text\n\n   {usage}\n\n{rst.text(command.help or '')}\n\n"
        records = (parameter.get_help_record(context) for parameter in command.params)
        rows = [(f"``{said[0]}``", rst.text(said[1])) for said in records if said]
        found += rst.table(("argument or option", "meaning"), rows)
    return found


def _first(text: str | None) -> str:
    return (text or "").split("\n\n")[0]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("vcal-commands", rst.directive(commands))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
