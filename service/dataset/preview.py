"""Makes the preview of a run's data set, piece by piece: small pictures, and surfaces coloured by what is known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.computations.records import SpheresFound
from service.compute.camera_model import CameraModel
from service.compute.images.render import covered_shares, seen_points
from service.compute.images.views import FULL_HD, ImageCrop, marker_free_crops
from service.compute.surfaces.chamfer import ChamferSettings, chamfer, sample
from service.compute.surfaces.constellations import match_constellations
from service.compute.surfaces.fuse import Source
from service.compute.surfaces.heat_map import HeatScale, heat_picture
from service.compute.surfaces.surface import PointIndex, Surface, read_ply
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform
from service.core.units import metres, mm
from service.dataset.preview_records import (
    AT_LEAST,
    CoveragePreview,
    CropPreview,
    DecidedRegion,
    DistancePreview,
    GroundTruthPreview,
    Preview,
    ViewPreview,
    put,
    write_preview,
)
from service.dataset.records import DataSet, Mesh, Pixels, PosedView
from service.dataset.registrations import last_result
from service.dataset.run_data_set import data_set_of, specimen_pixels
from service.dataset.scene_view import MeshColours, Scene, SceneMesh, SceneSphere, decimated, scene_json
from service.dataset.summary import MESH, RecordedFusion, RunSummary, recorded_fusion

PICTURE = "fusion_picture"  # kind of its artefact
_HIGH = 99.0  # percentile of the sigmas at the end of the colours
#: What a vertex can come from, in the order of the colours; the names and colours of the fusion's picture.
_PARTS = ((Source.CT, "CT", "#d65e00"), (Source.BLEND, "blend", "#f0e442"), (Source.SCAN, "scan", "#0072b2"))


@dataclass(frozen=True, slots=True)
class VertexFigures:
    """Colours of points on the mesh, for their source and for their standard deviation."""

    sources: MeshColours
    sigmas: MeshColours


def shown_ground_truth(fusion: RecordedFusion, sources: str, sigmas: str, sigma_high_mm: float) -> GroundTruthPreview:
    """Return the figures of a fusion as it was recorded, with the names of the files of its two coloured meshes."""
    measures = fusion.measures
    return GroundTruthPreview(
        step=fusion.step,
        ct_share=measures["ct_share"],
        scan_share=measures["scan_share"],
        blend_share=measures["blend_share"],
        sigma_median_mm=measures["sigma_median_mm"],
        sigma_high_mm=sigma_high_mm,
        distance_change_max_mm=measures["sphere_distance_change_max_mm"],
        loop_closure_mm=measures.get("loop_closure_mm"),
        faces=int(measures["ground_truth_faces"]),
        regions=tuple(DecidedRegion(region.source, region.by) for region in fusion.answer.regions),
        sources=sources,
        sigmas=sigmas,
    )


def vertex_figures(path: Path, points_m: Array) -> tuple[VertexFigures, float]:
    """Return source and sigma at points (V, 3) of the mesh, those of the nearest vertices, and a high sigma, mm.

    Args:
        path: file of the recorded mesh, a PLY in millimetres with `source` and `sigma_mm` at each vertex.
        points_m: (V, 3) points of a simplified mesh in the same frame.

    Raises:
        DataError: it has no such properties.
    """
    columns, _ = read_ply(path)
    if not {"source", "sigma_mm"} <= set(columns):
        raise DataError("the ground truth's mesh has neither source nor sigma", where=path.name)
    vertices_m = metres(np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1))
    _, nearest = PointIndex(vertices_m).nearest(points_m)
    sigma_mm = columns["sigma_mm"].astype(np.float64)
    high_mm = float(np.percentile(sigma_mm, _HIGH))
    places = np.zeros(len(Source))
    for place, (source, _, _) in enumerate(_PARTS):
        places[source] = place
    values = places[columns["source"].astype(np.int64)][nearest]
    classes = tuple((name, colour) for _, name, colour in _PARTS)
    return VertexFigures(
        MeshColours(values, "source", "", classes),
        MeshColours(np.minimum(sigma_mm[nearest], high_mm), "stated sigma (mm)", "%{intensity:.3f} mm"),
    ), high_mm


_SPACING_M = 5e-4  # coarser than the paper's 0.1 mm: it is for looking
_SAMPLES = 3_000_000  # of each surface at most; a larger one is sampled more coarsely
_FULL_M = 2e-3  # end of the colours: parts that only one of the two shows do not use them up


@dataclass(frozen=True, slots=True)
class SimplifiedMesh:
    """The mesh for the screen: points (V, 3) in metres, triangles (F, 3)."""

    points_m: Array
    triangles: NDArray[np.int64]

    @classmethod
    def of(cls, mesh: Mesh) -> SimplifiedMesh:
        """Simplify a mesh to about as many triangles as a browser draws smoothly."""
        return cls(*decimated(mesh.vertices_m, mesh.faces))


def shown_coverage(
    folder: Path, summary: RunSummary, dataset: DataSet, mesh: SimplifiedMesh, counts: NDArray[np.int64]
) -> CoveragePreview:
    """Write the mesh coloured by the number of views (V,) that see it, with the cameras."""
    poses = {view.name: view.T_world_camera for view in dataset.views}
    colours = MeshColours(counts.astype(np.float64), "views that see it", "%{intensity:.0f} views")
    figure = scene_json(_scene(summary, mesh, colours, poses))
    shares = covered_shares(counts, mesh.points_m, mesh.triangles, AT_LEAST)
    return CoveragePreview(shares, put(folder, "coverage.json", figure.encode()))


def fused_mesh(folder: Path, summary: RunSummary, fusion: RecordedFusion, mesh: SimplifiedMesh) -> GroundTruthPreview:
    """Write the fused mesh coloured by source and by standard deviation. Raises DataError if it has neither."""
    figures, high_mm = vertex_figures(summary.store.artefact_path(fusion.files[MESH].sha256), mesh.points_m)
    sources, sigmas = (
        put(folder, f"{name}.json", scene_json(_scene(summary, mesh, colours, {})).encode())
        for name, colours in (("sources", figures.sources), ("sigmas", figures.sigmas))
    )
    return shown_ground_truth(fusion, sources, sigmas, high_mm)


def shown_distances(folder: Path, summary: RunSummary, fusion: RecordedFusion | None) -> DistancePreview:
    """Return how far CT and scan are from each other, and the scan coloured by it.

    The figures and the picture are those that the fusion recorded. Without a fusion, CT and scan are brought together
    by their spheres and compared here, for the screen alone.

    Raises:
        DataError: the run has no CT.
        ComputeError: the spheres of the two do not agree, or the surfaces are not near each other.
    """
    refs = summary.artefacts("ct_mesh")
    if not refs:
        raise DataError("the run has no CT", where=summary.run_id)
    ct = Surface.kept(summary.store.artefact_path(refs[-1].sha256))
    vertices_m, faces = summary.scan_mesh()  # not the data set's mesh, in which both may be fused
    scan = Surface(np.asarray(vertices_m, np.float64), np.asarray(faces, np.int64))
    if fusion is None:
        return _compared(folder, summary, ct, scan)
    ct = ct.moved(np.array(fusion.answer.T_scan_ct))
    samples = sample(ct, _spacing_m(ct, scan), np.random.default_rng(0))
    figure = _distance_figure(folder, summary, scan, samples.points_m)
    picture = cv2.imread(str(summary.store.artefact_path(fusion.files[PICTURE].sha256)))
    if picture is None:
        raise DataError("the recorded picture of the fusion cannot be read", where=summary.run_id)
    m = fusion.measures
    return DistancePreview(
        chamfer_mm=m["chamfer_ct_scan_mm"],
        ct_to_scan_mm=m["ct_to_scan_mm"],
        scan_to_ct_mm=m["scan_to_ct_mm"],
        ct_to_scan_median_mm=m["ct_to_scan_median_mm"],
        scan_to_ct_median_mm=m["scan_to_ct_median_mm"],
        floor_mm=m["chamfer_floor_mm"],
        excluded=None,
        outlier_mm=mm(ChamferSettings().outlier_m),
        spacing_mm=mm(fusion.spacing_m),
        spheres=int(m["spheres_compared"]),
        spheres_rms_mm=m["spheres_rms_mm"],
        figure=figure,
        picture=_put_picture(folder, np.asarray(picture, dtype=np.uint8)),
        step=fusion.step,
    )


def _compared(folder: Path, summary: RunSummary, ct: Surface, scan: Surface) -> DistancePreview:
    """Return CT and scan, aligned by their spheres and compared, and the CT in its own frame."""
    found = last_result(summary.protocol, summary.state, "ct_surface", SpheresFound)
    if found is None:
        raise DataError("the run has no CT", where=summary.run_id)
    match = match_constellations(np.array(summary.scan_spheres_m()), np.array(found.spheres_m))
    ct = ct.moved(match.T_a_b)
    settings = ChamferSettings(spacing_m=_spacing_m(ct, scan), to_faces=False)
    score = chamfer(ct, scan, settings)
    picture = heat_picture(ct, scan, score, HeatScale(_FULL_M, settings.outlier_m), ("CT", "scan"))
    n = score.pred_to_gt.n + score.gt_to_pred.n
    return DistancePreview(
        chamfer_mm=mm(score.chamfer_m),
        ct_to_scan_mm=mm(score.pred_to_gt.mean_m),
        scan_to_ct_mm=mm(score.gt_to_pred.mean_m),
        ct_to_scan_median_mm=mm(score.pred_to_gt.median_m),
        scan_to_ct_median_mm=mm(score.gt_to_pred.median_m),
        floor_mm=mm(score.floor_m),
        excluded=(score.pred_to_gt.excluded + score.gt_to_pred.excluded) / max(n, 1),
        outlier_mm=mm(settings.outlier_m),
        spacing_mm=mm(settings.spacing_m),
        spheres=len(match.pairs),
        spheres_rms_mm=mm(match.rms_m),
        figure=_distance_figure(folder, summary, scan, score.pred.samples.points_m),
        picture=_put_picture(folder, picture),
    )


def _spacing_m(ct: Surface, scan: Surface) -> float:
    return max(_SPACING_M, float(np.sqrt(max(ct.area_m2, scan.area_m2) / _SAMPLES)))


def _distance_figure(folder: Path, summary: RunSummary, scan: Surface, ct_points_m: Array) -> str:
    """Write the scan coloured by its distance to points (N, 3) on the CT. Returns the file's name."""
    shown = SimplifiedMesh(*decimated(scan.vertices_m, scan.faces))
    distance_m, _ = PointIndex(ct_points_m).nearest(shown.points_m)
    title = f"distance to the CT (mm, at most {mm(_FULL_M):g})"
    colours = MeshColours(mm(np.minimum(distance_m, _FULL_M)), title, "%{intensity:.3f} mm")
    return put(folder, "distances.json", scene_json(_scene(summary, shown, colours, {})).encode())


