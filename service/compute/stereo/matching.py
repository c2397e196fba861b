"""Chooses which posed images are matched, rectifies each pair, and finds and refines its disparities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh
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


Image = NDArray[np.uint8]
Disparity = NDArray[np.float32]

_BLOCK = 5
_NEAR, _FAR = 0.6, 1.5  # of the distance of the object: depths that are tried at first
_COARSE = 4  # times smaller images, in which the range of depths is found
_SPAN = (0.5, 99.5)  # percentiles of the coarse disparities
_AGREE_PX = 1.0  # of both directions
_JUMP_PX = 2.0  # between neighbours: an edge, where the block lies on two surfaces
_SPECKLE_PX, _SPECKLE_STEP_PX = 150, 1.5
_FEWEST_COARSE_PIXELS = 200  # coarse pixels that agree; a pair with fewer does not show the same


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Depth (H, W) along z of a pinhole camera, NaN where unknown, with the weight of what it says."""

    depth_m: Disparity = field(repr=False)
    camera: CameraModel
    T_world_camera: Transform
    weight: float

    def points_m(self, step: int) -> Array:
        """Return (N, 3) every `step`-th known pixel's point in the world."""
        v, u = (k.ravel() for k in np.mgrid[: self.depth_m.shape[0] : step, : self.depth_m.shape[1] : step])
        z = self.depth_m[v, u].astype(np.float64)
        known = np.isfinite(z)
        u, v, z = u[known], v[known], z[known]
        of = self.camera
        camera = np.stack([(u - of.cx) / of.fx * z, (v - of.cy) / of.fy * z, z], axis=1)
        return camera @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def depth_of_pair(pair: Rectified, distance_m: float) -> DepthMap | None:
    """Return the depth of a pair's left image of an object at this distance; None if too little agrees.

    The range of disparities is found in small images first. The weight of a depth is the square of the change of
    disparity (px) per metre of depth at the object: the inverse variance, up to the variance of the matching.
    """
    first = pair.disparity(_FAR * distance_m) / _COARSE
    last = pair.disparity(_NEAR * distance_m) / _COARSE
    coarse = _agreed(_reduced(pair.left), _reduced(pair.right), first, last, 3)
    known = coarse[np.isfinite(coarse)]
    if len(known) < _FEWEST_COARSE_PIXELS:
        return None
    low, high = (float(x) for x in np.percentile(known, _SPAN))
    margin = 1.5 + 0.08 * (high - low)
    low, high = max(first, low - margin), min(last, high + margin)
    found = refined(pair.left, pair.right, _agreed(pair.left, pair.right, _COARSE * low, _COARSE * high, _BLOCK))
    found[~pair.seen] = np.nan
    return depth_map(pair, found, distance_m)


def depth_map(pair: Rectified, disparity_px: Disparity, distance_m: float) -> DepthMap:
    """Return the depth map of a pair's left image from its disparities (H, W); `distance_m` is that of the object."""
    depth = pair.depth_m(_without_edges(disparity_px))
    slope = pair.f_px * pair.baseline_m / distance_m**2
    return DepthMap(depth, pair.left_camera, pair.T_world_left, slope**2)


