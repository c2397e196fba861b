"""SIFT features of a grey image, by COLMAP."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pycolmap
from numpy.typing import NDArray

from service.core.geometry import Array

_LARGE_SHARE = 0.125  # of the features that are kept if there are too many


@dataclass(frozen=True, slots=True, eq=False)
class SiftFeatures:
    """SIFT features of one image.

    Attributes:
        points: (n, 2) in COLMAP's image coordinates, first pixel's centre at 0.5.
        scales_px: (n,).
        orientations_rad: (n,).
        descriptors: (n, 128) uint8, with L1-root normalisation.
    """

    points: Array = field(repr=False)
    scales_px: Array = field(repr=False)
    orientations_rad: Array = field(repr=False)
    descriptors: NDArray[np.uint8] = field(repr=False)


def extract_sift(grey: NDArray[np.uint8], max_features: int, first_octave: int) -> SiftFeatures:
    """Extract the features of an image (H, W), on the CPU and with one thread.

    COLMAP leaves out the smallest scales first. Of what it finds beyond the limit, the smallest are placed most
    exactly: cameras are twice as accurate with them as with as many large ones (bench/registration/accuracy.py). An
    eighth are the largest, because images from other distances show what is small here at another scale.

    Args:
        grey: the image.
        max_features: at most so many.
        first_octave: -1 doubles the image first, 0 does not.
    """
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    extraction.use_gpu = False
    extraction.sift.max_num_features = max_features
    extraction.sift.first_octave = first_octave
    extractor = pycolmap.FeatureExtractor.create(extraction, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
    # Columns x, y, scale, orientation; COLMAP keeps whole levels of scale: up to twice as many as requested.
    found = np.asarray(pycolmap.keypoints_to_matrix(keypoints), dtype=np.float64).reshape(-1, 4)
    kept = np.argsort(found[:, 2], kind="stable")
    if len(kept) > max_features:
        large = int(_LARGE_SHARE * max_features)
        kept = np.concatenate([kept[: max_features - large], kept[len(kept) - large :]])
    kept = np.sort(kept)
    return SiftFeatures(
        found[kept, :2],
        found[kept, 2],
        found[kept, 3],
        np.asarray(descriptors.data, dtype=np.uint8).reshape(-1, 128)[kept],
    )
