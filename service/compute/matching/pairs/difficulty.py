"""How difficult a pair of images is: by viewing angle, scale and overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.compute.matching.pairs.loader import View
from service.core.geometry import Array
from service.core.units import deg

CLASSES = ("easy", "medium", "hard", "extreme")
MOST_ANGLE_DEG = (15.0, 30.0, 45.0)  # of easy, medium and hard pairs; beyond, a pair is extreme
MOST_SCALE = (1.2, 1.5, 2.0)
LEAST_OVERLAP = (0.6, 0.4, 0.2)


@dataclass(frozen=True, slots=True)
class Difficulty:
    """What makes a pair difficult.

    Attributes:
        angle_deg: median angle at the common points between the rays to both cameras.
        scale: median ratio of the sizes of the common points' surroundings in both images, at least 1.
        overlap: the smaller one of both directions.
    """

    angle_deg: float
    scale: float
    overlap: float

    @property
    def name(self) -> str:
        """The class: that of the worst of the three."""
        by_angle = int(np.searchsorted(MOST_ANGLE_DEG, self.angle_deg))
        by_scale = int(np.searchsorted(MOST_SCALE, self.scale))
        by_overlap = sum(self.overlap < least for least in LEAST_OVERLAP)
        return CLASSES[max(by_angle, by_scale, by_overlap)]


def difficulty(common_m: Array, first: View, second: View, overlap: float) -> Difficulty:
    """The difficulty of a pair with these common points (N, 3), N > 0, in the world frame."""
    rays = [common_m - view.T_world_camera[:3, 3] for view in (first, second)]
    cosine = np.sum(rays[0] * rays[1], axis=1) / np.prod([np.linalg.norm(ray, axis=1) for ray in rays], axis=0)
    angle_rad = float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))
    sizes = [
        view.K[0, 0] / (ray @ view.T_world_camera[:3, 2]) for view, ray in zip((first, second), rays, strict=True)
    ]
    ratio = float(np.median(sizes[0] / sizes[1]))
    return Difficulty(deg(angle_rad), max(ratio, 1.0 / ratio), overlap)
