"""``.. vcal-published::``: the table of published evaluations of uncertainty."""

from sphinx.application import Sphinx

from . import rst
from .published_examples import EXAMPLES

_HEADER = ("source", "quantity", "expected", "GUM", "Monte Carlo", "data from")
_UNITS = {"ohm": "Ω", "mohm": "mΩ", "uV": "µV", "um": "µm"}


def published() -> str:
    """The table of all examples, computed now."""
    rows = []
    for one in EXAMPLES:
        budget, ensemble = one.budget(), one.ensemble()
        for i, p in enumerate(one.printed):
            found = one.by_gum(p, budget), one.by_draws(p, ensemble)
            name = p.output if p.what == "y" else p.what if p.output == "y" else f"u({p.output})"
            unit = f" / {_UNITS.get(p.unit, p.unit)}" if p.unit else ""
            rows.append(
                (
                    "" if i else f"{one.source}: {one.subject}",
                    f"{name}{unit}",
                    p.text.replace("-", "−"),
                    *(f"{x:.{p.decimals + 1}f}".replace("-", "−") for x in found),
                    "" if i else one.data,
                )
            )
    return rst.table(_HEADER, rows)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("vcal-published", rst.directive(published))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
