"""The volumetric error before and after compensation, and the decision on its tolerance: the first
lines of a report, sections, and keys of the record.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...compensation.machine import IdentifiedMachine
from ...compensation.volumetric_error import VolumetricError, volumetric_error
from ...numerics.conformity import Conformity, Draws, Requirement, Tolerance, Verdict, decide
from ...study.statements import AcceptanceSettings
from ..html import text
from ..html.picture import Picture
from ..html.scene import Scene
from ..html.sheet import Section, Table, Tile

_SAID: Mapping[Verdict, str] = {
    "conforms": "the machine conforms",
    "does_not_conform": "the machine does not conform",
    "undecided": "conformity cannot be decided",
}
_SHORT: Mapping[Verdict, str] = {
    "conforms": "conforms",
    "does_not_conform": "does not conform",
    "undecided": "cannot be decided",
}
_STAGES = {"before": "as it is", "after": "after compensation"}
_NONE_IN = 3.0
"""Where none of n draws is beyond the tolerance, the probability of that is below 3 / n with a
confidence of 95 %."""


@dataclass(frozen=True)
class Decided:
    """The volumetric error of an identified machine, and the decision where a tolerance is set."""

    error: VolumetricError
    asked: AcceptanceSettings | None
    decisions: Mapping[str, Conformity]
    """By stage, ``"before"`` and ``"after"``; empty without a tolerance."""
    gain: bool
    """Whether compensation reduces the error at the check points (`Closure.no_gain`)."""

    @property
    def stages(self) -> list[str]:
        """The stages of which the page speaks."""
        return ["before", "after"] if self.gain else ["before"]

    @property
    def sentence(self) -> str:
        """The result in the words of a workshop."""
        rms, largest = (_means(self.error, name) for name in ("rms", "largest"))
        said = (
            f"In the working volume, the tool point is off by up to {largest['before']} µm (rms "
            f"{rms['before']} µm); "
        )
        if self.gain:
            said += f"compensation leaves up to {largest['after']} µm (rms {rms['after']} µm)."
        else:
            said += "compensation does not reduce the error."
        return f"{said} {self.verdict}".rstrip()

    @property
    def verdict(self) -> str:
        """The decision in one sentence; empty without a tolerance."""
        if self.asked is None:
            return ""
        said = [
            f"{_STAGES[stage]}, {_SAID[one.verdict]} (conformance probability {chance(one)})"
            for stage in self.stages
            for one in (self.decisions[stage],)
        ]
        return f"With a tolerance of {self.asked.volumetric_um:g} µm: {'; '.join(said)}."


def decided(machine: IdentifiedMachine) -> Decided | None:
    """The volumetric error of a machine, and the decision on the tolerance that its study states;
    None for a machine without parameters, whose error is known to be zero.
    """
    if not len(machine.theta):
        return None
    given, gain = machine.about.get("acceptance"), not machine.no_gain
    if given is None:
        return Decided(volumetric_error(machine), None, {}, gain)
    asked = AcceptanceSettings(**given)
    error = volumetric_error(machine, asked.draws, asked.seed)
    limit = Tolerance(upper=asked.volumetric_um)
    rule = Requirement(limit, asked.risk_percent / 100.0, asked.rule)
    decisions = {stage: decide(Draws(getattr(error, stage).largest), rule) for stage in _STAGES}
    return Decided(error, asked, decisions, gain)


def chance(one: Conformity) -> str:
    """The conformance probability as text, no finer than the number of draws shows it."""
    if one.draws is not None and one.probability in (0.0, 1.0):
        share = 100.0 * _NONE_IN / one.draws
        least = share if one.probability == 0.0 else 100.0 - share
        return f"{'below' if one.probability == 0.0 else 'above'} {least:.4g} %"
    return f"{100.0 * one.probability:.1f} %"


def _means(error: VolumetricError, name: str) -> dict[str, str]:
    return {
        stage: text.number(float(getattr(getattr(error, stage), name).mean())) for stage in _STAGES
    }


def volumetric_tiles(found: Decided | None) -> list[Tile]:
    """Largest error before and after, and the decision."""
    if found is None:
        return []
    rms, largest = (_means(found.error, name) for name in ("rms", "largest"))
    arrow = " → ".join
    how = arrow(_STAGES[stage] for stage in found.stages)
    tiles = [
        Tile(
            "Largest error in the working volume",
            f"{arrow(largest[stage] for stage in found.stages)} µm",
            f"rms {arrow(rms[stage] for stage in found.stages)} µm; {how}",
        )
    ]
    if found.asked is not None:
        *first, last = found.stages
        note = "".join(
            f"; {_STAGES[stage]}: {_SHORT[found.decisions[stage].verdict]}" for stage in first
        )
        name = f"Acceptance, tolerance {found.asked.volumetric_um:g} µm"
        tiles.append(Tile(name, _SHORT[found.decisions[last].verdict], f"{_STAGES[last]}{note}"))
    return tiles


def acceptance_section(found: Decided | None) -> list[Section]:
    """The decision with everything that it depends on; no section without a tolerance."""
    if found is None or found.asked is None:
        return []
    asked = found.asked
    rows = [
        (
            _STAGES[stage],
            *text.rounded(one.estimate, text.COVERAGE * one.u),
            chance(one),
            text.number(one.guard_band[1]),
            text.number(one.acceptance[1]),
            text.number(one.rejection[1]),
            _SHORT[one.verdict],
        )
        for stage in found.stages
        for one in (found.decisions[stage],)
    ]
    header = (
        "", "largest error, µm", "U (k = 2), µm", "conformance probability", "guard band, µm",
        "acceptance limit, µm", "rejection limit, µm", "decision",
    )  # fmt: skip
    rule = (
        f"Guarded acceptance and rejection with a risk of at most {asked.risk_percent:g} %: the "
        "machine conforms where the estimate is at most the acceptance limit, and does not conform "
        "where it is above the rejection limit. In between, nothing can be decided; a smaller "
        "uncertainty would narrow that interval."
        if asked.rule == "guarded"
        else "Simple acceptance: the estimate is compared with the tolerance. Near it, the risk of "
        "a wrong decision is up to 50 %."
    )
    note = (
        f"Probabilities are counted over {asked.draws} machines drawn from the identified "
        f"distribution (seed {asked.seed}), at {found.error.positions} positions in the working "
        "volume, each approached in a random direction and under conditions of the measurement; "
        "the largest error is not normally distributed. It is taken after the best rigid alignment "
        "of all positions. After compensation: without everything that was identified; a control "
        "whose tables carry less leaves more (vcal verify)."
    )
    title = f"Acceptance: volumetric error of at most {asked.volumetric_um:g} µm (JCGM 106)"
    return [Section(title, (rule,), tables=(Table(header, rows, "lrrrrrrl"),), note=note)]


def volumetric_section(
    found: Decided | None, drawn: tuple[Picture, ...], scenes: tuple[Scene, ...] = ()
) -> list[Section]:
    """Sizes of the volumetric error, its pictures, and scenes of it where there are pictures."""
    title = "Volumetric error"
    if found is None and not drawn:
        return []
    turned = scenes if drawn else ()
    if found is None:
        return [Section(title, pictures=drawn, scenes=turned)]
    error, rows = found.error, []
    for stage in found.stages:
        sizes = getattr(error, stage)
        cells = [text.rounded(*_moments(v)) for v in (sizes.rms, sizes.largest)]
        rows.append((_STAGES[stage], *(cell for pair in cells for cell in pair)))
    note = (
        f"At {error.positions} positions in the working volume, after the best rigid alignment: "
        f"mean and standard deviation over {error.draws} machines drawn from the identified "
        f"distribution (seed {error.seed})."
    )
    table = Table(("", "rms, µm", "u, µm", "largest, µm", "u, µm"), rows, "lrrrr", note=note)
    return [Section(title, tables=(table,), pictures=drawn, scenes=turned)]


def _moments(values: np.ndarray) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1))


def volumetric_record(found: Decided | None) -> dict[str, Any]:
    """The keys ``volumetric_error`` and ``acceptance`` of the record; without what there is not."""
    if found is None:
        return {}
    error = found.error
    content: dict[str, Any] = {
        "volumetric_error": {
            "sentence": found.sentence,
            "positions": error.positions,
            "draws": error.draws,
            "seed": error.seed,
            **{stage: _sizes_record(getattr(error, stage)) for stage in _STAGES},
        }
    }
    if found.asked is not None:
        content["acceptance"] = {
            "sentence": found.verdict,
            "tolerance_um": found.asked.volumetric_um,
            "risk": found.asked.risk_percent / 100.0,
            "rule": found.asked.rule,
            **{stage: _decision_record(one) for stage, one in found.decisions.items()},
        }
    return content


def _sizes_record(sizes: Any) -> dict[str, float]:
    found = {}
    for name in ("rms", "largest"):
        mean, u = _moments(getattr(sizes, name))
        found |= {f"{name}_um": mean, f"{name}_standard_uncertainty_um": u}
    return found


def _decision_record(one: Conformity) -> dict[str, Any]:
    return {
        "verdict": one.verdict,
        "estimate_um": one.estimate,
        "standard_uncertainty_um": one.u,
        "conformance_probability": one.probability,
        "conformance_probability_u": one.u_probability,
        "guard_band_um": one.guard_band[1],
        "acceptance_limit_um": one.acceptance[1],
        "rejection_limit_um": one.rejection[1],
    }
