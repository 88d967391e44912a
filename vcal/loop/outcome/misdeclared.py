"""Declared sizes that do not fit, as a result."""

from collections.abc import Mapping
from dataclasses import dataclass

from ...identification.declared_sizes import DeclaredSizes

_LARGER = 1.2
"""Factor from which a size counts as larger than declared."""


@dataclass(frozen=True)
class Misdeclared:
    """Declared sizes that do not fit the readings."""

    test: DeclaredSizes
    factors: Mapping[str, float]
    """Factors on the sizes of error motions and location errors with which they fit, by kind
    (`declared_kind`); empty where no factors help."""
    used: bool
    """Whether the search started from a fit with these sizes."""

    @property
    def words(self) -> str:
        """What is larger than declared, after "the declared sizes do not fit:"."""
        if self.test.gross:
            far = [
                f"{p.name} is {value:.3g} {p.unit}, {abs(times):.0f} times its declared size"
                for _, p, times, value in self.test.far[:3]
            ]
            return "; ".join(far)
        larger = [
            f"{kind} {factor:.2g} times"
            for kind, factor in self.factors.items()
            if factor > _LARGER
        ]
        if larger:
            return f"errors are larger than declared ({', '.join(larger)})"
        return f"errors are {self.test.ratio:.2g} times larger than declared"
