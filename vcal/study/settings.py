"""The keys of a study file (setup.toml), with their types, units and bounds."""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator

from ..bounds import (
    Angle,
    ErrorSize,
    JointBound,
    LinkLength,
    Offset,
    Position,
    RotaryBound,
    Seed,
    Within,
)
from ..design.plan_space import DesignSettings
from ..design.spaces import settings_of
from ..errors import StudyError
from ..instruments import INSTRUMENTS
from ..instruments.base import FileName, InstrumentSettings, TableInstrument
from ..loop.settings import LoopSettings
from ..registry import nearest
from .folder import Folder
from .messages import at, explain, listed, refusal, shown, source
from .plugins.instruments import own_instruments
from .plugins.trial import own_code_error
from .reading.assign import Place
from .reading.formats import TableFormat, plain_format
from .statements import AcceptanceSettings, CertificateSettings, MeasurementSettings, Words

ToolOffset = tuple[Offset, Offset, Offset]
"""Tool offset, mm."""
_Smoothness = Annotated[
    float,
    Within(0.02, 10.0, "shorter lies between the points, and longer is a straight line"),
]
_Component = Annotated[float, Within(-1e6, 1e6, "a direction has components of the size of one")]
_Vector = tuple[_Component, _Component, _Component]
_Coupling = Annotated[float, Within(-1e4, 1e4, "no gearing between joints is larger")]
_Degree = Annotated[int, Within(0, 50, "no plan has the points for a higher degree")]
_SMALLEST, _LARGEST = 1e-15, 1e15
"""Sizes of nonzero numbers whose squares and products stay finite and nonzero."""
COMPUTABLE = f"zero, or a number from {_SMALLEST:g} to {_LARGEST:g} in size"
"""Description in messages of a number that is `computable`."""


