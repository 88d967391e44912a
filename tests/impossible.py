"""Declarations that no machine, instrument or measurement has, written by hand.

A line is one declaration: an override of the start study of that instrument (several with ``&``),
or, in `COLUMNS`, what is done to a column of one of its tables. `ACCEPTED` holds those that vcal
takes all the same, each with the reason.
"""

import math

import numpy as np

MACHINE = """
machine.tool_offset_mm=[0, 0, -5000]
machine.tool_offset_mm=[0, 0, -15000]
machine.tool_offset_mm=[3000, 3000, 0]
machine.tool_offset_mm=[0, 0, 9999]
machine.tool_offset_mm=[0, 0, -0.15]
machine.tool_offset_mm=[0, 0, -150000]
machine.tool_offset_mm=[0.001, 0, 0]
machine.tool_offset_mm=[-1e9, 0, 0]
machine.tool_offset_mm=[0, 0, nan]
machine.travel_mm.X=[0, 0]
machine.travel_mm.X=[1000, 0]
machine.travel_mm.X=[0, 0.05]
machine.travel_mm.X=[0, 1]
machine.travel_mm.X=[0, 1e6]
machine.travel_mm.X=[0, 1e9]
machine.travel_mm.X=[-1e7, 1e7]
machine.travel_mm.X=[5000, 6000]
machine.travel_mm.Y=[0, 250000]
machine.travel_mm.Z=[-300000, 500]
machine.travel_mm.Z=[0, inf]
machine.up=[0, 0, 0]
machine.up=[0, 0, 1e9]
machine.chain="w X b Y Y t"
machine.chain="w b t"
machine.chain="X Y Z"
machine.chain="w X b Y Z Q t"
model.geometric={family="smooth", translation_um=0, rotation_urad=5, squareness_urad=5}
model.geometric={family="smooth", translation_um=-4, rotation_urad=5, squareness_urad=5}
model.geometric={family="smooth", translation_um=100000, rotation_urad=5, squareness_urad=5}
model.geometric={family="smooth", translation_um=1e6, rotation_urad=5, squareness_urad=5}
model.geometric={family="smooth", translation_um=4, rotation_urad=1e5, squareness_urad=5}
model.geometric={family="smooth", translation_um=4, rotation_urad=1e-9, squareness_urad=5}
model.geometric={family="smooth", translation_um=4, rotation_urad=5, squareness_urad=3e5}
model.geometric={family="smooth", translation_um=4, rotation_urad=5, squareness_urad=-1}
model.geometric={SMOOTH, smoothness=0}
model.geometric={SMOOTH, smoothness=-1}
model.geometric={SMOOTH, smoothness=1e3}
model.geometric={SMOOTH, smoothness=1e-6}
model.geometric={SMOOTH, location_um=1e9}
loop.alpha=0
loop.alpha=1
loop.alpha=-0.01
loop.alpha=5
loop.alpha=nan
loop.draws=0
loop.draws=1
loop.draws=-500
loop.draws=10000000000
loop.seed=-1
loop.seed=1.5
loop.max_effects=-1
loop.max_effects=1000000000
acceptance.volumetric_um=0
acceptance.volumetric_um=-20
acceptance.volumetric_um=1e7
acceptance.volumetric_um=1e-9
acceptance={volumetric_um=20, risk_percent=0}
acceptance={volumetric_um=20, risk_percent=100}
acceptance={volumetric_um=20, risk_percent=-5}
acceptance={volumetric_um=20, draws=1}
acceptance={volumetric_um=20, draws=100000000}
measurement.date="2026-02-30"
measurement.date="2026-13-01"
holdout={kind="last", share=0}
holdout={kind="last", share=1}
holdout={kind="last", share=-0.2}
holdout={kind="random", seed=-3}
holdout={kind="blocks", blocks=1}
holdout={kind="blocks", blocks=100000}
data.must_see={EYX = -1}
data.must_see={EYX = 1000}
data.must_see={EYX = 40}
data.header_row=-1
data.skip_rows=-5
data.skip_rows=100000000
data.columns={x_mm = {from = "x_mm", offset = 1e15}}
data.columns={x_mm = {from = 0}}
data.columns={x_mm = {from = "x_mm", sign = 2}}
data.columns={x_mm = {from = "x_mm", unit = "kg"}}
certificate.laboratory.country="Atlantis"
"""
"""On the laser tracker's machine."""

