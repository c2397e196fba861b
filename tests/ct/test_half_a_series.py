"""A CT series that ends too early, without a gap: spheres are missing, or its last slice cuts the specimen."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from service.computations.job import JobContext, RecordedContext
from service.core.errors import ComputeError
from service.store.store import Store
from service.worker.loop import HANDLERS

Volume = np.ndarray[tuple[int, ...], np.dtype[np.int16]]
RADIUS_M, VOXEL_M, FIRST_SLICE_M = 6e-3, 1e-3, 20e-3
CENTRES = ((12.0, 12.0, 12.0), (44.0, 12.0, 12.0))  # voxels k, j, i


def volume(slices: int) -> Volume:
    """Two spheres of 1000 HU in air, in the first `slices` of 56 slices."""
    at = np.moveaxis(np.indices((56, 24, 24)), 0, -1).astype(np.float64)
    inside = np.zeros(at.shape[:3])
    for centre in CENTRES:
        depth = RADIUS_M / VOXEL_M - np.linalg.norm(at - centre, axis=-1)
        inside = np.maximum(inside, np.clip(depth + 0.5, 0.0, 1.0))
    return (-1000 + 2000 * inside[:slices]).astype(np.int16)


def computed(folder: Path, hounsfield: Volume, spheres: int, **further: object) -> Mapping[str, float]:
    """The measures of the job on a volume."""
    T = np.diag([VOXEL_M, VOXEL_M, VOXEL_M, 1.0])
    T[2, 3] = FIRST_SLICE_M
    buffer = io.BytesIO()
    np.save(buffer, hounsfield)
    with Store.open(folder / "data") as store:
        kept = store.put_bytes(buffer.getvalue(), kind="ct_volume", media_type="application/x-npy", original_name="v")
        arguments = {
            "radius_m": RADIUS_M, "expected": spheres, "hounsfield": kept.sha256, "T_ct_voxel": T.tolist(),
            "threshold_hu": 0.0, **further,
        }  # fmt: skip
        context: RecordedContext = JobContext(arguments, store, folder, lambda *_: None)
        return HANDLERS["ct_surface"](context).measures


def spheres_found(folder: Path, slices: int) -> float:
    return computed(folder, volume(slices), len(CENTRES))["spheres_found"]


def test_the_whole_series_has_both_spheres(tmp_path: Path) -> None:
    assert spheres_found(tmp_path, 56) == 2


def test_half_of_it_is_refused_with_what_it_covers(tmp_path: Path) -> None:
    with pytest.raises(ComputeError, match="found 1 spheres") as caught:
        spheres_found(tmp_path, 28)
    assert "The 28 slices cover 20.0 to 47.0 mm along their normal (0.00, 0.00, 1.00)" in caught.value.what
    assert "whole series" in caught.value.remedy


# Four spheres around a specimen of 8 × 10 voxels, which is longer than they reach; below them the scanner's table.
AROUND = ((10, 10, 10), (26, 10, 46), (12, 34, 10), (24, 34, 46))  # voxels k, j, i


def on_a_table(slices: int) -> Volume:
    at = np.moveaxis(np.indices((56, 56, 56)), 0, -1).astype(np.float64)
    inside = np.zeros(at.shape[:3])
    for centre in AROUND:
        depth = RADIUS_M / VOXEL_M - np.linalg.norm(at - centre, axis=-1)
        inside = np.maximum(inside, np.clip(depth + 0.5, 0.0, 1.0))
    inside[4:50, 16:24, 22:32] = 1.0
    inside[:, 50:53] = 1.0
    return (-1000 + 2000 * inside[:slices]).astype(np.int16)


@pytest.mark.parametrize(("slices", "cut_mm2"), [(56, 0), (40, 80)])
def test_a_specimen_that_goes_on_beyond_the_last_slice_is_measured(
    tmp_path: Path, slices: int, cut_mm2: float
) -> None:
    measures = computed(tmp_path, on_a_table(slices), len(AROUND), measure_cut=True)
    assert measures["spheres_found"] == len(AROUND)
    assert measures["cut_by_ends_mm2"] == pytest.approx(cut_mm2)


def test_a_job_of_an_earlier_version_gives_what_it_gave(tmp_path: Path) -> None:
    assert "cut_by_ends_mm2" not in computed(tmp_path, on_a_table(56), len(AROUND))
