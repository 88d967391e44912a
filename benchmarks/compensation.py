"""The error that `vcal verify` foretells, against that of simulated machines.

Machines are drawn from the declared family of the demo study with an effect, measured with its plan
and noise, and identified. Each is compensated in every format; the error of the true machine at the
compensated commands is compared with the expected one, over the working volume.

    python benchmarks/compensation.py --sets 500
"""

import time

import jax
import numpy as np
from records import parser_of, write

import vcal
from vcal.compensation import working_volume
from vcal.compensation.expected import after_alignment, drawn_errors, expected
from vcal.demo import FOLDER
from vcal.model.simulate import simulate

FORMATS = {"without": 0, "linuxcnc-screw": 21, "linuxcnc": 7}
"""Points per axis of each format."""


def one_set(study, effects, seed: int) -> dict:
    """Expected and realised rms, um, of one machine, by format."""
    true = simulate(study.model, study.plan, jax.random.key(seed), effects=effects)
    fit = vcal.identify(true.model, true.measurement)
    machine = vcal.IdentifiedMachine.of_fit(fit)
    use = working_volume(machine, 5, seed)
    nominal = machine.nominal(use.position)
    found = {}
    for name, points in FORMATS.items():
        tables = None
        if points:
            tables = vcal.compensate(machine, name, {"points": points}, parts=False).tables
        errors = drawn_errors(machine, use, tables, draws=100, seed=seed)
        added = 0.0
        if tables is not None:
            added = tables.applied(use.position, use.directions, use.covariates)
        plan = machine.plan(use.position + added, use.directions, use.covariates)
        left = (true.tool_points(plan) - nominal)[None]
        found[name] = {
            "expected": expected(after_alignment(errors, nominal)).rms.mean,
            "realised": expected(after_alignment(left, nominal)).rms.mean,
            "u": expected(after_alignment(errors, nominal)).rms.u,
        }
    return found


def main() -> None:
    """Make the sets and write the result."""
    parser = parser_of(__doc__, "compensation")
    parser.add_argument("--sets", type=int, default=500)
    options = parser.parse_args()
    vcal.enable_float64()
    study = vcal.load_study(FOLDER / "setup.toml")
    setup = study.model.setup(study.plan)
    effects = [
        next(e for e in vcal.CATALOGUE[name].candidates(setup) if e.placement == "Y")
        for name in ("backlash", "thermal_tilt")
    ]
    began, sets = time.process_time(), []
    for seed in range(1, options.sets + 1):
        sets.append(one_set(study, effects, seed))
        if seed % 25 == 0:
            print(seed, round(time.process_time() - began), "s", flush=True)
    summary = {name: summary_of([one[name] for one in sets]) for name in FORMATS}
    found = {"sets": options.sets, "summary": summary}
    write(options.out, found | {"cpu_s": round(time.process_time() - began)})


def summary_of(sets: list[dict[str, float]]) -> dict[str, float]:
    """Means over the machines, and how often one machine is near what is expected of it."""
    foretold, realised, u = (np.array([s[k] for s in sets]) for k in ("expected", "realised", "u"))
    return {
        "expected_um": float(foretold.mean()),
        "realised_um": float(realised.mean()),
        "realised_over_expected": float(realised.mean() / foretold.mean()),
        "within_2u": float((np.abs(realised - foretold) <= 2.0 * u).mean()),
        "at_most_1.1": float((realised <= 1.1 * foretold).mean()),
    }


if __name__ == "__main__":
    main()