SMOOTH = 'family="smooth", translation_um=4, rotation_urad=5, squareness_urad=5'
EFFECTS = """
name="backlash", placement="Y", size_um=-1e9
name="backlash", placement="Y", size_um=5000
name="backlash", placement="Y", size_um=1e7
name="backlash", placement="Y", size_um_sigma=1e6
name="backlash", placement="Y", size_um_sigma=-1
name="backlash", placement="Y", size_um=nan
name="screw_cyclic", placement="Y", pitch_mm=0
name="screw_cyclic", placement="Y", pitch_mm=-10
name="screw_cyclic", placement="Y", pitch_mm=1e-4
name="screw_cyclic", placement="Y", pitch_mm=0.0005
name="screw_cyclic", placement="Y", pitch_mm=1e-9
name="screw_cyclic", placement="Y", pitch_mm=1e6
name="screw_cyclic", placement="X", pitch_mm=10, sine_um=1e5
name="screw_cyclic", placement="X", pitch_mm=10, cosine_um=-5000
name="scale_growth", placement="X", alpha_um_per_m_K=1e4
name="scale_growth", placement="X", alpha_um_per_m_K=-5000
name="scale_growth", placement="X", alpha_um_per_m_K_sigma=1e5
name="thermal_tilt", placement="Y", component="EAY", k_EAY_urad_per_K=1e5
name="thermal_tilt", placement="Y", component="EAY", k_EAY_urad_per_K=-6000
name="warm_up", component="EYX", placement="X", size_um=1e5, tau_h=1
name="warm_up", component="EYX", placement="X", size_um=10, tau_h=0
name="warm_up", component="EYX", placement="X", size_um=10, tau_h=-3
name="warm_up", component="EYX", placement="X", size_um=10, tau_h=1e7
name="warm_up", component="EYX", placement="X", size_um=10, tau_h=1e-9
name="range_scale", offset_um=0, scale_um_per_m=9893
name="range_scale", offset_um=1e6, scale_um_per_m=1
name="range_scale", offset_um_sigma=1e7
name="station_drift", rate_X_um_per_h=1e9
name="backlash", placement="W", size_um=1
name="backlash", placement="Y", size_um={distribution="uniform", low=-1e6, high=1e6}
name="backlash", placement="Y", size_um={distribution="uniform", low=5, high=1}
name="backlash", placement="Y", size_um={distribution="normal", mean=1e5, std=1}
"""
"""Effects on the laser tracker's machine."""

