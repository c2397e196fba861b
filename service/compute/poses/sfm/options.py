"""Settings of structure from motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from service.compute.camera_model import CameraModel

Mapper = Literal["incremental", "global", "triangulated"]
Refine = Literal["nothing", "principal_point", "intrinsics"]
Progress = Callable[[str, int, int], None]  # stage, done, total (total 0: unknown)


@dataclass(frozen=True, slots=True)
class SfmOptions:
    """Settings of the front end and of the refinement.

    Attributes:
        max_image_size: longer side to which images are reduced for feature extraction; 0 keeps the full size.
        max_features: most per image; most of them are those with the smallest scales (`extract_sift`).
        first_octave: -1 doubles the image first (finer and four times slower), 0 does not.
        neighbours: number of images, nearest in viewing direction, with which each image is matched (needs a prior).
        max_angle_deg: largest angle between two matched views, as seen from the scene.
        verification_error_px: largest epipolar distance of an inlier match, at extraction size.
        filter_error_px: observations with larger errors are dropped before the final bundle adjustment.
        min_track: least number of views of a point in the final bundle adjustment.
        loss_px: scale of the final bundle adjustment's robust (Cauchy) loss.
        threads: of extraction and matching.
        mapping_threads: of mapping and bundle adjustment. With one, the same features give the same model bit for
            bit; with more, sums depend on the order in which threads finish.
        refine: intrinsics that the final bundle adjustment may change.
        seed: of all random choices.
        timeout_s: time limit of one stage.
    """

    max_image_size: int = 3200
    max_features: int = 3000
    first_octave: int = 0
    neighbours: int = 8
    max_angle_deg: float = 60.0
    verification_error_px: float = 2.0
    filter_error_px: float = 1.5
    min_track: int = 3
    loss_px: float = 0.5
    threads: int = 2
    mapping_threads: int = 1
    refine: Refine = "nothing"
    seed: int = 1
    timeout_s: float = 3600.0


Effort = Literal["quick", "normal", "quality"]


def options_for(effort: Effort, camera: CameraModel, *, refine: Refine = "nothing", threads: int = 2) -> SfmOptions:
    """Settings for images of this camera.

    Camera positions were off by 0.017–0.028 mm (normal) and 0.013 mm (quality) on 20 rendered images 1920 px wide of
    a scene 0.65 m away (bench/poses/sfm.py); the errors are noise, so more features reduce them.
    """
    longer = max(camera.width, camera.height)
    if effort == "quick":
        return SfmOptions(max_image_size=1280, max_features=2500, neighbours=8, refine=refine, threads=threads)
    if effort == "normal":
        return SfmOptions(
            max_image_size=min(longer, 2400), max_features=4000, neighbours=8, refine=refine, threads=threads
        )
    # Small images are doubled first; large ones have enough pixels.
    small = longer <= 2400
    return SfmOptions(
        max_image_size=min(longer, 4000),
        max_features=8000,
        first_octave=-1 if small else 0,
        neighbours=10,
        refine=refine,
        threads=threads,
    )


def reduction(max_image_size: int, width: int, height: int) -> float:
    """Image pixels per pixel at which features are extracted."""
    return max(1.0, max(width, height) / max_image_size) if max_image_size else 1.0
