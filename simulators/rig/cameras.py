"""The cameras that a simulated rig may have: which simulator each is, where it is found, and its part of rig.yaml."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from simulators.gige_camera.registers import SERIAL
from simulators.sony_camera.properties import Code
from simulators.sony_camera.recorded import recorded_table

CAMERAS = {"Sony ILCE-7RM5": "camera", "Canon EOS R5": "canon", "GigE Vision": "gige", "video": "video"}
STILL = ("Sony ILCE-7RM5", "Canon EOS R5")  # with a button; a person can hold them, and they can be second cameras
_LENS = {"aperture_f": 22.0, "lens": "50 mm", "focal_length_mm": 50.0}  # set by hand, as the protocols want it
_ISO = 100  # as the protocols want it
_LONGEST_FRAME_S = 30.0  # this camera renders its images
_VIDEO_LATENCY_S = 2.0  # twice what the simulator holds a frame back at most, and a frame


def place(model: str, host: str, folder: Path) -> tuple[str, ...]:
    """The words of the command line that say where the simulator is to be found."""
    match CAMERAS[model]:
        case "gige":
            return "--host", host
        case "video":
            return "--pipe", str(folder / "video")
        case _:
            return "--port", "0"


def as_recorded(body: str) -> tuple[str, ...]:
    """The words for a Sony with the table of a recorded body; its ISO is set at the body if it lists no values."""
    iso = next((one for one in recorded_table(body).properties if one.code == Code.ISO), None)
    if iso is None or iso.choices != ():
        return "--recorded", body
    by_hand = [{"code": f"{Code.ISO:x}", "how": "value", "value": _ISO}]
    return "--recorded", body, "--answers", json.dumps(by_hand)


def restart_options(ready: dict[str, Any], taken: int) -> tuple[str, ...]:
    """The words with which a camera that died is found where it was, and counts on."""
    port = str(ready.get("gphoto_port", "")).rpartition(":")[2]
    return (*(("--port", port) if port else ()), "--first-counter", str(taken + 1))


def section(ready: dict[str, Any], exposure_s: float) -> dict[str, Any]:
    """The camera with this ready line in rig.yaml; one picture may take this long, since it is rendered."""
    match ready["simulator"]:
        case "gige":
            found = {"driver": "genicam", "camera": ready["host"], "serial": SERIAL}
            return {**found, **_LENS, "frame_timeout_s": min(exposure_s, _LONGEST_FRAME_S)}
        case "video":
            found = {"driver": "video", "port": "video", "model": "simulated microscope", "exposure_s": 1 / 15}
            timing = {"latency_s": _VIDEO_LATENCY_S, "frame_timeout_s": min(exposure_s, _LONGEST_FRAME_S)}
            return {**found, **_LENS, **timing}
        case _:
            return {"driver": "gphoto", "port": ready["gphoto_port"], "capture_timeout_s": exposure_s}
