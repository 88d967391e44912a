"""What a study file may say: the keys of setup.toml, their types and bounds."""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator

from ..catalogue import nearest
from ..design.plan_space import DesignSettings
from ..design.spaces import settings_of
from ..errors import StudyError
from ..instruments import INSTRUMENTS
from ..instruments.base import FileName, InstrumentSettings, TableInstrument
from ..loop.loop_settings import LoopSettings
from .folder import Folder
from .messages import at, explain, listed, refusal, shown, source
from .own_code import told
from .own_instruments import own_instruments

Triple = tuple[float, float, float]
_Offset = Annotated[float, Field(ge=-1e4, le=1e4)]
ToolOffset = tuple[_Offset, _Offset, _Offset]
"""No tool is longer than ten metres: such a number is in another unit than mm."""
_Length = Annotated[float, Field(ge=-1e6, le=1e6)]
_Angle = Annotated[float, Field(ge=-720, le=720)]
_Size = Annotated[float, Field(ge=1e-6, le=1e6)]
"""um or urad: errors of a machine that are less, or more than a metre, are in another unit."""
_LARGEST_WHOLE = 2**63 - 1
_SMALLEST, _LARGEST = 1e-15, 1e15
"""Sizes of numbers, other than zero, whose squares and products can be computed with."""
COMPUTABLE = f"zero, or a number from {_SMALLEST:g} to {_LARGEST:g} in size"
"""What messages call a number that is `computable`."""


class Table(BaseModel):
    """A table of a study file: keys that are not declared are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class JointSettings(Table):
    """A row of ``[[machine.joint]]``: standard Denavit-Hartenberg parameters of one joint."""

    type: Literal["revolute", "prismatic"]
    """Whether the joint turns or slides."""
    a_mm: _Length = 0.0
    """Length of the link: along x of the joint's own frame."""
    alpha_deg: _Angle = 0.0
    """Twist of the link: about x."""
    d_mm: _Length = 0.0
    """Offset along z, to which a prismatic joint adds its position."""
    theta_deg: _Angle = 0.0
    """Angle about z, to which a revolute joint adds its position."""
    low_deg: float | None = None
    """Lowest angle of a revolute joint; not checked where it is not given."""
    high_deg: float | None = None
    """Highest angle of a revolute joint."""
    low_mm: float | None = None
    """Lowest position of a prismatic joint."""
    high_mm: float | None = None
    """Highest position of a prismatic joint."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest joint variable, degree or millimetre; infinite where not given."""
        low, high = (
            (self.low_deg, self.high_deg)
            if self.type == "revolute"
            else (self.low_mm, self.high_mm)
        )
        return -math.inf if low is None else low, math.inf if high is None else high

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        unit, other = ("deg", "mm") if self.type == "revolute" else ("mm", "deg")
        for key in (f"low_{other}", f"high_{other}"):
            if getattr(self, key) is not None:
                raise ValueError(
                    f"found {key}, expected low_{unit} and high_{unit} for a {self.type} joint; "
                    "correct the key"
                )
        low, high = self.bounds
        if not low < high:
            raise ValueError(
                f"found low_{unit} {low:g} and high_{unit} {high:g}, expected low below high; "
                "exchange or correct them"
            )
        return self


class RotarySettings(Table):
    """``[machine.rotary.C]``: where a rotary axis of a machine is, and how far it turns."""

    at_mm: tuple[_Length, _Length, _Length]
    """A point on the axis while all axes are at zero, in the frame of the machine, in which the
    tool point is then at `tool_offset_mm`."""
    travel_deg: tuple[_Angle, _Angle] | None = None
    """Lowest and highest angle; a whole turn or more, where its errors come round with it."""

    @model_validator(mode="after")
    def _turns(self) -> Self:
        if self.travel_deg is not None and not self.travel_deg[1] - self.travel_deg[0] >= 1.0:
            low, high = self.travel_deg
            raise ValueError(
                f"found travel_deg = [{low:g}, {high:g}], expected [lowest, highest] in degrees, "
                "one degree apart at least; exchange or correct them"
            )
        return self


