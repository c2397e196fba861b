"""Which of the protocol's viewpoints the bench of reconstruction takes."""

from __future__ import annotations

import numpy as np

from bench.reconstruction.viewpoints import protocol_shots
from bench.scenes import Shot
from simulators.scene.world import SCENE_CENTRE_M, Scene

SCENE = Scene.generate(3)
ALL = protocol_shots(SCENE, 108)


def lowest_deg(shots: list[Shot], azimuth_deg: float) -> float:
    """Least angle between a horizontal normal of this azimuth and the views."""
    eyes = np.array([SCENE.true_camera(shot.q, shot.station)[:3, 3] - SCENE_CENTRE_M for shot in shots])
    eyes /= np.linalg.norm(eyes, axis=1, keepdims=True)
    azimuth = np.radians(azimuth_deg)
    return float(np.degrees(np.arccos((eyes @ np.array([np.cos(azimuth), np.sin(azimuth), 0.0])).max())))


def test_all_viewpoints_of_the_protocol_are_there() -> None:
    assert len(ALL) == len({shot.name for shot in ALL}) == 108
    assert sorted(shot.station for shot in ALL) == ["station_1"] * 54 + ["station_2"] * 54


def test_fewer_viewpoints_see_steep_surfaces_as_well_as_all() -> None:
    few = protocol_shots(SCENE, 36)
    assert len(few) == 36
    assert {shot.name for shot in few} < {shot.name for shot in ALL}
    assert {shot.station for shot in few} == {"station_1", "station_2"}
    for azimuth in range(0, 360, 15):
        assert lowest_deg(few, azimuth) < lowest_deg(ALL, azimuth) + 5
    every_third = ALL[::3]
    assert np.mean([lowest_deg(few, a) for a in range(0, 360, 15)]) <= np.mean(
        [lowest_deg(every_third, a) for a in range(0, 360, 15)]
    )
