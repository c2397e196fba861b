"""The camera driver in its hosted child process, with a simulated camera for it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

from drivers.gphoto import DRIVER, GphotoConfig
from drivers.host.hosted_device import hosted
from drivers.interfaces import Camera, CameraSettings
from tests.support.rig.camera_simulator import RunningCamera, camera_simulator

PAPER = CameraSettings(aperture_f=22.0, exposure_s=1 / 15, iso=100, focus_mode="Manual", image_quality="JPEG")


def driver(port: str, **config: Any) -> Camera:
    return hosted(
        Camera,
        "drivers.gphoto:DRIVER",
        GphotoConfig(port=port, **config),
        call_timeout_s=DRIVER.call_timeout_s,
        name="camera",
    )


@contextmanager
def gphoto_rig(
    name: str, faults: list[dict[str, Any]] | None = None, *options: str, **config: Any
) -> Generator[tuple[Camera, RunningCamera]]:
    """Start the simulator of this name, and open the driver on it."""
    with camera_simulator(faults or [], *options, name=name) as simulator:
        camera = driver(simulator.gphoto_port, **config)
        try:
            camera.open()
            yield camera, simulator
        finally:
            camera.close()
