"""Printed numbers beside those that came out."""

from ..registry import Row
from .results import Results
from .setting import THIRTEEN
from .table_four import PRINTED, exchanged


def table(results: Results) -> list[Row]:
    """All printed numbers, and those that belong beside them."""
    rows = []
    for f in results.figures:
        note = f"with the publication's roundings {f.rounded:.{f.digits}f}"
        rows.append(Row(f.quantity, f.seed, f.exact, f.unit, f"{note}. {f.note}".rstrip(". ")))
    rows.append(Row("cycles", 30_000, float(results.draws), "1"))
    noise, everything = (results.cycles[f"planar, {n}"] for n in ("noise", "all errors"))
    assert noise.by_beams is not None and everything.by_beams is not None
    swapped = exchanged()
    for name in THIRTEEN:
        note = f"noise alone; with all 21 errors {everything.by_beams[name]:.3g} um"
        if swapped[name] != PRINTED[name]:
            note += f"; printed {swapped[name]:g} with EXZ and EZY exchanged"
        rows.append(Row(f"U of {name}", PRINTED[name], noise.by_beams[name], "um", note))
    first = results.variants[0]
    rows += [
        Row("rms of ln(vcal / printed), EXZ and EZY exchanged", None, first.exchanged, "1",
            "thirteen entries, noise alone, closed form"),
        Row("rms of ln(vcal / printed), labels as printed", None, first.as_printed, "1"),
    ]  # fmt: skip
    assert noise.tool_by_beams is not None and everything.tool_by_beams is not None
    for cycles, what in ((noise, "noise alone"), (everything, "all 21 errors")):
        by_beams = cycles.tool_by_beams
        assert by_beams is not None
        rows.append(
            Row(
                "largest linear uncertainty in the volume, a component",
                None,
                float(by_beams.max()),
                "um",
                f"path “planar”, beam by beam, {what}",
            )
        )
    rows.append(
        Row(
            "largest linear uncertainty of an angle in the volume",
            max(PRINTED[n] for n in THIRTEEN[8:]),
            max(noise.by_beams[n] for n in THIRTEEN[8:]),
            "um",
            "entries with an asterisk, noise alone",
        )
    )
    steps = results.better.steps
    for step in (steps[0], *steps[-2:]):
        checked = results.checked[step.freedom]
        rows.append(
            Row(
                f"largest U of the thirteen, {step.freedom}",
                None,
                max(checked.identified.values()),
                "um",
                f"Monte Carlo, path “3d” and least squares; closed form {step.largest:.3f} um",
            )
        )
    v = results.verification
    rows += [
        Row("differences to the second device within 3 um", 1.0, v.inside, "1",
            f"share, over {v.repeats} repeats; printed: all, of three repeats"),
        Row("repeats with all differences within 3 um", None, v.all_inside, "1", "share"),
        Row("normalised errors of at most one", None, v.agreeing, "1",
            "share; 0.954 where both uncertainties are right"),
    ]  # fmt: skip
    return rows
