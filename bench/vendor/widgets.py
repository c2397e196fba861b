"""Every configuration name of the simulated camera in libgphoto2: read, and where possible set and read back."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import time
from typing import Any

AS_REAL, REFUSED, NOT_SIMULATED = "as the real one", "refused as the real one refuses", "not simulated"
CACHE_S = 2.1  # libgphoto2 caches a property's value for two seconds
_TEXT, _RANGE, _TOGGLE, _RADIO, _MENU = 2, 3, 4, 5, 6  # widget types of gphoto2-widget.h
_SECTIONS = (0, 1)
_CONTROLS = ("d2c1", "d2c2", "d2d1")

_RAW = "the property behind a name above, by its code"
_SETTING = "a value that is not offered is refused"
LISTED: dict[str, tuple[str, str]] = {
    "autofocus": (AS_REAL, "the half-pressed release; there is always something to focus on"),
    "capture": (AS_REAL, "the release; a picture is taken when it is fully pressed"),
    "movie": (NOT_SIMULATED, "refused: the simulated body takes no films"),
    "opcode": (AS_REAL, "a line for any operation; operations that the body does not know are refused"),
    "capturetarget": (AS_REAL, "the client sends an empty value by this name (set `d222` instead), which is refused"),
    **dict.fromkeys(
        ("serialnumber", "manufacturer", "cameramodel", "deviceversion", "vendorextension", "batterylevel"),
        (AS_REAL, "read-only"),
    ),
    "focusindication": (AS_REAL, "read-only"),
    "focalposition": (AS_REAL, "read-only, 0 to 100"),
    "manualfocus": (AS_REAL, "a step of −7 to 7, in manual focus and in direct manual focus"),
    **dict.fromkeys(
        ("prioritymode", "imagesize", "iso", "f-number", "imagequality", "jpegquality", "focusmode", "shutterspeed"),
        (AS_REAL, _SETTING),
    ),
    "whitebalance": (AS_REAL, f"{_SETTING}; it does not change the picture"),
    "capturemode": (AS_REAL, f"{_SETTING}; one picture is taken in every mode"),
    "exposurecompensation": (AS_REAL, f"{_SETTING}; with the dial on M it does not change the picture"),
    "expprogram": (AS_REAL, "read-only: the dial is on M"),
    **dict.fromkeys(
        ("5005", "5007", "500a", "5010", "5013", "d203", "d20d", "d21e", "d222", "d252", "d253", "d25a"),
        (AS_REAL, _RAW),
    ),
    **dict.fromkeys(("500e", "d213", "d215", "d218", "d235", "d24c"), (AS_REAL, f"{_RAW}; read-only")),
    **dict.fromkeys(_CONTROLS, (AS_REAL, "a control: it has no value to read")),
}


def look(port: str) -> dict[str, tuple[str, bool]]:
    """Name → result, and whether reading, setting and reading back agreed; run it in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "bench.vendor.widgets", port],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    return {name: (answer, works) for name, (answer, works) in json.loads(done.stdout.splitlines()[-1]).items()}


def _opened(gp: Any, port: str) -> Any:
    camera, ports, abilities = gp.Camera(), gp.PortInfoList(), gp.CameraAbilitiesList()
    ports.load()
    abilities.load()
    camera.set_port_info(ports[ports.lookup_path(port)])
    camera.set_abilities(abilities[abilities.lookup_model("PTP/IP Camera")])
    camera.init()
    return camera


def _leaves(widget: Any) -> list[Any]:
    if widget.get_type() not in _SECTIONS:
        return [widget]
    return [leaf for child in widget.get_children() for leaf in _leaves(child)]


def _other_value(widget: Any) -> Any:
    """A settable value that differs from the current one; None if there is none."""
    if widget.get_type() in (_RADIO, _MENU):
        others = [choice for choice in widget.get_choices() if choice != widget.get_value()]
        return others[0] if others else None
    if widget.get_type() == _RANGE:
        low, high, step = widget.get_range()
        return low + step if widget.get_value() == low else high
    return None


def _set(gp: Any, camera: Any, name: str, value: Any) -> str:
    try:
        widget = camera.get_single_config(name)
        widget.set_value(value)
        camera.set_single_config(name, widget)
    except gp.GPhoto2Error as error:
        return f"refused ({error.code})"
    time.sleep(CACHE_S)
    return str(camera.get_single_config(name).get_value())


# What must read back differently from what was set: toggles, steps, and the client's own bugs.
_EXPECTED = {"capturetarget": "refused", "manualfocus": "refused", "movie": "refused"}


def _look(gp: Any, camera: Any, widget: Any) -> tuple[str, bool]:
    name, value = widget.get_name(), widget.get_value()
    if widget.get_readonly():
        return f"{value}, read-only", True
    if name in _CONTROLS:
        return str(value), True
    if name in ("autofocus", "movie"):
        said = _set(gp, camera, name, 1)
        return f"set 1: {said}", said.startswith("refused") == (name == "movie")
    other = _other_value(widget)
    if other is None:
        return str(value), True
    said = _set(gp, camera, name, other)
    before = _set(gp, camera, name, value) if said == str(other) else "left"
    if name in _EXPECTED:
        return f"{value}, set {other}: {said}", said.startswith(_EXPECTED[name])
    return f"{value}, set {other}: {said}, set back: {before}", said == str(other) and before == str(value)


def _main(port: str) -> None:
    gp: Any = importlib.import_module("gphoto2")
    camera = _opened(gp, port)
    seen = {widget.get_name(): _look(gp, camera, widget) for widget in _leaves(camera.get_config())}
    camera.exit()
    print(json.dumps(seen))


if __name__ == "__main__":
    _main(sys.argv[1])