def _reduced(image: Image) -> Image:
    small = cv2.resize(image, None, fx=1 / _COARSE, fy=1 / _COARSE, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _agreed(left: Image, right: Image, first_px: float, last_px: float, block: int) -> Disparity:
    """Return the disparities (H, W) of the left image that the right one confirms; NaN elsewhere."""
    lowest = int(np.floor(first_px))
    count = 16 * max(1, int(np.ceil((last_px - lowest + 1) / 16)))
    matcher = matcher_of(lowest, count, block)
    # Columns without a partner within the range are not matched: a border on both sides keeps them.
    border = max(0, lowest + count, -lowest)
    a, b = (np.pad(image, ((0, 0), (border, border)), mode="edge") for image in (left, right))
    forth = matched(matcher, a, b, lowest)
    back = matched(matcher, np.ascontiguousarray(b[:, ::-1]), np.ascontiguousarray(a[:, ::-1]), lowest)[:, ::-1]
    found = confirmed(forth, back)
    return np.ascontiguousarray(found[:, border : border + left.shape[1]])


def matcher_of(lowest_px: int, count: int, block: int) -> cv2.StereoSGBM:
    """Return the search over so many disparities from the lowest one."""
    return cv2.StereoSGBM.create(
        minDisparity=lowest_px,
        numDisparities=count,
        blockSize=block,
        P1=8 * block**2,
        P2=40 * block**2,
        uniquenessRatio=3,
        preFilterCap=31,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )


def confirmed(forth: Disparity, back: Disparity) -> Disparity:
    """Return the disparities (H, W) of the left image with which those of the right one agree; NaN elsewhere."""
    columns = np.arange(forth.shape[1], dtype=np.float32)[None, :] - forth
    rows = np.broadcast_to(np.arange(forth.shape[0], dtype=np.float32)[:, None], forth.shape)
    there = cv2.remap(
        np.ascontiguousarray(back),
        np.nan_to_num(columns, nan=-1.0),
        np.ascontiguousarray(rows),
        cv2.INTER_NEAREST,
        borderValue=float("nan"),
    )
    return np.where(np.abs(forth - there) <= _AGREE_PX, forth, np.float32(np.nan)).astype(np.float32)


def matched(matcher: cv2.StereoSGBM, left: Image, right: Image, lowest: int) -> Disparity:
    """Return the disparities (H, W) of the left image, NaN where none was found or only a speckle."""
    sixteenths = matcher.compute(left, right)
    none = 16 * (lowest - 1)
    cv2.filterSpeckles(sixteenths, none, _SPECKLE_PX, int(16 * _SPECKLE_STEP_PX))
    out = sixteenths.astype(np.float32) / np.float32(16)
    out[sixteenths <= none] = np.nan
    return out


def _without_edges(disparity: Disparity) -> Disparity:
    """Drop pixels at jumps of disparity, where a block covers two surfaces."""
    filled = np.nan_to_num(disparity, nan=-1e6)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(filled, kernel), cv2.dilate(filled, kernel)
    # A pixel beside one without disparity is an edge too: both have a large difference.
    out = disparity.copy()
    out[high - low > _JUMP_PX] = np.nan
    return out


SPAN_PX = 16  # of disparity, to both sides of the guess
_STEP = 2  # pixels between the rays of the guess
_GUESS_JUMP_PX = 3.0  # between neighbouring rays: an edge of the guess, across which nothing is interpolated
_FEWEST_PIXELS = 2000  # pixels that agree; a pair with fewer does not show the same


def guided_depth(pair: Rectified, guess: RayMesh, distance_m: float) -> DepthMap | None:
    """Return the depth of the left image of a pair, searched around a guessed surface; None if too little agrees.

    One image is drawn as the other camera would see it if the guess were true, and then matched with the other.
    """
    left, right = pair.left_camera, pair.right_camera
    forward = _disparity_of(guess, left, pair.T_world_left, pair)
    backward = _disparity_of(guess, right, pair.T_world_right, pair)
    forth = _searched(pair.left, pair.right, forward)
    mirrored = _searched(_flipped(pair.right), _flipped(pair.left), np.ascontiguousarray(backward[:, ::-1]))
    back = np.ascontiguousarray(mirrored[:, ::-1])
    found = refined(pair.left, pair.right, confirmed(forth, back))
    found[~pair.seen] = np.nan
    if np.count_nonzero(np.isfinite(found)) < _FEWEST_PIXELS:
        return None
    return depth_map(pair, found, distance_m)


def _flipped(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(image[:, ::-1])


def _disparity_of(guess: RayMesh, camera: CameraModel, T_world_camera: Transform, pair: Rectified) -> Disparity:
    """Return the disparities (H, W) that the guess would have in one of the two cameras; NaN where it is not met."""
    depth = _depth_of(guess, camera, T_world_camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        sparse = (pair.f_px * pair.baseline_m / depth + pair.left_px - pair.right_px).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    filled = np.nan_to_num(sparse, nan=-1e6, posinf=-1e6)
    jump = cv2.dilate(filled, kernel) - cv2.erode(filled, kernel) > _GUESS_JUMP_PX * _STEP
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32) / np.float32(_STEP)
    smooth = cv2.remap(sparse, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    nearest = cv2.remap(sparse, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    at_edge = cv2.remap(jump.astype(np.uint8), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) > 0
    return np.where(at_edge, nearest, smooth).astype(np.float32)


def _depth_of(guess: RayMesh, camera: CameraModel, T_world_camera: Transform) -> NDArray[np.float64]:
    """Return the depth along z of every _STEP-th pixel; NaN where no surface is met."""
    v, u = np.mgrid[: camera.height : _STEP, : camera.width : _STEP]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return guess.depths(T_world_camera, rays.reshape(-1, 3)).reshape(u.shape)


def _searched(one: NDArray[np.uint8], two: NDArray[np.uint8], guess: Disparity) -> Disparity:
    """Return the disparities (H, W) of image `one` within SPAN_PX of the guess in its pixels; NaN elsewhere."""
    height, width = one.shape
    border = 2 * SPAN_PX
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    known = np.isfinite(guess)
    level = cv2.remap(
        two, np.where(known, columns - guess, -1), rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    a, b = (np.pad(image, ((0, 0), (border, border)), mode="edge") for image in (one, np.asarray(level, np.uint8)))
    rest = matched(matcher_of(-SPAN_PX, 2 * SPAN_PX, _BLOCK), a, b, -SPAN_PX)[:, border : border + width]
    # The partner stands at the column less the rest, and was drawn there with the guess of that column.
    there = cv2.remap(
        guess, np.nan_to_num(columns - rest, nan=-10.0), rows, cv2.INTER_LINEAR, borderValue=float("nan")
    )
    found = rest + there
    found[~known] = np.nan
    return np.asarray(found, dtype=np.float32)


# Disparities to a small part of a pixel, by least squares between the images along the rows.
#
# Semi-global matching prefers whole pixels. Source of the method: Lucas and Kanade, "An iterative image
# registration technique", IJCAI 1981, in one dimension; grey values may differ by an offset within the window.


_WINDOW = 7
_ROUNDS = 4
_FARTHEST_PX = 1.0  # from the start: beyond it another minimum was found
_LEAST_CONTRAST = 4.0  # grey values² of the gradient's variance: less is noise
_FEWEST_KNOWN = 0.5  # share of the window that must be known


def refined(left: Image, right: Image, disparity: Disparity) -> Disparity:
    """Return the disparities (H, W) of the left image, refined; as they were where the images say too little.

    NaN stays NaN, and becomes of what moves by more than _FARTHEST_PX.
    """
    known = np.isfinite(disparity)
    weight = known.astype(np.float32)
    share = np.maximum(_mean(weight), np.float32(1e-6))
    one, two = (image.astype(np.float32) for image in (left, right))
    gradient = np.asarray(cv2.Sobel(two, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8), dtype=np.float32)
    columns, rows = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in left.shape[::-1]))
    found = np.where(known, disparity, np.float32(0)).astype(np.float32)
    start = found.copy()
    for _ in range(_ROUNDS):
        partner = columns - found
        there, slope = (
            np.asarray(cv2.remap(image, partner, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32)
            for image in (two, gradient)
        )
        rest = one - there
        mean_rest, mean_slope = (
            _mean(np.asarray(weight * value, dtype=np.float32)) / share for value in (rest, slope)
        )
        variance = _mean(weight * slope**2) / share - mean_slope**2
        together = _mean(weight * slope * rest) / share - mean_slope * mean_rest
        usable = known & (variance > _LEAST_CONTRAST) & (share > _FEWEST_KNOWN)
        # right(x - d - s) ≈ there - slope * s
        step = np.where(usable, -together / np.maximum(variance, np.float32(1e-6)), 0.0)
        found += np.clip(step, -0.5, 0.5).astype(np.float32)
    found[~known | (np.abs(found - start) > _FARTHEST_PX)] = np.nan
    return found


def _mean(image: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the mean over the window around each pixel."""
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (_WINDOW, _WINDOW)), dtype=np.float32)
