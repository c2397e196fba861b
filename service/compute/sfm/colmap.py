"""Converts between our conventions and COLMAP's, half a pixel and the direction of poses, and extracts its SIFT."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pycolmap
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import DataError
from service.core.geometry import Array, Transform, inverse, transform

HALF_PIXEL = 0.5  # COLMAP's first pixel spans 0..1 with its centre at 0.5; ours is centred at 0


def to_colmap_camera(camera: CameraModel) -> pycolmap.Camera:
    """Return COLMAP's camera for our calibrated one: OPENCV, or FULL_OPENCV if it has more than k1, k2, p1, p2."""
    more = [camera.k3, camera.k4, camera.k5, camera.k6]
    return pycolmap.Camera(
        camera_id=1,
        model="FULL_OPENCV" if any(more) else "OPENCV",
        width=camera.width,
        height=camera.height,
        params=[
            camera.fx,
            camera.fy,
            camera.cx + HALF_PIXEL,
            camera.cy + HALF_PIXEL,
            camera.k1,
            camera.k2,
            camera.p1,
            camera.p2,
            *(more if any(more) else []),
        ],
    )


def from_colmap_camera(camera: pycolmap.Camera) -> CameraModel:
    """Convert a COLMAP camera into ours.

    Raises:
        DataError: its model has distortion terms that ours does not have.
    """
    p = [float(v) for v in camera.params]
    size = (int(camera.width), int(camera.height))
    name = camera.model_name
    more: list[float] = []
    if name in {"OPENCV", "FULL_OPENCV"}:
        fx, fy, cx, cy, k1, k2, p1, p2, *more = p
    elif name == "PINHOLE":
        (fx, fy, cx, cy), (k1, k2, p1, p2) = p, (0.0,) * 4
    elif name in {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"}:
        f, cx, cy, *radial = p
        fx = fy = f
        k1, k2, p1, p2 = (*radial, 0.0, 0.0, 0.0, 0.0)[:4]
    else:
        raise DataError(
            f"camera model {name} is not supported",
            where=f"camera {camera.camera_id}",
            remedy="Export the model with an OPENCV, FULL_OPENCV, RADIAL, SIMPLE_RADIAL or PINHOLE camera",
        )
    return CameraModel(*size, fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL, k1, k2, p1, p2, *more)


def to_colmap_pose(T_world_camera: Transform) -> pycolmap.Rigid3d:
    """Return COLMAP's cam_from_world for our T_world_camera (4, 4)."""
    T_camera_world = inverse(T_world_camera)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(T_camera_world[:3, :3]), T_camera_world[:3, 3])


def from_colmap_pose(cam_from_world: pycolmap.Rigid3d) -> Transform:
    """Return T_world_camera (4, 4) from COLMAP's cam_from_world."""
    rotation = np.asarray(cam_from_world.rotation.matrix(), dtype=np.float64)
    return inverse(transform(rotation, np.asarray(cam_from_world.translation, dtype=np.float64)))


def from_colmap_pixels(points: Array) -> Array:
    """Return our pixels (N, 2) from COLMAP's image coordinates (N, 2)."""
    return points - HALF_PIXEL


def to_colmap_pixels(pixels: Array) -> Array:
    """Return COLMAP's image coordinates (N, 2) from our pixels (N, 2)."""
    return pixels + HALF_PIXEL


_LARGE_SHARE = 0.125  # of the features that are selected if there are too many


@dataclass(frozen=True, slots=True, eq=False)
class SiftFeatures:
    """SIFT features of one image.

    Attributes:
        points: (n, 2) places in COLMAP's image coordinates, first pixel's centre at 0.5.
        scales_px: (n,) scales.
        orientations_rad: (n,) orientations.
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
        max_features: largest number of features.
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
