"""One page for every effect of the catalogue: what it is, what it needs, how it shows."""

import inspect
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..effects.base import Effect, Setup
from ..instruments.conditions import file_name
from ..io.study import looked_for
from ..plots import png, signature, signatures
from .picture import Picture
from .place import Place
from .record import versions
from .sheet import Section, Table, sheet
from .text import DASH, number, unit

_PLACE = Place(record="effects.json", schema="vcal-effects/")
Example = tuple[Effect, Setup]


def effect_page(effect: type[Effect], example: Example | None) -> tuple[str, list[Picture]]:
    """The page of an effect as HTML, and the picture of its signature where there is one.

    `example` is an instance of it on a plan that has everything it needs.
    """
    text = inspect.cleandoc(effect.__doc__ or "").split("\n\n")
    paragraphs = tuple(" ".join(part.replace("`", "").split()) for part in text)
    sections = [Section("What it is", paragraphs)]
    pictures: list[Picture] = []
    if example is not None:
        instance, setup = example
        sections.append(needs(instance, setup))
        pictures = [picture(instance, setup)]
        sections.append(Section("How it shows", pictures=tuple(pictures)))
        sections.append(use(instance, looked_for(effect)))
    page = sheet(
        effect.name,
        f"{effect.summary[:1].upper()}{effect.summary[1:]}.",
        sections,
        kicker="vcal effects",
        facts=[("disturbs", f"the {effect.where}"), ("kind", effect.kind)],
    )
    return page, pictures


def picture(instance: Effect, setup: Setup) -> Picture:
    """What an effect does on the plan of `setup`."""
    caption = (
        "What one standard deviation of every parameter's prior does to the port by which it "
        "moves the tool point most, on a bundled plan; parameters that are looked for stand at "
        "the middle of their scan."
    )
    return Picture(instance.name, "", caption, png(signature(signatures(instance, setup))))


def needs(instance: Effect, setup: Setup) -> Section:
    """Its parameters with their priors, and the columns it needs."""
    axes = setup.plan.axes
    rows = [
        (
            p.name,
            unit(p.unit) or DASH,
            "looked for" if p.shape else number(p.sigma) if math.isfinite(p.sigma) else "flat",
        )
        for p in instance.parameters
    ]
    needed = dict.fromkeys(file_name(n, axes) for n in instance.needs)
    told = dict.fromkeys(file_name(n, axes) for n in instance.betrayed_by)
    where = instance.placement or "no place of its own"
    return Section(
        "Parameters, and what it needs",
        tables=(
            Table(("parameter", "unit", "prior, standard deviation"), rows, "llr"),
            Table(
                ("", ""),
                [
                    ("needs in the data", ", ".join(needed) or "nothing that is recorded"),
                    ("betrayed by", ", ".join(told) or "nothing that is recorded"),
                    ("placed here on", where),
                ],
            ),
        ),
    )


def use(instance: Effect, searched: bool) -> Section:
    """How it is declared, simulated and, where it is `searched`, looked for."""
    place = f":{instance.placement}" if instance.placement else ""
    keys = ",".join(f"{p.label}={p.sigma:g}" for p in instance.amplitudes[:2])
    declared = [f'name = "{instance.name}"']
    declared += [f'placement = "{instance.placement}"'] if instance.placement else []
    declared += [f"{p.label} = {p.sigma:g}" for p in instance.amplitudes[:2]]
    left_out = "is identified" if instance.kind == "systematic" else "keeps its prior"
    simulated = shlex.quote(f"{instance.name}{place}:{keys}")
    return Section(
        "In use",
        points=(
            f"In a study, as part of the model: [[model.effect]] with {', '.join(declared)}; "
            f"a parameter that is left out {left_out}.",
            f"Simulated: vcal simulate SETUP.toml --out DIR --with {simulated}",
            f"Looked for alone: vcal loop SETUP.toml --out DIR --effects {instance.name}"
            if searched
            else "The loop does not look for it: it can be declared in a study.",
        ),
    )


def write_effects(
    effects: Sequence[type[Effect]], examples: Mapping[str, Example | None], out: Path
) -> Path:
    """Pages of effects and a list of them in the folder `out`; returns the path of the list, or of
    the page where there is one only.

    Raises `StudyError` where `out` is a file, or a folder with other things or with changed pages
    in it.
    """

    def make(work: Path) -> Sequence[str]:
        files, listed = [], []
        for effect in effects:
            page, pictures = effect_page(effect, examples[effect.name])
            (work / f"{effect.name}.html").write_text(page, encoding="utf-8")
            files += [f"{effect.name}.html", *(p.file for p in pictures)]
            for picture in pictures:
                (work / picture.file).write_bytes(picture.data)
            listed.append((effect.name, effect.summary, effect.where, effect.kind))
        if len(effects) > 1:
            table = Table(
                ("effect", "what it is", "disturbs", "kind"),
                listed,
                links={name: f"{name}.html" for name, *_ in listed},
            )
            whole = sheet(
                "The catalogue of effects",
                f"{len(effects)} effects; each has a page beside this one.",
                [Section("Effects", tables=(table,))],
                kicker="vcal effects",
            )
            (work / "index.html").write_text(whole, encoding="utf-8")
            files.append("index.html")
        record = {"schema": _PLACE.schema + "1", "versions": versions(), "files": files}
        (work / _PLACE.record).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        return [*files, _PLACE.record]

    _PLACE.fill(out, make)
    return out / ("index.html" if len(effects) > 1 else f"{effects[0].name}.html")