class Table(BaseModel):
    """A table of a study file. Unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class JointSettings(Table):
    """A row of ``[[machine.joint]]``: standard Denavit-Hartenberg parameters of one joint."""

    type: Literal["revolute", "prismatic"]
    """Whether the joint turns or slides."""
    a_mm: LinkLength = 0.0
    """Length of the link: along x of the joint's own frame."""
    alpha_deg: Angle = 0.0
    """Twist of the link: about x."""
    d_mm: LinkLength = 0.0
    """Offset along z, to which a prismatic joint adds its position."""
    theta_deg: Angle = 0.0
    """Angle about z, to which a revolute joint adds its position."""
    low_deg: JointBound | None = None
    """Lowest angle of a revolute joint; unbounded by default."""
    high_deg: JointBound | None = None
    """Highest angle of a revolute joint; unbounded by default."""
    low_mm: JointBound | None = None
    """Lowest position of a prismatic joint; unbounded by default."""
    high_mm: JointBound | None = None
    """Highest position of a prismatic joint; unbounded by default."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest joint variable, degree or millimetre; infinite where unbounded."""
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
    """``[machine.rotary.C]``: position and travel of a rotary axis."""

    at_mm: tuple[Position, Position, Position]
    """A point on the axis with all axes at zero, in the machine frame, in which the tool point is
    then at `tool_offset_mm`."""
    travel_deg: tuple[RotaryBound, RotaryBound] | None = None
    """Lowest and highest angle. Over a whole turn or more, the error motions are periodic."""

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
    """``[machine]``: a chain of linear and rotary axes, or an arm described by joint rows."""

    chain: str | None = None
    """Kinematic chain by ISO 10791-6, such as ``"w X b Y Z t"``: workpiece, axes, bed, axes, tool.
    """
    tool_offset_mm: ToolOffset = (0.0, 0.0, 0.0)
    """Vector from the frame of the last axis to the tool point."""
    travel_mm: dict[str, tuple[Position, Position]] = {}
    """Lowest and highest position per linear axis."""
    rotary: dict[Literal["A", "B", "C"], RotarySettings] = {}
    """Position and travel of every rotary axis of the chain."""
    joint: tuple[JointSettings, ...] = ()
    """Joints of an arm from base to flange, in place of a chain."""
    urdf: FileName | None = None
    """URDF file in the study folder that describes an arm, in place of a chain or of joint rows.
    Its moving joints from the base to the tip are J1, J2, ..., with columns q1_cmd_deg (or
    q1_cmd_mm of a prismatic one), ..."""
    base_link: str | None = None
    """Link of the URDF file that is the base; by default the one that no joint carries."""
    tip_link: str | None = None
    """Link of the URDF file in whose frame the tool offset is; by default the only one that carries
    no other."""
    convention: Literal["standard", "modified"] = "standard"
    """Denavit-Hartenberg convention of the joint rows: Rz(theta) Tz(d) Tx(a) Rx(alpha), or modified
    (Craig), Rx(alpha) Tx(a) Rz(theta) Tz(d)."""
    coupling: tuple[tuple[_Coupling, ...], ...] | None = None
    """Matrix from the commanded positions of all joints, in the units of their columns, to the
    joint variables of the rows: one row per joint. For an arm that counts joint 3 from the
    horizontal, the third row is [0, -1, 1, 0, 0, 0]. The identity by default."""
    up: Literal["+X", "-X", "+Y", "-Y", "+Z", "-Z"] | _Vector = "+Z"
    """The direction against gravity in the frame of the bed or of the arm's base: an axis ("+Y" for
    a horizontal spindle, "-Z" for an arm that hangs from the ceiling), or a vector of any length,
    such as [0.5, 0, 0.87] for a base on a slope."""
    base: str | None = None
    """A remark on the place of the arm's base, whose pose is always identified."""
    manufacturer: Words | None = None
    """Manufacturer of the machine; shown in the report and in a certificate, as the next two."""
    model: Words | None = None
    """Its model or type designation, as on its plate."""
    serial_number: Words | None = None
    """Its serial number."""

    @model_validator(mode="after")
    def _one_machine(self) -> Self:
        ways = [
            *(["a chain"] if self.chain is not None else []),
            *(["joint rows"] if self.joint else []),
            *(["a urdf"] if self.urdf is not None else []),
        ]
        if len(ways) != 1:
            found = {0: "neither a chain nor joint rows", 2: f"both {' and '.join(ways)}"}
            raise ValueError(
                f"found {found.get(len(ways), ', '.join(ways))}, expected either `chain` (axes of "
                "a machine tool) or [[machine.joint]] rows, or a `urdf` file; keep or add one of "
                "them"
            )
        needed = {
            "convention": ("joint rows", bool(self.joint)),
            "coupling": ("joint rows or a urdf", bool(self.joint) or self.urdf is not None),
            "base_link": ("a urdf", self.urdf is not None),
            "tip_link": ("a urdf", self.urdf is not None),
        }
        for key, (what, there) in needed.items():
            if key in self.model_fields_set and not there:
                raise ValueError(
                    f"found {key} together with {ways[0]}, expected it with {what} only; remove "
                    "it, or describe the machine in that way"
                )
        if not isinstance(self.up, str) and not any(self.up):
            raise ValueError(
                "found up = [0, 0, 0], expected the direction against gravity; correct the vector"
            )
        if self.chain is None and self.rotary:
            raise ValueError(
                f"found rotary together with {ways[0]}, expected it with a `chain` only; describe "
                "the axes in the rows, or remove it"
            )
        if self.urdf is not None and self.travel_mm:
            raise ValueError(
                "found travel_mm together with a urdf, expected the bounds in the limits of its "
                "joints; remove it"
            )
        if self.joint and self.travel_mm:
            raise ValueError(
                "found travel_mm together with joint rows, expected the bounds in the rows; "
                "give `low_deg` and `high_deg` (revolute) or `low_mm` and `high_mm` (prismatic) "
                "per [[machine.joint]]"
            )
        return self


class FourierSettings(Table):
    """``[model.geometric]`` of a machine tool with Fourier amplitudes in a table."""

    family: Literal["fourier"]
    """Fourier polynomials over the travel."""
    table: FileName
    """File with the columns component, a0, a1, n1, b1, c1, n2, b2, c2 (um, urad)."""


class SmoothSettings(Table):
    """``[model.geometric]`` of a machine tool with smooth error motions of declared size."""

    family: Literal["smooth"]
    """Smooth functions over the travel (Matern-5/2)."""
    translation_um: ErrorSize
    """Prior standard deviation of each error translation."""
    rotation_urad: ErrorSize
    """Prior standard deviation of each error rotation."""
    squareness_urad: ErrorSize
    """Prior standard deviation of each squareness error, those of rotary axes included."""
    location_um: ErrorSize | None = None
    """Prior standard deviation of each position error of a rotary axis; `translation_um` by
    default."""
    smoothness: _Smoothness = 0.5
    """Correlation length of an error motion over the travel. Guideways typically bend over about
    half their length."""


