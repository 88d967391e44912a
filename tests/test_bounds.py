"""Every number that a user declares has bounds with a reason, and the documentation lists them."""

import math
from typing import get_args

import pytest
from pydantic import BaseModel, ValidationError

from vcal.bounds import Within, declared_bounds
from vcal.design.spaces import SPACES
from vcal.instruments import INSTRUMENTS
from vcal.study import settings
from vcal.study.geometric_family import FAMILY_COLUMNS
from vcal.study.machine_description import MachineDescription
from vcal.study.optional_columns import CONDITIONS, condition

ROOTS = (
    settings.StudySettings,
    settings.SeveralSettings,
    settings.FourierSettings,
    settings.SmoothSettings,
    settings.LinkSettings,
    MachineDescription,
    *(one.Settings for one in INSTRUMENTS.values()),
    *(one.Settings for one in SPACES.values()),
)


def tables(model, seen):
    """A settings class and those of the tables in it."""
    if model in seen:
        return seen
    seen.add(model)
    for field in model.model_fields.values():
        stack = [field.annotation]
        while stack:
            one = stack.pop()
            if isinstance(one, type) and issubclass(one, BaseModel):
                tables(one, seen)
            stack += get_args(one)
    return seen


MODELS = sorted(
    {model for root in ROOTS for model in tables(root, set())}, key=lambda one: one.__qualname__
)


@pytest.mark.parametrize("model", MODELS, ids=lambda one: one.__name__)
def test_every_number_has_bounds_with_a_reason(model):
    for one in declared_bounds(model):
        assert one.within is not None, f"{model.__name__}.{one.key} has no bounds"
        assert one.within.low < one.within.high and len(one.within.why) > 10, one


def test_there_are_numbers():
    """So that the test above does not pass for want of any."""
    assert sum(1 for model in MODELS for _ in declared_bounds(model)) > 200


def test_the_documentation_lists_all_of_them():
    pytest.importorskip("sphinx")
    from _site.bounds import bounds
    from _site.study_keys import settings_classes

    page = bounds()
    listed = {one.model for one in (*settings_classes(), *settings_classes(MachineDescription))}
    for model in MODELS:
        for one in declared_bounds(model):
            assert f"``{one.key.partition('.')[0]}``" in page, (model, one.key)
        assert model in listed or not [*declared_bounds(model)], model
    assert "no tool is longer than 10 m" in page and "no screw" in page


class Example(BaseModel):
    """Numbers with bounds of every kind."""

    share: settings.Seed = 3
    ends: tuple[settings.Position, settings.Position] = (0.0, 1.0)


def test_bounds_hold_at_their_ends():
    closed, half = Within(0.0, 1.0, "x"), Within(0.0, 1.0, "x", open_low=True, open_high=True)
    assert closed.holds(0.0) and closed.holds(1.0) and not closed.holds(math.nan)
    assert not half.holds(0.0) and not half.holds(1.0) and half.holds(0.5)
    assert half.expected(0.0) == "a number greater than 0" and closed.interval == "0 to 1"
    assert half.expected(1.0) == "a number less than 1" and half.interval == "above 0, below 1"
    assert closed.expected(-1.0) == "a number of at least 0"
    assert Within(0.0, math.inf, "x").interval == "at least 0"


def test_a_mistake_says_why():
    with pytest.raises(ValidationError) as caught:
        Example.model_validate({"ends": (0.0, 1e9)})
    (error,) = caught.value.errors()
    assert error["ctx"]["why"] == "no machine has an axis of more than 200 m"
    assert error["loc"] == ("ends", 1)


@pytest.mark.parametrize(
    ("column", "low"),
    [("T_x_degC", -50.0), ("spindle_degC", -50.0), ("payload_kg", 0.0), ("tool_mass_kg", 0.0),
     ("path_mm", 0.0), ("since_x_mm", 0.0), ("run", 0.0), ("q3_cmd_deg", -720.0)],
)  # fmt: skip
def test_columns_of_conditions(column, low):
    found = condition(column)
    assert found is not None and found.low == low and found.why


def test_columns_of_ones_own_have_no_bounds():
    assert condition("pressure_bar") is None and condition("x_offset_um") is None


def test_every_column_has_a_reason():
    assert all(len(c.why) > 10 for c in (*CONDITIONS, *FAMILY_COLUMNS))
