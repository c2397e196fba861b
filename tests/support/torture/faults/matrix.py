"""All cases of the fault matrix, device by device; their names are stable."""

from __future__ import annotations

import errno
from collections.abc import Iterator

from tests.support.torture.faults.case import Case, Scene
from tests.support.torture.faults.wire.proxy import Column, Spoil

COLUMNS: dict[Column, str] = {
    "drop": "is lost",
    "stall": "and all that follow on the connection never arrive",
    "truncate": "is cut in half",
    "corrupt": "arrives with bytes changed",
    "duplicate": "arrives twice",
    "reorder": "arrives after the next one",
    "reject": "is refused",
    "away_1s": "never arrives: the device is gone for 1 s",
    "away_30s": "never arrives: the device is gone for 30 s",
    "away_never": "never arrives: the device is gone for good",
    "slow": "and each of its kind comes 0.3 s late",
    "noise": "and each of its kind is random bytes",
    "mutated": "and each of its kind comes with bytes changed",
}
# device and wire, kind → (what it is, recorded images before it is armed, which message of the kind, how many)
_ROBOT: dict[str, tuple[str, int, int, int]] = {
    "rtde/version": ("the answer to the protocol version", -1, 1, 1),
    "rtde/controller": ("the answer to the controller's version", -1, 1, 1),
    "rtde/outputs": ("the answer to the setup of outputs", -1, 1, 1),
    "rtde/inputs": ("the answer to the setup of inputs", -1, 1, 1),
    "rtde/start": ("the answer to the start of the stream", -1, 1, 1),
    "rtde/stream": ("a package of the stream", 1, 40, 1),
    "rtde/command": ("a command written to a register", 1, 5, 1),
    "dashboard/welcome": ("the dashboard's welcome", -1, 1, 1),
    "dashboard/answer": ("an answer of the dashboard", -1, 1, 1),
    "script/script": ("the control script", -1, 1, 1),
}
_CAMERA: dict[str, tuple[str, int, int, int]] = {
    "ptpip/connect": ("the answer to the command connection", -1, 1, 1),
    "ptpip/event_connect": ("the answer to the event connection", -1, 1, 1),
    "ptpip/session": ("the answer to the session", -1, 1, 1),
    "ptpip/device_info": ("the description of the device", -1, 1, 1),
    "ptpip/properties": ("the list of properties", 1, 2, 1),
    "ptpip/set": ("the answer to a setting", -1, 2, 1),
    "ptpip/release": ("the answer to the shutter", 1, 1, 1),
    "ptpip/event": ("the event of a new file", 1, 1, 1),
    "ptpip/file_info": ("the description of a file", 1, 1, 1),
    "ptpip/file": ("a packet of a file", 1, 2, 1),
    "ptpip/request": ("a request to the camera", 1, 6, 1),
}
# What Sony's bodies do not have, and the files: an EOS tells everything as an answer to the polling of its events.
_CANON: dict[str, tuple[str, int, int, int]] = {
    "ptpip/remote_mode": ("the answer to the remote mode", -1, 1, 1),
    "ptpip/event_mode": ("the answer to the event mode", -1, 1, 1),
    "ptpip/events": ("a packet of the camera's events", 1, 4, 1),
    "ptpip/eos_set": ("the answer to a setting", -1, 2, 1),
    "ptpip/press": ("the answer to the full press of the shutter", 1, 2, 1),
    "ptpip/let_go": ("the answer to its release", 1, 1, 1),
    "ptpip/file_info": ("the description of a file", 1, 1, 1),
    "ptpip/file": ("a packet of a file", 1, 2, 1),
}
_TABLE: dict[str, tuple[str, int, int, int]] = {
    "grbl/welcome": ("the controller's welcome", -1, 1, 1),
    "grbl/setting": ("a setting", -1, 20, 1),
    "grbl/status": ("a report", 1, 20, 1),
    "grbl/answer": ("the answer to a piece of a motion", 1, 3, 1),
    "grbl/query": ("a request for a report", 1, 20, 1),
    "grbl/jog": ("a piece of a motion", 1, 3, 1),
    "grbl/home": ("the command to home", -1, 1, 1),
    "grbl/homed": ("the answer to homing", -1, 1, 1),
}
_KUKA: dict[str, tuple[str, int, int, int]] = {
    "lines/hello": ("the application's greeting", -1, 1, 1),
    "lines/state": ("a line of the stream", 1, 40, 1),
    "lines/ack": ("the answer to a request", 1, 1, 1),
    "lines/done": ("the end of a motion", 1, 1, 1),
    "lines/request": ("a request to the application", 1, 1, 1),
    "lines/beat": ("a sign of life", 1, 20, 1),
}
# Datagrams, a hundred a second; forty of them are spoilt, of those that nobody waits for.
_FRI: dict[str, tuple[str, int, int, int]] = {
    "fri/message": ("each of 40 messages of FRI", 1, 20, 40),
    "fri/reply": ("each of 40 replies to FRI", 1, 20, 40),
}
# A camera that rig.yaml names by its address is not searched for.
_GIGE: dict[str, tuple[str, int, int, int]] = {
    "gvcp/description": ("a piece of the camera's description", -1, 5, 1),
    "gvcp/register": ("the value of a register", 1, 3, 1),
    "gvcp/written": ("the answer to the taking of control", -1, 1, 1),
    "gvcp/set": ("the answer to a setting", -1, 1, 1),
    "gvcp/request": ("a request to the camera", 1, 5, 1),
    "gvsp/leader": ("the beginning of an image", 1, 1, 1),
    "gvsp/payload": ("a packet of an image", 1, 2, 1),
    "gvsp/trailer": ("the end of an image", 1, 1, 1),
}
_LISTEN: dict[str, tuple[str, int, int, int]] = {
    "dicom/associate": ("the request of an association", -1, 1, 1),
    "dicom/accept": ("the answer to it", -1, 1, 1),
    "dicom/command": ("the head of a slice", -1, 30, 1),
    "dicom/slice": ("a slice", -1, 30, 1),
    "dicom/stored": ("the answer to a slice", -1, 30, 1),
    "dicom/release": ("the end of an association", -1, 1, 1),
    "dicom/released": ("the answer to its end", -1, 1, 1),
}
_LIGHTBOX: dict[str, tuple[str, int, int, int]] = {
    "serial/identity": ("the box's identity", -1, 1, 1),
    "serial/light": ("a reading of the light", 1, 1, 1),
    "serial/temperature": ("a reading of the temperature", 1, 1, 1),
    "serial/pedal": ("the count of the pedal", -1, 1, 1),
    "serial/request": ("a request to the box", 1, 1, 1),
}
# Messages that the protocol cannot refuse, or that cannot be reordered because the sender waits for the answer.
_NO_REFUSAL = {"rtde/controller", "rtde/stream", "rtde/command", "dashboard/welcome", "script/script"} | {
    "ptpip/event", "ptpip/request", "serial/request", "grbl/welcome", "grbl/status", "grbl/query", "grbl/jog",
    "lines/state", "lines/done", "lines/request", "lines/beat", "grbl/home", "fri/message", "fri/reply",
    "dicom/associate", "dicom/command", "dicom/slice", "dicom/release", "dicom/released",
    "gvcp/request", "gvsp/leader", "gvsp/payload", "gvsp/trailer",
}  # fmt: skip


