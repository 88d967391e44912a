"""Several effects together, where each alone fits badly and may mask the others."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from ...identification.fit import Fit
from ...identification.identify import identify
from ...model.declared_noise import declared_whitener
from .rivals import Rival, widened

MOST = 10
"""Most names of which subsets are weighed."""
_TOGETHER = 4
"""Most effects in a subset."""
_REFITS = 3
"""Number of subsets of each size that are refitted."""


@dataclasses.dataclass(frozen=True)
class Subset:
    """Some rivals, and a fit with all of them."""

    rivals: tuple[Rival, ...]
    fit: Fit


def smallest_subset(
    base: Fit,
    rivals: Sequence[Rival],
    enough: Callable[[Fit], bool],
    most: float,
    keep: np.ndarray,
    room: int = 0,
) -> Subset | None:
    """The smallest subset of rivals (one per name, at least two) whose joint fit is `enough`.

    Of several such subsets of the same size, that with the highest evidence; None where there is
    none. Forward selection may take one effect for parts of two others. All subsets are weighed by
    a linear fit of the amplitudes, with the shapes that each rival has alone. The best of every
    size are refitted, except those whose linear fit leaves a chi-square above `most`, against the
    declared noise.
    """
    linear = _Linear.of(base, rivals)
    for size in range(2, min(_TOGETHER, len(rivals)) + 1):
        sets = list(itertools.combinations(range(len(rivals)), size))
        noise = max(1.0, min(linear.chi2(places) / base.dof for places in sets)) ** 0.5
        sets.sort(key=lambda places: -linear.log_evidence(places, noise))
        found = []
        for places in sets[:_REFITS]:
            if linear.declared_chi2(places) > most:
                continue
            chosen = tuple(rivals[i] for i in places)
            with suppress(np.linalg.LinAlgError):
                fit = _together(base, chosen, keep, room)
                if fit.converged and fit.determined and enough(fit):
                    found.append(Subset(chosen, fit))
        if found:
            noise = max(1.0, min(one.fit.chi2 / one.fit.dof for one in found)) ** 0.5
            return max(found, key=lambda one: _evidence(one, noise))
    return None


@dataclasses.dataclass(frozen=True)
class _Linear:
    """Linear problem in the amplitudes of all rivals, with the parameters of a fit eliminated."""

    left: np.ndarray
    """Whitened residual of the fit, and of its prior."""
    response: np.ndarray
    """Its derivative by the amplitudes, with the parameters of the fit eliminated."""
    declared: np.ndarray
    """(n, m, m), from the whitened readings of a row to those in units of the declared noise."""
    gram: np.ndarray
    slope: np.ndarray
    precision: np.ndarray
    columns: list[np.ndarray]
    """Of every rival."""
    log_prior: np.ndarray

    @classmethod
    def of(cls, base: Fit, rivals: Sequence[Rival]) -> "_Linear":
        """The problem linearised at the minimum of the fit."""
        root = np.sqrt(base.within_scans)
        known = np.linalg.qr(np.vstack([base.jacobian, np.diag(root)]))[0]

        def beside(columns: np.ndarray) -> np.ndarray:
            return columns - known @ (known.T @ columns)

        responses, precision, places, end = [], [], [], 0
        for rival in rivals:
            size, mine = len(rival.effect.amplitudes), rival.fit.model.places[-1]
            response = rival.fit.jacobian[:, mine]
            responses.append(np.vstack([response, np.zeros((len(root), size))]))
            precision.append(rival.fit.precision[mine])
            places.append(np.arange(end, end := end + size))
        left = beside(np.concatenate([base.whitened, -root * base.theta]))
        response = beside(np.hstack(responses))
        declared = declared_whitener(base.model, base.measurement)
        return cls(
            left,
            response,
            np.einsum("nij,njk->nik", declared, np.linalg.pinv(np.asarray(base.whitener))),
            response.T @ response,
            response.T @ left,
            np.concatenate(precision),
            places,
            np.array([rival.log_prior for rival in rivals]),
        )

    def chi2(self, places: Sequence[int]) -> float:
        """Chi-square of a fit with these rivals, including their priors."""
        return float(self.left @ self.left) - 2.0 * self._solved(places, 1.0)[0]

    def declared_chi2(self, places: Sequence[int]) -> float:
        """Chi-square of the readings alone, against the declared noise."""
        its = self._places(places)
        h = self.gram[np.ix_(its, its)] + np.diag(self.precision[its])
        left = self.left - self.response[:, its] @ np.linalg.lstsq(h, self.slope[its])[0]
        n, m, _ = self.declared.shape
        rows = np.einsum("nij,nj->ni", self.declared, left[: n * m].reshape(n, m))
        return float((rows**2).sum())

    def log_evidence(self, places: Sequence[int], noise: float) -> float:
        """Log evidence over the fit without rivals, with the noise multiplied by `noise`."""
        gain, h, precision = self._solved(places, noise)
        proper = precision[precision > 0.0]
        occam = 0.5 * (np.log(proper).sum() - np.linalg.slogdet(h)[1])
        return float(gain + occam + self.log_prior[list(places)].sum())

    def _places(self, places: Sequence[int]) -> np.ndarray:
        return np.concatenate([self.columns[i] for i in places])

    def _solved(self, places: Sequence[int], noise: float) -> tuple[float, np.ndarray, np.ndarray]:
        its = self._places(places)
        h = self.gram[np.ix_(its, its)] / noise**2 + np.diag(self.precision[its])
        slope = self.slope[its] / noise**2
        # Two rivals that are identical on these readings leave a flat direction.
        return 0.5 * float(slope @ np.linalg.lstsq(h, slope)[0]), h, self.precision[its]


def _together(base: Fit, rivals: Sequence[Rival], keep: np.ndarray, room: int) -> Fit:
    """The refit with all of them, from where each alone converged."""
    alone = len(base.model.effects)
    model = base.model.with_effects(*(widened(r.effect, r.wider) for r in rivals))
    sizes = [r.fit.theta[r.fit.model.places[-1]] for r in rivals]
    shapes = dict(base.shapes)
    for place, rival in enumerate(rivals, start=alone):
        if shape := rival.fit.shapes.get(alone):
            shapes[place] = dict(shape)
    return identify(
        model,
        base.measurement,
        theta=np.concatenate([base.theta[: len(base.model.entries)], *sizes]),
        shapes=shapes,
        whitener=base.whitener,
        keep=keep,
        room=room,
    )


def _evidence(one: Subset, noise: float) -> float:
    return one.fit.log_evidence(noise) + math.fsum(rival.log_prior for rival in one.rivals)
