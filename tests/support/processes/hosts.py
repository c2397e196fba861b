"""The processes of drivers in tests: forks of the zygote, which has imported the drivers."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from drivers.host import hosted_device
from drivers.host.hosted_device import HostedDevice
from tests.support.processes.forked import Forked


@pytest.fixture(scope="module", autouse=True)
def forked_hosts() -> Generator[None]:
    """Fork the process of each driver that this process opens. tests/robot/test_host.py starts them for real."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hosted_device, "Popen", Forked)
        yield


def driver_pid(device: object) -> int:
    """The process id of the driver behind this proxy, which is open."""
    hosted: HostedDevice = vars(device)["hosted_device"]
    assert hosted.pid is not None
    return hosted.pid
