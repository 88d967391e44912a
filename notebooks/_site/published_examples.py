"""Published evaluations of uncertainty, and what vcal computes for them (page: `published`).

Inputs are those that a source states, results are printed as it does. `EXAMPLES` is also what
`tests/test_published_budgets.py` checks.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

import vcal
from vcal.distributions import (
    Arcsine,
    Certificate,
    Groups,
    Inputs,
    MultivariateNormal,
    Normal,
    Repeats,
    StudentT,
    Triangular,
    Uniform,
)
from vcal.uncertainty import (
    Budget,
    CalibrationCurve,
    Ensemble,
    calibration_curve,
    propagate,
    propagate_distributions,
)

_DRAWS = 200_000
_MEMORY = "memory"
_SUNCAL = "public tests of suncal, after TN 1900 and the NIST Uncertainty Machine"
_METRODATA = "memory, y and u compared with the public file of metrodata.de"


class Printed(NamedTuple):
    """One printed result: ``what`` is y, u, U, low, high, or k = U/u."""

    what: str
    text: str
    """As printed, in a unit of 1/`factor`; half of its last digit may be lost to rounding."""
    unit: str = ""
    factor: float = 1.0
    output: str = "y"
    within: float | None = None
    """Agreement that the source's rounding of intermediate values allows, in the printed unit."""
    gum: bool = True
    monte_carlo: bool = True
    """Whether the method is to give the printed number; both are shown in any case."""

    @property
    def decimals(self) -> int:
        """Digits after the decimal point."""
        return len(self.text.partition(".")[2])

    @property
    def allowed(self) -> float:
        """Largest difference of a result that agrees, in the printed unit."""
        return 0.5 * 10.0**-self.decimals if self.within is None else self.within


@dataclass(frozen=True)
class Published:
    """One published evaluation."""

    source: str
    subject: str
    inputs: Callable[[], Inputs]
    function: Callable[[dict[str, Any]], Any]
    printed: tuple[Printed, ...]
    data: str
    """Where the numbers come from."""
    k: float | None = None
    """Coverage factor that the source states; otherwise that of `coverage`."""
    coverage: float = 0.95
    order: int = 1
    contributions: Mapping[str, str] = field(default_factory=dict)
    """Printed contributions |c| u by input, in the unit of `per`."""
    per: float = 1.0
    within: float | None = None
    """As in `Printed`, for the contributions."""

    def budget(self) -> Budget:
        """The GUM budget."""
        vcal.enable_float64()
        found = propagate(self.function, self.inputs(), order=self.order, coverage=self.coverage)  # pyright: ignore[reportArgumentType]
        return found if self.k is None else found.stated(k=self.k)

    def ensemble(self, draws: int = _DRAWS) -> Ensemble:
        """The Monte Carlo result."""
        vcal.enable_float64()
        return propagate_distributions(self.function, self.inputs(), draws, seed=1)

    def by_gum(self, one: Printed, budget: Budget) -> float:
        """A printed quantity from the budget, in its unit."""
        i = budget.labels.index(one.output)
        low, high = budget.interval(one.output)
        u, U = budget.u[i], budget.U[i]
        found = {"y": budget.value[i], "u": u, "U": U, "low": low, "high": high, "k": U / u}
        return float(found[one.what]) * one.factor

    def by_draws(self, one: Printed, ensemble: Ensemble) -> float:
        """A printed quantity from the draws, U half the width of the coverage interval."""
        i = ensemble.index(one.output)
        p = self.coverage if self.k is None else math.erf(self.k / math.sqrt(2.0))
        low, high = ensemble.interval(one.output, p if one.what == "U" else self.coverage)
        u, U = ensemble.u[i], 0.5 * (high - low)
        found = {"y": ensemble.mean[i], "u": u, "U": U, "low": low, "high": high, "k": U / u}
        return float(found[one.what]) * one.factor


def _total(v: dict[str, Any]) -> Any:
    return sum(v.values())


def _viscometer(v: dict[str, Any]) -> Any:
    """mu_M = mu_C t_M (rho_B - rho_M) / (t_C (rho_B - rho_C))."""
    buoyant = (v["rho_B"] - v["rho_M"]) / (v["rho_B"] - v["rho_C"])
    return v["mu_C"] * v["t_M"] / v["t_C"] * buoyant