class OneLinkSettings(Table):
    """A row of ``[[model.geometric.link]]``: errors of one joint of an arm that are known, of
    another size than those of the others, or shared with another joint.
    """

    joint: str
    """Name of the joint: "J1" for the first row of ``[[machine.joint]]``, and so on."""
    components: str = Field(default="XYZABC", pattern="^[XYZABC]+$")
    """The errors that are meant: translations X, Y, Z and rotations A, B, C, such as "ZC"."""
    fixed: bool = False
    """Whether these errors are known to be zero, and not identified."""
    translation_um: ErrorSize | None = None
    """Prior standard deviation of the error translations; that of the other links by default."""
    rotation_urad: ErrorSize | None = None
    """Prior standard deviation of the error rotations; that of the other links by default."""
    bounded: bool = False
    """Whether these sizes are half-widths of uniform distributions instead. An identification uses
    their standard deviation, the half-width divided by the square root of 3. An error of a
    prismatic joint is then constant along its travel."""
    tie: str | None = None
    """Joint with the same errors, such as one of the same gearbox: one parameter stands for both.
    """

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        sized = [k for k in ("translation_um", "rotation_urad") if getattr(self, k) is not None]
        ways = [*(["fixed"] if self.fixed else []), *(["tie"] if self.tie else [])]
        ways += sized[:1]
        if len(ways) != 1:
            raise ValueError(
                f"found {listed(ways) if ways else 'none of them'}, expected one of fixed = true, "
                "tie, and sizes (translation_um, rotation_urad); keep or add one of them"
            )
        if self.bounded and not sized:
            raise ValueError(
                "found bounded without a size, expected it with translation_um or rotation_urad; "
                "add the half-width, or remove it"
            )
        return self


class LinkSettings(Table):
    """``[model.geometric]`` of an arm: constant errors of each link."""

    family: Literal["smooth"] = "smooth"
    """May be left out: an arm has this one only."""
    link_translation_um: ErrorSize
    """Prior standard deviation of each of the three error translations of a link."""
    link_rotation_urad: ErrorSize
    """Prior standard deviation of each of the three error rotations of a link."""
    slide_translation_um: ErrorSize | None = None
    """Prior standard deviation of the three error translations of a prismatic joint that vary along
    its travel (positioning and straightness); `link_translation_um` by default."""
    slide_rotation_urad: ErrorSize | None = None
    """The same for its three error rotations; `link_rotation_urad` by default."""
    slide_smoothness: _Smoothness = 0.5
    """Correlation length of these error motions over the travel, as in a machine tool's family."""
    link: tuple[OneLinkSettings, ...] = ()
    """Errors of single joints that are fixed, bounded, of another size, or shared."""


class AnyFamilySettings(Table):
    """The keys of all families, for the message where the family is unknown."""

    family: Literal["fourier", "smooth"]
    table: Any = None
    translation_um: Any = None
    rotation_urad: Any = None
    squareness_urad: Any = None
    location_um: Any = None
    smoothness: Any = None


class EffectSettings(BaseModel):
    """A row of ``[[model.effect]]``. Further keys are parameters with their unit."""

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, Any] = Field(init=False)
    name: str
    """Name of an effect in the catalogue or in `effects_file`."""
    data_set: str | None = None
    """Data set whose instrument has the effect, in a study of several data sets."""
    placement: str = ""
    """Axis or joint on which the effect acts."""
    component: str | None = None
    """Port on which the effect acts, such as ``"EAY"``, where several are possible."""


class ModelSettings(Table):
    """``[model]``: the declared errors and effects."""

    geometric: Table | None = None
    """Family of the geometric errors of the machine; none by default."""
    previous: FileName | None = Field(default=None, alias="from")
    """Report of an earlier campaign of the same arm (its ``report.json``), whose posterior of the
    geometric errors, with all correlations, takes the place of their prior. The file declares the
    same ``[model.geometric]``. Effects that were found there are not carried over."""
    effect: tuple[EffectSettings, ...] = ()
    """Declared effects."""
    effects_file: FileName | None = None
    """Python file in the study folder with effect classes of the user's own."""