STUDIES = {
    "laser_tracker": """
instrument.range_sigma_um=0
instrument.range_sigma_um=-1.3
instrument.range_sigma_um=1e-7
instrument.range_sigma_um=10000
instrument.range_sigma_um=1e5
instrument.range_sigma_um_per_m=-0.1
instrument.range_sigma_um_per_m=1000
instrument.range_sigma_um_per_m=1e5
instrument.angle_sigma_urad=0
instrument.angle_sigma_urad=-2
instrument.angle_sigma_urad=10000
instrument.angle_sigma_urad=1e6
instrument.angle_sigma_urad=1e-8
instrument.station_mm=[900000, 0, 0]
instrument.station_mm=[0, 0, -1e8]
instrument.station_mm=[nan, 0, 0]
instrument.euler_xyz_deg=[1000, 0, 0]
instrument.euler_xyz_deg=[0, -5000, 0]
instrument.dead_path_mm=1e7
instrument.dead_path_sigma_um=-1
instrument.dead_path_sigma_um=1e8
instrument.tools={A = [1e6, 0, 0]}
instrument.tools_sigma_um=-5
instrument.tools_sigma_um=1e8
instrument.stations={A = {station_mm = [1e7, 0, 0]}}
instrument.stations={A = {euler_xyz_deg = [0, 0, 9999]}}
design.starts=0
design.starts=100000000
design.steps=0
design.steps=-200
design.seconds_per_point=-10
design.seconds_per_point=1e9
design.seconds_per_metre=-1
design.seconds_per_metre=1e8
design.grid=[1, 1, 1]
design.grid=[1000, 1000, 1000]
design.more=0
design.more=10000000
design.station_low_mm=[-1e9, 0, 0] & design.station_high_mm=[0, 0, 0]
""",
    "ball_array": """
instrument.probe_sigma_um=0
instrument.probe_sigma_um=-0.7
instrument.probe_sigma_um=1e-9
instrument.probe_sigma_um=20000
instrument.probe_sigma_um=1e6
instrument.ball_position_u_um=-0.8
instrument.ball_position_u_um=20000
instrument.ball_position_u_um=1e8
instrument.supports=[0.5, 0.5]
instrument.supports=[-0.5, 0.5]
instrument.supports=[0.2, 1.7]
instrument.supports=[22, 78]
design.across_mm=[-1, 0]
design.across_mm=[1e6, 0]
design.spacing_mm=0
design.spacing_mm=-50
design.spacing_mm=1e6
design.seconds_per_pose=-300
design.seconds_per_pose=1e9
design.seconds_per_ball=-1
""",
    "laser_frame": """
instrument.sigma_um=0
instrument.sigma_um=-0.5
instrument.sigma_um=1e5
instrument.sigma_um=1e-8
instrument.reference_degC=-273
instrument.reference_degC=293.15
instrument.psd_lever_mm=-5
instrument.psd_lever_mm=1e6
instrument.psd_size_mm=0
instrument.psd_size_mm=-10
instrument.psd_size_mm=1e5
instrument.psd_size_mm=1e-6
instrument.filter_mm=-1
instrument.filter_mm=1e4
instrument.filter_index=1
instrument.filter_index=0.5
instrument.filter_index=50
""",
    "r_test": """
instrument.radius_mm=0
instrument.radius_mm=-2
instrument.radius_mm=1e6
instrument.radius_mm=1e-4
instrument.external_sigma_um=0
instrument.external_sigma_um=-0.25
instrument.external_sigma_um=1e5
instrument.external_sigma_um=1e-9
instrument.internal_sigma_um=-0.02
instrument.internal_sigma_um=1e6
instrument.external_u_um=-1
instrument.external_u_um=1e6
instrument.range_mm=0
instrument.range_mm=-3
instrument.range_mm=1e4
instrument.range_mm=1e-9
instrument.sphere_radius_mm=0
instrument.sphere_radius_mm=-11
instrument.sphere_radius_mm=1e6
instrument.tip_radius_mm=-1
instrument.tip_radius_mm=1e6
instrument.probes=[[1, 0, 0], [1, 0, 0], [0, 0, 1]]
instrument.probes=[[0, 0, 0], [0, 1, 0], [0, 0, 1]]
""",
    "static_r_test": """
instrument.external_sigma_um=-0.4
instrument.external_sigma_um=1e6
instrument.zero_u_um=-2
instrument.zero_u_um=1e6
instrument.range_mm=1e5
instrument.sphere_radius_mm=1e-6
machine.rotary.C={at_mm = [0, 0, 1e7]}
machine.rotary.C={at_mm = [0, 0, -200], travel_deg = [360, 0]}
machine.rotary.C={at_mm = [0, 0, -200], travel_deg = [0, 0.5]}
machine.rotary.C={at_mm = [0, 0, -200], travel_deg = [0, 1e6]}
machine.rotary.A={at_mm = [nan, 0, 0]}
machine.tool_offset_mm=[0, 0, -4000]
model.geometric.location_um=-15
model.geometric.location_um=1e6
""",
    "interferometer": """
instrument.position_sigma_um=0
instrument.position_sigma_um=-0.2
instrument.position_sigma_um=1e5
instrument.position_sigma_um=1e-8
instrument.position_sigma_um_per_m=-1
instrument.position_sigma_um_per_m=1e6
instrument.straightness_sigma_um=-0.5
instrument.straightness_sigma_um=1e6
instrument.angle_sigma_urad=0
instrument.angle_sigma_urad=1e6
instrument.laser_u_um_per_m=-0.2
instrument.laser_u_um_per_m=1e6
instrument.square_u_urad=-1
instrument.square_u_urad=1e6
instrument.expansion_um_per_m_K=1000
instrument.expansion_um_per_m_K=-200
instrument.expansion_u_um_per_m_K=-1
instrument.expansion_u_um_per_m_K=1000
instrument.material_u_K=-0.1
instrument.material_u_K=300
instrument.dead_path_u_um_per_m_K=-1
instrument.dead_path_u_um_per_m_K=1e4
instrument.environment_um=-1
instrument.environment_um=1e7
instrument.line.0.line=-1
instrument.line.0.dead_path_mm=-250
instrument.line.0.dead_path_mm=1e7
instrument.line.0.offset_mm=[1e6, 0, 0]
""",
    "double_ball_bar": """
instrument.length_mm=0
instrument.length_mm=-150
instrument.length_mm=1e5
instrument.length_mm=0.15
instrument.length_u_um=-0.5
instrument.length_u_um=1e6
instrument.sigma_um=0
instrument.sigma_um=-0.3
instrument.sigma_um=1e5
instrument.range_mm=0
instrument.range_mm=-1
instrument.range_mm=1e4
design.shortest_arc_deg=0
design.shortest_arc_deg=400
design.lengths_mm=[0]
design.lengths_mm=[1e6]
design.centre_low_mm=[-1e9, 0, 0]
design.seconds_per_setup=-1
design.seconds_per_run=1e9
design.arcs_deg={XY = [0, 9999]}
""",
    "touch_probe": """
instrument.diameter_mm=0
instrument.diameter_mm=-25
instrument.diameter_mm=1e6
instrument.diameter_mm=1e-4
instrument.diameter_u_um=-0.4
instrument.diameter_u_um=1e7
instrument.stylus_radius_mm=-3
instrument.stylus_radius_mm=5000
instrument.stylus_u_um=-1
instrument.stylus_u_um=1e7
instrument.probe_sigma_um=0
instrument.probe_sigma_um=-0.5
instrument.probe_sigma_um=1e5
design.lowest_deg=90
design.lowest_deg=-90
design.seconds_per_contact=-5
design.place_low_mm=[-1e9, 0, 0] & design.place_high_mm=[0, 0, 0]
""",
    "pose_probe": """
instrument.position_sigma_um=0
instrument.position_sigma_um=-20
instrument.position_sigma_um=1e6
instrument.orientation_sigma_urad=0
instrument.orientation_sigma_urad=-50
instrument.orientation_sigma_urad=1e6
machine.joint.0.low_mm=1700 & machine.joint.0.high_mm=500
machine.joint.0.high_mm=1e7
machine.joint.1.d_mm=1e7
machine.joint.1.alpha_deg=-9000
machine.joint.1.low_deg=165 & machine.joint.1.high_deg=-165
machine.joint.1.low_deg=-1e9
machine.tool_offset_mm=[9000, 0, 0]
model.geometric.slide_translation_um=-1
model.geometric.slide_translation_um=1e6
model.geometric.slide_rotation_urad=1e6
""",
    "reflectors": """
instrument.tool_reflectors=0
instrument.tool_reflectors=-3
instrument.tool_reflectors=100000
instrument.base_reflectors=-1
instrument.base_reflectors=1000000
instrument.sigma_um=0
instrument.sigma_um=-15
instrument.sigma_um=1e5
instrument.station_sigma_um=-1
instrument.station_sigma_um=1e9
instrument.station_sigma_urad=-1
instrument.reflectors_sigma_um=-1
instrument.reflectors_sigma_um=1e9
machine.joint.1.a_mm=1e6
machine.joint.1.a_mm=nan
machine.joint.1.theta_deg=1e5
machine.joint.0.low_deg=-1e6
machine.tool_offset_mm=[0, 0, 5000]
model.geometric.link_translation_um=0
model.geometric.link_translation_um=-300
model.geometric.link_translation_um=1e6
model.geometric.link_rotation_urad=0
model.geometric.link_rotation_urad=1e6
machine.coupling=[[1, 0, 0], [0, 1, 0], [0, 0, 1]]
""",
}
"""By the kind of the start study."""