def _within(half: float, middle: float = 0.0) -> Uniform:
    return Uniform(middle - half, middle + half)


def _u_shaped(half: float, middle: float = 0.0) -> Arcsine:
    return Arcsine(middle - half, middle + half)


# --- JCGM 100 ---

_OBSERVED = np.array(
    [
        [5.007, 4.994, 5.005, 4.990, 4.999],
        [19.663e-3, 19.639e-3, 19.640e-3, 19.685e-3, 19.678e-3],
        [1.0456, 1.0438, 1.0468, 1.0428, 1.0433],
    ]
)
_DAY_MEANS = (172, 116, 13, 144, 106, 31, 60, 125, 163, 41)
"""uV above 10 V."""
_DAY_S = (60, 77, 111, 101, 67, 93, 80, 73, 88, 86)


def _impedance(v: dict[str, Any]) -> dict[str, Any]:
    import jax.numpy as jnp

    voltage, current, phase = v["observed"]
    z = voltage / current
    return {"R": z * jnp.cos(phase), "X": z * jnp.sin(phase), "Z": z}


def _line(curve: Callable[[], CalibrationCurve]) -> Callable[[], Inputs]:
    """The coefficients of a fitted line as an input."""
    return lambda: Inputs({"c": curve().distribution})


def _coefficients(v: dict[str, Any]) -> dict[str, Any]:
    return {"a": v["c"][0], "b": v["c"][1]}


def _thermometer() -> CalibrationCurve:
    t = [21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511]
    b = [171, 169, 166, 159, 164, 165, 156, 157, 159, 161, 160]
    return calibration_curve(np.array(t) - 20.0, -1e-3 * np.array(b))


def _days() -> Inputs:
    means = [10.0 + 1e-6 * m for m in _DAY_MEANS]
    return Inputs({"V": Groups(means=means, s=[1e-6 * s for s in _DAY_S], n=5)})


# --- ISO/TS 28037 ---

_SIX = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
_X = (1.2, 1.9, 2.9, 4.0, 4.7, 5.9)
_Y = (3.4, 4.4, 7.2, 8.5, 10.8, 13.5)
_NPL = "public documentation of GTC, which quotes the standard"


def _equal() -> CalibrationCurve:
    return calibration_curve(_SIX, (3.3, 5.6, 7.1, 9.3, 10.7, 12.1), u_y=0.5)


def _unequal() -> CalibrationCurve:
    u = (0.5, 0.5, 0.5, 1.0, 1.0, 1.0)
    return calibration_curve(_SIX, (3.2, 4.3, 7.6, 8.6, 11.7, 12.8), u_y=u)


def _both() -> CalibrationCurve:
    return calibration_curve(_X, _Y, u_x=0.2, u_y=(0.2, 0.2, 0.2, 0.4, 0.4, 0.4))


def _unknown() -> CalibrationCurve:
    return calibration_curve(_SIX, (3.014, 5.225, 7.004, 9.061, 11.201, 12.762))


def _lines(a: str, b: str, u_a: str, u_b: str, drawn: bool = True) -> tuple[Printed, ...]:
    return (
        Printed("y", a, output="a"),
        Printed("y", b, output="b"),
        Printed("u", u_a, output="a", monte_carlo=drawn),
        Printed("u", u_b, output="b", monte_carlo=drawn),
    )


# --- EA-4/02 ---


def _resistor(v: dict[str, Any]) -> Any:
    return (v["R_S"] + v["dR_D"] + v["dR_TS"]) * v["r_C"] * v["r"] - v["dR_TX"]


def _gauge_block(v: dict[str, Any]) -> Any:
    expansion = 11.5e-6 * v["dt"] + v["dalpha"] * v["Dt"]
    return v["l_S"] + v["dl_D"] + v["dl"] + v["dl_C"] - 5e7 * expansion - v["dl_V"]


def _furnace(v: dict[str, Any]) -> Any:
    voltage = v["dV_iS1"] + v["dV_iS2"] + v["dV_R"]
    reference = 0.077 / 0.189 * v["dt_0S"]
    return v["t_S"] + v["dt_S"] + 0.077 * voltage - reference + v["dt_D"] + v["dt_F"]


