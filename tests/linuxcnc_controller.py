"""A LinuxCNC controller without a screen, which drives to points with what vcal has written."""

import json
import os
import pwd
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

_TIMEOUT_S = 900
_SYSTEM_PYTHON = "/usr/bin/python3"

DRIVE = r"""#!/usr/bin/python3
import json, time
import hal, linuxcnc

task = json.load(open("task.json"))
joints = range(len(task["points"][0]))
command, status = linuxcnc.command(), linuxcnc.stat()
probe = hal.component("probe")
probe.ready()


def wait(done, seconds=30.0):
    end = time.time() + seconds
    while time.time() < end:
        status.poll()
        if done():
            return
        time.sleep(0.005)
    raise SystemExit("the controller did not answer in time")


def motors():
    return [hal.get_value("joint.%d.motor-pos-cmd" % j) for j in joints]


def arrived(point):
    at = [hal.get_value("axis.%s.pos-cmd" % letter.lower()) for letter in task["axes"]]
    return max(abs(a - b) for a, b in zip(at, point)) < 1e-6


def coming():
    # What the tables of the joints still have to add: it comes with limited acceleration.
    names = ["joint.%d.backlash-" % j for j in joints]
    return max(abs(hal.get_value(n + "corr") - hal.get_value(n + "filt")) for n in names)


def settled():
    # Offsets follow the command with a delay; nothing may move for 80 ms, or for 2 s where a table
    # has not come: a busy computer may stop the controller for longer, or its ramp does not start.
    last, since, end = motors(), time.time(), time.time() + 10.0
    while time.time() < end:
        time.sleep(0.01)
        now, still = motors(), time.time() - since
        if max(abs(a - b) for a, b in zip(now, last)) > 1e-9:
            last, since = now, time.time()
        elif still > (0.08 if coming() < 5e-5 else 2.0):
            return now
    raise SystemExit("the motors did not come to rest")


def start():
    command.state(linuxcnc.STATE_ON)
    command.wait_complete()
    status.poll()
    if not all(status.homed[: len(joints)]):
        for joint in joints:
            command.home(joint)
        wait(lambda: all(status.homed[: len(joints)]))
    command.mode(linuxcnc.MODE_MDI)
    command.wait_complete()
    if task["active"]:
        wait(lambda: hal.get_value(task["active"]))


command.state(linuxcnc.STATE_ESTOP_RESET)
command.wait_complete()
start()
found = []
for number, (point, pins) in enumerate(zip(task["points"], task["pins"])):
    if number == task["off_before"]:
        command.state(linuxcnc.STATE_OFF)
        command.wait_complete()
        time.sleep(0.3)
        start()
    for name, value in pins.items():
        hal.set_p(name, str(value))
    command.mdi("G53 G0 " + " ".join("%s%.9f" % one for one in zip(task["axes"], point)))
    command.wait_complete(30)
    # On a busy computer the state may still be that before the move: the command tells.
    wait(lambda: arrived(point) and status.interp_state == linuxcnc.INTERP_IDLE and status.inpos)
    found.append(settled())
json.dump(found, open("found.json", "w"))
"""


def why_not() -> str:
    """Why no controller can be run here; empty where one can."""
    if shutil.which("linuxcnc") is None or shutil.which("script") is None:
        return "LinuxCNC is not installed (Debian: apt-get install linuxcnc-uspace)"
    if os.geteuid() == 0 and shutil.which("runuser") is None:
        return "LinuxCNC refuses root, and there is no runuser to become another user"
    return ""


