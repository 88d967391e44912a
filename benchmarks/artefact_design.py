"""Designs of a ball artefact: seconds for sweeps and searches, cold and warm, and what they gave.

    python benchmarks/artefact_design.py --out benchmarks/results/artefact_design.json

A sweep is the 21 designs of `vcal reproduce artefact-design` with 1000 machines each: *linear* by
the linear estimate, *exact* with the kinematics and an identification in every draw. Cold is the
first one of the process, with compilation as far as the user's cache of compiled programs does not
spare it; warm the next. A search is one of twelve poses of eleven
balls from eight starts, cold and then warm.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from vcal.cli.session import start
from vcal.reproduce.artefact_design.expected import task
from vcal.reproduce.artefact_design.optimised import optimise
from vcal.reproduce.artefact_design.results import Effort, nominal_poses
from vcal.reproduce.artefact_design.searches import FREEDOMS, Searches
from vcal.reproduce.artefact_design.setting import KNOWN
from vcal.reproduce.artefact_design.sweep import exact, linear
from vcal.uncertainty.programs import Programs

HERE = Path(__file__).resolve().parent
SEARCHED = Effort().searched


def main() -> None:
    """Run every case and keep the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "artefact_design.json")
    parser.add_argument("--only", default="", help="cases with this in their name")
    options = parser.parse_args()
    start()  # with the cache of compiled programs, as the commands
    given, nominal, rows = task(), nominal_poses(), []

    def timed(name: str, function: Callable[[], Any], note: Callable[[Any], str]) -> None:
        if options.only not in name:
            return
        seconds, found = [], None
        for _ in range(2):
            began = time.perf_counter()
            found = function()
            seconds.append(time.perf_counter() - began)
        row = {"case": name, "cold_s": seconds[0], "warm_s": seconds[1], "found": note(found)}
        rows.append(row)
        print(row, flush=True)
        record = {"device": jax.devices()[0].device_kind, "draws": options.draws, "rows": rows}
        options.out.write_text(json.dumps(record, indent=1) + "\n")

    programs = Programs()
    for known in KNOWN:
        timed(
            f"sweep, exact, {known}",
            lambda k=known: exact(given, k, draws=options.draws, seed=0, programs=programs),
            lambda found: f"{found['N', 11].rms:.3f} um at the nominal design",
        )
    for known in KNOWN:
        timed(
            f"sweep, linear, {known}",
            lambda k=known: linear(given, k, draws=options.draws, seed=0),
            lambda found: f"{(found['N', 11] ** 2).mean() ** 0.5:.3f} um at the nominal design",
        )
    for name in SEARCHED:
        freedom = FREEDOMS[name]
        searches = Searches([given], freedom)
        for known in KNOWN:
            timed(
                f"search, {name}, {known}",
                lambda f=freedom, k=known, s=searches: optimise(given, nominal, k, f, searches=s),
                lambda o: f"{o.rms_um:.3f} um, {100 * o.gain:.1f} % less",
            )


if __name__ == "__main__":
    main()