def _thermocouple(v: dict[str, Any]) -> Any:
    voltage = v["V_iX"] + v["dV_iX1"] + v["dV_iX2"] + v["dV_R"] + v["dV_LX"]
    return voltage + v["dt_X"] / 0.026 - v["dt_0X"] / 0.039


def _power_sensor(v: dict[str, Any]) -> Any:
    mismatch = v["M_Sr"] * v["M_Xc"] / (v["M_Sc"] * v["M_Xr"])
    return (v["K_S"] + v["dK_D"]) * mismatch * v["p_Cr"] * v["p_Cc"] * v["p"]


def _attenuator(v: dict[str, Any]) -> Any:
    loss = v["L_S"] + v["dL_S"] + v["dL_D"] + v["dL_M"] + v["dL_K"]
    return loss + v["dL_ib"] - v["dL_ia"] + v["dL_0b"] - v["dL_0a"]


def _multimeter(v: dict[str, Any]) -> Any:
    return 100.1 - v["V_S"] + v["dV_iX"] - v["dV_S"]


def _caliper(v: dict[str, Any]) -> Any:
    return 100.0 - v["l_S"] + 1.7 * v["Dt"] + v["dl_iX"] + v["dl_M"]


def _block_calibrator(v: dict[str, Any]) -> Any:
    return _total(v) - 2.0 * v["dt_iX"]


_MAXIMA = (
    18.75, 28.25, 25.75, 28.00, 28.50, 20.75, 21.00, 22.75, 18.50, 27.25, 20.75,
    26.50, 28.00, 23.25, 28.00, 21.75, 26.00, 26.50, 28.00, 33.25, 32.00, 29.50,
)  # fmt: skip

