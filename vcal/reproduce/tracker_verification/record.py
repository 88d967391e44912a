"""What the record holds besides the table."""

from dataclasses import asdict
from typing import Any

import numpy as np

from ...uncertainty.comparison import Comparison
from .compared import Rung
from .results import INFLUENCES, Results
from .trials import KINDS, Trials


def record(results: Results) -> dict[str, Any]:
    """All numbers behind the page, by section."""
    first = next(iter(results.many.values()))
    return {
        "seed": results.seed,
        "draws": results.draws,
        "setting": asdict(first.setting),
        "family": asdict(results.search),
        "rank": asdict(results.rank),
        "tests": {name: _errors(t) for name, t in results.many.items()},
        "gum_and_monte_carlo": {name: _rung(r) for name, r in results.rungs.items()},
        "influences": {
            name: {**asdict(INFLUENCES[name]), "tests": t.ensemble.draws, **_errors(t)}
            for name, t in results.influences.items()
        },
        "probing": asdict(results.probing),
    }


def _errors(trials: Trials) -> dict[str, Any]:
    found = {}
    for kind in KINDS:
        p = trials.pooled[kind, "distance"]
        found[kind] = {"mean": p.mean, "sd": p.sd, "u_mean": p.u_mean, "q95": p.quantile(0.95)}
    return found


def _rung(rung: Rung) -> dict[str, Any]:
    return {
        "error_motions": _comparison(rung.motions),
        "components": _comparison(rung.components),
        "lengths": [asdict(length) for length in rung.lengths],
        "undefined": list(rung.undefined),
    }


def _comparison(c: Comparison) -> list[dict[str, Any]]:
    return [
        {
            "output": label,
            "gum": {"y": c.value[i, 0], "u": c.u[i, 0], "low": c.low[i, 0], "high": c.high[i, 0]},
            "monte_carlo": {
                "y": c.value[i, 1],
                "u": c.u[i, 1],
                "low": c.low[i, 1],
                "high": c.high[i, 1],
            },
            "delta": c.delta[i],
            "verdict": verdict,
        }
        for i, (label, verdict) in enumerate(zip(c.labels, c.verdicts, strict=True))
        if np.isfinite(c.delta[i])
    ]