def driven(files, axes, volume_mm, points_mm, pins, active="", off_before=-1) -> np.ndarray:
    """Positions of the motors (n, axes), mm, at commanded points (n, axes), mm.

    `files` are those of a compensation; their INI lines are merged into the controller's. `pins`
    are the values of HAL pins before every move, `active` is a pin to wait for before the first
    one. The machine is switched off and on again before the point `off_before`.
    """
    folder = Path(tempfile.mkdtemp(prefix="vcal-linuxcnc-"))
    try:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        task = {"axes": axes, "points": np.asarray(points_mm).tolist(), "pins": pins}
        task |= {"active": active, "off_before": off_before}
        (folder / "task.json").write_text(json.dumps(task), encoding="utf-8")
        (folder / "drive.py").write_text(DRIVE, encoding="utf-8")
        (folder / "drive.py").chmod(0o755)
        (folder / "sim.tbl").write_text("", encoding="utf-8")
        (folder / "sim.hal").write_text(_hal(axes), encoding="utf-8")
        own = next((text for name, text in files.items() if name.endswith(".ini")), "")
        (folder / "sim.ini").write_text(_ini(axes, volume_mm, own), encoding="utf-8")
        said = _run(folder)
        if not (folder / "found.json").is_file():
            raise RuntimeError(f"LinuxCNC ended without a result:\n{said}")
        return np.array(json.loads((folder / "found.json").read_text(encoding="utf-8")))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run(folder: Path) -> str:
    command = ["script", "-qec", "linuxcnc sim.ini", "/dev/null"]
    environment = {"HOME": str(folder), "PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LANG": "C.UTF-8"}
    if os.geteuid() == 0:
        user = pwd.getpwnam("nobody")
        for path in (folder, *folder.iterdir()):
            os.chown(path, user.pw_uid, user.pw_gid)
        command = ["runuser", "-u", "nobody", "--", "env", f"HOME={folder}", *command]
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=_TIMEOUT_S,
        check=False,
    )
    reports = [p for p in folder.glob("linuxcnc_*.txt")]
    return "\n".join([done.stdout, done.stderr, *(p.read_text(errors="replace") for p in reports)])


def _hal(axes: str) -> str:
    lines = [
        "loadrt [KINS]KINEMATICS",
        "loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS",
        "addf motion-command-handler servo-thread",
        "addf motion-controller servo-thread",
        *(f"net p{j} joint.{j}.motor-pos-cmd => joint.{j}.motor-pos-fb" for j in range(len(axes))),
        "net estop iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in",
        "net tp iocontrol.0.tool-prepare => iocontrol.0.tool-prepared",
        "net tc iocontrol.0.tool-change => iocontrol.0.tool-changed",
    ]
    return "\n".join(lines) + "\n"


def _ini(axes: str, volume_mm, own: str) -> str:
    """The INI file of a simulated machine, with the lines of a compensation merged into it."""
    # An acceleration with which LinuxCNC follows jumps of more than 2.5 um (linuxcnc_screw.py).
    fast = ["MAX_VELOCITY = 1500", "MAX_ACCELERATION = 5000"]
    sections = {
        "EMC": ["VERSION = 1.1", "MACHINE = vcal"],
        "DISPLAY": ["DISPLAY = ./drive.py"],
        "TASK": ["TASK = milltask", "CYCLE_TIME = 0.005"],
        "RS274NGC": ["PARAMETER_FILE = sim.var"],
        "EMCMOT": ["EMCMOT = motmod", "SERVO_PERIOD = 1000000"],
        "EMCIO": ["TOOL_TABLE = sim.tbl", "EMCIO = io", "CYCLE_TIME = 0.100"],
        "HAL": ["HALFILE = sim.hal"],
        "TRAJ": [
            f"COORDINATES = {' '.join(axes)}",
            "LINEAR_UNITS = mm",
            "ANGULAR_UNITS = degree",
            "MAX_LINEAR_VELOCITY = 1500",
            "DEFAULT_LINEAR_VELOCITY = 500",
        ],
        "KINS": [f"KINEMATICS = trivkins coordinates={axes}", f"JOINTS = {len(axes)}"],
    }
    for joint, (axis, (low, high)) in enumerate(zip(axes, volume_mm, strict=True)):
        limits = [f"MIN_LIMIT = {low - 1.0}", f"MAX_LIMIT = {high + 1.0}", *fast]
        sections[f"AXIS_{axis}"] = [*limits]
        home = ["TYPE = LINEAR", f"HOME = {low}", "HOME_SEQUENCE = 0", "STEPGEN_MAXACCEL = 25000"]
        sections[f"JOINT_{joint}"] = [*home, *limits]
    section = ""
    for line in own.splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif line and not line.startswith("#"):
            sections[section].append(line)
    return "\n".join(f"[{name}]\n" + "\n".join(lines) + "\n" for name, lines in sections.items())