def _put_picture(folder: Path, picture: NDArray[np.uint8]) -> str:
    _, encoded = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, 88))
    return put(folder, "distances.jpg", encoded.tobytes())


def _scene(summary: RunSummary, mesh: SimplifiedMesh, colours: MeshColours, poses: dict[str, Transform]) -> Scene:
    """Return the coloured mesh with its spheres, and cameras if there are poses."""
    centres = summary.scan_spheres_m()
    spheres = [SceneSphere(str(k), "registration", centre) for k, centre in enumerate(centres)]
    shown = SceneMesh(mesh.points_m, mesh.triangles, colours=colours)
    radius_m = metres(summary.protocol.spheres.radius_mm)
    return Scene(poses, dict.fromkeys(poses, ""), spheres, radius_m, shown, up=_up(summary))


def _up(summary: RunSummary) -> tuple[float, float, float] | None:
    """Return the way from the spheres to the cameras of the run's own registration; a scan's axes point anywhere."""
    own = summary.best()
    if own is None:
        return None
    eyes = np.array([np.array(T)[:3, 3] for T in summary.registrations()[own].T_scan_camera.values()])
    x, y, z = eyes.mean(axis=0) - np.array(summary.scan_spheres_m()).mean(axis=0)
    return float(x), float(y), float(z)


