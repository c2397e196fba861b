"""Detects spheres as the paper does: boxes, masks of the colour channels, an ellipse, Canny points, RANSAC."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image_of
from service.compute.markers.cones import Cone, angles_to, ransac_cone
from service.compute.markers.records import (
    DEFAULTS,
    DetectionOptions,
    OutlineEvidence,
    SphereOutline,
    outline_from_cone,
)
from service.compute.markers.rough import find_candidates
from service.core.errors import DataError
from service.core.geometry import Array
from service.core.text_files import file_text, parse_json

Box = tuple[float, float, float, float]  # left, top, right, bottom, pixels

MARGIN = 0.35  # of a circle's radius, added around its box
MASK_SIDE = 96  # pixels to which a box is reduced for its mask and the ellipse
MOST_LOSS = 0.3  # false pixels of the best ellipse over the mask's area
_LEAST_STEP = 10.0  # grey levels between sphere and surroundings for a channel to be used
_ENVELOPE = 0.08  # of the semi-axis, on both sides of the ellipse
_SLOTS = 96  # azimuth bins for the outline's coverage
_MOST_BOXES = 24
_LEAST_BOX_PX = 8
# Canny points lie on pixel centres and share errors along the outline; about this many are independent.
_INDEPENDENT = 20
_LEAST_SIGMA_PX = 0.15


@dataclass(frozen=True, slots=True)
class EllipseEstimate:
    """An ellipse in pixels of the image; `loss` is its false positives and negatives over the mask's area."""

    x: float
    y: float
    a: float
    b: float
    theta_rad: float
    loss: float


def detect_by_masks(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    options: DetectionOptions = DEFAULTS,
    boxes: Sequence[Box] | None = None,
) -> tuple[SphereOutline, ...]:
    """Detect outlines in an image (H, W, 3) by the paper's chain (supplement, "Ellipse Detection"), the best first.

    Boxes and masks replace Grounding DINO and SAM 2: boxes come from circle votes unless given, masks from GrabCut on
    each channel, started at the middle. It serves for comparison with the default detector; its edge points lie on
    whole pixels of one grey image.

    Args:
        image_bgr: an image of the camera's size.
        camera: the camera by which points are undistorted before the conic is fitted.
        options: radii, coverage and number of points are used.
        boxes: boxes of another detector; None: they are found here.
    """
    found: list[SphereOutline] = []
    for box in find_boxes(image_bgr, options) if boxes is None else boxes:
        if min(box[2] - box[0], box[3] - box[1]) < _LEAST_BOX_PX:
            continue
        mask = sphere_mask(image_bgr, box)
        if mask is None:
            continue
        estimate = fit_ellipse(mask, box)
        if estimate.loss > MOST_LOSS:
            continue
        outline = _outline(image_bgr, camera, estimate, options)
        if outline is not None and all(_apart(outline, other) for other in found):
            found.append(outline)
    return tuple(sorted(found, key=lambda outline: -outline.score))