class MachineSettings(Table):
    """``[machine]``: a chain of linear and rotary axes, or an arm in joint rows."""

    chain: str | None = None
    """ISO 10791-6 description, such as ``"w X b Y Z t"``."""
    tool_offset_mm: ToolOffset = (0.0, 0.0, 0.0)
    """From the last axis's frame to the tool point."""
    travel_mm: dict[str, tuple[float, float]] = {}
    """Lowest and highest position per linear axis."""
    rotary: dict[Literal["A", "B", "C"], RotarySettings] = {}
    """The rotary axes of the chain."""
    joint: tuple[JointSettings, ...] = ()
    up: Literal["+X", "-X", "+Y", "-Y", "+Z", "-Z"] = "+Z"
    """Which axis points against gravity: "+Y" where the spindle is horizontal, "-Z" for an arm that
    hangs from the ceiling."""
    base: str | None = None
    """A remark on where the arm's base stands; its pose is always identified."""

    @model_validator(mode="after")
    def _one_machine(self) -> Self:
        if (self.chain is None) == (not self.joint):
            found = (
                "both a chain and joint rows" if self.joint else "neither a chain nor joint rows"
            )
            raise ValueError(
                f"found {found}, expected either `chain` (axes of a machine tool) or "
                "[[machine.joint]] rows; keep or add one of them"
            )
        if self.joint and self.rotary:
            raise ValueError(
                "found rotary beside joint rows, expected it beside a `chain`; describe the axes "
                "in the rows, or remove it"
            )
        if self.joint and self.travel_mm:
            raise ValueError(
                "found travel_mm beside joint rows, expected the bounds in the rows; "
                "give `low_deg` and `high_deg` (revolute) or `low_mm` and `high_mm` (prismatic) "
                "per [[machine.joint]]"
            )
        return self


class FourierSettings(Table):
    """``[model.geometric]`` of a machine tool whose amplitudes stand in a table."""

    family: Literal["fourier"]
    """Fourier polynomials over the travel."""
    table: FileName
    """File with the columns component, a0, a1, n1, b1, c1, n2, b2, c2 (um, urad)."""


class SmoothSettings(Table):
    """``[model.geometric]`` of a machine tool with smooth error motions of declared size."""

    family: Literal["smooth"]
    """Smooth functions over the travel (Matern-5/2)."""
    translation_um: _Size
    """One-sigma size of each error translation."""
    rotation_urad: _Size
    """One-sigma size of each error rotation."""
    squareness_urad: _Size
    """One-sigma size of each squareness, also of rotary axes to what carries them."""
    location_um: _Size | None = None
    """One-sigma size of each error of where a rotary axis is; by default `translation_um`."""
    smoothness: float = Field(default=0.5, ge=0.02, le=10)
    """Correlation length over travel. Guideways bend over about half their length."""


class LinkSettings(Table):
    """``[model.geometric]`` of an arm: constant errors of each link."""

    family: Literal["smooth"] = "smooth"
    """May be left out: an arm has this one only."""
    link_translation_um: _Size
    """One-sigma size of each of the three error translations of a link."""
    link_rotation_urad: _Size
    """One-sigma size of each of the three error rotations of a link."""


class AnyFamilySettings(Table):
    """The keys of all families, to say what is wrong where the family is not one of them."""

    family: Literal["fourier", "smooth"]
    table: Any = None
    translation_um: Any = None
    rotation_urad: Any = None
    squareness_urad: Any = None
    location_um: Any = None
    smoothness: Any = None


class EffectSettings(BaseModel):
    """A row of ``[[model.effect]]``; the further keys are parameters with their unit."""

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, Any] = Field(init=False)
    name: str
    """Identifier of the catalogue, or of an effect in `effects_file`."""
    data_set: str | None = None
    """Data set whose instrument it belongs to, where there are several."""
    placement: str = ""
    """Axis or joint where it sits."""
    component: str | None = None
    """Port on which it acts, such as ``"EAY"``, where there are several."""


class ModelSettings(Table):
    """``[model]``: what is declared about errors."""

    geometric: Table | None = None
    effect: tuple[EffectSettings, ...] = ()
    effects_file: FileName | None = None
    """Python file beside the study with the user's own effect classes."""


class DataSettings(Table):
    """``[data]``: names of the tables beside the study file."""

    data: FileName = "data.csv"
    """Table with one row per reading, or per point of a plan."""
    check: FileName | None = None
    """Independent check points; by default ``check.csv`` where that exists."""
    must_see: dict[str, int] = {}
    """What the points have to tell apart without any prior: by name, the highest Legendre degree of
    an error motion (``EYX = 4``; a straightness counts from the second degree, as its slope is a
    squareness), or zero for a squareness (``EC0Y = 0``).
    """