# Pixels have no checksum of their own: UDP's drops a packet that arrives changed, and so is it lost.
_CHECKED_BY_UDP = {("gvsp/payload", "corrupt"), ("gvsp/payload", "mutated")}


def _wires(device: str, scene: Scene, kinds: dict[str, tuple[str, int, int, int]], act: str = "") -> Iterator[Case]:
    for place, (what, after, nth, times) in kinds.items():
        kind = place.split("/")[1]
        for column, happens in COLUMNS.items():
            if (column == "reject" and place in _NO_REFUSAL) or (place, column) in _CHECKED_BY_UDP:
                continue
            spoil = Spoil(kind, column, nth, 1 if column.startswith("away_") else times)
            # With noise libgphoto2 hangs at an EOS until its process is killed, a minute for each attempt.
            patience = 1 if scene == "canon" and column in ("noise", "mutated") else 3
            yield Case(
                f"{device}/{place}/{column}",
                scene,
                f"{what} {happens}",
                spoil,
                after,
                act=act,
                mend=act,
                patience=patience,
            )


def _robot_itself() -> Iterator[Case]:
    def plan(kind: str, on: str = "move", nth: int = 2, **more: object) -> tuple[dict[str, object], ...]:
        return ({"device": "robot", "on": on, "kind": kind, "nth": nth, **more},)

    own = "robot/itself"
    yield Case(
        f"{own}/protective_stop",
        "arm",
        "a protective stop in a motion",
        faults=plan("protective_stop"),
        mend="unlock",
    )
    yield Case(
        f"{own}/emergency_stop",
        "arm",
        "the emergency stop in a motion",
        faults=plan("emergency_stop"),
        mend="power_up",
    )
    yield Case(f"{own}/joint_limit", "arm", "a joint at its limit", faults=plan("joint_limit"), mend="unlock")
    yield Case(f"{own}/motion_refused", "arm", "the controller does not start a motion", faults=plan("reject"))
    yield Case(
        f"{own}/script_ends", "arm", "the control script ends at a command", faults=plan("reject", "command", 6)
    )
    yield Case(f"{own}/no_ik", "arm", "views out of the arm's reach", act="nothing", value={"distance_m": 1.9})
    yield Case(
        f"{own}/slider_0",
        "arm",
        "the speed slider at 0",
        after=1,
        act="slider",
        value={"fraction": 0.0},
        mend="slider_up",
    )
    yield Case(f"{own}/slider_10", "arm", "the speed slider at 10 %", after=1, act="slider", value={"fraction": 0.1})