Progress = Callable[[str, int, int], None]  # activity, amount done, total


def make_preview(summary: RunSummary, folder: Path, progress: Progress) -> Preview:
    """Write pictures and figures of a run's data set into a folder.

    Args:
        summary: the run.
        folder: the preview's folder; it is made if it is not there, and its content is replaced.
        progress: a function that is called with the activity, the amount done and the total.

    Raises:
        DataError: there is no data set yet, or a photograph cannot be read.
    """
    progress("reading the run", 0, 0)
    dataset = data_set_of(summary)
    folder.mkdir(parents=True, exist_ok=True)
    wanted = partial(specimen_pixels, summary)
    preview = _begun(dataset, crop_size(dataset, wanted))
    write_preview(folder, preview)
    mesh = SimplifiedMesh.of(dataset.mesh)
    counts, views = np.zeros(len(mesh.points_m), dtype=np.int64), list(preview.views)
    for k, view in enumerate(dataset.views):
        progress("pictures", k, len(views))
        crops = marker_free_crops(wanted(view), dataset.pixels.markers(view), preview.crop, CROPS)
        views[k], small = small_pictures(folder, views[k], view, dataset.pixels, crops)
        counts += seen_points(mesh.points_m, small.camera, view.T_world_camera, small.depth_m)
        preview = dataclasses.replace(preview, views=tuple(views))
        write_preview(folder, preview)
    coverage = shown_coverage(folder, summary, dataset, mesh, counts)
    preview = dataclasses.replace(preview, coverage=coverage)
    write_preview(folder, preview)
    fusion = recorded_fusion(summary)
    if fusion is not None:
        progress("colouring the ground truth", 0, 0)
        truth = fused_mesh(folder, summary, fusion, mesh)
        preview = dataclasses.replace(preview, ground_truth=truth)
        write_preview(folder, preview)
    progress("comparing the CT with the scan", 0, 0)
    preview = dataclasses.replace(_with_distances(preview, folder, summary, fusion), whole=True)
    write_preview(folder, preview)
    return preview


