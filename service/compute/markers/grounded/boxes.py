"""Boxes around spheres by Grounding DINO: tiles of large images, a falling threshold, one box for each place."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.markers.grounded.networks import DEVIATION, MEAN, Floats, Networks
from service.compute.markers.paper_chain import Box
from service.compute.markers.records import DEFAULTS, DetectionOptions
from service.core.geometry import Array

FIRST_THRESHOLD = 0.35  # Grounding DINO's usual one
LAST_THRESHOLD = 0.1
_FALL = 0.8  # of the threshold, until enough spheres are found
_MOST_REDUCED = 2.5  # images reduced more than this are searched in tiles as well
_OVERLAP = 0.25  # of a tile, with its neighbour: a sphere on the border of one is whole in the other
_BORDER = 0.01  # of a tile; a box that ends so close to an inner border is a part
_SAME = 0.5  # intersection over union of two boxes of one sphere
_INSIDE = 0.8  # of the smaller box, in a larger one
_MOST_STRETCHED = 2.0  # side ratio of a box; a sphere at the image's border is cut
_BATCH = 4  # images given to the network at once


@dataclass(frozen=True, slots=True)
class _Tile:
    left: int
    top: int
    right: int
    bottom: int

    def cuts(self, box: Array, width: int, height: int) -> bool:
        """Whether a box in pixels of the image ends at a border of the tile that is not one of the image."""
        x, y = _BORDER * (self.right - self.left), _BORDER * (self.bottom - self.top)
        return bool(
            (self.left > 0 and box[0] < self.left + x)
            or (self.top > 0 and box[1] < self.top + y)
            or (self.right < width and box[2] > self.right - x)
            or (self.bottom < height and box[3] > self.bottom - y)
        )


def find_boxes(
    image_bgr: NDArray[np.uint8], networks: Networks, least: int, options: DetectionOptions = DEFAULTS
) -> list[Box]:
    """Boxes (left, top, right, bottom) in pixels of an image (H, W, 3), the most certain first.

    The threshold falls from FIRST_THRESHOLD until there are `least` boxes or it is below LAST_THRESHOLD (paper,
    "Sphere Detection").

    Args:
        image_bgr: of any size; larger ones are searched in tiles as well.
        networks: Grounding DINO.
        least: spheres expected in the image.
        options: the range of radii, as fractions of the image's width.
    """
    width = image_bgr.shape[1]
    scores, boxes = _proposals(image_bgr, networks)
    sides = boxes[:, 2:] - boxes[:, :2]
    low, high = 2 * options.min_radius * width, 2.5 * options.max_radius * width
    fits = (sides.min(axis=1) > low) & (sides.max(axis=1) < high)
    fits &= sides.max(axis=1) < _MOST_STRETCHED * sides.min(axis=1)
    order = np.argsort(-scores[fits], kind="stable")
    scores, boxes = scores[fits][order], boxes[fits][order]
    threshold = FIRST_THRESHOLD
    while True:
        kept = _apart(boxes[scores >= threshold])
        if len(kept) >= least or threshold <= LAST_THRESHOLD:
            return [(float(b[0]), float(b[1]), float(b[2]), float(b[3])) for b in kept]
        threshold = max(LAST_THRESHOLD, _FALL * threshold)


def _proposals(image_bgr: NDArray[np.uint8], networks: Networks) -> tuple[Array, Array]:
    """Scores (N,) and boxes (N, 4) of the whole image and its tiles, parts at inner borders left out."""
    height, width = image_bgr.shape[:2]
    scores: list[Array] = [np.zeros(0)]
    boxes: list[Array] = [np.zeros((0, 4))]
    for group in _batches(tiles_of(width, height, networks.size_px)):
        pictures = [image_bgr[t.top : t.bottom, t.left : t.right] for t in group]
        found = networks.boxes(np.concatenate([_prepared(picture, networks.size_px) for picture in pictures]))
        for tile, some, relative in zip(group, *found, strict=True):
            side = np.array([tile.right - tile.left, tile.bottom - tile.top], dtype=np.float64)
            middle, half = relative[:, :2] * side, 0.5 * relative[:, 2:] * side
            # Fractions count from the outer edge of the first pixel, our pixels from its centre.
            shift = np.array([tile.left, tile.top]) - 0.5
            corners = np.hstack([middle - half + shift, middle + half + shift])
            whole = np.array([not tile.cuts(box, width, height) for box in corners], dtype=np.bool_)
            scores.append(np.asarray(some[whole], dtype=np.float64))
            boxes.append(np.asarray(corners[whole], dtype=np.float64))
    return np.concatenate(scores), np.concatenate(boxes)


def tiles_of(width: int, height: int, size_px: tuple[int, int]) -> list[_Tile]:
    """The whole image, and overlapping equal tiles if the network would see it much reduced."""
    reduced = max(min(width, height) / size_px[0], max(width, height) / size_px[1])
    out = [_Tile(0, 0, width, height)]
    if reduced > _MOST_REDUCED:
        columns, rows = (math.ceil(side / (_MOST_REDUCED * size_px[1])) + 1 for side in (width, height))
        across, down = list(_spans(width, columns)), list(_spans(height, rows))
        out += [_Tile(left, top, right, bottom) for top, bottom in down for left, right in across]
    return out


def _spans(length: int, count: int) -> Iterator[tuple[int, int]]:
    """`count` equal spans that cover a length and overlap."""
    side = math.ceil(length / (count - (count - 1) * _OVERLAP)) if count > 1 else length
    for k in range(count):
        start = round(k * (length - side) / max(1, count - 1))
        yield start, start + side


def _batches(tiles: Sequence[_Tile]) -> Iterator[list[_Tile]]:
    """The whole image alone, since its size differs; then tiles, several at once."""
    yield [tiles[0]]
    for first in range(1, len(tiles), _BATCH):
        yield list(tiles[first : first + _BATCH])


def _prepared(picture: NDArray[np.uint8], size_px: tuple[int, int]) -> Floats:
    """(1, 3, h, w) of a picture as Grounding DINO was trained on them."""
    height, width = picture.shape[:2]
    factor = min(size_px[0] / min(height, width), size_px[1] / max(height, width))
    return normalised(picture, (round(factor * width), round(factor * height)))


def normalised(picture: NDArray[np.uint8], size: tuple[int, int]) -> Floats:
    """(1, 3, h, w) RGB of a BGR picture resized to (w, h), with the mean and deviation of the training images."""
    larger = size[0] > picture.shape[1]
    resized = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR if larger else cv2.INTER_AREA)
    rgb = np.asarray(resized, dtype=np.float32)[:, :, ::-1] / np.float32(255)
    scaled = (rgb - np.array(MEAN, dtype=np.float32)) / np.array(DEVIATION, dtype=np.float32)
    return np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])


def _apart(boxes: Array) -> list[Array]:
    """Of boxes (N, 4), the best first, those that are not on a better one."""
    kept: list[Array] = []
    for box in boxes:
        if all(not _overlap(box, other) for other in kept):
            kept.append(box)
    return kept


def _overlap(a: Array, b: Array) -> bool:
    common = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    areas = [float(np.prod(box[2:] - box[:2])) for box in (a, b)]
    return bool(common > _SAME * (sum(areas) - common) or common > _INSIDE * min(areas))