def _camera_itself() -> Iterator[Case]:
    def plan(kind: str, on: str, nth: int = 1, times: int = 1) -> tuple[dict[str, object], ...]:
        return ({"device": "camera", "on": on, "kind": kind, "nth": nth, "times": times},)

    own = "camera/itself"
    for name, what, faults in (
        ("busy", "the camera is busy twice", plan("busy", "shutter", 2, 2)),
        ("card_full", "the card is full", plan("disk_full", "shutter", 2)),
        ("shutter_refused", "the shutter is refused", plan("reject", "shutter", 2)),
        ("setting_refused", "a setting is refused", plan("reject", "set", 2, 99)),
        ("setting_ignored", "a setting is refused silently", plan("ignore", "set", 2, 99)),
        ("stale", "the frame before comes again", plan("stale", "image", 2)),
        ("no_image", "no file comes", plan("no_image", "image", 2)),
        ("truncated", "a file ends early", plan("truncate", "image", 2)),
        ("corrupt", "a file has bytes changed", plan("corrupt", "image", 2)),
        ("wrong_exif", "a photograph tells other settings", plan("wrong_exif", "image", 2)),
        ("raw_only", "a RAW comes without its JPEG", plan("raw_only", "image", 2)),
    ):
        yield Case(f"{own}/{name}", "camera", what, faults=faults)
    busy = plan("busy", "shutter", 2, 999)
    yield Case(f"{own}/busy_on", "camera", "the camera is busy and stays so", faults=busy, patience=0)
    yield Case(f"{own}/battery_low", "camera", "the battery is at 5 %", options=("--battery", "5"), act="nothing")
    yield Case(f"{own}/switched_off", "camera", "the camera is switched off", after=1, act="camera_off")


def _more_of_the_robot() -> Iterator[Case]:
    own, local = "robot/itself", ("--local",)
    yield Case(f"{own}/local_control", "arm", "remote control is off", options=local, act="nothing", mend="remote")
    yield Case(f"{own}/local_control_on", "arm", "remote control is off and stays so", options=local, act="nothing")
    yield Case(f"{own}/switched_off", "arm", "the controller loses its power", after=1, act="arm_off")


def _table_itself() -> Iterator[Case]:
    for name, what, kind, value in (
        ("limit_switch", "a limit switch is hit", "hard_limit", 0.0),
        ("door", "the safety door is opened for 1 s", "door", 1.0),
        ("door_tapped", "the safety door is opened for a moment", "door", 1e-6),
        ("reset", "somebody resets the controller", "reset_button", 0.0),
        ("held", "somebody holds the axes", "hold_button", 0.0),
        ("unplugged_1s", "the cable is pulled for 1 s", "unplug", 1.0),
    ):
        plan = ({"device": "grbl", "on": "jog", "kind": kind, "nth": 12, "value": value},)
        yield Case(f"table/itself/{name}", "table", f"{what}, in a motion", faults=plan)
    yield Case("table/itself/switched_off", "table", "the controller loses its power", after=1, act="table_off")


