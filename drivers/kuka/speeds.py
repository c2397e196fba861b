"""Samples with speeds, from the joints and poses of a stream that has none."""

from __future__ import annotations

from collections import deque

import numpy as np

from drivers.interfaces import RobotSample
from drivers.kuka.wire import State
from service.core.geometry import inverse

SPEED_WINDOW_S = 0.05  # over one period the encoders' steps would dominate


class Speeds:
    """The recent states of one stream, from whose differences the speeds are computed."""

    def __init__(self) -> None:
        self._recent: deque[State] = deque()  # over SPEED_WINDOW_S

    def sample(self, state: State, now_s: float) -> RobotSample:
        """The sample of a state that arrived at this host time.monotonic()."""
        recent = self._recent
        recent.append(state)
        while len(recent) > 2 and recent[1].time_s < state.time_s - SPEED_WINDOW_S:
            recent.popleft()
        old, before, new = recent[0], recent[max(len(recent) - 2, 0)], recent[-1]
        window_s, period_s = max(new.time_s - old.time_s, 1e-6), max(new.time_s - before.time_s, 1e-6)
        apart = inverse(old.T_base_flange) @ new.T_base_flange
        return RobotSample(
            controller_time_s=new.time_s,
            monotonic_s=now_s,
            joints_rad=new.joints_rad,
            joint_velocities_rad_s=(new.joints_rad - old.joints_rad) / window_s,
            target_velocities_rad_s=(new.commanded_rad - before.commanded_rad) / period_s,
            T_base_flange=new.T_base_flange,
            tcp_speed_m_s=float(np.linalg.norm(apart[:3, 3])) / window_s,
            safety=new.safety,
        )