class DataSettings(TableFormat):
    """``[data]``: names of the tables in the study folder, and how the table of data is read."""

    file: FileName | None = None
    """Table with one row per reading, or per point of a plan: text, a spreadsheet (XLSX, ODS) or
    parquet; ``data.csv`` by default."""
    data: FileName = "data.csv"
    """The same under its older name."""
    check: FileName | None = None
    """Table of independent check points; by default ``check.csv`` where that exists."""
    must_see: dict[str, _Degree] = {}
    """Errors that the data have to identify without any prior: the name of an error motion with its
    highest Legendre degree (``EYX = 4``; a straightness counts from the second degree, as its slope
    is a squareness), or a squareness with 0 (``EC0Y = 0``).
    """

    @model_validator(mode="after")
    def _named_once(self) -> Self:
        if self.file is not None and "data" in self.model_fields_set:
            raise ValueError(
                f"found file = {self.file!r} and data = {self.data!r}, expected one of them, as "
                "both name the table of data; remove one"
            )
        return self

    @property
    def table(self) -> str:
        """Name of the table of data."""
        return self.file or self.data


class DataSetSettings(TableFormat):
    """A row of ``[[data]]``: one of several data sets of the machine, with its instrument. The keys
    of ``[data]`` that say how the file is read (`sheet` to `columns`) are keys of the row too.
    """

    name: str
    """Name in reports: letters, digits, ``-`` and ``_``."""
    file: FileName
    """Its table in the study folder."""
    instrument: InstrumentSettings
    """Its instrument, as in ``[instrument]``."""
    tool_offset_mm: ToolOffset | None = None
    """Vector from the frame of the last axis to the tool point; by default that of ``[machine]``.
    """
    tool: str | None = None
    """Name of the tool, where data sets of reflectors have the same one: the places of its
    reflectors are then the same unknowns in all data sets with that name."""
    start_s: Annotated[
        float, Within(-1e10, 1e10, "no measurements of one machine are 300 years apart")
    ] = 0.0
    """Time of its ``t_s = 0`` on the common clock of the study."""
    must_see: dict[str, _Degree] = {}
    """Errors that this data set alone has to identify, as in ``[data]``."""


class HoldoutSettings(Table):
    """``[holdout]``: which readings are held out to test the predictions of a fit. Without it, the
    choice is that of the instrument (the last fifth of the poses of an arm; for others, blocks,
    poses or runs in turn), or a random fifth where that cannot be predicted from the rest.
    """

    kind: Literal["last", "random", "blocks", "run", "column", "none"]
    """``"last"``: the last ones in time; ``"random"``: randomly chosen ones; ``"blocks"``: blocks
    in time, each predicted from the others; ``"run"``, ``"column"``: all with one value in the
    column ``run``, or in another one, predicted from those with other values; ``"none"``: no
    reading is kept out of the final fit, and blocks in time are predicted in turn. Where the
    instrument keeps its held-out readings out of every fit, as on an arm, so do ``"last"`` and
    ``"random"``."""
    share: Annotated[
        float, Within(0.01, 0.5, "fewer test nothing, and more leave too few for the fit")
    ] = 0.2
    """Share of the rows with ``"last"`` and ``"random"``."""
    seed: Seed = 0
    """Seed of the random choice."""
    blocks: Annotated[
        int, Within(2, 1000, "one block predicts nothing, and more hold a row each")
    ] = 5
    """Number of blocks, of equally many rows in time."""
    column: str | None = None
    """Name of a column of the data with ``"column"``. Numbers closer than a hundredth of its range
    count as one value."""

    @model_validator(mode="after")
    def _fits_its_kind(self) -> Self:
        uses = {
            "share": ("last", "random"),
            "seed": ("random",),
            "blocks": ("blocks", "none"),
            "column": ("column",),
        }
        for key, kinds in uses.items():
            if key in self.model_fields_set and self.kind not in kinds:
                raise ValueError(
                    f'found {key} with kind = "{self.kind}", expected it with '
                    f"{listed(kinds)} only; remove it, or change the kind"
                )
        if self.kind == "column" and not self.column:
            raise ValueError(
                'found kind = "column" without column, expected the name of a column of the data; '
                'add it, such as column = "q1_cmd_mm"'
            )
        return self


class StudySettings(Table):
    """The whole study file. The tables `instrument`, `design` and `model.geometric` are validated
    by the class that they name.
    """

    name: str = ""
    """What reports call the study."""
    machine: MachineSettings
    instrument: InstrumentSettings
    model: ModelSettings = ModelSettings()
    data: DataSettings = DataSettings()
    tables: dict[str, TableFormat] = {}
    """How further tables are read (check points, artefact, family), by the name of the file."""
    holdout: HoldoutSettings | None = None
    loop: LoopSettings = LoopSettings()
    acceptance: AcceptanceSettings | None = None
    measurement: MeasurementSettings = MeasurementSettings()
    certificate: CertificateSettings = CertificateSettings()
    design: DesignSettings = DesignSettings()


