"""Cuts spheres and their posts out of a ground-truth mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from service.compute.ground_truth.fusion.fuse import Fused, compact
from service.compute.ground_truth.fusion.overlap import Mask
from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class Markers:
    """Spheres on posts, in the frame of the mesh.

    Attributes:
        centres_m: (M, 3).
        radius_m: of the spheres.
        up: (3,) along the posts, away from the table.
        post_radius_m: of the posts; 0: there are none.
        post_length_m: below the centres.
        margin_m: cut around both.
    """

    centres_m: Array
    radius_m: float
    up: Array
    post_radius_m: float = 0.0
    post_length_m: float = 0.2
    margin_m: float = 0.002

    def near(self, points_m: Array) -> Mask:
        """(N,) which points (N, 3) are on a sphere or a post, or within the margin of one."""
        up = self.up / np.linalg.norm(self.up)
        out = np.zeros(len(points_m), dtype=np.bool_)
        for centre in self.centres_m:
            way = points_m - centre
            along = way @ up
            out |= np.linalg.norm(way, axis=1) <= self.radius_m + self.margin_m
            if self.post_radius_m > 0:
                aside = np.linalg.norm(way - along[:, None] * up, axis=1)
                out |= (aside <= self.post_radius_m + self.margin_m) & (along < 0) & (along > -self.post_length_m)
        return out


def without_markers(fused: Fused, markers: Markers) -> Fused:
    """The ground truth without the faces that touch a sphere or a post; where they stood it is open."""
    near = markers.near(fused.surface.vertices_m)
    surface, kept = compact(fused.surface.vertices_m, fused.surface.faces[~fused.surface.touching(near)])
    return replace(
        fused,
        surface=surface,
        source=fused.source[kept],
        weight=fused.weight[kept],
        sigma_m=fused.sigma_m[kept],
        wound=fused.wound[kept],
    )
