"""LoFTR by kornia: matches without a detector, learned; needs PyTorch and a file of weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.compute.matching.methods.method import Matcher, Matches, Picture
from service.compute.matching.methods.networks import (
    Network,
    Torch,
    grey_0_to_1,
    read_weights,
    set_weights,
    torch_with,
)
from service.core.geometry import Array

WEIGHTS = (
    "loftr_outdoor.ckpt (12 million parameters, trained on MegaDepth; linked in kornia's feature/loftr/loftr.py)"
)
LONGER_SIDE_PX = 840  # at which LoFTR was trained and its pose errors were published (Sun et al., CVPR 2021)
_CELL = 8  # pixels in a cell of the coarse level: sizes are multiples of it


class LoFTR:
    """The network with its weights."""

    def __init__(self, torch: Torch, network: Network) -> None:
        self._torch, self._network = torch, network

    def __call__(self, first: Picture, second: Picture) -> Matches:
        """Match two pictures, reduced to LONGER_SIDE_PX."""
        sizes = [reduced_size(picture) for picture in (first, second)]
        inputs = [
            self._torch.tensor(grey_0_to_1(picture, size))
            for picture, size in zip((first, second), sizes, strict=True)
        ]
        with self._torch.inference():
            found = self._network({"image0": inputs[0], "image1": inputs[1]})
        pixels = [
            original_px(np.asarray(found[name].numpy(), dtype=np.float64), size, picture)
            for name, size, picture in zip(("keypoints0", "keypoints1"), sizes, (first, second), strict=True)
        ]
        return Matches(pixels[0], pixels[1], np.asarray(found["confidence"].numpy(), dtype=np.float64))


def reduced_size(picture: Picture) -> tuple[int, int]:
    """Return the width and height at which the network sees a picture."""
    height, width = picture.shape[:2]
    factor = min(1.0, LONGER_SIDE_PX / max(height, width))
    return max(1, round(factor * width / _CELL)) * _CELL, max(1, round(factor * height / _CELL)) * _CELL


def original_px(points: Array, size: tuple[int, int], picture: Picture) -> Array:
    """Return our pixels (M, 2) of the network's points (M, 2), whose first pixel has its centre at 0.5."""
    height, width = picture.shape[:2]
    return points * (np.array([width, height]) / np.array(size)) - 0.5


def _load(weights: Path | None) -> LoFTR:
    torch = torch_with("LoFTR", "LoFTR")
    network = torch.make(pretrained=None)
    state = {name.removeprefix("matcher."): value for name, value in read_weights(torch, weights, WEIGHTS).items()}
    set_weights(network, state, weights, WEIGHTS)
    return LoFTR(torch, network)


KIND = Matcher("loftr", "LoFTR (kornia 0.9.0), outdoor weights, 840 px", _load, WEIGHTS)
