"""Universal Robots arms over ur_rtde: configuration and entry point. Only the child process loads the library."""

from __future__ import annotations

import importlib
import platform
from typing import TYPE_CHECKING, cast

from pydantic import Field

from drivers.errors import DriverMissingError
from drivers.interfaces import Abandoned
from drivers.plugin import DriverConfig, DriverSpec

if TYPE_CHECKING:
    from drivers.interfaces import Device


class UrConfig(DriverConfig):
    """A robot's section in rig.yaml."""

    host: str = Field(description="address of the controller; its ports are fixed: 30004, 29999, 30003")
    connect_timeout_s: float = Field(
        default=5.0, gt=0, description="timeout for each port to answer before connecting"
    )
    stale_after_s: float = Field(
        default=1.0, gt=0, description="age of the newest sample above which the link counts as dead"
    )
    upper_registers: bool = Field(
        default=False,
        description="use the controller's registers 24 to 47, where a fieldbus (EtherNet/IP, PROFINET) or another "
        "program uses those below",
    )
    stop_deceleration_rad_s2: float = Field(default=2.0, gt=0)  # with which a motion is stopped
    watchdog_s: float = Field(
        default=0.2,
        ge=0.1,
        le=1.0,
        description="time without a heartbeat of the program that drives the arm after which the controller stops it",
    )
    rest_within_s: float = Field(
        default=0.45,
        gt=0,
        description="longest time until the arm stands after that program died: a protocol that moves faster than "
        "the arm brakes in it is refused",
    )
    unattended_s: float = Field(
        default=5.0,
        gt=0,
        description="the same for a program that is alive but does not query the moving arm (it may store an image)",
    )

    @property
    def abandoned(self) -> Abandoned:
        """The watchdog ends the motion."""
        return Abandoned(self.watchdog_s, self.rest_within_s)


_LIBRARY = ("rtde_control", "rtde_receive")


def _build(config: UrConfig) -> Device:
    try:
        module = importlib.import_module("drivers.ur.robot")
    except ModuleNotFoundError as error:
        if error.name not in _LIBRARY:
            raise
        raise DriverMissingError(
            f"ur-rtde, the library for arms of Universal Robots, is not installed; it has no ready-made package for "
            f"Python {platform.python_version()} on {platform.system()} {platform.machine()}",
            where=config.host,
            remedy="Use Python 3.12 or 3.11 on Linux x86_64, or build the library as docs/howto/installation.md says",
        ) from error
    return cast("Device", module.UrRobot(config))


DRIVER = DriverSpec(kind="robot", config=UrConfig, build=_build, hosted=True, call_timeout_s=30.0)