def _kuka_itself() -> Iterator[Case]:
    own = "kuka/itself"
    for name, what in (("protective_stop", "a protective stop"), ("emergency_stop", "the emergency stop")):
        plan = ({"device": "robot", "on": "move", "kind": name, "nth": 2},)
        yield Case(f"{own}/{name}", "kuka", f"{what} in a motion", faults=plan, mend="kuka_release")
    plan = ({"device": "robot", "on": "move", "kind": "reject", "nth": 2},)
    yield Case(f"{own}/motion_refused", "kuka", "the controller does not start a motion", faults=plan)
    words = "somebody opens the cell between two motions"
    yield Case(f"{own}/cell_opened", "kuka", words, after=1, act="kuka_stop", mend="kuka_release")
    yield Case(f"{own}/switched_off", "kuka", "the controller loses its power", after=1, act="kuka_off")


def _video_itself() -> Iterator[Case]:
    def case(name: str, what: str, act: str, mend: str = "film", **value: object) -> Case:
        return Case(f"video/itself/{name}", "video", what, after=1, act=act, mend=mend, value=value)

    yield case("frozen", "the camera gives the same image again and again", "film", how="frozen")
    yield case("damaged", "its images are damaged", "film", how="damaged")
    yield case("other_size", "its images have another size", "film", how="other_size")
    yield case("noise", "it sends random bytes", "film", how="noise")
    yield case("silent", "it stands still", "film_pauses")
    yield case("away_1s", "it is gone for 1 s", "film_ends", mend="", seconds=1.0)
    yield case("away_never", "it is gone for good", "film_ends", mend="")


def _gige_itself() -> Iterator[Case]:
    own = "gige/itself"
    for name, what, kind in (
        ("lost_packets", "packets of an image are lost, and sent again", "lost_packets"),
        ("incomplete", "packets of an image are lost for good", "truncate"),
        ("no_image", "no image comes", "no_image"),
        ("stale", "the image before comes again", "stale"),
    ):
        plan = ({"device": "camera", "on": "image", "kind": kind, "nth": 2},)
        yield Case(f"{own}/{name}", "gige", what, faults=plan)
    yield Case(f"{own}/taken", "gige", "another program controls the camera", act="taken", mend="let_go")
    yield Case(f"{own}/taken_on", "gige", "another program controls the camera, and keeps it", act="taken")
    yield Case(f"{own}/switched_off", "gige", "the camera loses its power", after=1, act="gige_off")


def _files() -> Iterator[Case]:
    def scan(name: str, what: str, act: str, mend: str = "scan", **value: object) -> Case:
        return Case(f"scanner/export/{name}", "scan", what, act=act, mend=mend, value=value)

    yield scan("half_written", "the export is still being written", "half_written", mend="")
    yield scan("truncated", "the export ends early", "truncated")
    yield scan("truncated_on", "the export ends early and stays so", "truncated", mend="")
    yield scan("empty", "the export is empty", "empty")
    yield scan("corrupt", "the export has bytes changed", "corrupt")
    yield scan("replaced", "the export is replaced while it is read", "replaced", mend="")
    yield scan("wrong_unit", "the export is in inches", "scaled", factor=1 / 25.4)
    yield scan("metres", "the export is in metres", "scaled", factor=1e-3)
    yield scan("wrong_specimen", "the export is of another specimen", "wrong_specimen")
    yield scan("none", "there is no export", "no_export")
    yield scan("share_1s", "the share is gone for 1 s", "share_away", mend="", seconds=1.0)
    yield scan("share_30s", "the share is gone until a person brings it back", "share_away", mend="share_back")
    yield scan("share_never", "the share is gone for good", "share_away", mend="")

    def ct(name: str, what: str, mend: str = "ct") -> Case:
        return Case(f"ct/series/{name}", "ct", what, act="ct", mend=mend, value={"kind": name})

    for name, what in (
        ("drop", "a slice is missing"),
        ("truncate", "a slice ends early"),
        ("corrupt", "a slice has bytes changed"),
        ("duplicate", "a slice is there twice"),
        ("tilt", "a slice is tilted"),
        ("localiser", "a localiser lies in the series"),
        ("two_series", "a second series lies in the folder"),
        ("mirrored", "the pixels are mirrored"),
    ):
        yield ct(name, what)
    for name, what, seconds, mend in (
        ("share_1s", "the share is gone for 1 s", 1.0, ""),
        ("share_never", "the share is gone for good", None, ""),
    ):
        value = {"seconds": seconds}
        yield Case(f"ct/series/{name}", "ct", what, act="share_away", mend=mend, value=value)
    yield Case("ct/series/none", "ct", "there is no series", act="no_export", mend="ct")


