"""The run page's drawing of planned board images: from the files before the step, as recorded afterwards."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from service.web.calibration_boards import board_plan_svg


def test_the_drawing_shows_corners_over_the_image_and_the_cameras_places() -> None:
    counts = [[r * 12 + c for c in range(12)] for r in range(8)]
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 0.1, 0.2]
    svg = board_plan_svg("90 board poses; coverage < 100 %", counts, poses, np.array([-1.0, 0.0, 0.0]))
    root = ET.fromstring(svg)
    words = [element.text for element in root.iter() if element.text]
    assert {"90 board poses", "coverage < 100 %"} <= set(words)
    assert "95" in words
    assert "–" in words, "an empty cell says so"
    assert sum(element.tag.endswith("circle") for element in root.iter()) == 3
    empty = ET.fromstring(board_plan_svg("none", counts, np.zeros((0, 4, 4)), np.array([-1.0, 0.0, 0.0])))
    assert not any(element.tag.endswith("circle") for element in empty.iter())