class SeveralSettings(Table):
    """The study file of several data sets; each row of `data` is validated by its instrument."""

    name: str = ""
    """What reports call the study."""
    machine: MachineSettings
    data: tuple[DataSetSettings, ...]
    check: FileName | None = None
    """Table of independent check points; by default ``check.csv`` where that exists."""
    tables: dict[str, TableFormat] = {}
    """How further tables are read (check points, artefact, family), by the name of the file."""
    model: ModelSettings = ModelSettings()
    holdout: HoldoutSettings | None = None
    loop: LoopSettings = LoopSettings()
    acceptance: AcceptanceSettings | None = None
    measurement: MeasurementSettings = MeasurementSettings()
    certificate: CertificateSettings = CertificateSettings()


AnySettings = StudySettings | SeveralSettings
"""A whole study file, of one data set or of several."""


def table_formats(settings: AnySettings, file: str) -> dict[str, tuple[TableFormat, Place]]:
    """How the tables of a study are read, by the name of the file, with the place of these keys.

    Raises `StudyError` for two declarations of one table.
    """
    if isinstance(settings, StudySettings):
        found = {settings.data.table: (plain_format(settings.data), Place(file, "data."))}
    else:
        found = {
            row.file: (plain_format(row), Place(file, f"data.{i}."))
            for i, row in enumerate(settings.data)
        }
    for name, form in settings.tables.items():
        if name in found:
            raise refusal(
                file,
                f"key tables.{name}",
                f"it beside the keys of {found[name][1].key.rstrip('.')}, which names that table",
                "one declaration of a table",
                f"move the keys to [{found[name][1].key.rstrip('.')}]",
            )
        found[name] = form, Place(file, f"tables.{name}.")
    return found


def computable(value: float) -> bool:
    """Whether the size of a number is plausible for a quantity in the unit of its key."""
    return value == 0 or _SMALLEST <= abs(value) <= _LARGEST


def validate(
    raw: Mapping[str, Any], file: str, overrides: Mapping[str, str], folder: Folder
) -> AnySettings:
    """The settings in a raw TOML tree; raises one `StudyError` that lists every mistake in it.

    Files in `folder` that define instruments of the user's own are executed.
    """
    for key, value in _numbers(raw):
        if isinstance(value, int):
            continue  # checked on reading
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
        # Validated as JSON, in which a list counts as a tuple, so that validation can be strict
        # otherwise: "3", 3.0 and true are not accepted for 3.
        return model.model_validate_json(json.dumps(raw, default=str), strict=True)
    except ValidationError as error:
        raise explain(error, file, raw, model, overrides) from error
    except Exception as error:  # raised by a validator in a user's own settings
        if (text := own_code_error(error)) is None:
            raise
        raise StudyError(text) from error


def _refined(
    raw: Mapping[str, Any], file: str, overrides: Mapping[str, str], folder: Folder
) -> type[StudySettings]:
    """The settings class with the keys of the named instrument and of the named family."""
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
    """The settings class for several data sets, each row with the keys of its own instrument.

    Raises `StudyError` for an ``[instrument]`` in addition to the rows, for no row, and for names
    of data sets that are malformed or repeated.
    """
    if "instrument" in raw:
        raise refusal(
            source(file, "instrument", overrides),
            "key instrument",
            "an [instrument] together with [[data]] rows",
            "only one of the two, as a row has its own [data.instrument]",
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
        return  # reported by the validation
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
    """The class of the instrument in a table; None where the table names none."""
    kind, own = at(raw, (*key, "kind")), at(raw, (*key, "kind_file"))
    table = ".".join(str(part) for part in key)
    if own is not None and not (isinstance(own, str) and own):
        raise refusal(
            source(file, f"{table}.kind_file", overrides),
            f"key {table}.kind_file",
            shown(own),
            "the name of a Python file in the study folder, in quotes",
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
    """The default of ``[machine]``: the usual machine of the instruments, if they agree on one."""
    usual = {None if kind is None else kind.machine for kind in kinds}
    chain = usual.pop() if len(usual) == 1 else None
    return ... if chain is None else MachineSettings(chain=chain)


def _model(raw: Mapping[str, Any]) -> Any:
    """``[model]`` with the keys of the named family."""
    family = at(raw, ("model", "geometric", "family"))
    geometric: type[Table]
    arm = at(raw, ("machine", "joint")) or at(raw, ("machine", "urdf"))
    if arm and not at(raw, ("machine", "chain")):
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