def find_boxes(image_bgr: NDArray[np.uint8], options: DetectionOptions = DEFAULTS) -> list[Box]:
    """Find the boxes around what may be a sphere, the most certain first."""
    scale = min(1.0, options.coarse_width_px / image_bgr.shape[1])
    small = image_bgr
    if scale < 1:
        size = (round(image_bgr.shape[1] * scale), round(image_bgr.shape[0] * scale))
        small = np.asarray(cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    width = small.shape[1]
    circles = find_candidates(
        small, options.min_radius * width, options.max_radius * width, options.min_vote, _MOST_BOXES
    )
    out: list[Box] = []
    for circle in circles:
        x, y, half = circle.x / scale, circle.y / scale, (1 + MARGIN) * circle.radius / scale
        out.append((x - half, y - half, x + half, y + half))
    return out


def sphere_mask(image_bgr: NDArray[np.uint8], box: Box) -> NDArray[np.bool_] | None:
    """Return a (side, side) mask of the sphere in the middle of the reduced box; None if there is none.

    The masks of the channels are joined, opened and closed, and the component that contains the middle is used. The
    middle is assumed to be sphere and the box's corners background; GrabCut decides the rest.
    """
    patch = cv2.resize(cut(image_bgr, box), (MASK_SIDE, MASK_SIDE), interpolation=cv2.INTER_AREA)
    rows, columns = np.mgrid[0:MASK_SIDE, 0:MASK_SIDE] - (MASK_SIDE - 1) / 2
    distance = np.hypot(rows, columns) / (MASK_SIDE / 2 / (1 + MARGIN))  # in radii of the circle in the box
    joined = np.zeros((MASK_SIDE, MASK_SIDE), dtype=np.uint8)
    for channel in range(3):
        values = patch[:, :, channel]
        step = float(np.median(values[distance < 0.8])) - float(np.median(values[distance > 1.15]))
        if abs(step) < _LEAST_STEP:
            continue  # this channel does not separate sphere and surroundings
        labels = np.full((MASK_SIDE, MASK_SIDE), cv2.GC_PR_BGD, dtype=np.uint8)
        labels[distance < 1.0] = cv2.GC_PR_FGD
        labels[distance < 0.5] = cv2.GC_FGD
        labels[distance > 1.25] = cv2.GC_BGD
        background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
        colours = np.ascontiguousarray(np.repeat(values[:, :, None], 3, axis=2))
        cv2.setRNGSeed(0)
        cv2.grabCut(colours, labels, (0, 0, 0, 0), background, foreground, 3, cv2.GC_INIT_WITH_MASK)
        joined |= ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
    return in_the_middle(joined)


def in_the_middle(joined: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
    """Return the component at the middle of a (side, side) mask, opened and closed first; None if there is none."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    smooth = np.asarray(cv2.morphologyEx(cv2.morphologyEx(joined, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel))
    _, parts = cv2.connectedComponents(smooth.astype(np.uint8))
    part = int(parts[len(joined) // 2, len(joined) // 2])
    return np.asarray(parts == part, dtype=np.bool_) if part else None


def cut(image_bgr: NDArray[np.uint8], box: Box) -> NDArray[np.uint8]:
    """Return the box cropped from the image; beyond the image, its border is repeated."""
    height, width = image_bgr.shape[:2]
    rows = np.clip(np.arange(round(box[1]), round(box[3])), 0, height - 1)
    columns = np.clip(np.arange(round(box[0]), round(box[2])), 0, width - 1)
    return np.ascontiguousarray(image_bgr[np.ix_(rows, columns)])


def fit_ellipse(mask: NDArray[np.bool_], box: Box) -> EllipseEstimate:
    """Return the ellipse with the fewest false positives and negatives against a mask, from several starts."""
    side = len(mask)
    rows, columns = np.mgrid[0:side, 0:side].astype(np.float64)
    inside = mask.astype(np.float64)

    def loss(p: Array) -> float:
        dx, dy = columns - p[0], rows - p[1]
        c, s = np.cos(p[4]), np.sin(p[4])
        a, b = max(float(p[2]), 2.0), max(float(p[3]), 2.0)
        # An edge softened by half a pixel gives the simplex search a slope to follow.
        r = np.hypot((c * dx + s * dy) / a, (c * dy - s * dx) / b)
        e = np.clip(0.5 + (1 - r) * 0.5 * (a + b), 0.0, 1.0)
        return float(np.abs(e - inside).sum() / inside.sum())

    y, x = (float(v) for v in np.argwhere(mask).mean(axis=0))
    radius = float(np.sqrt(inside.sum() / np.pi))
    half = side / 2 / (1 + MARGIN)
    starts = [
        (x, y, radius, radius, 0.1),
        (side / 2, side / 2, half, half, 0.1),
        (x, y, 1.15 * radius, 0.9 * radius, 0.8),
    ]
    fits = [minimize(loss, np.array(s), method="Nelder-Mead", options={"maxfev": 260, "xatol": 0.02}) for s in starts]
    best = min(fits, key=lambda fit: float(fit.fun))
    p = np.asarray(best.x, dtype=np.float64)
    sx, sy = (box[2] - box[0]) / side, (box[3] - box[1]) / side
    return EllipseEstimate(
        box[0] + (p[0] + 0.5) * sx - 0.5, box[1] + (p[1] + 0.5) * sy - 0.5, abs(p[2]) * sx, abs(p[3]) * sy, p[4],
        float(best.fun),
    )  # fmt: skip


def middle_colour(image_bgr: NDArray[np.uint8], ellipse: EllipseEstimate) -> tuple[float, float, float]:
    """Return the median colour (blue, green, red; 0..255) of an ellipse's middle; black outside the image."""
    reach = max(2, round(0.4 * min(ellipse.a, ellipse.b)))
    u, v = round(ellipse.x), round(ellipse.y)
    middle = image_bgr[max(0, v - reach) : max(0, v + reach), max(0, u - reach) : max(0, u + reach)]
    if middle.size == 0:
        return 0.0, 0.0, 0.0
    b, g, r = (float(value) for value in np.median(middle.reshape(-1, 3), axis=0))
    return b, g, r


def _outline(
    image_bgr: NDArray[np.uint8], camera: CameraModel, estimate: EllipseEstimate, options: DetectionOptions
) -> SphereOutline | None:
    """Return the outline by Canny points in the ellipse's envelope, undistorted and fitted by RANSAC."""
    radius = 0.5 * (estimate.a + estimate.b)
    reach = max(3.0, _ENVELOPE * radius)
    half = max(estimate.a, estimate.b) + reach + 4
    left, top = max(0, int(estimate.x - half)), max(0, int(estimate.y - half))
    patch = image_bgr[top : int(estimate.y + half) + 1, left : int(estimate.x + half) + 1]
    if min(patch.shape[:2]) < 8:
        return None
    grey = cv2.GaussianBlur(cv2.cvtColor(patch, cv2.COLOR_BGR2GRAY), (5, 5), 1.0)
    # Thresholds from this region: relative to the whole image's maximum, one highlight would affect all spheres.
    steep = float(np.percentile(np.abs(cv2.Laplacian(grey, cv2.CV_32F)), 90))
    edge = cv2.Canny(np.asarray(grey, dtype=np.uint8), 4.0 * steep, 10.0 * steep)
    pixels = np.argwhere(edge > 0)[:, ::-1].astype(np.float64) + np.array([left, top])
    dx, dy = pixels[:, 0] - estimate.x, pixels[:, 1] - estimate.y
    c, s = np.cos(estimate.theta_rad), np.sin(estimate.theta_rad)
    r = np.hypot((c * dx + s * dy) / estimate.a, (c * dy - s * dx) / estimate.b)
    near = np.abs(r - 1) * radius < reach
    pixels = pixels[near]
    if len(pixels) < 16:
        return None
    rays = np.column_stack([camera.normalise(pixels), np.ones(len(pixels))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    slots = ((np.arctan2(dy, dx)[near] / (2 * np.pi) % 1.0) * _SLOTS).astype(np.int64)
    per_pixel = 1.0 / camera.fx
    half_angle = np.arctan(radius * per_pixel)
    fit = ransac_cone(
        rays, np.ones(len(rays)), slots, (0.8 * half_angle, 1.25 * half_angle), 1.5 * per_pixel,
        np.random.default_rng(options.seed),
    )  # fmt: skip
    if fit is None:
        return None
    cone, inlier = fit
    coverage = len(np.unique(slots[inlier])) / _SLOTS
    if coverage < options.min_coverage:
        return None
    return outline_from_cone(
        cone, camera, options.n_points, _evidence(image_bgr, camera, cone, rays[inlier], estimate, coverage)
    )


def _evidence(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    cone: Cone,
    rays: Array,
    estimate: EllipseEstimate,
    coverage: float,
) -> OutlineEvidence:
    off_px = angles_to(cone, rays) * camera.fx
    sigma_px = max(_LEAST_SIGMA_PX, 1.4826 * float(np.median(np.abs(off_px))))
    variance = (sigma_px / camera.fx) ** 2 / (_INDEPENDENT * coverage)
    return OutlineEvidence(
        coverage=coverage,
        rms_px=float(np.sqrt(np.mean(off_px**2))),
        sigma_px=sigma_px,
        n_edges=len(rays),
        systematic_px=_LEAST_SIGMA_PX,
        contrast=0.0,  # not measured by this chain
        colour_bgr=middle_colour(image_bgr, estimate),
        score=coverage * (1 - estimate.loss),
        # A direction is determined by half of each point's information, the radius by all of it.
        cone_covariance=np.diag([2 * variance, 2 * variance, variance]),
    )


def _apart(a: SphereOutline, b: SphereOutline) -> bool:
    distance = np.arccos(np.clip(a.cone.axis @ b.cone.axis, -1, 1))
    return bool(distance > 0.5 * max(a.cone.half_angle_rad, b.cone.half_angle_rad))


_FORM = 'Write {"image.jpg": [[left, top, right, bottom], …], …} in pixels of the image'


def detect_file_by_masks(
    path: Path,
    camera: CameraModel,
    options: DetectionOptions = DEFAULTS,
    boxes: Mapping[str, Sequence[Box]] | None = None,
) -> tuple[SphereOutline, ...]:
    """Detect the outlines in one image file by the paper's chain.

    Args:
        path: JPEG, PNG or TIFF of the camera's size.
        camera: intrinsics.
        options: the detector's options.
        boxes: (left, top, right, bottom) in pixels by file name; an image without an entry has no sphere. None: found
            by circle votes.

    Raises:
        DataError: the file is not an image of the camera's size.
    """
    mine = None if boxes is None else boxes.get(path.name, ())
    return detect_by_masks(read_image_of(path, camera), camera, options, boxes=mine)


def read_boxes(path: Path, names: Sequence[str]) -> dict[str, list[Box]]:
    """Read the boxes by image name from a JSON file, such as Grounding DINO's.

    Raises:
        DataError: the file is not JSON of this format, a box has no area, or an image is not among `names`.
    """
    data = parse_json(file_text(path), name=str(path), remedy=_FORM)
    if not isinstance(data, dict):
        raise DataError("the file does not hold boxes by image name", where=str(path), remedy=_FORM)
    known = cast(dict[str, Any], data)
    strange = sorted(set(known) - set(names))
    if strange:
        raise DataError(f"there is no image {strange[0]!r}", where=str(path), remedy=_FORM)
    return {
        name: [_box(entry, f"{path}: {name}") for entry in _list(entries, path)] for name, entries in known.items()
    }


def _list(entries: Any, path: Path) -> list[Any]:
    if not isinstance(entries, list):
        raise DataError("the boxes of an image are not a list", where=str(path), remedy=_FORM)
    return cast(list[Any], entries)


def _box(entry: Any, where: str) -> Box:
    try:
        left, top, right, bottom = (float(value) for value in entry)
    except (TypeError, ValueError) as error:
        raise DataError(f"{entry!r} is not a box", where=where, remedy=_FORM) from error
    if not (left < right and top < bottom):  # NaN fails too
        raise DataError(f"the box {entry!r} has no area", where=where, remedy=_FORM)
    return left, top, right, bottom