EXAMPLES = (
    Published(
        "JCGM 100, H.2",
        "impedance",
        lambda: Inputs(
            {"observed": MultivariateNormal(_OBSERVED.mean(1), np.cov(_OBSERVED) / 5.0, dof=4)}
        ),
        _impedance,
        (
            Printed("y", "127.732", "ohm", output="R"),
            Printed("u", "0.071", "ohm", output="R"),
            Printed("y", "219.847", "ohm", output="X"),
            # 0.2956 at first order; print has what the five single results give.
            Printed("u", "0.295", "ohm", output="X", within=1e-3),
            Printed("y", "254.260", "ohm", output="Z"),
            Printed("u", "0.236", "ohm", output="Z"),
        ),
        _MEMORY,
    ),
    Published(
        "JCGM 100, H.3",
        "thermometer: correction at 20 °C + t",
        _line(_thermometer),
        _coefficients,
        _lines("-0.1712", "0.00218", "0.0029", "0.00067", drawn=False),
        _MEMORY,
    ),
    Published(
        "JCGM 100, H.5",
        "voltage standard, ten days",
        _days,
        _total,
        (
            Printed("y", "10.000097", "V"),
            # The standard deviation of a t with 9 degrees of freedom is 1.13 times its scale.
            Printed("u", "18", "uV", 1e6, monte_carlo=False),
        ),
        "memory, compared with the public tests of suncal",
    ),
    Published(
        "ISO/TS 28037, 6",
        "line, equal weights",
        _line(_equal),
        _coefficients,
        _lines("1.867", "1.757", "0.465", "0.120"),
        _NPL,
    ),
    Published(
        "ISO/TS 28037, 6",
        "line, unequal weights",
        _line(_unequal),
        _coefficients,
        _lines("0.885", "2.057", "0.530", "0.178"),
        _NPL,
    ),
    Published(
        "ISO/TS 28037, 7",
        "line, uncertainty in x and y",
        _line(_both),
        _coefficients,
        _lines("0.5788", "2.1597", "0.4764", "0.1355"),
        _NPL,
    ),
    Published(
        "ISO/TS 28037, annex E",
        "line, unknown uncertainty",
        _line(_unknown),
        _coefficients,
        # Before the factor of the standard deviation of a t, 1.41 for four degrees of freedom.
        _lines("1.172", "1.964", "0.159", "0.041", drawn=False),
        _NPL,
    ),
    Published(
        "EA-4/02, S2",
        "weight of 10 kg",
        lambda: Inputs(
            {
                "m_S": Certificate(10000.005, 0.045, k=2),
                "dm_D": _within(0.015),
                "dm": Repeats([0.01, 0.03, 0.02], s=0.025),
                "dm_C": _within(0.010),
                "dB": _within(0.010),
            }
        ),
        _total,
        (
            Printed("y", "10000.025", "g"),
            Printed("u", "29.3", "mg", 1e3),
            Printed("U", "59", "mg", 1e3, monte_carlo=False),
        ),
        "memory, m_S and dm_D compared with the public file of metrodata.de",
        k=2.0,
        contributions={"m_S": "22.5", "dm_D": "8.66", "dm": "14.4", "dm_C": "5.77", "dB": "5.77"},
        per=1e3,
        within=0.05,
    ),
    Published(
        "EA-4/02, S3",
        "resistor of 10 kΩ",
        lambda: Inputs(
            {
                "R_S": Certificate(10000.053, 0.005, k=2),
                "dR_D": _within(0.010, 0.020),
                "dR_TS": _within(2.75e-3),
                "r_C": Triangular(1.0 - 1e-6, 1.0 + 1e-6),
                "r": Repeats([1.0000104, 1.0000107, 1.0000106, 1.0000103, 1.0000105]),
                "dR_TX": _within(5.5e-3),
            }
        ),
        _resistor,
        (
            Printed("y", "10000.178", "ohm"),
            Printed("u", "8.33", "mohm", 1e3, within=0.01),
            Printed("U", "17", "mohm", 1e3, monte_carlo=False),
        ),
        _MEMORY,
        k=2.0,
        contributions={
            "R_S": "2.5",
            "dR_D": "5.8",
            "dR_TS": "1.6",
            "r_C": "4.1",
            "r": "0.7",
            "dR_TX": "3.2",
        },
        per=1e3,
    ),  # fmt: skip
    Published(
        "EA-4/02, S4",
        "gauge block of 50 mm, from 50 mm; second order",
        lambda: Inputs(
            {
                "l_S": Certificate(20.0, 30.0, k=2),
                "dl_D": _within(30.0),
                "dl": Repeats([-94.0] * 5, s=12.0),
                "dl_C": _within(32.0),
                "dt": _within(0.05),
                "dalpha": Triangular(-2e-6, 2e-6),
                "Dt": _within(0.5),
                "dl_V": _within(6.7),
            }
        ),
        _gauge_block,
        (
            Printed("y", "-74", "nm"),
            Printed("u", "36.4", "nm"),
            Printed("U", "73", "nm", monte_carlo=False),
        ),
        _MEMORY,
        k=2.0,
        order=2,  # The product of two quantities whose estimates are zero.
        contributions={
            "l_S": "15.0",
            "dl_D": "17.3",
            "dl": "5.37",
            "dl_C": "18.5",
            "dt": "16.6",
            "dl_V": "3.87",
        },
        within=0.05,
    ),  # fmt: skip
    Published(
        "EA-4/02, S5",
        "type N thermocouple: furnace at 1000 °C",
        lambda: Inputs(
            {
                "t_S": Normal(1000.5, 0.10),
                "dt_S": Certificate(0.0, 0.3, k=2),
                "dV_iS1": Certificate(0.0, 2.0, k=2),
                "dV_iS2": _within(0.5),
                "dV_R": _within(2.0),
                "dt_0S": _within(0.1),
                "dt_D": _within(0.3),
                "dt_F": _within(1.0),
            }
        ),
        _furnace,
        (Printed("y", "1000.5", "°C"), Printed("u", "0.641", "K", within=2e-3)),
        _METRODATA,
        k=2.0,
    ),
    Published(
        "EA-4/02, S5",
        "type N thermocouple: voltage",
        lambda: Inputs(
            {
                "V_iX": Normal(36248.0, 1.6),
                "dV_iX1": Certificate(0.0, 2.0, k=2),
                "dV_iX2": _within(0.5),
                "dV_R": _within(2.0),
                "dV_LX": _within(5.0),
                "dt_X": Normal(0.5, 0.641),
                "dt_0X": _within(0.1),
            }
        ),
        _thermocouple,
        (
            Printed("y", "36267.23", "uV", monte_carlo=False),
            Printed("u", "25.0", "uV", within=0.1),
            Printed("U", "50", "uV", monte_carlo=False),
        ),
        _METRODATA,
        k=2.0,
    ),
    Published(
        "EA-4/02, S6",
        "power sensor at 18 GHz",
        lambda: Inputs(
            {
                "K_S": Normal(0.957, 0.0055),
                "dK_D": _within(0.002, -0.001),
                "M_Sr": _u_shaped(2 * 0.02 * 0.02, 1.0),
                "M_Xc": _u_shaped(2 * 0.07 * 0.12, 1.0),
                "M_Sc": _u_shaped(2 * 0.07 * 0.10, 1.0),
                "M_Xr": _u_shaped(2 * 0.02 * 0.02, 1.0),
                "p_Cr": Normal(1.0, 0.0014),
                "p_Cc": Normal(1.0, 0.0014),
                "p": Repeats([0.9772, 0.9671, 0.9836]),
            }
        ),
        _power_sensor,
        (
            Printed("y", "0.933"),
            Printed("u", "0.016", monte_carlo=False),
            Printed("U", "0.032", monte_carlo=False),
        ),
        _METRODATA,
        k=2.0,
    ),
    Published(
        "EA-4/02, S7",
        "coaxial step attenuator at 30 dB",
        lambda: Inputs(
            {
                "L_S": Repeats([30.033, 30.058, 30.018, 30.052]),
                "dL_S": Certificate(0.003, 0.005, k=2),
                "dL_D": _within(0.002),
                "dL_M": _u_shaped(0.02 * math.sqrt(2.0)),
                "dL_K": _within(0.003),
                "dL_ib": _within(0.0005),
                "dL_ia": _within(0.0005),
                "dL_0b": Normal(0.0, 0.002),
                "dL_0a": Normal(0.0, 0.002),
            }
        ),
        _attenuator,
        (
            Printed("y", "30.043", "dB"),
            # The t of four readings has 1.7 times the standard deviation of its scale.
            Printed("u", "0.0224", "dB", monte_carlo=False),
            Printed("U", "0.045", "dB", monte_carlo=False),
        ),
        _METRODATA,
        k=2.0,
    ),
    Published(
        "EA-4/02, S9",
        "multimeter at 100 V",
        lambda: Inputs(
            {
                "V_S": Certificate(100.0, 0.002, k=2),
                "dV_iX": _within(0.05),
                "dV_S": _within(0.011),
            }
        ),
        _multimeter,
        (
            Printed("y", "0.1", "V"),
            Printed("u", "0.030", "V"),
            Printed("U", "0.05", "V"),
        ),
        _MEMORY,
        k=1.65,
        contributions={"V_S": "0.001", "dV_iX": "0.029", "dV_S": "0.0064"},
        within=5e-4,
    ),
    Published(
        "EA-4/02, S10",
        "vernier caliper at 150 mm",
        lambda: Inputs(
            {
                "l_S": _within(0.8),
                "Dt": _within(2.0),
                "dl_iX": _within(25.0),
                "dl_M": _within(50.0),
            }
        ),
        _caliper,
        (
            Printed("y", "0.10", "mm", 1e-3),
            # Printed from contributions with two digits.
            Printed("u", "33", "um", within=1.0),
            Printed("k", "1.83", within=0.02),
            Printed("U", "0.06", "mm", 1e-3),
        ),
        _MEMORY,
        k=1.83,
        contributions={"l_S": "0.46", "Dt": "2.0", "dl_iX": "15", "dl_M": "29"},
        within=0.6,
    ),
    Published(
        "EA-4/02, S11",
        "temperature block calibrator at 180 °C",
        lambda: Inputs(
            {
                "t_S": Normal(180.1, 0.010),
                "dt_S": Certificate(0.0, 0.030, k=2),
                "dt_D": _within(0.040),
                "dt_iX": _within(0.050),
                "dt_R": _within(0.100),
                "dt_A": _within(0.250),
                "dt_H": _within(0.050),
                "dt_V": _within(0.030),
            }
        ),
        _block_calibrator,
        (
            Printed("y", "180.1", "°C"),
            Printed("u", "0.164", "K", within=1e-3),
            Printed("k", "1.81", within=0.03),
            Printed("U", "0.3", "K"),
        ),
        _MEMORY,
        k=1.81,
    ),
    Published(
        "EA-4/02, S12",
        "household water meter, mean of three runs",
        # Deviations from the error of indication: the public data do not state its value.
        lambda: Inputs({"e_av": Normal(0.0, 6.0e-4, dof=2), "de": Normal(0.0, 6.8e-4)}),
        _total,
        (
            Printed("u", "0.91", "", 1e3),
            # Printed for ten degrees of freedom, of 10.5.
            Printed("k", "2.28", within=0.012, monte_carlo=False),
            Printed("U", "2", "", 1e3, monte_carlo=False),
        ),
        "public test of a program for laboratories, after EA-4/02",
        coverage=0.9545,
    ),
    Published(
        "NIST TN 1900, E2",
        "surface temperature, 22 daily maxima",
        lambda: Inputs({"t": Repeats(_MAXIMA)}),
        _total,
        (
            Printed("y", "25.6", "°C"),
            # The standard deviation of the t is 1.05 times its scale.
            Printed("u", "0.872", "K", monte_carlo=False),
            Printed("low", "23.8", "°C"),
            Printed("high", "27.4", "°C"),
        ),
        _MEMORY,
    ),
    Published(
        "NIST TN 1900, E3",
        "falling ball viscometer",
        lambda: Inputs(
            {
                "mu_C": Normal(4.63, 0.0463),
                "t_M": Normal(61.0, 6.1),
                "t_C": Normal(36.6, 5.49),
                "rho_B": Normal(2217.0, 0.5),
                "rho_M": Normal(1180.0, 0.5),
                "rho_C": Normal(810.0, 0.5),
            }
        ),
        _viscometer,
        (
            Printed("y", "5.69", "mPa s", monte_carlo=False),
            Printed("u", "1.11", "mPa s", within=0.1, monte_carlo=False),
            Printed("y", "5.82", "mPa s", gum=False),
            Printed("low", "4.05", "mPa s", gum=False, within=0.01),
            Printed("high", "8.39", "mPa s", gum=False, within=0.01),
        ),
        _SUNCAL,
    ),
    Published(
        "NIST TN 1900, E11",
        "microwave step attenuator",
        lambda: Inputs(
            {
                "L_S": StudentT.from_std(30.0402, 0.0091, 3.0),
                "dL_S": _within(0.00433, 0.003),
                "dL_D": _u_shaped(0.00198),
                "dL_M": _u_shaped(0.02828),
                "dL_K": _u_shaped(0.0029698),
                "dL_ib": _within(0.0005196),
                "dL_ia": _within(0.0005196),
                "dL_0b": Normal(0.0, 0.002),
                "dL_0a": Normal(0.0, 0.002),
            }
        ),
        _total,
        (
            Printed("y", "30.043", "dB"),
            Printed("u", "0.0224", "dB", gum=False, within=5e-4),
            Printed("low", "30.006", "dB", gum=False),
            Printed("high", "30.081", "dB", gum=False),
        ),
        _SUNCAL,
    ),
    Published(
        "NIST TN 1900, E13",
        "coefficient of thermal expansion",
        lambda: Inputs(
            {
                "L0": StudentT.from_std(1.4999, 1e-4, 3.0),
                "L1": StudentT.from_std(1.5021, 2e-4, 3.0),
                "T0": StudentT.from_std(288.15, 0.02, 3.0),
                "T1": StudentT.from_std(373.10, 0.05, 3.0),
            }
        ),
        lambda v: (v["L1"] - v["L0"]) / (v["L0"] * (v["T1"] - v["T0"])),
        (
            Printed("y", "17.266", "1/MK", 1e6, monte_carlo=False),
            Printed("y", "17.268", "1/MK", 1e6, gum=False),
            # The linear u of standard deviations is 1.76; the GUM takes the scales of the t.
            Printed("u", "1.74", "1/MK", 1e6, gum=False, within=0.03),
        ),
        _SUNCAL,
    ),
)