class DataSetSettings(Table):
    """A row of ``[[data]]``: one of several data sets of the machine, with its instrument."""

    name: str
    """What reports call it: letters, digits, ``-`` and ``_``."""
    file: FileName
    """Its table beside the study file."""
    instrument: InstrumentSettings
    tool_offset_mm: ToolOffset | None = None
    """From the last axis's frame to the tool point, where it is not that of the machine."""
    start_s: float = 0.0
    """When its ``t_s`` was zero, on the clock of the study."""
    must_see: dict[str, int] = {}
    """What its points have to tell apart by themselves, as in ``[data]``."""


class StudySettings(Table):
    """setup.toml as a whole; `instrument`, `design` and `model.geometric` are refined by what they
    name.
    """

    name: str = ""
    """What reports call the study."""
    machine: MachineSettings
    instrument: InstrumentSettings
    model: ModelSettings = ModelSettings()
    data: DataSettings = DataSettings()
    loop: LoopSettings = LoopSettings()
    design: DesignSettings = DesignSettings()


class SeveralSettings(Table):
    """setup.toml of several data sets, each row of `data` refined by its instrument."""

    name: str = ""
    """What reports call the study."""
    machine: MachineSettings
    data: tuple[DataSetSettings, ...]
    check: FileName | None = None
    """Independent check points; by default ``check.csv`` where that exists."""
    model: ModelSettings = ModelSettings()
    loop: LoopSettings = LoopSettings()


AnySettings = StudySettings | SeveralSettings
"""What a study file may say as a whole."""


def computable(value: float) -> bool:
    """Whether a number is of a size that a quantity in the unit of its name can have."""
    return value == 0 or _SMALLEST <= abs(value) <= _LARGEST


def validate(
    raw: Mapping[str, Any], file: str, overrides: Mapping[str, str], folder: Folder
) -> AnySettings:
    """The settings in a raw tree; raises `StudyError` that lists every mistake in it.

    Files in `folder` that define a user's own instruments are run for it.
    """
    for key, value in _numbers(raw):
        if isinstance(value, int):
            if abs(value) > _LARGEST_WHOLE:
                raise refusal(
                    source(file, key, overrides),
                    f"key {key}",
                    shown(value),
                    "a whole number of at most 2^63 - 1",
                    "correct the value",
                )
            continue
        spread = key.startswith("model.effect.") and key.endswith("_sigma") and value == math.inf
        if not math.isfinite(value) and not spread:
            raise refusal(
                source(file, key, overrides),
                f"key {key}",
                str(value),
                "a finite number",
                "correct the value",
            )
        if math.isfinite(value) and not computable(value):
            raise refusal(
                source(file, key, overrides),
                f"key {key}",
                f"{value:g}",
                COMPUTABLE,
                "correct the value",
            )
    refined = _several if isinstance(raw.get("data"), list) else _refined
    model = refined(raw, file, overrides, folder)
    try:
        # As JSON, in which a list is a tuple, so that validation can be strict about the rest:
        # "3", 3.0 and true are not taken for 3.
        return model.model_validate_json(json.dumps(raw, default=str), strict=True)
    except ValidationError as error:
        raise explain(error, file, raw, model, overrides) from error
    except Exception as error:  # of a validator in a user's own settings
        if (text := told(error)) is None:
            raise
        raise StudyError(text) from error


def _refined(
    raw: Mapping[str, Any], file: str, overrides: Mapping[str, str], folder: Folder
) -> type[StudySettings]:
    """The settings class with the named instrument's and family's own keys."""
    kind = _kind(raw, ("instrument",), file, overrides, folder)
    instrument = kind.Settings if kind is not None else InstrumentSettings
    design = settings_of(kind.kind) if kind is not None else DesignSettings
    model = _model(raw)
    return create_model(
        "StudySettings",
        __base__=StudySettings,
        machine=(MachineSettings, _machine([kind])),
        instrument=(instrument, ...),
        model=(model, model()),
        design=(design, design()),
    )


