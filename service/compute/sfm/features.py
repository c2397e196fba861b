"""Holds what structure from motion is given: features of images, verified matches of pairs, and tracks."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.core.errors import DataError
from service.core.geometry import Array

_NORM = 512.0  # length of a descriptor in unsigned bytes
_ROWS = 512  # descriptors compared at a time, so that the products stay in the processor's cache
_MOST_ANGLE_RAD = 0.7  # between descriptors of one scene point
_MOST_RATIO = 0.8  # angle to the nearest descriptor over that to the second nearest (Lowe, 2004, 7.1)


# What NumPy and the archive format raise for invalid bytes.
_DAMAGED = (ValueError, KeyError, TypeError, IndexError, OSError, EOFError, RuntimeError, zipfile.BadZipFile,
            zlib.error)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class ImageFeatures:
    """SIFT features of one image (colmap.py says which, if there are too many).

    Attributes:
        width, height: size of the image as captured, px.
        pixels: (n, 2) float32 in the image as captured, first pixel's centre at 0.
        scales_px: (n,) float32 in the image as captured.
        descriptors: (n, 128) uint8.
    """

    width: int
    height: int
    pixels: NDArray[np.float32] = field(repr=False)
    scales_px: NDArray[np.float32] = field(repr=False)
    descriptors: NDArray[np.uint8] = field(repr=False)

    def to_bytes(self) -> bytes:
        """Return a NumPy archive (.npz, about 0.1 kB a feature); the same features give the same bytes."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            size=np.array([self.width, self.height]),
            pixels=self.pixels,
            scales_px=self.scales_px,
            descriptors=self.descriptors,
        )
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> ImageFeatures:
        """Rebuild the features from `to_bytes`'s archive.

        Raises:
            DataError: the bytes are not such an archive.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                width, height = (int(v) for v in archive["size"])
                return cls(width, height, archive["pixels"], archive["scales_px"], archive["descriptors"])
        except _DAMAGED as error:
            raise DataError("these bytes are not features of an image", remedy="Extract them again") from error


@dataclass(frozen=True, slots=True, eq=False)
class PairMatches:
    """Matches of two images that agree with one epipolar geometry; empty if the images have nothing in common.

    Attributes:
        first, second: names of the images, first < second.
        features: (m, 2) uint32 feature indices in the first and the second image.
        configuration: COLMAP's kind of two-view geometry.
        matrices: (3, 3, 3) essential, fundamental and homography matrix from the first to the second image; zero if
            absent.
    """

    first: str
    second: str
    features: NDArray[np.uint32] = field(repr=False)
    configuration: int
    matrices: Array = field(repr=False)

    @property
    def pair(self) -> tuple[str, str]:
        """Names of both images in order."""
        return self.first, self.second


def pack_matches(matches: Sequence[PairMatches]) -> bytes:
    """Pack matches of any number of pairs into a NumPy archive (.npz), sorted by pair, whatever the given order."""
    ordered = sorted(matches, key=lambda m: m.pair)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        pairs=np.array(json.dumps([m.pair for m in ordered])),
        counts=np.array([len(m.features) for m in ordered], dtype=np.int64),
        features=np.concatenate([np.empty((0, 2), np.uint32), *(m.features for m in ordered)]),
        configurations=np.array([m.configuration for m in ordered], dtype=np.int64),
        matrices=np.array([m.matrices for m in ordered]).reshape(-1, 3, 3, 3),
    )
    return buffer.getvalue()


def unpack_matches(data: bytes) -> list[PairMatches]:
    """Rebuild the matches from `pack_matches`'s archive, sorted by pair.

    Raises:
        DataError: the bytes are not such an archive.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            pairs = json.loads(str(archive["pairs"]))
            ends = np.cumsum(archive["counts"])
            each = np.split(archive["features"], ends[:-1])
            kinds, matrices = archive["configurations"], archive["matrices"]
            return [
                PairMatches(first, second, each[k], int(kinds[k]), matrices[k])
                for k, (first, second) in enumerate(pairs)
            ]
    except _DAMAGED as error:
        raise DataError("these bytes are not matches of images", remedy="Match the images again") from error


def match_descriptors(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return indices (m, 2) of descriptors (n, 128) and (k, 128) that are mutual nearest and pass the ratio test.

    Products of unsigned bytes are integers below 2^24, which single precision adds exactly in any order: the same
    descriptors give the same matches on every machine.
    """
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), dtype=np.uint32)
    a, b = first.astype(np.float32), second.astype(np.float32)
    forth, clear = _nearest(a, b)
    rows = np.flatnonzero(clear)
    wanted = np.unique(forth[rows])
    back = np.full(len(b), -1, dtype=np.int64)
    nearest, clear = _nearest(b[wanted], a)
    back[wanted[clear]] = nearest[clear]
    rows = rows[back[forth[rows]] == rows]
    return np.column_stack([rows, forth[rows]]).astype(np.uint32)


def _nearest(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Find the nearest descriptor of b for each of a, and whether it passes the limits on distance and ratio."""
    index = np.empty(len(a), dtype=np.int64)
    clear = np.empty(len(a), dtype=np.bool_)
    turned = np.ascontiguousarray(b.T)
    buffer = np.empty((_ROWS, len(b)), dtype=np.float32)
    for start in range(0, len(a), _ROWS):
        part = a[start : start + _ROWS]
        products = np.matmul(part, turned, out=buffer[: len(part)])
        rows = np.arange(len(part))
        best = products.argmax(axis=1)
        cosine = products[rows, best].astype(np.float64) / _NORM**2
        products[rows, best] = -1.0
        second = products.max(axis=1).astype(np.float64) / _NORM**2
        angle = np.arccos(np.minimum(cosine, 1.0))
        index[start : start + len(part)] = best
        clear[start : start + len(part)] = (angle <= _MOST_ANGLE_RAD) & (
            angle < _MOST_RATIO * np.arccos(np.minimum(second, 1.0))
        )
    return index, clear


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of scene points.

    Attributes:
        image: (O,) index of the image, in the order of the model's poses.
        point: (O,) index of the point.
        pixels: (O, 2) places in the image as captured.
        points: (P, 3) positions in the model's frame and unit; every point has at least two observations.
    """

    image: NDArray[np.int64] = field(repr=False)
    point: NDArray[np.int64] = field(repr=False)
    pixels: Array = field(repr=False)
    points: Array = field(repr=False)

    def thinned(self, most: int) -> Tracks:
        """Reduce to about `most` observations, keeping the longest tracks; unchanged if there are few enough.

        Tracks are taken in the order of their length, after each image has got its share.
        """
        if len(self.image) <= most:
            return self
        length = np.bincount(self.point, minlength=len(self.points))
        n_images = int(self.image.max()) + 1
        keep = np.zeros(len(self.points), dtype=bool)
        share = max(1, most // n_images // 2)
        order = np.argsort(-length[self.point], kind="stable")
        for i in range(n_images):  # so that a weakly connected image keeps its few points
            mine = order[self.image[order] == i][:share]
            keep[self.point[mine]] = True
        for p in np.argsort(-length, kind="stable"):
            if length[keep].sum() >= most:
                break
            keep[p] = True
        number = np.cumsum(keep) - 1
        rows = keep[self.point]
        return Tracks(self.image[rows], number[self.point[rows]], self.pixels[rows], self.points[keep])
