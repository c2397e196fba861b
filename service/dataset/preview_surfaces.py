"""Makes the coloured surfaces of a preview: how many views see it, what it comes from, how far scan and CT differ."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.computations.records import SpheresFound
from service.compute.ground_truth.chamfer import ChamferSettings, chamfer, sample
from service.compute.ground_truth.distances import PointIndex
from service.compute.ground_truth.fuse import Source
from service.compute.ground_truth.heat_map import HeatScale, heat_picture
from service.compute.ground_truth.surface import Surface, read_ply
from service.compute.pixels.render import covered_shares
from service.compute.surfaces.constellations import match_constellations
from service.core.errors import DataError
from service.core.geometry import Array, Transform
from service.core.units import metres, mm
from service.dataset.preview_records import (
    AT_LEAST,
    CoveragePreview,
    DecidedRegion,
    DistancePreview,
    GroundTruthPreview,
    put,
)
from service.dataset.records import DataSet, Mesh
from service.dataset.registrations import last_result
from service.dataset.scene_view import MeshColours, Scene, SceneMesh, SceneSphere, decimated, scene_json
from service.dataset.summary import MESH, RecordedFusion, RunSummary

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
