"""The error that `vcal verify` foretells, against that of simulated machines.

Machines are drawn from the declared family of the demo study with an effect, measured with its plan
and noise, and identified. Each is compensated in every format; the error of the true machine at the
compensated commands is compared with the expected one, over the working volume.

    python benchmarks/compensation.py --sets 500
"""

import time
from dataclasses import replace

import jax
import numpy as np
from records import parser_of, write

import vcal
from vcal.compensation import IdentifiedMachine, working_volume
from vcal.compensation.base import left_over
from vcal.compensation.expected import after_alignment, drawn_errors, expected
from vcal.demo import FOLDER
from vcal.identification.batch import identify_one, prepare_batch
from vcal.model.simulate import draw, prepare, simulate

FORMATS = {"without": 0, "linuxcnc-screw": 21, "linuxcnc": 7}
"""Points per axis of each format."""


def one_set(estimated: IdentifiedMachine, true: IdentifiedMachine, seed: int) -> dict:
    """Expected and realised rms, um, of one machine, by format."""
    use = working_volume(estimated, 5, seed)
    nominal = estimated.nominal(use.position)
    found = {}
    for name, points in FORMATS.items():
        tables = None
        if points:
            tables = vcal.compensate(estimated, name, {"points": points}, parts=False).tables
            left = left_over(true, tables, use)
        else:
            left = true.displacement(use.plan(true))
        errors = drawn_errors(estimated, use, tables, draws=100, seed=seed)
        foretold = expected(after_alignment(errors, nominal)).rms
        realised = expected(after_alignment(left[None], nominal)).rms.mean
        found[name] = {"expected": foretold.mean, "u": foretold.u, "realised": realised}
    return found


def machines(sets: int):
    """Pairs of the identified and the true machine: all have one plan, noise and posterior
    covariance; errors and readings are drawn for each.
    """
    study = vcal.load_study(FOLDER / "setup.toml")
    setup = study.model.setup(study.plan)
    effects = [
        next(e for e in vcal.CATALOGUE[name].candidates(setup) if e.placement == "Y")
        for name in ("backlash", "thermal_tilt")
    ]
    model = study.model.with_effects(*effects)
    first = simulate(model, study.plan, jax.random.key(0))
    fit = vcal.identify(model, first.measurement)
    pattern = IdentifiedMachine.of_fit(fit)
    mine = [i for i, effect in enumerate(model.effects) if not effect.on_instrument]
    places = np.concatenate([fit.places_of(i)[0] for i in mine])
    simulator, batch = prepare(model, study.plan), prepare_batch(model, study.plan)

    @jax.jit
    def measured(key):
        drawn = draw(simulator, key)
        return drawn.theta, identify_one(batch, drawn.readings)

    for seed in range(1, sets + 1):
        truth, found = measured(jax.random.key(seed))
        if not found.converged:
            raise SystemExit(f"seed {seed}: the identification did not converge")
        yield (
            replace(pattern, theta=np.asarray(found.theta)[places]),
            replace(pattern, theta=np.asarray(truth)[places]).whole,
        )


def main() -> None:
    """Make the sets and write the result."""
    parser = parser_of(__doc__, "compensation")
    parser.add_argument("--sets", type=int, default=500)
    options = parser.parse_args()
    vcal.enable_float64()
    began, sets = time.process_time(), []
    for seed, (estimated, true) in enumerate(machines(options.sets), start=1):
        sets.append(one_set(estimated, true, seed))
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
