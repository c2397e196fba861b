"""Job kind `ct_surface`: computes the surface of a CT volume and finds its spheres."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash, Matrix, SpheresFound


class Arguments(JobRecord):
    """The decoded volume: `hounsfield` is a NumPy array, `T_ct_voxel` maps its indices to metres.

    With `labels`, an array of the same shape, the surface is that of the segmented voxels, not at `threshold_hu`.
    With `measure_cut`, the measures say how much the first and the last slice cut.
    """

    radius_m: float
    expected: int
    slices: tuple[Hash, ...] = ()
    hounsfield: Hash
    T_ct_voxel: Matrix
    threshold_hu: float
    labels: Hash | None = None
    measure_cut: bool = False  # jobs of earlier versions did not


KIND = JobKind(
    name="ct_surface",
    arguments=Arguments,
    answer=SpheresFound,
    compute="service.computations.ct_surface.compute:ct_surface",
    words="CT surface",
    order=20,
    version=3,  # also gives the radius of the spheres
    demand=lambda _: Demand(memory_mb=1500, limit_s=7200),
)
