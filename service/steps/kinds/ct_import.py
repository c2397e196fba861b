"""Step kind `ct_import`: stores a CT series and its segmentation, computes its surface and finds the spheres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np

from drivers.interfaces import CtSeries, CtSource, CtVolume
from service.computations.records import Point, SphereDetails
from service.computations.scans import CT_SURFACE, LOCATE_SPHERES, CtSurfaceArguments, LocateSpheresArguments
from service.core.errors import DataError
from service.core.records.base import ArtefactRef, Record
from service.core.step_params import NeededDevice, RepeatedStep, StepParams
from service.core.units import metres, mm
from service.steps.arrivals import keep_array, keep_clean, keep_mesh, layout_uncertainties, wait_for
from service.steps.context import Announcement, JobRequest, StepContext, StepKind, StepOutcome
from service.steps.measures import Count, Measure, SphereMeasures


class Params(StepParams):
    """The files and spheres to expect from the CT suite."""

    gives: ClassVar = "ct_surface"
    repeated: ClassVar = RepeatedStep("Put another series into the CT folder and import it")

    # mesh: segmented by other software (Mimics STL); segmentation: a series, and a DICOM SEG or NIfTI file of it
    source: Literal["dicom", "mesh", "segmentation"] = "dicom"
    segments: tuple[str, ...] = ()  # the segmentation's labels, in NIfTI files numbers; empty: all
    threshold_hu: float = -450.0  # half way between air and tissue or plastic: unbiased surfaces
    spheres: int  # number of registration and control spheres in the volume
    wait_s: float = 600.0  # longest wait until the series is complete

    @property
    def needed_devices(self) -> tuple[NeededDevice, ...]:
        """A CT source."""
        return (NeededDevice("ct"),)


class Measures(SphereMeasures):
    """The measures of the series, and of the spheres in its surface."""

    slices: Annotated[Count, "slices of the series"] = None
    images_elsewhere: Annotated[
        Count, "images of the acquisition beyond those of the series: of another reconstruction, or missing"
    ] = None
    cut_by_ends_mm2: Annotated[
        float | None,
        Measure("mm²", 1, 1e6),
        "area between the spheres that the first and the last slice cut: above 0 if the object goes on beyond them",
    ] = None
    slice_spacing_mm: Annotated[float | None, Measure("mm", 0.01, 10), "distance between slices"] = None
    voxel_mm: Annotated[float | None, Measure("mm", 0.01, 10), "longest side of a voxel"] = None
    label_voxels: Annotated[Count, "voxels of the segments"] = None
    label_contrast_hu: Annotated[
        float | None,
        Measure("HU", 100, 5000),
        "least difference between a segmented sphere and its surroundings in the series",
    ] = None
    surface_faces: Annotated[Count, "faces of the surface computed from the series"] = None


class Result(Record):
    """The spheres in the CT frame, metres."""

    spheres_m: tuple[Point, ...]
    details: SphereDetails


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Wait for a series without faults (or a mesh), store its files, and let the worker find the spheres."""
    request, kept, measures = (_mesh if params.source == "mesh" else _series)(context, params)
    (answer,) = context.evidence.run_jobs(request)
    result = Result.model_validate(answer.result)
    uncertainties = layout_uncertainties(result.details.layout)
    measured = Measures.read({**measures, **answer.measures})
    return StepOutcome(measured, kept + answer.artefacts, result, uncertainties, (answer.source,))


def _mesh(context: StepContext, params: Params) -> tuple[JobRequest, tuple[ArtefactRef, ...], Mapping[str, float]]:
    """Store a mesh that was segmented elsewhere: the job on it, the stored files, and its measures."""
    ct = context.devices.ct()
    scan = ct.read_mesh(wait_for(context, ct.segmented_meshes, params.wait_s, "a segmented CT mesh", ct.report))
    mesh, kept = keep_mesh(context, scan, device="ct", kind="ct_mesh")
    radius_m = metres(context.protocol.spheres.radius_mm)
    arguments = LocateSpheresArguments(mesh=mesh.sha256, radius_m=radius_m, expected=params.spheres)
    return JobRequest.of(LOCATE_SPHERES, arguments), kept, {}


def _series(context: StepContext, params: Params) -> tuple[JobRequest, tuple[ArtefactRef, ...], Mapping[str, float]]:
    """Store a series: the job on it, the stored files, and its measures."""
    ct = context.devices.ct()
    series = wait_for(context, lambda: _sound(ct), params.wait_s, "a CT series without faults", ct.report)
    volume = ct.read(series)
    labels, found = _labels(context, params, volume)
    kept = keep_clean(context, ct, series.files, device="ct", kind="ct_slice")
    array = keep_array(context, volume.hounsfield, device="ct", kind="ct_volume", name="hounsfield.npy")
    arguments = CtSurfaceArguments(
        radius_m=metres(context.protocol.spheres.radius_mm),
        expected=params.spheres,
        slices=tuple(ref.sha256 for ref in kept),
        hounsfield=array.sha256,
        T_ct_voxel=volume.T_ct_voxel.tolist(),
        threshold_hu=params.threshold_hu,
        measure_cut=True,
    )
    if labels:
        arguments = arguments.model_copy(update={"labels": labels[-1].sha256})
    if series.acquired_images is not None:
        found = {**found, "images_elsewhere": float(max(0, series.acquired_images - series.slices))}
    measures = {
        **found,
        "slices": float(series.slices),
        "slice_spacing_mm": round(mm(volume.spacing_m[2]), 6),  # DICOM gives positions with six decimal places
        "voxel_mm": round(mm(max(volume.spacing_m)), 6),
    }
    return JobRequest.of(CT_SURFACE, arguments), kept + labels, measures


def _labels(
    context: StepContext, params: Params, volume: CtVolume
) -> tuple[tuple[ArtefactRef, ...], Mapping[str, float]]:
    """Store the segmentation of a series: its file and the decoded array, in this order, and its measures."""
    if params.source != "segmentation":
        return (), {}
    ct = context.devices.ct()
    file = wait_for(context, ct.segmentations, params.wait_s, "a segmentation of the CT series", ct.report)
    labels = ct.read_labels(file, volume, params.segments)
    kept = keep_clean(context, ct, file.files, device="ct", kind="ct_segmentation")
    array = keep_array(context, labels.inside, device="ct", kind="ct_labels", name="labels.npy")
    context.note("segments", names=list(labels.segments))
    return (*kept, array), {"label_voxels": float(np.count_nonzero(labels.inside))}


def _sound(ct: CtSource) -> Sequence[CtSeries]:
    """Return the series without faults, oldest first.

    Raises DataError if the newest is one of several in the same frame of reference, such as the products of one
    acquisition of a photon-counting suite: all show the specimen, with other values.
    """
    found = [series for series in ct.series() if not series.problems and series.slices > 1]
    frame = found[-1].frame_of_reference if found else ""
    alike = [series for series in found if frame and series.frame_of_reference == frame]
    if len(alike) > 1:
        names = "; ".join(f"{series.description or series.uid} ({series.slices} slices)" for series in alike)
        raise DataError(
            f"{len(alike)} series show the specimen in the same frame of reference, and nothing says which to use: "
            f"{names}",
            where="the CT folder",
            remedy="Take the others out of the CT folder, then confirm; for the next run, name the one to use in "
            "rig.yaml (series: a part of its description)",
        )
    return found


KIND = StepKind(
    "ct_import",
    Params,
    Measures,
    Result,
    execute,
    words=lambda _params, _before: Announcement(
        "import the CT series", "Nothing moves. The software waits for the series."
    ),
    drawing="transport",
)
