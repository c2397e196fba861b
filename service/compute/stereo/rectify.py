"""Chooses which posed images are matched with which, and rectifies each pair at the surface that it sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, transform

BEST_DEG, WIDEST_DEG = 13.0, 60.0
_NARROWEST_DEG = 4.0
_FALLBACK_DEG = 25.0  # pairs wider than this are only used by views without closer ones
PARTNERS, FEW_PARTNERS = 3, 2  # of each view, of few and of many
MANY = 60


@dataclass(frozen=True, slots=True)
class StereoView:
    """A grey image (H, W) of a pinhole camera; T_world_camera in metres, x right, y down, z forward."""

    image: NDArray[np.uint8] = field(repr=False)
    camera: CameraModel
    T_world_camera: Transform

    @property
    def eye_m(self) -> Array:
        """(3,) centre of projection in the world."""
        return self.T_world_camera[:3, 3]


def looked_at_m(views: Sequence[StereoView]) -> Array:
    """Return (3,) the point nearest to all optical axes, in the least-squares sense.

    Raises:
        ComputeError: the axes are parallel, or meet behind a camera.
    """
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        axis = view.T_world_camera[:3, 2]
        across = np.eye(3) - np.outer(axis, axis)
        normal += across
        right += across @ view.eye_m
    if np.linalg.cond(normal) > 1e9:
        raise ComputeError("the cameras look in parallel", remedy="Use images that look at one object from around")
    point: Array = np.linalg.solve(normal, right).astype(np.float64)
    if any(float((point - view.eye_m) @ view.T_world_camera[:3, 2]) <= 0 for view in views):
        raise ComputeError("the cameras look at no common point", remedy="Use images that look at one object")
    return point


def stereo_pairs(views: Sequence[StereoView]) -> tuple[tuple[int, int], ...]:
    """Return the pairs of views by index, each with those whose angle at the object is nearest to BEST_DEG.

    A view without a partner up to _FALLBACK_DEG gets the nearest up to WIDEST_DEG.

    Raises:
        ComputeError: there is no pair.
    """
    centre = looked_at_m(views)
    rays = np.stack([view.eye_m - centre for view in views])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)))
    partners = FEW_PARTNERS if len(views) > MANY else PARTNERS
    chosen: set[tuple[int, int]] = set()
    for k, row in enumerate(angles):
        for close, wide in ((_NARROWEST_DEG, _FALLBACK_DEG), (_FALLBACK_DEG, WIDEST_DEG)):
            usable = np.flatnonzero((row >= close) & (row < wide))
            usable = usable[np.argsort(np.abs(row[usable] - BEST_DEG), kind="stable")][:partners]
            chosen |= {(min(k, int(other)), max(k, int(other))) for other in usable}
            if len(usable):
                break
    if not chosen:
        raise ComputeError(
            f"no two images look at the object at an angle between {_NARROWEST_DEG:g} and {WIDEST_DEG:g}°",
            remedy="Use more images",
        )
    return tuple(sorted(chosen))


# Rectification of a pair: rows along the baseline, and both principal points moved to the surface that is seen.
#
# It replaces `cv2.stereoRectify`, which keeps the principal points together and so gives absurd images for steep
# pairs.


_LARGEST = 1.5  # times the size of an image: what a tilted pair may be stretched to


@dataclass(frozen=True, slots=True)
class Rectified:
    """A pair whose rows correspond.

    Attributes:
        left, right: (H, W) grey images.
        seen: (H, W) pixels of the left image that the photograph has.
        T_world_left, T_world_right: poses of both cameras, whose x runs along the baseline.
        f_px: focal length of both.
        left_px, right_px: x of the principal points; y_px of both.
        baseline_m: distance between the cameras.
    """

    left: NDArray[np.uint8] = field(repr=False)
    right: NDArray[np.uint8] = field(repr=False)
    seen: NDArray[np.bool_] = field(repr=False)
    T_world_left: Transform
    T_world_right: Transform
    f_px: float
    left_px: float
    right_px: float
    y_px: float
    baseline_m: float

    @property
    def left_camera(self) -> CameraModel:
        """The pinhole camera of the left image."""
        height, width = self.left.shape
        return CameraModel(width, height, self.f_px, self.f_px, self.left_px, self.y_px)

    @property
    def right_camera(self) -> CameraModel:
        """The pinhole camera of the right image."""
        return replace(self.left_camera, cx=self.right_px)

    def disparity(self, depth_m: float) -> float:
        """Return the column in the left image minus that in the right one of a point at this depth, in pixels."""
        return self.f_px * self.baseline_m / depth_m + self.left_px - self.right_px

    def depth_m(self, disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the depth (H, W) of disparities (H, W); NaN where they are, and behind the camera."""
        true = disparity_px - np.float32(self.left_px - self.right_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(true > 0, np.float32(self.f_px * self.baseline_m) / true, np.nan).astype(np.float32)


def rectified(one: StereoView, two: StereoView, centre_m: Array) -> Rectified:
    """Rectify two views of an object at `centre_m` (3,), which comes to the middle of both images."""
    x = two.eye_m - one.eye_m
    baseline = float(np.linalg.norm(x))
    x = x / baseline
    z = one.T_world_camera[:3, 2] + two.T_world_camera[:3, 2]
    z = z - (z @ x) * x
    z = z / np.linalg.norm(z)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    f = 0.25 * (one.camera.fx + one.camera.fy + two.camera.fx + two.camera.fy)
    corners = [_corners(view, R, f) for view in (one, two)]
    centres = [_projected(centre_m - view.eye_m, R, f) for view in (one, two)]
    about = [c - m for c, m in zip(corners, centres, strict=True)]
    most = _LARGEST * max(one.camera.width, one.camera.height)
    low = np.maximum(np.maximum(about[0].min(axis=0), about[1].min(axis=0)), -most / 2)
    high = np.minimum(np.minimum(about[0].max(axis=0), about[1].max(axis=0)), most / 2)
    size = np.maximum(np.ceil(high - low), 1).astype(int)
    principal = [-(m + low) for m in centres]
    warped = [
        _warped(view, R, f, point, (int(size[0]), int(size[1])))
        for view, point in zip((one, two), principal, strict=True)
    ]
    return Rectified(
        left=warped[0][0],
        right=warped[1][0],
        seen=warped[0][1],
        T_world_left=transform(R, one.eye_m),
        T_world_right=transform(R, two.eye_m),
        f_px=f,
        left_px=float(principal[0][0]),
        right_px=float(principal[1][0]),
        y_px=float(principal[0][1]),
        baseline_m=baseline,
    )


def _projected(directions: Array, R: Array, f: float) -> Array:
    """Return the pixels (..., 2) of directions (..., 3) of the world, from the principal point."""
    p = directions @ R
    return f * p[..., :2] / p[..., 2:]


def _corners(view: StereoView, R: Array, f: float) -> Array:
    """Return (4, 2) corners of an image in the rectified one, from its principal point."""
    camera = view.camera
    w, h = camera.width - 0.5, camera.height - 0.5
    pixels = np.array([[-0.5, -0.5, 1.0], [w, -0.5, 1.0], [w, h, 1.0], [-0.5, h, 1.0]])
    return _projected(pixels @ np.linalg.inv(camera.matrix).T @ view.T_world_camera[:3, :3].T, R, f)


def _warped(
    view: StereoView, R: Array, f: float, principal: Array, size: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the image turned to the axes R, and where it has pixels."""
    K = np.array([[f, 0.0, principal[0]], [0.0, f, principal[1]], [0.0, 0.0, 1.0]])
    H = K @ R.T @ view.T_world_camera[:3, :3] @ np.linalg.inv(view.camera.matrix)
    image = cv2.warpPerspective(view.image, H, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    whole = np.full(view.image.shape, 255, dtype=np.uint8)
    seen = cv2.warpPerspective(whole, H, size, flags=cv2.INTER_NEAREST, borderValue=0) > 0
    return np.asarray(image, dtype=np.uint8), np.asarray(seen, dtype=np.bool_)
