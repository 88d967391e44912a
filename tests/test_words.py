"""Numbers and sentences as they are printed."""

import pytest

from vcal.report.html.text import sentence_of
from vcal.words import three_digits


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.01234, "0.0123"), (4.5, "4.5"), (999.4, "999"), (999.6, "1000"), (1029.4, "1029"),
     (-2820.0, "-2820"), (3e7, "3e+07"), (float("nan"), "nan")],
)  # fmt: skip
def test_three_digits_without_an_exponent(value, text):
    assert three_digits(value) == text


def test_a_sentence_keeps_the_spelling_of_an_identifier():
    assert sentence_of("the noise is larger") == "The noise is larger."
    assert sentence_of("screw_cyclic X: a pitch.") == "screw_cyclic X: a pitch."
