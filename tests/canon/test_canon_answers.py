"""Properties of a Canon that are absent, offer nothing or are outside their list: refused in words, or no matter."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DeviceRefusedError, DeviceUnavailableError
from drivers.interfaces import CameraSettings
from simulators.canon_camera.recorded import recording_of
from tests.support.rig.camera_simulator import camera_simulator
from tests.support.rig.gphoto_rig import driver

WANTED = CameraSettings(8.0, 1 / 15, 100, "Automatic", "JPEG")
READ = ("d101", "d102", "d103", "d105", "d106", "d108", "d109", "d111", "d11b", "d11c", "d120", "d1af", "d1d8")


def spoilt(one: dict[str, Any], how: str) -> list[dict[str, Any]]:
    match how:
        case "absent":
            return []
        case "offers nothing":
            return [{key: value for key, value in one.items() if key != "numbers"} | {"access": "ro"}]
        case _:
            return [one | ({"value": 0xEE} if one["type"] != "str" else {})]


WAYS = ("absent", "offers nothing", "outside its list")
# Each way once, and a body without a number, in every submission; of the others a tenth are drawn.
ALWAYS = (("d101", "absent"), ("d102", "offers nothing"), ("d120", "outside its list"), ("d1af", "absent"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "how"),
    [pytest.param(code, how, marks=pytest.mark.sweep(always=(code, how) in ALWAYS)) for code in READ for how in WAYS],
)
def test_an_unexpected_property_is_refused_in_words_or_does_not_matter(code: str, how: str, tmp_path: Path) -> None:
    """Each call ends, none is a fault of the driver, and what reads back after `apply` is what was asked for."""
    recording = json.loads(recording_of("eos-r5-1.2.0").read_text(encoding="utf-8"))
    listing = recording["devices"]["camera"]["answers"]["listing"]
    assert code in {one["code"] for one in listing["properties"]}
    listing["properties"] = [
        kept for one in listing["properties"] for kept in (spoilt(one, how) if one["code"] == code else [one])
    ]
    file = tmp_path / "spoilt.json"
    file.write_text(json.dumps(recording), encoding="utf-8")
    with camera_simulator([], "--fast", "--replay", str(file), name="canon") as running:
        camera = driver(running.gphoto_port)
        try:
            if code == "d1af" and how == "absent":
                with pytest.raises(DeviceUnavailableError, match="eosserialnumber"):
                    camera.open()
                return
            camera.open()
            assert camera.report().identity.model == "Canon EOS R5"
            with suppress(DeviceRefusedError):
                assert camera.apply(WANTED) == WANTED
            with suppress(DeviceRefusedError):
                assert camera.capture(tmp_path).counter == 1
        finally:
            camera.close()
