"""KUKA LBR iiwa and LBR Med arms over our own Sunrise application: configuration and entry point."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from drivers.interfaces import Abandoned
from drivers.plugin import DriverConfig, DriverSpec

if TYPE_CHECKING:
    from drivers.interfaces import Device


HEARTBEAT_S = 0.3  # without one, the Sunrise application stops the arm (sunrise/engine, Engine.java)


class KukaConfig(DriverConfig):
    """A robot's section in rig.yaml."""

    host: str = Field(description="address of the controller (Sunrise Cabinet)")
    port: int = Field(default=30010, ge=1, le=65535, description="port of the Sunrise application")
    connect_timeout_s: float = Field(
        default=5.0, gt=0, description="longest wait for the connection and the greeting"
    )
    answer_timeout_s: float = Field(default=3.0, gt=0, description="longest wait for the answer to a request")
    stale_after_s: float = Field(
        default=1.0, gt=0, description="age of the newest sample above which the link counts as dead"
    )
    unattended_s: float = Field(
        default=5.0,
        gt=0,
        description="time after which a moving arm is stopped whose program is alive but does not query it",
    )
    rest_within_s: float = Field(
        default=0.55,
        gt=0,
        description="longest time until the arm stands after the program that drives it died: a protocol that moves "
        "faster than the arm brakes in it is refused",
    )
    fri_port: int | None = Field(
        default=None,
        ge=1,
        le=65535,
        description="UDP port of this machine at which to listen to the controller's FRI, usually 30200; without "
        "FRI, poses come from the application alone",
    )
    fri_host: str = Field(
        default="",
        description="address of this machine in the network of FRI, if that is not the application's (KONI)",
    )
    fri_period_ms: int = Field(default=10, ge=1, le=100, description="milliseconds between two messages of FRI")

    @property
    def abandoned(self) -> Abandoned:
        """The application ends the motion."""
        return Abandoned(HEARTBEAT_S, self.rest_within_s)


def _build(config: KukaConfig) -> Device:
    from drivers.kuka.robot import KukaRobot  # noqa: PLC0415 - only the child process needs it

    return KukaRobot(config)


# Hosted although there is no native library: the heartbeat of the program reaches only a driver's own process.
DRIVER = DriverSpec(kind="robot", config=KukaConfig, build=_build, hosted=True, call_timeout_s=30.0)
