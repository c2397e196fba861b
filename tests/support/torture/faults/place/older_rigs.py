"""The rigs of a case with a Universal Robots arm, a still camera, a light box, or the folders of scanner and CT."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.support.torture.faults.place.ct_suite import Suite
from tests.support.torture.faults.place.material import ct_folder, scan_folder
from tests.support.torture.faults.wire.proxy import Wire

if TYPE_CHECKING:
    from tests.support.torture.faults.trial import Trial


def arm_rig(trial: Trial) -> dict[str, Any]:
    """An arm of Universal Robots; returns the devices' section of the rig file."""
    near = trial.near_host
    trial.simulators.start("ur", "--host", trial.arm_host, "--speed-up", "3", *trial.plan(), *trial.case.options)
    trial.wired(
        Wire("robot", "rtde", (near, 30004), (trial.arm_host, 30004)),
        Wire("robot", "dashboard", (near, 29999), (trial.arm_host, 29999)),
        Wire("robot", "script", (near, 30003), (trial.arm_host, 30003)),
    )
    host = near if trial.proxy else trial.arm_host
    limits = {"connect_timeout_s": 2.0, "watchdog_s": 1.0, "stale_after_s": 2.0}
    return {"robot": {"driver": "ur", "host": host, **limits}}


def camera_rig(trial: Trial, body: str) -> dict[str, Any]:
    """A still camera of this maker; returns the devices' section of the rig file."""
    words = (body, "--port", "0", "--fast", "--image-width", "96", *trial.plan(), *trial.case.options)
    ready = trial.simulators.start(*words)
    port, near_port = int(ready["port"]), 15740
    trial.wired(Wire("camera", "ptpip", (trial.near_host, near_port), ("127.0.0.1", port)))
    address = f"ptpip:{trial.near_host}:{near_port}" if trial.proxy else str(ready["gphoto_port"])
    return {"camera": {"driver": "gphoto", "port": address, "capture_timeout_s": 5.0}}


def lightbox_rig(trial: Trial) -> dict[str, Any]:
    """A light box; returns the devices' section of the rig file."""
    far, line = trial.folder / "far", trial.folder / "line"
    trial.simulators.start("lightbox", "--link", str(far), *trial.plan(), *trial.case.options)
    trial.wired(Wire("lightbox", "serial", str(line), str(far)))
    return {"lightbox": {"driver": "lightbox", "port": str(line if trial.proxy else far), "timeout_s": 0.3}}


def scan_rig(trial: Trial) -> dict[str, Any]:
    """An export folder of a scanner; returns the devices' section of the rig file."""
    scan_folder(trial.scene_folder, trial.material)
    return {"scanner": {"driver": "scan_folder", "folder": str(trial.scene_folder), "stable_s": 0.5}}


def ct_rig(trial: Trial) -> dict[str, Any]:
    """The folders of a CT and of a scanner; returns the devices' section of the rig file."""
    ct_folder(trial.scene_folder, trial.material)
    scans = trial.folder / "scans"
    scans.mkdir()
    return {
        "scanner": {"driver": "scan_folder", "folder": str(scans), "stable_s": 0.5},
        "ct": {"driver": "dicom_folder", "folder": str(trial.scene_folder), "stable_s": 0.5},
    }


def listen_rig(trial: Trial) -> dict[str, Any]:
    """A receiver for what a CT sends, and the folder of a scanner; returns the devices' section of the rig file."""
    trial.suite = Suite(trial)
    return trial.suite.rig(full=bool(trial.case.value.get("full")))
