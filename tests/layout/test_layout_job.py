"""The job `layout` on a photograph taken with a lens that is not calibrated yet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.computations.job import JobContext
from service.store.store import Store
from service.worker.loop import HANDLERS
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, camera, render


@pytest.mark.slow
@pytest.mark.parametrize(("k1", "width"), [(-0.07, 1920), pytest.param(-0.1, 1440, marks=pytest.mark.sweep)])
def test_a_large_photograph_by_a_lens_that_was_not_calibrated_shows_all_spheres(
    tmp_path: Path, k1: float, width: int
) -> None:
    """At full size the distortion bends outlines so much that the detector finds only seven of them."""
    lens = replace(camera(2880), k1=k1)
    spheres = np.concatenate([REGISTRATION_M, CONTROL_M])
    image = render(lens, spheres * [1, -1, -1] + [0, 0, 0.8], 1, oversample=1)
    ok, jpeg = cv2.imencode(".jpg", image)
    assert ok
    with Store.open(tmp_path / "data") as store:
        photograph = store.put_bytes(jpeg.tobytes(), kind="image", media_type="image/jpeg", original_name="a.jpg")
        arguments = {
            "images": [{"sha256": photograph.sha256, "focal_mm": 50.0}],
            "sensor_width_mm": 50.0 / 1.4,
            "radius_m": RADIUS_M,
            "control": len(CONTROL_M),
            "expected": len(spheres),
        }
        answer = HANDLERS["layout"](JobContext(arguments, store, tmp_path, lambda _what, _done, _all: None))
        overlay = cv2.imread(str(store.artefact_path(answer.artefacts[0].sha256)))
    assert answer.measures["spheres_seen"] == len(spheres)
    assert answer.measures["photographs_used"] == 1
    assert overlay is not None
    assert overlay.shape == (width * 2 // 3, width, 3)
