"""The buffer of an arm's samples keeps up after a pause of the process."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
import pytest

from drivers.arm.stream import PoseStream
from drivers.errors import DeviceUnavailableError
from drivers.interfaces import RobotSample, SafetyState


def sample(at_s: float) -> RobotSample:
    zeros = np.zeros(7)
    return RobotSample(at_s, at_s, zeros, zeros, zeros, np.eye(4), 0.0, SafetyState.NORMAL)


def test_all_that_arrived_meanwhile_is_taken_at_once_and_in_order() -> None:
    arrived = deque([sample(0.01 * i) for i in range(20_000)])
    stream = PoseStream(
        lambda: arrived.popleft() if arrived else None, stale_after_s=1.0, where="a test", vendor_errors=()
    )
    try:
        stream.catch_up()
        taken = stream.between(0.0, 200.0)
    finally:
        stream.close()
    assert [s.monotonic_s for s in taken] == [0.01 * i for i in range(20_000)]


def test_a_stream_that_has_ended_brings_nothing_however_young_its_last_sample() -> None:
    arrived = deque([sample(time.monotonic())])

    def read() -> RobotSample:
        if not arrived:
            raise ConnectionError("the controller hung up")
        return arrived.popleft()

    stream = PoseStream(read, stale_after_s=600.0, where="a test", vendor_errors=(ConnectionError,))
    try:
        stream.catch_up()
        assert stream.newest() is None
        with pytest.raises(DeviceUnavailableError, match="the controller hung up"):
            stream.latest()
    finally:
        stream.close()
