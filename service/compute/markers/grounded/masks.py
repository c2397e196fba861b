"""Masks of the spheres in boxes by SAM 2, one for each colour channel, joined as in the paper."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.markers.grounded.boxes import normalised
from service.compute.markers.grounded.networks import Networks
from service.compute.markers.paper_chain import MASK_SIDE, Box, cut, in_the_middle

_BATCH = 6  # pictures given to the network at once: two boxes


def sphere_masks(
    image_bgr: NDArray[np.uint8], boxes: Sequence[Box], networks: Networks
) -> Iterator[NDArray[np.bool_] | None]:
    """For each box a (MASK_SIDE, MASK_SIDE) mask of the sphere in its middle; None if there is none.

    SAM 2 sees each colour channel as a grey picture and is pointed at its middle; what any channel shows is kept
    (paper, "Sphere Segmentation").

    Args:
        image_bgr: (H, W, 3).
        boxes: with a margin around the sphere.
        networks: SAM 2.
    """
    size = (networks.side_px, networks.side_px)
    per_batch = _BATCH // 3
    for first in range(0, len(boxes), per_batch):
        some = [cut(image_bgr, box) for box in boxes[first : first + per_batch]]
        pictures = [normalised(np.repeat(patch[:, :, c, None], 3, axis=2), size) for patch in some for c in range(3)]
        logits = networks.masks(np.concatenate(pictures))
        for k in range(len(some)):
            yield in_the_middle(_joined(logits[3 * k : 3 * k + 3]))


def _joined(logits: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The pixels that at least one of three channels' logits (3, m, m) calls the object, at the masks' size."""
    size = (MASK_SIDE, MASK_SIDE)
    channels = [cv2.resize(channel, size, interpolation=cv2.INTER_LINEAR) > 0 for channel in logits]
    return np.any(np.array(channels), axis=0).astype(np.uint8)