def _listen_itself() -> Iterator[Case]:
    def case(name: str, what: str, act: str, mend: str, **value: object) -> Case:
        return Case(f"listen/itself/{name}", "listen", what, act=act, mend=mend, value=value)

    yield case("sender_killed", "the sender dies in the middle of a series", "send_cut", "send")
    yield case("sender_killed_on", "the same, and nobody sends again", "send_cut", "")
    yield case("receiver_killed", "the receiver is killed in the middle of a series", "receiver_killed", "listen")
    yield case("disk_full", "the disk is full", "send", "listen", full=True)
    yield case("slice_missing", "a slice is missing in what is sent", "send_spoilt", "send_afresh", kind="drop")
    yield case("slice_cut", "a slice that is sent ends early", "send_spoilt", "send_afresh", kind="truncate")
    yield case("two_series", "two series are sent at once", "send_two", "send_afresh")


# Calls of each kind that a capture makes after its first image is recorded: the disk fails at each of them.
_CALLS = {"write": 6, "sync_file": 8, "rename": 5, "make_read_only": 4, "sync_directory": 8, "commit": 6, "append": 6}


def _store() -> Iterator[Case]:
    def disk(name: str, what: str, number: int, effect: str, nth: int) -> Case:
        value = {"errno": number, "effect": effect, "nth": nth}
        return Case(f"store/{name}", "store", what, after=1, act="disk", mend="disk", value=value)

    for effect, count in _CALLS.items():
        for nth in range(1, count + 1):
            words = f"the disk is full at {effect} number {nth}"
            yield disk(f"disk_full/{effect}_{nth:02d}", words, errno.ENOSPC, effect, nth)
    for name, what, number in (
        ("read_only", "the data folder becomes read-only", errno.EROFS),
        ("io_error", "the disk fails", errno.EIO),
        ("share_error", "the share of the data does not answer", errno.ESTALE),
    ):
        for effect in ("", "write", "commit"):
            yield disk(
                f"{name}/{effect or 'any'}", f"{what}: at {effect or 'whatever comes first'}", number, effect, 1
            )

    def other(name: str, what: str, act: str, mend: str = "", **value: object) -> Case:
        return Case(f"store/{name}", "store", what, after=1, act=act, mend=mend, value=value)

    yield other("database/locked_2s", "another program holds the database for 2 s", "lock", seconds=2.0)
    yield other("database/locked_40s", "another program holds the database for 40 s", "lock", seconds=40.0)
    words, value = "another program holds the database for 340 s", {"seconds": 340.0}
    yield Case("store/database/locked_340s", "store", words, after=1, act="lock", value=value, longer_s=400.0)
    yield other("database/gone", "the data folder is gone until a person brings it back", "data_away", "data_back")
    yield other("clock/ahead", "the clock is put forward by an hour", "clock", seconds=3600.0)
    yield other("clock/back", "the clock is put back by an hour", "clock", seconds=-3600.0)


def cases() -> dict[str, Case]:
    """All cases by name, in the order of the table."""
    found = [
        *_wires("robot", "arm", _ROBOT),
        *_robot_itself(),
        *_more_of_the_robot(),
        *_wires("camera", "camera", _CAMERA),
        *_camera_itself(),
        *_wires("canon", "canon", _CANON),
        *_wires("lightbox", "lightbox", _LIGHTBOX),
        Case("lightbox/itself/unplugged", "lightbox", "the serial cable is unplugged", after=1, act="unplug"),
        *_wires("table", "table", _TABLE),
        *_table_itself(),
        *_wires("kuka", "kuka", _KUKA),
        *_wires("kuka", "fri", _FRI),
        *_kuka_itself(),
        *_video_itself(),
        *_wires("gige", "gige", _GIGE),
        *_gige_itself(),
        *_files(),
        *_wires("listen", "listen", _LISTEN, act="send"),
        *_listen_itself(),
        *_store(),
    ]
    return {case.name: case for case in found}
