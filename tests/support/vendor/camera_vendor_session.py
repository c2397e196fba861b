"""A session of plain python-gphoto2 in a process of its own: JSON commands in argv, JSON answers on stdout.

libgphoto2 closes file descriptor 0 and holds the interpreter lock, so it may not run in the test's process.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import sys
import tempfile
import time
from typing import Any

from tests.support.processes.forked import run

gp: Any = importlib.import_module("gphoto2")


def vendor_session(port: str, *commands: list[Any], timeout_s: float = 60.0) -> list[Any]:
    """Run the commands in a new process; an answer is {"error": code} if libgphoto2 raised."""
    with tempfile.TemporaryDirectory() as settings:  # libgphoto2 keeps some in the user's
        words = [sys.executable, "-m", "tests.support.vendor.camera_vendor_session", port, json.dumps(commands)]
        done = run(words, timeout_s=timeout_s, env={**os.environ, "XDG_CONFIG_HOME": settings})
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def _fetch(camera: Any, path: Any) -> dict[str, Any]:
    file = camera.file_get(path.folder, path.name, gp.GP_FILE_TYPE_NORMAL)  # keep it: it owns the memory used below
    data = bytes(memoryview(file.get_data_and_size()))
    return {
        "name": path.name,
        "size": len(data),
        "head": data[:4].hex(),
        "tail": data[-2:].hex(),
        "sha256": hashlib.sha256(data).hexdigest(),
    }


def _events(camera: Any, seconds: float, files: int = 99, last: str = "") -> list[list[Any]]:
    """What happens in so many seconds, or until so many files have come and an event with these words."""
    seen: list[list[Any]] = []
    end = time.monotonic() + seconds

    def enough() -> bool:
        told = not last or any(last in str(event) for event in seen)
        return told and sum(kind == "file" for kind, _ in seen) >= files

    while time.monotonic() < end and not enough():
        event, data = camera.wait_for_event(50)
        if event == gp.GP_EVENT_FILE_ADDED:
            seen.append(["file", _fetch(camera, data)])
        elif event == gp.GP_EVENT_CAPTURE_COMPLETE:
            seen.append(["complete", None])
        elif event == gp.GP_EVENT_UNKNOWN:
            seen.append(["unknown", str(data)])
    return seen


def _run(camera: Any, verb: str, *arguments: Any) -> Any:  # noqa: PLR0911 - one return a verb
    if verb == "value":
        return camera.get_single_config(arguments[0]).get_value()
    if verb == "choices":
        return list(camera.get_single_config(arguments[0]).get_choices())
    if verb == "set":
        widget = camera.get_single_config(arguments[0])
        widget.set_value(arguments[1])
        started = time.monotonic()
        camera.set_single_config(arguments[0], widget)
        return time.monotonic() - started
    if verb == "capture":
        return _fetch(camera, camera.capture(gp.GP_CAPTURE_IMAGE))
    if verb == "trigger":
        return camera.trigger_capture()
    if verb == "events":
        return _events(camera, *arguments)
    if verb == "preview":
        file = camera.capture_preview()
        data = bytes(memoryview(file.get_data_and_size()))
        return {"size": len(data), "head": data[:2].hex(), "tail": data[-2:].hex()}
    if verb == "storage":
        return [[store.capacitykbytes, store.freekbytes] for store in camera.get_storageinfo()]
    if verb == "sleep":
        return time.sleep(arguments[0])
    raise ValueError(verb)


def _main(port: str, commands: list[list[Any]]) -> list[Any]:
    answers: list[Any] = []
    camera = gp.Camera()
    ports = gp.PortInfoList()
    ports.load()
    camera.set_port_info(ports[ports.lookup_path(port)])
    abilities = gp.CameraAbilitiesList()
    abilities.load()
    camera.set_abilities(abilities[abilities.lookup_model("PTP/IP Camera")])
    try:
        camera.init()
        for command in commands:
            try:
                answers.append(_run(camera, *command))
            except gp.GPhoto2Error as error:
                answers.append({"error": error.code})
        camera.exit()
    except gp.GPhoto2Error as error:
        answers.append({"error": error.code})
    return answers


if __name__ == "__main__":
    print(json.dumps(_main(sys.argv[1], json.loads(sys.argv[2]))))  # noqa: T201 - the answer to the parent
