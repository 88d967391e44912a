"""Two-level Monte Carlo against exact draws: time for the same precision, and agreement.

The problem is that of batch.py. Both methods are timed with compiled programs, for as many draws
and for the precision of as many draws. Then two-level results of many seeds are compared with one
long campaign of exact draws, in units of their standard errors.

    python benchmarks/two_level.py --draws 1000000 --repeats 200
"""

import time

import numpy as np
from batch import problem
from records import parser_of, write

import vcal
from vcal.uncertainty import Ensemble, Programs, monte_carlo, two_level

SHORT = 20_000
"""Draws whose precision every repeat has."""
P = 0.025
"""Probability below the interval."""


def density_at_ends(ensemble: Ensemble, labels: tuple[str, ...]) -> np.ndarray:
    """Density (2, q) of every output at both ends of the interval."""
    step = 0.25 * P
    slopes = [
        [ensemble.quantile(label, p + step) - ensemble.quantile(label, p - step)
         for label in labels]
        for p in (P, 1.0 - P)
    ]  # fmt: skip
    return 2.0 * step / np.array(slopes)


def main() -> None:
    """Time and compare both methods."""
    parser = parser_of(__doc__, "two_level")
    parser.add_argument("--draws", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=200)
    options = parser.parse_args()
    vcal.enable_float64()
    model, plan = problem()
    programs = Programs()
    methods = {"exact": monte_carlo, "two-level": two_level}
    seconds, found = {}, {}
    for name, method in methods.items():
        method(model, model, plan, draws=SHORT, seed=1, programs=programs)  # compiles
        begun = time.perf_counter(), time.process_time()
        found[name] = method(model, model, plan, draws=options.draws, seed=2, programs=programs)
        seconds[name] = {"wall_s": time.perf_counter() - begun[0],
                         "cpu_s": time.process_time() - begun[1]}  # fmt: skip
        print(name, seconds[name], flush=True)
    two, exact = found["two-level"], found["exact"].ensemble
    labels = two.labels
    count = len(labels)
    reference = {
        "u": exact.u[:count],
        "low": np.array([exact.interval(label)[0] for label in labels]),
        "high": np.array([exact.interval(label)[1] for label in labels]),
    }
    ends = np.sqrt(P * (1.0 - P)) / density_at_ends(exact, labels)
    fourth = np.array([np.mean((v - v.mean()) ** 4) for v in exact.values[:, :count].T])
    one_draw = {
        "u": np.sqrt(fourth - reference["u"] ** 4) / (2.0 * reference["u"]),
        "low": ends[0],
        "high": ends[1],
    }
    ratio = {
        name: getattr(two, f"error_of_{name}") / (one_draw[name] / np.sqrt(options.draws))
        for name in reference
    }
    apart: dict[str, list[np.ndarray]] = {name: [] for name in reference}
    for repeat in range(options.repeats):
        again = two_level(model, model, plan, draws=SHORT, seed=100 + repeat, programs=programs)
        for name, value in reference.items():
            error = np.hypot(
                getattr(again, f"error_of_{name}"), one_draw[name] / np.sqrt(options.draws)
            )
            apart[name].append((getattr(again, name) - value) / error)
    z = {name: np.array(values) for name, values in apart.items()}
    record = {
        "draws": options.draws,
        "seconds": seconds,
        "times_faster": seconds["exact"]["wall_s"] / seconds["two-level"]["wall_s"],
        "linear": two.linear,
        "exact": two.exact,
        "least_explained": float(two.explained.min()),
        "largest_standard_error_ratio": {name: float(r.max()) for name, r in ratio.items()},
        "repeats": options.repeats,
        "outputs": count,
        "within_3_standard_errors": {
            name: float((np.abs(values) <= 3.0).mean()) for name, values in z.items()
        },
        "rms_in_standard_errors": {
            name: float(np.sqrt((values**2).mean())) for name, values in z.items()
        },
    }
    for name, value in record.items():
        print(name, value)
    write(options.out, record)


if __name__ == "__main__":
    main()
