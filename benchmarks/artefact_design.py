"""Designs of a ball artefact: seconds of sweeps and searches, cold and warm, and their results.

    XDG_CACHE_HOME=$(mktemp -d) python benchmarks/artefact_design.py

A sweep is the 21 designs of `vcal reproduce artefact-design` with 1000 machines each: *linear* by
the linear estimate, *exact* with the kinematics and an identification in every draw. A search is
one of twelve poses of eleven balls from eight starts. Cold is the first run of the process, with
compilation unless the user's cache of compiled programs has the program; warm is the second run.
"""

from collections.abc import Callable
from typing import Any

import jax
from records import parser_of, timed, write

from vcal.cli.session import start
from vcal.design import gram_for
from vcal.reproduce.artefact_design.expected import task
from vcal.reproduce.artefact_design.machines import measured_by
from vcal.reproduce.artefact_design.results import Effort, nominal_poses
from vcal.reproduce.artefact_design.searches import FREEDOMS, Searches, optimise
from vcal.reproduce.artefact_design.setting import KNOWN
from vcal.reproduce.artefact_design.sweep import designs, exact
from vcal.uncertainty.mismatch import drawn_errors
from vcal.uncertainty.programs import Programs

SEARCHED = Effort().searched


def main() -> None:
    """Run every case and write the times."""
    parser = parser_of(__doc__, "artefact_design")
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--only", default="", help="cases with this in their name")
    options = parser.parse_args()
    start()  # with the cache of compiled programs, as the commands
    given, nominal, rows = task(), nominal_poses(), []

    def row(name: str, function: Callable[[], Any], note: Callable[[Any], str]) -> None:
        if options.only not in name:
            return
        cold, warm, found = timed(function, 1)
        rows.append({"case": name, "cold_s": cold, "warm_s": warm, "found": note(found)})
        print(rows[-1], flush=True)
        record = {"device": jax.devices()[0].device_kind, "draws": options.draws, "rows": rows}
        write(options.out, record)

    programs = Programs(brief=True)
    for known in KNOWN:
        row(
            f"sweep, exact, {known}",
            lambda k=known: exact(given, k, draws=options.draws, seed=0, programs=programs),
            lambda found: f"{found['N', 11].rms:.3f} um at the nominal design",
        )

    def linear(known):
        """Aligned error on the grid, um, of machines drawn one by one, by the linear estimate."""
        found = {}
        for design in designs():
            model, plan = measured_by(given, design.poses, known)
            gram = gram_for(model, given.gram, given.model)
            errors = drawn_errors(model, model, plan, gram, draws=options.draws, seed=0)
            found[design.key] = 1e6 * errors[:, 0]
        return found

    for known in KNOWN:
        row(
            f"sweep, linear, {known}",
            lambda k=known: linear(k),
            lambda found: f"{(found['N', 11] ** 2).mean() ** 0.5:.3f} um at the nominal design",
        )
    for name in SEARCHED:
        freedom = FREEDOMS[name]
        searches = Searches([given], freedom)
        for known in KNOWN:
            row(
                f"search, {name}, {known}",
                lambda f=freedom, k=known, s=searches: optimise(given, nominal, k, f, searches=s),
                lambda o: f"{o.rms_um:.3f} um, {100 * o.gain:.1f} % less",
            )


if __name__ == "__main__":
    main()
