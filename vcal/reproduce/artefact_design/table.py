"""Printed numbers, of which the publication has few, and what belongs beside them."""

from ..registry import Row
from .expected import best_plain
from .influences import SIZES
from .results import Results, nominal_poses
from .searches import FREEDOMS
from .setting import GRID, KNOWN, NOMINAL, PAIR_UM
from .timing import NOMINAL_S


def table(results: Results) -> list[Row]:
    """All numbers of the result."""
    r = results
    rows = [
        Row("balls", 11, NOMINAL[0], "1"),
        Row("offset a", 30, 1e3 * NOMINAL[1], "mm"),
        Row("offset b", 30, 1e3 * NOMINAL[2], "mm"),
        Row("standard deviation of reference distances", 2, PAIR_UM, "um"),
        Row("poses", 12, nominal_poses().rotation.shape[0], "1"),
        Row("points of the grid", 60 * 20 * 20, float(GRID[0] * GRID[1] * GRID[2]), "1"),
        Row("machines of a campaign", None, float(r.draws), "1"),
        Row("rms before compensation", None, r.before_um[0], "um", "aligned, expected"),
        Row("rms before compensation, raw", None, r.before_um[1], "um", "expected"),
    ]
    for known in KNOWN:
        nominal = r.theory[known]["N", 11]
        best = best_plain(r.task, nominal_poses(), known)
        rows += [
            Row(f"rms, nominal design, {known}", None, nominal.aligned, "um",
                f"aligned, expected; the bound of all linear estimates; raw {nominal.raw:.2f} um; "
                f"{r.fresh} drawn machines {r.nominal[known].rms:.3f} um"),
            Row(f"rms, plain least squares, {known}", None, best.aligned_um, "um",
                f"order {best.order}, {best.rank} of {best.columns} columns seen; "
                f"ratio {nominal.aligned / best.aligned_um:.3f}"),
        ]  # fmt: skip
        for name in FREEDOMS:
            if name in r.searched[known]:
                one = r.searched[known][name]
                rows.append(
                    Row(f"rms, {name}, {known}", None, one.optimised.rms_um, "um",
                        f"expected; {100 * one.optimised.gain:.1f} % below nominal; {r.fresh} "
                        f"fresh machines {one.checked.rms:.3f} um, theory {100 * one.off:+.1f} %")
                )  # fmt: skip
        star = r.star[known]
        rows.append(
            Row(f"rms, star stylus, {known}", None, star.alternating, "um",
                f"equal touches, same poses; {100 * star.gain:.1f} % below one stylus; with tips "
                f"and poses searched {star.found:.3f} um")
        )  # fmt: skip
        cheapest = r.trade[known].cheapest()
        if cheapest is not None:
            rows.append(
                Row(f"time for the nominal rms, {known}", None, cheapest.seconds, "s",
                    f"{cheapest.count} poses of {cheapest.balls} balls, {cheapest.rms_um:.3f} um; "
                    f"{100 * cheapest.seconds / NOMINAL_S:.0f} % of {NOMINAL_S:.0f} s")
            )  # fmt: skip
        for name, cost in r.costs[known].items():
            what = f"{SIZES[name][0]}: {SIZES[name][1]:g}" if name in SIZES else ""
            rows.append(
                Row(f"rms, influence {name}, {known}", None, cost.ignored, "um",
                    f"ignored; identified {cost.identified:.3f} um. {what}".strip())
            )  # fmt: skip
    return rows
