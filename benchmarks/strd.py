"""The least-squares solver on the 27 non-linear NIST StRD sets, from both starts.

All sets have the same settings. Digits are -log10 of the largest relative error, at most the 11
that are certified. For comparison, on the same residuals with the same derivatives: MINPACK's
`lmder` by scipy and the Levenberg-Marquardt of optimistix, both at tolerances of 1e-12. A star
marks an answer with less than four digits that the solver reports as a success.

    python benchmarks/strd.py
"""

import json
import sys
import time

import jax
import numpy as np
import optimistix as optx
from records import HERE, parser_of, write
from scipy.optimize import least_squares as scipy_least_squares

import vcal
from vcal.numerics.least_squares import Status, covariance, least_squares

sys.path.insert(0, str(HERE.parent / "tests"))
from test_strd import MODELS, SETS, data, digits, residual_of  # noqa: E402

TOLERANCE = 1e-12
REPEATS = 20


def by_minpack(residual, start, xy) -> tuple[float | np.ndarray, bool]:
    value = jax.jit(lambda b: residual(b, xy))
    slope = jax.jit(jax.jacfwd(lambda b: residual(b, xy)))
    try:
        with np.errstate(all="ignore"):
            found = scipy_least_squares(
                lambda b: np.asarray(value(b)),
                start,
                lambda b: np.asarray(slope(b)),
                method="lm",
                ftol=TOLERANCE,
                xtol=TOLERANCE,
                gtol=TOLERANCE,
                max_nfev=1000,
            )
    except ValueError:  # a residual or a Jacobian that is not finite
        return np.full(len(start), np.nan), False
    return found.x, bool(found.success)


def by_optimistix(residual, start, xy) -> tuple[np.ndarray, bool]:
    solver = optx.LevenbergMarquardt(TOLERANCE, TOLERANCE)
    found = optx.least_squares(residual, solver, start, xy, max_steps=1000, throw=False)
    return np.asarray(found.value), bool(found.result == optx.RESULTS.successful)


def run(name: str, start: int) -> dict:
    """Results of all solvers for one set and start."""
    it, xy, residual = SETS[name], data(name), residual_of(MODELS[name])
    begin = jax.numpy.asarray(it[f"start{start}"])
    clock = time.perf_counter()
    solution = jax.block_until_ready(least_squares(residual, begin, xy))
    first = time.perf_counter() - clock
    clock = time.perf_counter()
    for _ in range(REPEATS):
        jax.block_until_ready(least_squares(residual, begin, xy))
    again = (time.perf_counter() - clock) / REPEATS
    line = {
        "set": name,
        "level": it["level"],
        "start": start,
        "status": Status(int(solution.status)).name.lower(),
        "digits": digits(solution.value, it["certified"]),
        "digits_deviation": digits(np.sqrt(np.diag(covariance(solution))), it["sd"]),
        "digits_rss": digits(solution.cost, it["rss"]),
        "steps": int(solution.steps),
        "rank": int(solution.rank),
        "condition": float(solution.condition),
        "first_s": first,
        "again_ms": 1e3 * again,
    }
    for other, solve in (("minpack", by_minpack), ("optimistix", by_optimistix)):
        value, success = solve(residual, begin, xy)
        line[other] = {"digits": digits(value, it["certified"]), "success": success}
    return line


def table(lines: list[dict]) -> str:
    """One line per set and start."""

    def other(it: dict) -> str:
        shown = f"{max(it['digits'], 0.0):.1f}" if it["digits"] > -np.inf else "0.0"
        return shown + ("*" if it["success"] and it["digits"] < 4 else "")

    head = (
        f"{'set':9s} start {'status':11s} steps  digits  of sd  {'cond':>7s}  minpack  optimistix"
    )
    return "\n".join(
        [
            head,
            *(
                f"{x['set']:9s} {x['start']:5d} {x['status']:11s} {x['steps']:5d} "
                f"{x['digits']:7.1f} {x['digits_deviation']:6.1f}  {x['condition']:7.1e} "
                f"{other(x['minpack']):>8s} {other(x['optimistix']):>11s}"
                for x in lines
            ),
        ]
    )


def main() -> None:
    """Run all sets, or those that are named."""
    parser = parser_of(__doc__, "strd")
    parser.add_argument("--only", nargs="*", choices=list(SETS), default=list(SETS))
    options = parser.parse_args()
    vcal.enable_float64()
    lines = [run(name, start) for name in options.only for start in (1, 2)]
    print(table(lines))
    summary = {}
    for start in (1, 2):
        mine = [x for x in lines if x["start"] == start]
        summary[f"start{start}"] = {
            "sets": len(mine),
            "eight_digits_and_six_of_sd": sum(
                x["status"] == "converged"
                and x["digits"] >= 8
                and (x["digits_deviation"] >= 6 or x["set"] == "Lanczos1")
                for x in mine
            ),
            "silently_wrong": sum(x["status"] == "converged" and x["digits"] < 4 for x in mine),
        }
        for other in ("minpack", "optimistix"):
            summary[f"start{start}"][other] = {
                "eight_digits": sum(x[other]["digits"] >= 8 for x in mine),
                "silently_wrong": sum(x[other]["success"] and x[other]["digits"] < 4 for x in mine),
            }
        print(f"start {start}: {json.dumps(summary[f'start{start}'])}")
    write(options.out, {"summary": summary, "lines": finite(lines)})


def finite(value):
    """The same value with null for numbers that are not finite, which JSON does not have."""
    match value:
        case dict():
            return {key: finite(item) for key, item in value.items()}
        case list():
            return [finite(item) for item in value]
        case float() if not np.isfinite(value):
            return None
    return value


if __name__ == "__main__":
    main()