def _set(value):
    return lambda column: np.full(len(column), float(value))


def _row(value):
    """One cell of the column."""
    return lambda column: np.r_[column[:3], value, column[4:]]


def _in_turn(low, high):
    return lambda column: np.where(np.arange(len(column)) % 2 == 0, low, high)


def _new(value):
    """A further column."""
    return value


COLUMNS = [
    ("laser_tracker", "data.csv", "range_mm", _set(1500)),
    ("laser_tracker", "data.csv", "range_mm", _set(0)),
    ("laser_tracker", "data.csv", "azimuth_rad", _set(0.1)),
    ("laser_tracker", "data.csv", "elevation_rad", _set(0)),
    ("laser_tracker", "data.csv", "elevation_rad", _in_turn(-0.5, 0.5)),
    ("laser_tracker", "data.csv", "azimuth_rad", _in_turn(0.10, 0.11)),
    ("laser_tracker", "data.csv", "range_mm", _in_turn(1500, 1500.01)),
    ("laser_tracker", "data.csv", "range_mm", lambda c: -c),
    ("laser_tracker", "data.csv", "range_mm", lambda c: c * 1e3),
    ("laser_tracker", "data.csv", "range_mm", lambda c: c / 1e3),
    ("laser_tracker", "data.csv", "azimuth_rad", np.degrees),
    ("laser_tracker", "data.csv", "elevation_rad", lambda c: -c),
    ("laser_tracker", "data.csv", "x_mm", lambda c: c / 25.4),
    ("laser_tracker", "data.csv", "x_mm", lambda c: c * 1000),
    ("laser_tracker", "data.csv", "x_mm", _set(500)),
    ("laser_tracker", "data.csv", "dir_x", _row(0)),
    ("laser_tracker", "data.csv", "dir_y", lambda c: 2 * c),
    ("laser_tracker", "data.csv", "T_x_degC", lambda c: c + 273.15),
    ("laser_tracker", "data.csv", "T_y_degC", _row(-60)),
    ("laser_tracker", "data.csv", "T_z_degC", _row(151)),
    ("laser_tracker", "data.csv", "T_air_degC", _row(1e6)),
    ("laser_tracker", "data.csv", "t_s", lambda c: 1e12 + c),
    ("laser_tracker", "data.csv", "t_s", _row(1e300)),
    ("laser_tracker", "data.csv", "point", _row(-1)),
    ("laser_tracker", "data.csv", "point", _row(2.5)),
    ("laser_tracker", "data.csv", "payload_kg", _new(-5.0)),
    ("laser_tracker", "data.csv", "payload_kg", _new(1e9)),
    ("laser_tracker", "data.csv", "load_kg", _new(-1.0)),
    ("laser_tracker", "data.csv", "spindle_degC", _new(400.0)),
    ("laser_tracker", "data.csv", "path_mm", _new(-100.0)),
    ("laser_tracker", "data.csv", "since_x_mm", _new(-1.0)),
    ("laser_tracker", "data.csv", "speed_rpm", _new(1e8)),
    ("laser_tracker", "data.csv", "v_x_m_s", _new(500.0)),
    ("laser_tracker", "data.csv", "a_x_m_s2", _new(1e6)),
    ("laser_tracker", "data.csv", "approach_rad", _new(90.0)),
    ("laser_tracker", "data.csv", "T_gradient_K_per_m", _new(1e5)),
    ("laser_tracker", "errors.csv", "a1", _row(-5)),
    ("laser_tracker", "errors.csv", "a1", _row(1e6)),
    ("laser_tracker", "errors.csv", "b1", _row(1e5)),
    ("laser_tracker", "errors.csv", "n1", _row(1e9)),
    ("laser_tracker", "errors.csv", "n1", _row(5000)),
    ("laser_tracker", "errors.csv", "n2", _row(1e-6)),
    ("laser_tracker", "errors.csv", "a0", lambda c: c + 1e7),
    ("laser_tracker", "check.csv", "tcp_x_mm", lambda c: c / 1000),
    ("laser_tracker", "check.csv", "tcp_z_mm", lambda c: -c),
    ("laser_tracker", "check.csv", "tcp_x_mm", _set(0)),
    ("laser_tracker", "check.csv", "x_mm", lambda c: c + 1e5),
    ("ball_array", "data.csv", "x_mm", _set(300)),
    ("ball_array", "data.csv", "y_mm", _in_turn(200, 201)),
    ("ball_array", "data.csv", "pose", lambda c: 0 * c),
    ("ball_array", "data.csv", "ball", _row(99)),
    ("ball_array", "artefact.csv", "x_mm", lambda c: c * 1000),
    ("ball_array", "artefact.csv", "x_mm", lambda c: c / 1000),
    ("ball_array", "artefact.csv", "x_mm", lambda c: 0 * c),
    ("ball_array", "artefact.csv", "y_mm", lambda c: c + 1e5),
    ("ball_array", "artefact.csv", "z_mm", _row(math.inf)),
    ("laser_frame", "data.csv", "u_um", _set(0)),
    ("laser_frame", "data.csv", "v_um", _in_turn(1, 2)),
    ("laser_frame", "data.csv", "u_um", lambda c: c * 1e6),
    ("laser_frame", "data.csv", "segment", _row(77)),
    ("laser_frame", "data.csv", "path_mm", lambda c: -c - 1),
    ("laser_frame", "data.csv", "T_head_degC", lambda c: c + 273.15),
    ("r_test", "data.csv", "x_ext_mm", _set(0)),
    ("r_test", "data.csv", "z_ext_mm", _in_turn(-0.01, 0.01)),
    ("r_test", "data.csv", "x_ext_mm", lambda c: c * 1000),
    ("r_test", "data.csv", "a_set_m_s2", lambda c: -c),
    ("r_test", "data.csv", "a_set_m_s2", lambda c: c * 1e6),
    ("r_test", "data.csv", "sense", _row(3)),
    ("static_r_test", "data.csv", "x_ext_mm", _set(0.01)),
    ("static_r_test", "data.csv", "c_deg", lambda c: -c),
    ("static_r_test", "data.csv", "c_deg", np.radians),
    ("interferometer", "data.csv", "meas_position_um", lambda c: c * 1e6),
    ("interferometer", "data.csv", "T_material_degC", lambda c: c + 273.15),
    ("interferometer", "data.csv", "line", _row(-1)),
    ("double_ball_bar", "data.csv", "deviation_um", _set(3)),
    ("double_ball_bar", "data.csv", "deviation_um", _in_turn(-3, 3)),
    ("double_ball_bar", "data.csv", "deviation_um", lambda c: c * 1e4),
    ("touch_probe", "data.csv", "x_mm", _row(1e5)),
    ("pose_probe", "data.csv", "x_mm", _set(10)),
    ("pose_probe", "data.csv", "z_mm", lambda c: c / 1000),
    ("pose_probe", "data.csv", "q2_cmd_deg", np.radians),
    ("reflectors", "data.csv", "smr1_x_mm", _set(10)),
    ("reflectors", "data.csv", "smr1_x_mm", lambda c: c * 1000),
    ("reflectors", "data.csv", "q1_cmd_deg", lambda c: c * 100),
    ("reflectors", "data.csv", "q1_cmd_deg", lambda c: -c),
]
"""Kind, table, column, and its numbers from those that it has, or the number of a new column."""

_TILT = 'name="thermal_tilt", placement="Y", component="EAY", k_EAY_urad_per_K=-6000'
ACCEPTED = {
    f"model.effect=[{{{_TILT}}}]": "within three times what the loop takes to be possible: wrong "
    "units of a temperature make tilts of this size",
}
"""Declarations that are not refused, by their text, and why."""


def declarations():
    """Kind and overrides of every impossible declaration of a study file."""
    for line in filter(None, MACHINE.splitlines()):
        yield "laser_tracker", line.replace("SMOOTH", SMOOTH)
    for line in filter(None, EFFECTS.splitlines()):
        yield "laser_tracker", f"model.effect=[{{{line}}}]"
    for kind, text in STUDIES.items():
        for line in filter(None, text.splitlines()):
            yield kind, line
