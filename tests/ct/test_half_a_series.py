"""A CT series that ends too early, without a gap: spheres are missing, and the message says what it covers."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from service.core.errors import ComputeError
from service.store.store import Store
from service.worker.job import JobContext, RecordedContext
from service.worker.loop import HANDLERS

RADIUS_M, VOXEL_M, FIRST_SLICE_M = 6e-3, 1e-3, 20e-3
CENTRES = ((12.0, 12.0, 12.0), (44.0, 12.0, 12.0))  # voxels k, j, i


def volume(slices: int) -> np.ndarray[tuple[int, ...], np.dtype[np.int16]]:
    """Two spheres of 1000 HU in air, in the first `slices` of 56 slices."""
    at = np.moveaxis(np.indices((56, 24, 24)), 0, -1).astype(np.float64)
    inside = np.zeros(at.shape[:3])
    for centre in CENTRES:
        depth = RADIUS_M / VOXEL_M - np.linalg.norm(at - centre, axis=-1)
        inside = np.maximum(inside, np.clip(depth + 0.5, 0.0, 1.0))
    return (-1000 + 2000 * inside[:slices]).astype(np.int16)


def spheres_found(folder: Path, slices: int) -> float:
    T = np.diag([VOXEL_M, VOXEL_M, VOXEL_M, 1.0])
    T[2, 3] = FIRST_SLICE_M
    buffer = io.BytesIO()
    np.save(buffer, volume(slices))
    with Store.open(folder / "data") as store:
        kept = store.put_bytes(buffer.getvalue(), kind="ct_volume", media_type="application/x-npy", original_name="v")
        arguments = {
            "radius_m": RADIUS_M, "expected": len(CENTRES), "hounsfield": kept.sha256, "T_ct_voxel": T.tolist(),
            "threshold_hu": 0.0,
        }  # fmt: skip
        context: RecordedContext = JobContext(arguments, store, folder, lambda *_: None)
        return HANDLERS["ct_surface"](context).measures["spheres_found"]


def test_the_whole_series_has_both_spheres(tmp_path: Path) -> None:
    assert spheres_found(tmp_path, 56) == 2


def test_half_of_it_is_refused_with_what_it_covers(tmp_path: Path) -> None:
    with pytest.raises(ComputeError, match="found 1 spheres") as caught:
        spheres_found(tmp_path, 28)
    assert "The 28 slices cover 20.0 to 47.0 mm along their normal (0.00, 0.00, 1.00)" in caught.value.what
    assert "whole series" in caught.value.remedy
