"""The result of closing the loop: numbers and names only, from which pages and files are made."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ...effects.base import Effect
from ...geometry.error_motions import error_motion_tables
from ...identification.fit import Fit
from ...identification.model_averaging import Alternatives
from ...instruments.conditions import file_column, in_file
from ...labelled import html_table, labelling
from ...machine.parameters import in_units
from ...model.measurement import CheckPoints
from ...units import si_factor, si_unit
from ...words import counted
from ..empirical import Empirical
from ..residuals.outliers import Outlier
from ..residuals.variance_components import Component
from ..residuals.vibration import Vibration
from ..screening.candidates import Untestable
from ..screening.screening import Screening
from ..weighing.cross_validation import Rms
from ..weighing.weighing import AlikeShapes
from .misdeclared import Misdeclared
from .unexplained import Unexplained, way

LIKELY = 0.5
"""Probability above which an effect counts as found."""
Verdict = Literal["nothing_missing", "named", "ambiguous", "unexplained"]


_LOUDER, _SURELY = 1.5, 3.0
"""Scatter over the declared noise, and standard uncertainties of that ratio, from which the verdict
reports it."""
_WRONG, _EVEN = 3.0, 1.3
"""Factor from which the declared noise is wrong, and largest ratio of factors that are the same."""
_MOST_OF_IT = 0.5
"""Share of a reading's scatter from which the verdict describes the rest by the vibration alone."""
_A_PART = 0.05
"""Share of the remainder from which a covariate is reported together with noise that is correlated
in time."""


@dataclass(frozen=True)
class SetErrors:
    """Errors of a model on the readings of one data set of several."""

    heldout: Rms
    fit: Rms
    chi2_per_dof: float
    """Against the declared noise."""


@dataclass(frozen=True)
class Errors:
    """Errors of a model."""

    check: Rms | None
    """Volumetric error at the check points after rigid alignment; None without check data. Its
    uncertainty includes the alternatives to the effects, and what is unexplained."""
    check_raw: Rms | None
    heldout: Rms
    fit: Rms
    chi2_per_dof: float
    """Against the declared noise."""
    sets: Mapping[str, SetErrors] = field(default_factory=dict)
    """The same by data set, where there are several."""


@dataclass(frozen=True)
class FoundEffect:
    """An effect that the loop added."""

    effect: Effect
    status: Literal["named", "ambiguous"]
    placement: str
    """Its place; a class of equivalent placements is written ``"X|Y|Z"``."""
    parameters: list[tuple[str, float, str, float]]
    """(name, value, unit, standard uncertainty), from the final fit, at the placement of `effect`.
    At another placement of its class, size and sign may differ."""
    p_value: float
    log_evidence: float
    delta_bic: float
    heldout_gain: float
    """Relative fall of the held-out rms when it was added. Of several data sets, the largest fall;
    for an effect of one instrument, that of its own data set."""
    equivalent: list[str]
    alternatives: list[tuple[str, str, float]]
    separation: str
    """The measurement that would distinguish it from its rivals, in words; empty where none is
    needed."""
    probability: float = 1.0
    """Of its name, among all rivals."""
    chance: float = 0.0
    """Probability that no further effect is missing, where it is as probable beforehand as that one
    of the kinds that were tried is."""
    hint: str = ""
    """Reason why it is a hint only: no more likely than its rivals and chance together, no value
    above its uncertainty, or less than what is left unexplained. Empty for an effect that counts as
    found."""
    shapes: tuple[Mapping[str, float], ...] = ()
    """Values of its shape parameters, in their units, that the readings cannot distinguish, the
    most probable first; empty where there is one only. The model holds their mean
    (`vcal.effects.shape_class`), and two standard uncertainties of a shape parameter reach all of
    them."""
    alike: tuple[AlikeShapes, ...] = ()
    """Alternatives of which several shapes fit alike."""

    def shapes_of(self, name: str, placement: str) -> list[dict[str, float]]:
        """Values of the shape parameters of an alternative, in their units, that the readings
        cannot distinguish, the most probable first; empty where there is one only.
        """
        key = f"{name} {placement}".strip()
        its = next((one for one in self.alike if one.effect.key == key), None)
        return [] if its is None else [in_units(its.effect.shapes, v) for v in its.shapes]

    @property
    def perhaps_chance(self) -> bool:
        """Whether it is no more likely than not only because nothing more may be missing."""
        return self.probability > LIKELY >= self.probability * (1.0 - self.chance)

    @property
    def joint(self) -> bool:
        """Whether the data cannot distinguish its place from others."""
        return self.placement != self.effect.placement

    @property
    def name(self) -> str:
        """Its name and place, with effects of other kinds that cannot be distinguished from it."""
        own = f"{self.effect.name} {self.placement}".strip()
        others = [key for key in self.equivalent if key.split(" ")[0] != self.effect.name]
        return (
            f"{own} (indistinguishable from {', '.join(others)} with these data)" if others else own
        )


