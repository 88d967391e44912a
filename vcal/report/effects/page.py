"""Pages of the effects catalogue: definition, parameters, required columns, signature, use."""

import inspect
import math
import shlex
from collections.abc import Mapping, Sequence

from ...effects.base import Effect, Setup
from ...instruments.conditions import file_name
from ...study.study import looked_for
from ...words import counted
from ..html.picture import Picture
from ..html.sheet import Section, Table, sheet
from ..html.text import DASH, number, sentence_of, unit
from .related import Related

Example = tuple[Effect, Setup]
"""An instance of an effect, on a plan that has everything it needs."""


INDEX = "index.html"
"""File of the list of effects."""


def page(
    effect: type[Effect],
    example: Example | None,
    drawn: Picture | None = None,
    others: Related | None = None,
    summaries: Mapping[str, str] | None = None,
) -> str:
    """The page of an effect as HTML, with the picture of its signature.

    `others` are the related effects, whose pages lie beside this one; `summaries` describe them.
    """
    text = inspect.cleandoc(effect.__doc__ or "").split("\n\n")
    paragraphs = tuple(" ".join(part.replace("`", "").split()) for part in text)
    sections = [Section("Definition", paragraphs)]
    if example is not None:
        sections.append(needs(*example))
        if drawn is not None:
            sections.append(Section("Signature", pictures=(drawn,)))
        sections.append(use(example[0], looked_for(effect)))
    if others is not None:
        sections.append(related_effects(others, summaries or {}))
    return sheet(
        effect.name,
        sentence_of(effect.summary),
        sections,
        kicker="vcal effects",
        facts=[("disturbs", f"the {effect.where}"), ("kind", effect.kind)],
    )


def related_effects(others: Related, summaries: Mapping[str, str]) -> Section:
    """The related effects with links to their pages, and a link to the list of all."""
    by_column = f"depends on the same column: {others.column}"
    reasons = {
        name: "; ".join(
            ["same cause"] * (name in others.family) + [by_column] * (name in others.rivals)
        )
        for name in dict.fromkeys((*others.rivals, *others.family))
    }
    rows = [(name, summaries.get(name, ""), why) for name, why in reasons.items()]
    whole = "The catalogue of effects"
    return Section(
        "Related effects",
        ("Effects that depend on the same column may be mistaken for one another: the loop "
         "separates them by how the readings depend on the other columns.",) * bool(others.rivals),
        tables=(
            Table(("effect", "description", "related because"), rows,
                  links={name: f"{name}.html" for name in reasons}),
            Table(("",), [(whole,)], links={whole: INDEX}),
        ),
    )  # fmt: skip


def catalogue(effects: Sequence[type[Effect]]) -> str:
    """The list of effects as HTML, with links to their pages."""
    rows = [(effect.name, effect.summary, effect.where, effect.kind) for effect in effects]
    links = {name: f"{name}.html" for name, *_ in rows}
    table = Table(("effect", "description", "disturbs", "kind"), rows, links=links)
    return sheet(
        "The catalogue of effects",
        f"{counted(len(effects), 'effect')}; each has a page beside this one.",
        [Section("Effects", tables=(table,))],
        kicker="vcal effects",
    )


def needs(instance: Effect, setup: Setup) -> Section:
    """Its parameters with their priors, and the columns it needs."""
    axes = setup.plan.axes
    rows = [
        (
            p.name,
            unit(p.unit) or DASH,
            "searched" if p.shape else number(p.sigma) if math.isfinite(p.sigma) else "flat",
        )
        for p in instance.parameters
    ]
    needed = dict.fromkeys(file_name(n, axes) for n in instance.needs)
    shown = dict.fromkeys(file_name(n, axes) for n in instance.indicators)
    terms = [
        ("required columns", ", ".join(needed) or "none"),
        ("depends on", ", ".join(shown) or "nothing that is recorded"),
        ("placement in this example", instance.placement or "none of its own"),
    ]
    return Section(
        "Parameters and required columns",
        tables=(
            Table(("parameter", "unit", "prior, standard deviation"), rows, "llr"),
            Table(("", ""), terms),
        ),
    )


def use(instance: Effect, searched: bool) -> Section:
    """How to declare it in a study, to simulate it, and to search for it."""
    place = f":{instance.placement}" if instance.placement else ""
    keys = ",".join(f"{p.label}={p.sigma:g}" for p in instance.amplitudes[:2])
    declared = [f'name = "{instance.name}"']
    declared += [f'placement = "{instance.placement}"'] if instance.placement else []
    declared += [f"{p.label} = {p.sigma:g}" for p in instance.amplitudes[:2]]
    left_out = "is identified" if instance.kind == "systematic" else "keeps its prior"
    simulated = shlex.quote(f"{instance.name}{place}:{keys}")
    search = "The loop does not search for it: it can be declared in a study."
    if searched:
        search = "Searched for alone: vcal loop SETUP.toml --out DIR --effects " + instance.name
    return Section(
        "Use",
        points=(
            f"Declared in a study: [[model.effect]] with {', '.join(declared)}; a parameter "
            f"without a value {left_out}.",
            f"Simulated: vcal simulate SETUP.toml --out DIR --with {simulated}",
            search,
        ),
    )
