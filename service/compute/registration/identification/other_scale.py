"""If no image shows the spheres as a list has them: whether it would in another scale, or with another radius."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.compute.registration.identification.hypotheses import image_hypotheses
from service.compute.registration.identification.pairing import sightings
from service.core.geometry import Array, align_points
from service.core.units import MISTAKEN_LENGTHS, mistaken_length, mm

# A search in one scale finds a list that is off by up to 2 %.
_STEP, _STEPS = 1.03, 12
_OTHER_MISTAKES = {"a diameter taken as the radius": 2.0, "half the diameter taken as the diameter": 0.5}
_COMPARED = 3  # images
_LEAST = 5  # spheres that one image must show: four agree by chance in one of so many scales
_NEAR = 0.03  # relative, to one of the mistakes


def words_of_other_scale(
    outlines: Sequence[Sequence[SphereOutline]],
    names: Sequence[str],
    centres_m: Array,
    radius_m: float,
    camera: CameraModel,
) -> str:
    """In which other scale an image shows the list, in words; an empty text if in none.

    An image alone cannot tell a list in another scale from another radius of the spheres.
    """
    best: tuple[int, float, int] = (0, 1.0, 0)
    factors = (
        *(_STEP**k for k in range(-_STEPS, _STEPS + 1) if k),
        *MISTAKEN_LENGTHS.values(),
        *_OTHER_MISTAKES.values(),
    )
    for i in sorted(range(len(outlines)), key=lambda i: -len(outlines[i]))[:_COMPARED]:
        seen_m = sightings(outlines[i], radius_m, camera).positions_m
        for factor in factors:
            if len(outlines[i]) <= max(best[0], _LEAST - 1):
                break  # no scale shows more spheres than there are outlines, and a search costs a second
            for reading in image_hypotheses(outlines[i], factor * centres_m, radius_m, camera)[:1]:
                if reading.count > max(best[0], _LEAST - 1):
                    shown, listed = (np.array(side) for side in zip(*reading.markers.items(), strict=True))
                    best = reading.count, align_points(seen_m[shown], centres_m[listed], with_scale=True)[1], i
    count, scale, image = best
    if not count:
        return ""
    return (
        f"; with the list multiplied by about {scale:.3g}{words_of_unit(scale)}, {names[image]} shows {count} of "
        f"them: the list is in another unit or scale, or the radius is about {mm(radius_m) / scale:.3g} mm"
    )


def words_of_unit(scale: float) -> str:
    """The mistake by which lengths have to be multiplied by `scale`, in words within brackets, or nothing."""
    others = (words for words, factor in _OTHER_MISTAKES.items() if abs(scale / factor - 1) < _NEAR)
    words = mistaken_length(scale, _NEAR) or next(others, "")
    return f" ({words})" if words else ""