def _begun(dataset: DataSet, crop: tuple[int, int]) -> Preview:
    """Return all views, with the names of the files that they will have."""
    named = dataset.splits.named()
    views = tuple(
        ViewPreview(
            name=view.name,
            width=view.camera.width,
            height=view.camera.height,
            splits=tuple(split for split, names in named.items() if view.name in names),
            thumbnail=f"v{k:04d}-thumb.jpg",
            image=f"v{k:04d}-image.jpg",
            depth=f"v{k:04d}-depth.webp",
        )
        for k, view in enumerate(dataset.views)
    )
    return Preview(views, crop)


def _with_distances(preview: Preview, folder: Path, summary: RunSummary, fusion: RecordedFusion | None) -> Preview:
    try:
        return dataclasses.replace(preview, distances=shown_distances(folder, summary, fusion))
    except (DataError, ComputeError) as error:
        return dataclasses.replace(preview, no_distances=error.what)


THUMBNAIL_PX, IMAGE_PX = 320, 1280  # widths
CROPS = 2  # of each view
_PREVIEW_PARTS = (2, 3, 4)  # of the sides of a small photograph
_ROUND = 8  # crops of small photographs have sides that are multiples of this
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 82)
_WEBP = (cv2.IMWRITE_WEBP_QUALITY, 80)
_NEAR, _FAR = 2.0, 98.0  # percentiles of the depth at the ends of the colours

Colours = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class SmallDepth:
    """Depth (H, W) of a view at the size of its small picture, z in metres, with its camera."""

    camera: CameraModel
    depth_m: NDArray[np.float32]