def _several(
    raw: Mapping[str, Any], file: str, overrides: Mapping[str, str], folder: Folder
) -> type[SeveralSettings]:
    """The same for several data sets: every row has the keys of its own instrument.

    Raises `StudyError` for a second way to name an instrument, and for names of data sets that are
    not to be told from each other or from an axis.
    """
    if "instrument" in raw:
        raise refusal(
            source(file, "instrument", overrides),
            "key instrument",
            "an [instrument] beside [[data]] rows",
            "one or the other: a row has its own [data.instrument]",
            "move it below the row of its data, or write [data] for a single data set",
        )
    rows = raw["data"]
    if not rows:
        raise refusal(file, "key data", "no row", "at least one [[data]]", "add one")
    kinds, types = [], []
    for i in range(len(rows)):
        _check_name(rows, i, file, overrides)
        kind = _kind(raw, ("data", i, "instrument"), file, overrides, folder)
        instrument: Any = kind.Settings if kind is not None else InstrumentSettings
        kinds.append(kind)
        types.append(
            create_model("DataSetSettings", __base__=DataSetSettings, instrument=(instrument, ...))
        )
    model = _model(raw)
    sets: Any = tuple[tuple(types)]
    return create_model(
        "SeveralSettings",
        __base__=SeveralSettings,
        machine=(MachineSettings, _machine(kinds)),
        data=(sets, ...),
        model=(model, model()),
    )


def _check_name(rows: Sequence[Any], i: int, file: str, overrides: Mapping[str, str]) -> None:
    name = at(rows, (i, "name"))
    if not isinstance(name, str):
        return  # the validation says so
    place, key = source(file, f"data.{i}.name", overrides), f"key data.{i}.name"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
        raise refusal(
            place,
            key,
            shown(name),
            "letters, digits, - and _, beginning with a letter or a digit",
            "correct the name",
        )
    earlier = [at(rows, (k, "name")) for k in range(i)]
    if name in earlier:
        raise refusal(
            place,
            key,
            f"{name!r} again, first in data.{earlier.index(name)}.name",
            "every name once",
            "rename one of the data sets",
        )


def _kind(
    raw: Mapping[str, Any],
    key: Sequence[str | int],
    file: str,
    overrides: Mapping[str, str],
    folder: Folder,
) -> type[TableInstrument] | None:
    """The class of the instrument in a table, None where there is none to be read."""
    kind, own = at(raw, (*key, "kind")), at(raw, (*key, "kind_file"))
    table = ".".join(str(part) for part in key)
    if own is not None and not (isinstance(own, str) and own):
        raise refusal(
            source(file, f"{table}.kind_file", overrides),
            f"key {table}.kind_file",
            shown(own),
            "a Python file beside the study file, in quotes",
            "correct the value",
        )
    if not isinstance(kind, str):
        return None
    known = INSTRUMENTS if own is None else own_instruments(folder, own)
    if kind not in known:
        raise refusal(
            source(file, f"{table}.kind", overrides),
            f"key {table}.kind",
            f"the unknown instrument {kind!r}{nearest(kind, known)}",
            f"one of {listed(known)}" + ("" if own is None else f", as defined in {own}"),
            "correct the kind, or name the file of an instrument of your own as kind_file"
            if own is None
            else f"correct the kind; without the kind_file, it may be one of {listed(INSTRUMENTS)}",
        )
    return known[kind]


def _machine(kinds: Sequence[type[TableInstrument] | None]) -> Any:
    """The machine where the study has none: what its instruments, if they agree, go by."""
    usual = {None if kind is None else kind.machine for kind in kinds}
    chain = usual.pop() if len(usual) == 1 else None
    return ... if chain is None else MachineSettings(chain=chain)


def _model(raw: Mapping[str, Any]) -> Any:
    """``[model]`` with the keys of the named family."""
    family = at(raw, ("model", "geometric", "family"))
    geometric: type[Table]
    if at(raw, ("machine", "joint")) and not at(raw, ("machine", "chain")):
        geometric = LinkSettings
    else:
        families = {"fourier": FourierSettings, "smooth": SmoothSettings}
        geometric = families.get(family if isinstance(family, str) else "", AnyFamilySettings)
    # pydantic reads these at run time, which a type checker cannot follow.
    optional: Any = geometric | None
    return create_model("ModelSettings", __base__=ModelSettings, geometric=(optional, None))


def _numbers(tree: Any, key: str = "") -> Iterator[tuple[str, int | float]]:
    if isinstance(tree, int | float):
        yield key, tree
    elif isinstance(tree, Mapping | list):
        items = tree.items() if isinstance(tree, Mapping) else enumerate(tree)
        for part, value in items:
            yield from _numbers(value, f"{key}.{part}" if key else str(part))
