"""The section on recorded accelerometers and inclinometers, which may confirm a tilt."""

from ...loop.outcome.closure import Closure
from ...loop.outcome.confirmed import confirmations
from ..html import text
from ..html.sheet import Section, Table


def recorded_responses(closure: Closure) -> list[Section]:
    """Every recorded response against every identified effect that tilts a body; no section
    without any.
    """
    rows = [
        (
            one.column,
            one.effect,
            text.with_uncertainty(one.coefficient, one.expanded),
            text.with_uncertainty(one.across, one.across_expanded),
            text.percent(one.share),
            text.probability(one.p_value),
        )
        for one in confirmations(closure)
    ]
    if not rows:
        return []
    header = ("column", "effect", "coefficient ± U", "across ± U", "share of variance", "p")
    note = (
        "Coefficient: recorded change per change that the effect predicts, one where the sensor is "
        "on the body that tilts and its axis is that of its name; across: the same for a sensor "
        "turned by 90° about the vertical. U: expanded uncertainty (95 %). The share is what both "
        "describe beyond a linear drift, and p its probability without any relation."
    )
    return [
        Section(
            "Recorded tilt",
            (
                "Accelerometers and inclinometers respond to a tilt and cause none. They are not "
                "used to identify an effect, so that they can confirm it.",
            ),
            tables=(Table(header, rows, "llrrrr", note=note),),
            minor=True,
        )
    ]