def crop_size(dataset: DataSet, wanted: Callable[[PosedView], Mask]) -> tuple[int, int]:
    """Return the full HD where that is within the photograph, else a half, a third or a quarter of its sides.

    The largest that is free of markers in one of three views; the smallest if none is.

    Args:
        dataset: whole photographs.
        wanted: (H, W) pixels of a view that show the specimen.
    """
    camera = dataset.views[0].camera
    sizes = [
        (camera.width // part // _ROUND * _ROUND, camera.height // part // _ROUND * _ROUND) for part in _PREVIEW_PARTS
    ]
    if camera.width >= FULL_HD[0] and camera.height >= FULL_HD[1]:
        sizes = [FULL_HD, *(size for size in sizes if size[0] < FULL_HD[0])]
    few = dataset.views[:: max(1, len(dataset.views) // 3)][:3]
    masks = [(wanted(view), dataset.pixels.markers(view)) for view in few]
    fitting = (size for size in sizes if any(marker_free_crops(*both, size, 1) for both in masks))
    return next(fitting, sizes[-1])


def small_pictures(
    folder: Path, shown: ViewPreview, view: PosedView, pixels: Pixels, crops: Sequence[ImageCrop]
) -> tuple[ViewPreview, SmallDepth]:
    """Write the pictures of a view. Returns the view with what they show, and its depth.

    Args:
        folder: the preview's folder.
        shown: the view, whose files are to be written.
        view: the same view in the data set.
        pixels: the pixels of the data set.
        crops: the crops of the view.

    Raises:
        DataError: the photograph cannot be read.
    """
    colours = pixels.colours(view)
    put(folder, shown.image, _encoded(".jpg", _reduced(colours, IMAGE_PX), _JPEG))
    put(folder, shown.thumbnail, _encoded(".jpg", _reduced(colours, THUMBNAIL_PX), _JPEG))
    small = small_camera(view.camera)
    depth_m = pixels.depth_m(dataclasses.replace(view, camera=small))
    near_m, far_m = _ends(depth_m)
    put(folder, shown.depth, _encoded(".webp", depth_colours(depth_m, near_m, far_m), _WEBP))
    parts = tuple(_part(folder, shown, colours, crop, number) for number, crop in enumerate(crops))
    told = dataclasses.replace(shown, near_mm=mm(near_m), far_mm=mm(far_m), crops=parts, ready=True)
    return told, SmallDepth(small, depth_m)


def small_camera(camera: CameraModel) -> CameraModel:
    """Return the camera of the small picture."""
    if camera.width <= IMAGE_PX:
        return camera
    return camera.scaled(IMAGE_PX, max(1, round(camera.height * IMAGE_PX / camera.width)))


def depth_colours(depth_m: NDArray[np.float32], near_m: float, far_m: float) -> Colours:
    """Colour a depth, (H, W, 4) blue, green, red, opacity: near is yellow, far violet, no surface transparent."""
    level = np.clip((far_m - depth_m) / max(far_m - near_m, 1e-9) * 255, 0, 255).astype(np.uint8)
    colours = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    return np.dstack([colours, np.where(depth_m > 0, 255, 0).astype(np.uint8)])


def _part(folder: Path, shown: ViewPreview, colours: Colours, crop: ImageCrop, number: int) -> CropPreview:
    """Write the small picture of a crop."""
    name = shown.thumbnail.replace("-thumb.", f"-crop{number}.")
    put(folder, name, _encoded(".jpg", _reduced(colours[crop.slices], THUMBNAIL_PX), _JPEG))
    return CropPreview(crop.x, crop.y, crop.width, crop.height, name)


def _ends(depth_m: NDArray[np.float32]) -> tuple[float, float]:
    some = depth_m[::4, ::4]
    some = some[some > 0]
    if not len(some):
        return 0.0, 0.0
    near, far = np.percentile(some, (_NEAR, _FAR))
    return float(near), float(far)


def _reduced(colours: Colours, width: int) -> Colours:
    if colours.shape[1] <= width:
        return colours
    size = (width, max(1, round(colours.shape[0] * width / colours.shape[1])))
    return np.asarray(cv2.resize(colours, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _encoded(suffix: str, picture: Colours, options: tuple[int, int]) -> bytes:
    done, data = cv2.imencode(suffix, picture, options)
    if not done:
        raise DataError("a picture of the preview cannot be encoded", where=suffix)
    return data.tobytes()
