"""The picture of an effect: its signature on a plan."""

from ...effects.base import Effect, Setup
from ...plots import signature, signatures
from ..html.picture import Picture


def picture(instance: Effect, setup: Setup) -> Picture:
    """The deviations that an effect causes on the plan of `setup`."""
    caption = (
        "Deviation by one standard deviation of each parameter's prior, at the port through which "
        "the parameter moves the tool point most, on a bundled plan; searched parameters are at "
        "the middle of their scan."
    )
    return Picture.of(instance.name, "", caption, signature(signatures(instance, setup)))
