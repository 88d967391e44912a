"""The pictures of a virtual calibration with their captions."""

from collections.abc import Iterator

import numpy as np

from ... import plots
from ...geometry.error_motions import ErrorMotionTable
from ...plots.virtual import sources, volumetric_bounds, volumetric_histograms
from ...uncertainty.virtual import Motion, VirtualCalibration
from ..html.picture import Picture
from ..html.text import percent


def pictures(result: VirtualCalibration) -> Iterator[Picture]:
    """All pictures in the order of the page."""
    share = percent(result.coverage)
    if not result.faultless:
        caption = (
            "Root-mean-square volumetric error of every machine drawn, before and after "
            f"calibration. Bars below: {share} coverage intervals."
        )
        yield Picture.of("volumetric", "volumetric", caption, volumetric_histograms(result))
    if result.nodes and not result.faultless:
        caption = (
            f"Upper bound of the volumetric error for {share} of the machines, point by point in "
            "three mid-planes of the travel, after rigid alignment: before (top) and after "
            "calibration (bottom), each point under the conditions of a random row of the plan. "
            "One colour scale per row."
        )
        yield Picture.of("field", "field", caption, volumetric_bounds(result))
    if result.contributions:
        caption = (
            "Contribution of every source to the volumetric error after calibration, as a root "
            "mean square over points and machines (GUM). The squares add up."
        )
        yield Picture.of("sources", "sources", caption, sources(result.contributions))
    tables = [_table(motion) for motion in result.motions if motion.prior.any()]
    if tables:
        caption = (
            "Residual error motions after compensation (true minus identified): mean and expanded "
            "uncertainty U (k = 2) by Monte Carlo in blue; grey: the motion before any "
            "measurement (± 2 standard deviations, cut off at the frame). Where blue is as wide "
            "as grey, the plan gives no information."
        )
        yield Picture.of("error_motions", "motions", caption, plots.error_motions(tables))


def _table(motion: Motion) -> ErrorMotionTable:
    rotary = len(motion.position) and motion.axis not in ("X", "Y", "Z")
    prior = np.where(motion.prior > 0.0, motion.prior, np.inf)
    return ErrorMotionTable(
        name=motion.name,
        axis=motion.axis,
        unit=motion.unit,
        position=np.rad2deg(motion.position) if rotary else motion.position * 1e3,
        position_unit="deg" if rotary else "mm",
        value=motion.mean,
        u=motion.u,
        prior=motion.prior,
        information=np.clip(1.0 - (motion.u_gum / prior) ** 2, 0.0, 1.0),
    )
