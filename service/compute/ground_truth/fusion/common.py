"""The part of a CT that can be compared and fused with a scan: without what was taken away, and without noise."""

from __future__ import annotations

from dataclasses import dataclass, field

from service.compute.ground_truth.align import Aligned
from service.compute.ground_truth.fusion.fuse import outside, without_specks
from service.compute.ground_truth.fusion.regions import SphereRegion
from service.compute.ground_truth.surface import Surface

_MARGIN_M = 0.001  # around a sphere that was taken away: the CT's surface beside it is drawn towards it
# Smaller unconnected parts of the CT are noise, mostly in wood, whose density is near the threshold.
_LEAST_PART_M2 = 5e-5


@dataclass(frozen=True, slots=True)
class CommonPart:
    """A CT without the spheres that were taken away before the scan; `taken` is where they were."""

    ct: Surface = field(repr=False)
    taken: SphereRegion = field(repr=False)


def common_part(ct: Surface, aligned: Aligned, radius_m: float) -> CommonPart:
    """Leave out of a CT, in the scan's frame, the spheres of a radius that the scan lacks, and small loose parts."""
    taken = SphereRegion(aligned.taken_away_m, radius_m + _MARGIN_M)
    left = outside(ct, taken)
    del ct
    return CommonPart(without_specks(left, _LEAST_PART_M2), taken)
