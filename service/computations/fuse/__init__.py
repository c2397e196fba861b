"""Job kind `fuse`: the ground-truth mesh, from the CT and the scan, with the checks that both are in one frame."""

from __future__ import annotations

from typing import Literal

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash, Matrix, Point, SpheresFound
from service.computations.registration import Registration

Frame = Literal["world", "scan", "ct"]


class Region(JobRecord):
    """A part of space in which a person says which source counts: a polygon, or a box along the axes.

    Attributes:
        source: the source that counts there.
        frame: the frame of the positions.
        by: the person who drew it.
        corners_m: (K, 3) corners of a polygon, in order; empty for a box.
        along: the direction from the surface towards the viewer of the polygon; None: away from the table.
        below_m, above_m: the polygon's reach beyond its lowest and highest corner.
        centre_m, size_m: centre and size of a box.
    """

    source: Literal["ct", "scan"]
    frame: Frame
    by: str
    corners_m: tuple[Point, ...] = ()
    along: Point | None = None
    below_m: float = 0.0
    above_m: float = 0.0
    centre_m: Point | None = None
    size_m: Point | None = None


class Arguments(JobRecord):
    """Both meshes with their spheres, and the image-based registration of each, if there are images.

    Attributes:
        ct_mesh, scan_mesh: vertices and faces, in the frame of each.
        ct, scan: the spheres in them.
        ct_registration, scan_registration: the registrations with the same camera poses.
        blend_m: the width of the overlap over which the sources change.
        spacing_m: the spacing of the samples for the Chamfer distance.
        post_radius_m: the radius of the spheres' posts, which are then cut out with the spheres; None: no cut.
        regions: the regions where people decided, the later overruling the earlier.
        simulated: the run is, and the meshes say so; jobs of earlier versions did not say it.
    """

    ct_mesh: Hash
    scan_mesh: Hash
    ct: SpheresFound
    scan: SpheresFound
    ct_registration: Registration | None = None
    scan_registration: Registration | None = None
    radius_m: float
    blend_m: float
    spacing_m: float
    post_radius_m: float | None = None
    regions: tuple[Region, ...] = ()
    simulated: bool = False


class Answer(JobRecord):
    """The ground truth's transforms and regions.

    Attributes:
        T_scan_ct: the transform from sphere to sphere; the CT was moved by it.
        covariance: the covariance (6, 6) of T_scan_ct, m and rad.
        T_scan_ct_by_images: the same transform through the cameras; None without images.
        wound_m: (K, 3) outline of the wound's region in the scan's frame; empty without a wound.
        regions: the regions that people drew and that were used.
        taken_away: the spheres, by their numbers in the CT, that were cut out because the scan does not have them.
    """

    T_scan_ct: Matrix
    covariance: Matrix
    T_scan_ct_by_images: Matrix | None = None
    wound_m: tuple[Point, ...] = ()
    regions: tuple[Region, ...] = ()
    taken_away: tuple[int, ...] = ()


KIND = JobKind(
    name="fuse",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.fuse.compute:fuse",
    words="ground-truth mesh",
    version=4,  # leaves no face turned over; compares two million samples of a larger surface, not all
    order=65,
    demand=lambda _: Demand(memory_mb=1500, limit_s=7200),
)
