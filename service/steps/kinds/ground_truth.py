"""Step kind `ground_truth`: fuses CT and scan into the mesh of the data set; checks that both are in one frame.

Both of the paper's ways bring the CT to the scan: from sphere to sphere, and by the image-based registration, which
runs for each of the two meshes with the same outlines and camera poses. The first is used, the second checks it.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from service.computations import fuse
from service.computations.kind import read_part
from service.computations.records import Mounting, Point, PosedPhotograph, has_poses
from service.computations.registration import REGISTER
from service.computations.scans import LOCATE_SPHERES
from service.core.errors import ConfigurationError
from service.core.jobs import Each, Jobs, Reference, jobs_of
from service.core.records.base import Record
from service.core.run.state import JobState
from service.core.step_params import NAMES_CT, NAMES_REGISTRATION, NAMES_SCAN, RepeatedStep, StepParams
from service.core.units import metres
from service.steps.context import EarlierAnswer, JobRequest, StepContext, StepKind, StepOutcome
from service.steps.measures import Count, Deg, ErrorMm, Measure, MeasureRecord, Share
from service.steps.registration import decisive
from service.steps.registration_jobs import recorded_registration_jobs


class _Posed(Mounting):
    """The images and the source of their poses, as a registration received them."""

    images: tuple[PosedPhotograph, ...]
    poses: str


def with_located_images(registered: JobState, jobs: Jobs) -> JobRequest:
    """Return a registration's request for another mesh, whose images stand where the first one's spheres placed them.

    The request is unchanged where their poses were known before: by an arm, from a capture by hand, or by structure
    from motion.
    Otherwise each mesh would locate the images by its own spheres, in its own frame, and the two could not be
    compared.

    Args:
        registered: the finished job `register` of the first mesh.
        jobs: the run's jobs, for references.
    """
    recorded = dict(registered.arguments)
    known = read_part(_Posed, recorded, jobs)
    if known.poses == "spheres" and not has_poses(known, known.images):
        found = REGISTER.read_answer(registered.result).T_scan_camera
        recorded["images"] = [
            image.plain() | {"T_scene_camera": Reference(registered.job, f"result/T_scan_camera/{name}").record()}
            for image in known.images
            if (name := image.viewpoint) in found
        ]
    return JobRequest(REGISTER.name, recorded, version=REGISTER.version)


# Sources of poses that place each mesh by its own spheres, the more certain ones first.
_SOURCES = ("robot_corrected", "spheres", "robot", "triangulated", "colmap", "glomap")
_DRAWN_BELOW_M, _DRAWN_ABOVE_M = 0.04, 0.005  # depth of a drawn region about its corners
_Mm = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class WoundRegion(Record):
    """A part of space whose source a person chooses, against the proposal: an extruded polygon or a box."""

    source: Literal["ct", "scan"] = "ct"  # the source that counts there
    frame: fuse.Frame = "world"  # the frame of the positions; world: the base of the first station
    corners_mm: tuple[Point, ...] = ()  # the corners of a polygon, in order: x, y, z
    along: Point | None = None  # the direction from the polygon to its viewer; None: away from the table
    below_mm: float = 40.0  # the polygon's reach below its lowest corner
    above_mm: float = 5.0  # the polygon's reach above its highest corner
    centre_mm: Point | None = None  # the centre of a box along the axes of the frame
    size_mm: Point | None = None  # the size of the box

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        box = self.centre_mm is not None and self.size_mm is not None
        if box == bool(self.corners_mm) or (self.corners_mm and len(self.corners_mm) < 3):
            raise ValueError("a region is either a polygon of at least three corners_mm or a box: centre_mm, size_mm")
        return self


class Params(StepParams):
    """The surfaces that are fused, and how."""

    gives: ClassVar = "ground_truth"
    repeated: ClassVar = RepeatedStep("Correct the wound's region, then fuse again", same=True, device=False)

    ct: Annotated[str, NAMES_CT]  # step that imported the CT
    scan: Annotated[str, NAMES_SCAN]  # step that imported the scan
    # Step whose camera poses place both meshes; None: by the spheres alone.
    registration: Annotated[str | None, NAMES_REGISTRATION] = None
    blend_mm: _Mm = 3.0  # width of the overlap over which the mesh changes from the CT to the scan
    chamfer_spacing_mm: _Mm = 0.1  # the spacing of the samples for the Chamfer distance
    cut_posts_mm: _Mm | None = None  # cuts out spheres, and posts of this radius below them; None: they stay
    wound: tuple[WoundRegion, ...] = ()  # corrections of the proposed wound; a later one overrules an earlier one


class Measures(MeasureRecord):
    """The measures of CT and scan in one frame, and of the fused mesh."""

    spheres_compared: Annotated[Count, "spheres found in both CT and scan"] = None
    spheres_moved: Annotated[Count, "spheres that moved by more than their uncertainty explains"] = None
    sphere_distance_change_max_mm: Annotated[
        ErrorMm, "largest change of a distance between two spheres from the CT to the scan: of the transport"
    ] = None
    sphere_distance_change_rms_mm: Annotated[ErrorMm, "rms change of the distances between the spheres"] = None
    spheres_rms_mm: Annotated[ErrorMm, "rms distance of the spheres of CT and scan after the registration"] = None
    loop_closure_mm: Annotated[
        ErrorMm, "largest displacement of a sphere around the loop from scan to CT by spheres and back by cameras"
    ] = None
    loop_closure_rms_mm: Annotated[
        ErrorMm, "rms displacement of the spheres around the loop from scan to CT and back"
    ] = None
    loop_closure_deg: Annotated[Deg, "rotation around the loop from scan to CT by spheres and back by cameras"] = None
    chamfer_ct_scan_mm: Annotated[ErrorMm, "Chamfer distance of CT and scan as the paper defines it"] = None
    chamfer_floor_mm: Annotated[ErrorMm, "Chamfer distance that equal surfaces would have, by the sampling alone"] = (
        None
    )
    ct_to_scan_mm: Annotated[ErrorMm, "mean distance from the CT to the scan"] = None
    scan_to_ct_mm: Annotated[ErrorMm, "mean distance from the scan to the CT, with what only the scan shows"] = None
    ct_to_scan_median_mm: Annotated[ErrorMm, "median distance from the CT to the scan"] = None
    scan_to_ct_median_mm: Annotated[ErrorMm, "median distance from the scan to the CT"] = None
    ct_above_scan_mm: Annotated[
        float | None, Measure("mm", -20, 20), "median height of the CT above the scan where both are good"
    ] = None
    ct_spread_mm: Annotated[ErrorMm, "robust standard deviation of the height of the CT above the scan"] = None
    ct_share: Annotated[Share, "share of the vertices that come from the CT"] = None
    scan_share: Annotated[Share, "share of the vertices that come from the scan"] = None
    blend_share: Annotated[Share, "share of the vertices between the two"] = None
    wound_share: Annotated[Share, "share of the vertices in the wound's region"] = None
    sigma_median_mm: Annotated[ErrorMm, "median of the stated standard deviations of the vertices"] = None
    ground_truth_vertices: Annotated[Count, "vertices of the fused mesh"] = None
    ground_truth_faces: Annotated[Count, "faces of the fused mesh"] = None
    folded_faces: Annotated[Count, "faces that were turned over by the fusion"] = None


class Result(Record):
    """The ground truth's making, as the job reports it. Without a CT nothing is fused: the scan is the truth."""

    without: str = ""  # the skipped step that it would need
    registration: str = ""  # name of the registration that closed the loop
    details: fuse.Answer | None = None


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Register the CT by the images as the scan was, and fuse both."""
    skipped = next((step for step in (params.ct, params.scan) if step in context.run.skipped), None)
    if skipped is not None:
        return StepOutcome(Measures(), (), Result(without=skipped))
    ct = context.earlier_answer(params.ct, LOCATE_SPHERES)
    scan = context.earlier_answer(params.scan, LOCATE_SPHERES)
    arguments = fuse.Arguments(
        ct_mesh=context.earlier_artefact(params.ct, "ct_mesh").sha256,
        scan_mesh=context.earlier_artefact(params.scan, "scan_mesh").sha256,
        ct=ct.answer,
        scan=scan.answer,
        radius_m=metres(context.protocol.spheres.radius_mm),
        blend_m=metres(params.blend_mm),
        spacing_m=metres(params.chamfer_spacing_mm),
        regions=_regions(context, params),
        simulated=context.run.simulated,
    )
    if params.cut_posts_mm is not None:
        arguments = arguments.model_copy(update={"post_radius_m": metres(params.cut_posts_mm)})
    references: dict[str, Reference | Each | None] = {"ct": ct.reference(""), "scan": scan.reference("")}
    name = ""
    if params.registration is not None:
        name, of_scan, of_ct = _registrations(context, params.registration, ct)
        both = {"ct_registration": of_ct, "scan_registration": of_scan}
        arguments = arguments.model_copy(
            update={field: REGISTER.read_answer(job.result) for field, job in both.items()}
        )
        references |= {field: Reference(job.job, "result") for field, job in both.items()}
    (answer,) = context.evidence.run_jobs(JobRequest.of(fuse.KIND, arguments, references))
    result = Result(registration=name, details=fuse.KIND.read_answer(answer.result))
    return StepOutcome(Measures.read(answer.measures), answer.artefacts, result, computed_by=(answer.source,))


def _regions(context: StepContext, params: Params) -> tuple[fuse.Region, ...]:
    """Return the regions of the protocol, then those that people drew for this step on the 3D view."""
    author = f"protocol {context.protocol.id} {context.protocol.version}"
    drawn = (found for found in context.run.drawn if found.region.step == context.step.id)
    return (
        *(_region(region, author) for region in params.wound),
        *(
            fuse.Region(
                source=found.region.source,
                frame="scan",
                by=found.by,
                corners_m=found.region.corners_m,
                along=found.region.seen_along,
                below_m=_DRAWN_BELOW_M,
                above_m=_DRAWN_ABOVE_M,
            )
            for found in drawn
        ),
    )


def _region(region: WoundRegion, author: str) -> fuse.Region:
    def scaled(point: Point) -> Point:
        x, y, z = (metres(value) for value in point)
        return x, y, z

    of_box = {"centre_m": region.centre_mm, "size_m": region.size_mm}
    shape: dict[str, Any] = {name: scaled(point) for name, point in of_box.items() if point is not None}
    if region.corners_mm:
        shape = {
            "corners_m": tuple(scaled(corner) for corner in region.corners_mm),
            "below_m": metres(region.below_mm),
            "above_m": metres(region.above_mm),
        }
        if region.along is not None:
            shape["along"] = region.along
    return fuse.Region(source=region.source, frame=region.frame, by=author, **shape)


def _registrations(context: StepContext, step: str, ct: EarlierAnswer[Any]) -> tuple[str, JobState, JobState]:
    """Return the name of the registration that is used, its job for the scan, and the same for the CT."""
    found = recorded_registration_jobs(context.protocol, context.run, context.protocol.step(step))
    arrived = {} if found is None else found.arrived
    waited = decisive(context.protocol, context.protocol.step(step))
    name = next((name for name in _SOURCES if name in arrived and name in waited), None)
    if name is None:
        raise ConfigurationError(
            f"no registration of step {step!r} places the scan by its spheres",
            where=f"step {context.step.id}",
            remedy="Leave out `registration` of the step: CT and scan are then registered by the spheres alone",
        )
    mine = arrived[name]
    # The same job as the scan's, with the spheres of the CT instead of the scan's.
    of_ct = {
        "spheres_m": ct.answer.spheres_m,
        "sphere_covariance_m2": tuple(sphere.covariance_m2 for sphere in ct.answer.details.spheres),
    }
    references = {"spheres_m": "spheres_m", "sphere_covariance_m2": "details/spheres/*/covariance_m2"}
    recorded = dict(with_located_images(mine, jobs_of(context.run)).arguments)
    recorded.pop("state_pose_errors", None)  # no image is placed by the CT
    for field, path in references.items():
        reference = ct.reference(path)
        recorded[field] = of_ct[field] if reference is None else reference.record()
    request = JobRequest(REGISTER.name, recorded, version=REGISTER.version)
    context.evidence.run_jobs(request)
    jobs = [job for job in context.evidence.jobs(context.step.id) if job.kind == REGISTER.name]
    return name, mine, next(job for job in reversed(jobs) if job.status == "finished")


KIND = StepKind(
    "ground_truth",
    Params,
    Measures,
    Result,
    execute,
)
