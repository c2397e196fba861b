"""SIFT as COLMAP extracts it, with mutual nearest neighbours and Lowe's ratio test: the classical baseline."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from service.compute.matching.methods.method import Matcher, Matches, Picture
from service.compute.sfm.colmap import SiftFeatures, extract_sift, from_colmap_pixels
from service.compute.sfm.features import match_descriptors

MOST_FEATURES = 8192  # COLMAP's default
FIRST_OCTAVE = -1  # COLMAP's default: the image is doubled first


class ExtractedSift:
    """Features of pictures, cached for the pairs that follow."""

    def __init__(self) -> None:
        self._known: dict[bytes, SiftFeatures] = {}

    def of(self, picture: Picture) -> SiftFeatures:
        """Return the features of a picture, extracted once."""
        key = hashlib.blake2b(picture.tobytes()).digest()
        if key not in self._known:
            grey = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
            self._known[key] = extract_sift(grey, MOST_FEATURES, FIRST_OCTAVE)
        return self._known[key]


class Sift:
    """COLMAP's SIFT; the confidence of a match is the cosine of its descriptors."""

    def __init__(self) -> None:
        self._features = ExtractedSift()

    def __call__(self, first: Picture, second: Picture) -> Matches:
        """Match two pictures."""
        a, b = self._features.of(first), self._features.of(second)
        rows = match_descriptors(a.descriptors, b.descriptors)
        pairs = a.descriptors[rows[:, 0]].astype(np.float64), b.descriptors[rows[:, 1]].astype(np.float64)
        length = np.linalg.norm(pairs[0], axis=1) * np.linalg.norm(pairs[1], axis=1)
        cosine = np.sum(pairs[0] * pairs[1], axis=1) / np.maximum(length, 1e-12)
        first_px, second_px = (from_colmap_pixels(f.points[rows[:, k]]) for k, f in enumerate((a, b)))
        return Matches(first_px, second_px, cosine)


def _load(_weights: Path | None) -> Sift:
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value  # it announces each extraction
    return Sift()


KIND = Matcher("sift", "SIFT (COLMAP), mutual nearest neighbours, ratio 0.8", _load)