@dataclass(frozen=True)
class Rejected:
    """An effect that was tried and not added."""

    effect: str
    placement: str
    p_value: float
    reason: str


def in_words(effect: Effect) -> str:
    """What an empirical description is, in words: ``"local error"``."""
    return effect.summary.removeprefix("empirical: ")


def outdone_by(effect: Effect) -> str:
    """Reason why nothing else is added where an empirical description ends the search."""
    return f"an empirical description ({in_words(effect)}) describes the residual better"


def _in_short(found: FoundEffect) -> str:
    """Values of an effect with their standard uncertainties; the first three of many."""
    said = [f"{name} = {v:.3g} ± {u:.2g} {unit}" for name, v, unit, u in found.parameters[:3]]
    return ", ".join(said) + (", ..." if len(found.parameters) > 3 else "")


def _and(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


@dataclass(frozen=True)
class Closure:
    """The result of `close_loop`."""

    verdict: Verdict | None
    """None where the search was interrupted before any effect was found."""
    effects: list[FoundEffect]
    errors: Mapping[Literal["uncompensated", "before", "after"], Errors]
    before: Fit = field(repr=False)
    after: Fit = field(repr=False)
    nominal: Fit = field(repr=False)
    """The nominal machine with only the nuisances fitted."""
    alternatives: Sequence[Alternatives] = field(repr=False)
    """Alternatives to each of `effects`, the members of classes of shapes, then the description of
    what is unexplained."""
    check: CheckPoints | None = field(repr=False)
    unexplained: Unexplained | None
    suspected: list[Outlier]
    rejected: list[Rejected]
    untestable: list[Untestable]
    unseen: list[str]
    """Effects that the declared model already spans on this plan."""
    screenings: list[Screening] = field(repr=False)
    noise_scale: float
    """Root of chi-square per degree of freedom of the final fit, where it differs from one
    significantly; else one."""
    noise_components: tuple[Component, ...]
    """Estimated noise of every kind of reading; empty where the readings of a row are clustered."""
    settings: Mapping[str, Any]
    noise_scales: Mapping[str, float] = field(default_factory=dict)
    """`noise_scale` of every data set, by its name."""
    noise_uneven: bool = False
    """Whether the kinds of reading differ in the ratio of estimated to declared noise. The final
    fit then uses `noise_components`."""
    interrupted: bool = False
    sizes: Misdeclared | None = None
    """Declared sizes that do not fit; None where they fit."""
    no_gain: str = ""
    """Sentence where compensation does not reduce the error (`vcal.loop.outcome.gain`); else empty.
    """
    vibration: Vibration | None = None
    """A vibration in the residual, which runs of several feed rates can reveal."""
    notes: list[str] = field(default_factory=list)

    def __repr__(self) -> str:
        lines = [f"Closure: {self.sentence}"]
        lines += [
            f"  {e.effect.key}: {_in_short(e)} ({'hint' if e.hint else e.status})"
            for e in self.effects
        ]
        for row in self._error_rows():
            lines.append(f"  {row[0]}: {row[1]} uncompensated, {row[2]} before, {row[3]} after")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        header = ("", "uncompensated", "before", "after")
        return html_table(self.sentence, header, self._error_rows())

    def _error_rows(self) -> list[tuple[str, str, str, str]]:
        """The measures of error at the three stages, in words."""
        rows = []
        for name, attribute in (
            ("check points, um", "check"),
            ("held-out readings, um", "heldout"),
        ):
            of = [getattr(self.errors[k], attribute) for k in ("uncompensated", "before", "after")]
            if all(one is not None and math.isfinite(one.value) for one in of):
                a, b, c = (f"{one.value:.3g} ± {one.u:.2g}" for one in of)
                rows.append((name, a, b, c))
        return rows

    def to_pandas(self) -> Any:
        """The effects that were added as a `pandas.DataFrame`: a row per parameter with the index
        (effect, parameter) and the columns value, standard_uncertainty, unit, status, hint,
        probability, p_value.

        Raises `ImportError` where pandas is not installed.
        """
        pandas = labelling("pandas")
        rows = [
            (
                one.effect.key,
                name,
                value,
                u,
                unit,
                one.status,
                one.hint,
                one.probability,
                one.p_value,
            )
            for one in self.effects
            for name, value, unit, u in one.parameters
        ]
        columns = (
            "effect", "parameter", "value", "standard_uncertainty", "unit", "status", "hint",
            "probability", "p_value",
        )  # fmt: skip
        return pandas.DataFrame(rows, columns=columns).set_index(["effect", "parameter"])

    def to_xarray(self) -> Any:
        """The identified machine as an `xarray.Dataset` in SI units: the parameters
        (`Fit.to_xarray`), and every error motion and location error with its standard uncertainty,
        ``"EXX"`` and ``"u_EXX"``, over the positions of its axis (`error_motion_tables`).

        Raises `ImportError` where xarray is not installed.
        """
        found = self.after.to_xarray()
        for table in error_motion_tables(self.after, alternatives=self.alternatives):
            dims, unit = (), si_unit(table.unit)
            if len(table.position):
                dims = (f"position_{table.axis}",)
                place = {"units": si_unit(table.position_unit)}
                position = table.position * si_factor(table.position_unit)
                found = found.assign_coords({dims[0]: (dims, position, place)})
            for name, values in ((table.name, table.value), (f"u_{table.name}", table.u)):
                inside = np.asarray(values) * si_factor(table.unit)
                shaped = inside if dims else inside[0]
                found[name] = (dims, shaped, {"units": unit})
        return found

    @property
    def variance(self) -> dict[str, float]:
        """Shares of the whitened variance that the declared model leaves: the named effects, the
        empirical description, the declared noise, and the rest. They add up to one.
        """
        before, after = (self.errors[name].chi2_per_dof for name in ("before", "after"))
        before = max(before, after)  # with other weights, the declared chi2 is not minimal
        noise = min(1.0, after)
        what, described = self.unexplained, 0.0
        if what is not None and what.empirical is not None:
            described = what.share_of_variance * (after - noise)
        elif what is not None:
            best = max([*what.shares, *(share for *_, share in what.products)], default=0.0)
            described = min(best * after, after - noise)
        return {
            "named effects": (before - after) / before,
            "description": described / before,
            "noise": noise / before,
            "rest": (after - noise - described) / before,
        }

    @property
    def searched(self) -> list[str]:
        """The requested effects that were screened: they have a place on this instrument and the
        columns they need, and the declared model does not span them.
        """
        screened = {kind.kind for screening in self.screenings for kind in screening.kinds}
        return [name for name in self.settings.get("effects", ()) if name in screened]

    @property
    def passed_over(self) -> list[Rejected]:
        """Kinds of effects that were significant in some round but were neither added nor refitted,
        and are not in `rejected`. The last such round counts.
        """
        known = {f.effect.name for f in self.effects} | {r.effect for r in self.rejected}
        found: dict[str, Rejected] = {}
        for i, screening in enumerate(self.screenings):
            for kind in screening.kinds:
                p_value, best = screening.corrected(kind), kind.peaks[0].effect
                listed = kind.kind in known or isinstance(best, Empirical)
                if p_value <= self.settings["alpha"] and not listed:
                    why = self._why_passed_over(i)
                    found[kind.kind] = Rejected(kind.kind, best.placement, p_value, why)
        return list(found.values())

    def _why_passed_over(self, number: int) -> str:
        """Reason why the remaining candidates of a round (counted from 0) were not refitted."""
        if number < len(self.screenings) - 1:
            return "no longer significant after another effect was added"
        if self.interrupted:
            return "the search was interrupted"
        if self.screenings[number].added is not None:
            return "less probable than the effect that was added"
        if self.full:
            return "no more effects may be added (max_effects)"
        if self.unexplained is not None and self.unexplained.empirical is not None:
            return outdone_by(self.unexplained.empirical.effect)
        return "its evidence is far below that of others"

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        said = " ".join(filter(None, (self._noise_in_words, self._verdict_in_words, self.no_gain)))
        gross = self.sizes is not None and self.sizes.test.gross
        if gross and self.sizes is not None and self.sizes.words not in said:
            return f"The machine is not as declared: {self.sizes.words}. {said}"
        return said

    @property
    def wrong_noise(self) -> float | None:
        """Scatter of the readings over their declared noise, where that is wrong by a large factor
        that is the same for all kinds of reading and data sets; None where it is not, and where
        something else is unexplained, which scatters as well.
        """
        factor, each = self.noise_scale, [*self.noise_scales.values()]
        far = factor >= _WRONG or 0.0 < factor <= 1.0 / _WRONG
        uneven = self.noise_uneven or (each and max(each) > _EVEN * min(each))
        return factor if far and not uneven and self.unexplained is None else None

    @property
    def _noise_in_words(self) -> str:
        """A sentence where the declared noise is wrong by a large factor; else empty."""
        factor = self.wrong_noise
        if factor is None:
            return ""
        times, size = (factor, "small") if factor > 1.0 else (1.0 / factor, "large")
        alike = "" if len(self.noise_components) < 2 else " in all kinds of reading alike"
        return (
            f"The declared noise is {times:.2g} times too {size}: the readings scatter "
            f"{factor:.2g} times as declared{alike}."
        )

    @property
    def found(self) -> list[FoundEffect]:
        """The effects that are more likely than not, with a value above its uncertainty."""
        return [effect for effect in self.effects if not effect.hint]

    @property
    def hints(self) -> list[FoundEffect]:
        """The other effects that were added (`FoundEffect.hint`)."""
        return [effect for effect in self.effects if effect.hint]

    @property
    def _verdict_in_words(self) -> str:
        names, hints = [e.name for e in self.found], [e.name for e in self.hints]
        listed = _and(names)
        if self.interrupted:
            listed = _and(names + hints)
            return f"Interrupted before the search ended; found by then: {listed or 'nothing'}."
        tried = set(self.settings.get("effects", ()))
        tested = {kind.kind for screening in self.screenings for kind in screening.kinds}
        if self.verdict == "nothing_missing" and tried and tested and not tried & tested:
            return (
                "Nothing could be tested: the data contain no information about any effect that "
                "was tried."
            )
        if self.verdict == "nothing_missing" and self.wrong_noise and self.sizes is None:
            return "With the noise that the readings show, nothing was found that the model lacks."
        if self.louder:
            return (
                f"No effect was found, but {self._scatter()} times as declared: the noise is "
                "larger than declared, or an effect is missing that none of those tried describes."
            )
        if self.verdict == "nothing_missing" and self.sizes is not None:
            return f"No effect was found, but the declared sizes do not fit: {self.sizes.words}."
        if self.verdict == "nothing_missing":
            return "The declared model explains the measurement: nothing was found that it lacks."
        if self.verdict == "named":
            more = f"; there is a hint of {_and(hints)}" if hints else ""
            return f"The declared model lacked {listed}{more}."
        if self.verdict == "ambiguous" and all(one.perhaps_chance for one in self.effects):
            return (
                f"There is a hint of {_and(hints)}, but it is as likely that the declared model "
                "lacks nothing."
            )
        if self.verdict == "ambiguous":
            likely = all(
                2.0 * p < 1.0 for found in self.found for *_, p in found.alternatives
            )  # else a rival is more probable
            how = "most likely" if likely and names else "it may be"
            more = f", and perhaps {_and(hints)}" if names and hints else ""
            listed = listed or _and(hints)
            return f"The declared model lacks something: {how} {listed}{more}, but not for certain."
        found = f"Found {listed}; the rest is unexplained" if names else "Unexplained"
        if hints:
            several = counted(len(hints), "further effect" if names else "effect")
            found = f"Found {listed}, hints of {several}" if names else f"Hints of {several}"
            found += "; the rest is unexplained"
        limit = ", and no more effects may be added (max_effects)" if self.full else ""
        return f"{found}{limit}: {self._remainder()}."

    @property
    def louder(self) -> dict[str, float]:
        """Where no effect was found: noise far larger than declared, by kind of reading or data set
        (all: without a name), in units of the declared noise.
        """
        if self.verdict != "nothing_missing":
            return {}
        if self.noise_scale >= _LOUDER and not self.noise_uneven:
            return {"": self.noise_scale}
        parts = {
            part.name: part.factor
            for part in self.noise_components
            if part.factor >= _LOUDER and part.factor - 1.0 > _SURELY * part.u
        }
        sets = {name: scale for name, scale in self.noise_scales.items() if scale >= _LOUDER}
        return parts or sets

    def _scatter(self) -> str:
        """`louder` in words, up to "times as declared"."""
        (name, factor), *others = self.louder.items()
        first = f"{name} scatters {factor:.2g}" if name else f"the readings scatter {factor:.2g}"
        return _and([first, *(f"{other} {factor:.2g}" for other, factor in others)])

    @property
    def full(self) -> bool:
        """Whether the limit of effects ended the search, and no description did."""
        described = self.unexplained is not None and self.unexplained.empirical is not None
        return not described and len(self.effects) >= self.settings["max_effects"]

    def _remainder(self) -> str:
        swings = self.vibration
        if swings is None:
            return self._described()
        # A vibration in one data set does not describe the remainder of the others.
        most = swings.share > _MOST_OF_IT and not swings.data_set
        return swings.words if most else f"{self._described()}; {swings.words}"

    def _described(self) -> str:
        what = self.unexplained
        if what is None or not what.depends_on:
            return "it depends on no recorded covariate"
        axes = self.after.measurement.plan.axes
        columns = [file_column(name, axes)[0] for name in what.depends_on[:2]]
        on = " times ".join(columns if what.joint else columns[:1])
        along = f" {way(what.direction)}" if what.direction != "mixed" else ""
        described = what.empirical.effect if what.empirical is not None else None
        if isinstance(described, Empirical) and described.unit == "urad":
            along = f" by the rotation {described.port}"
        if what.where:
            place = what.where[0]
            column, given = file_column(place.covariate, axes)[0], self.after.measurement.plan
            low, high = (
                in_file(place.covariate, v, given, self.after.model.instrument)
                for v in (place.low, place.high)
            )
            said = what.words or "an error"
            of = f" with {columns[0]}" if columns[0] != column else ""
            return f"{said}{along}{of} where {column} is {low:.4g} to {high:.4g}"
        if what.words and what.empirical is None:
            share = what.shares[0]
            part = f", {100.0 * share:.0f} % of it with {columns[0]}" if share >= _A_PART else ""
            return f"{what.words}{along}{part}"
        if what.words:
            return f"{what.words}{along} ({on})"
        return f"it depends on {on}"
