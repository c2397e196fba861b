"""Coloured surfaces of a data set: how many views see it, and how far the scan is from the CT."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.ground_truth.distances.chamfer import ChamferSettings, chamfer
from service.compute.ground_truth.distances.heat_map import HeatScale, heat_picture
from service.compute.ground_truth.distances.neighbours import PointIndex
from service.compute.ground_truth.surface import Surface
from service.compute.pixels.coverage import covered_shares
from service.compute.surfaces.constellations import match_constellations
from service.core.errors import DataError
from service.core.geometry import Array, Transform
from service.core.units import metres, mm
from service.dataset.posed.records import DataSet, Mesh
from service.dataset.preview.records import AT_LEAST, ShownCoverage, ShownDistances, put
from service.dataset.registrations import last_result
from service.dataset.scene_view import MeshColours, Scene, SceneMesh, SceneSphere, decimated, scene_json
from service.dataset.summary import RunSummary
from service.jobs.records import SpheresFound

_SPACING_M = 5e-4  # coarser than the paper's 0.1 mm: it is for looking
_SAMPLES = 3_000_000  # of each surface at most; a larger one is sampled more coarsely
_FULL_M = 2e-3  # end of the colours: parts that only one of the two shows do not use them up


@dataclass(frozen=True, slots=True)
class Simplified:
    """The mesh for the screen: points (V, 3) in metres, triangles (F, 3)."""

    points_m: Array
    triangles: NDArray[np.int64]

    @classmethod
    def of(cls, mesh: Mesh) -> Simplified:
        """About as many triangles as a browser draws smoothly."""
        return cls(*decimated(mesh.vertices_m, mesh.faces))


def shown_coverage(
    folder: Path, summary: RunSummary, dataset: DataSet, mesh: Simplified, counts: NDArray[np.int64]
) -> ShownCoverage:
    """Write the mesh coloured by the number of views (V,) that see it, with the cameras."""
    poses = {view.name: view.T_world_camera for view in dataset.views}
    colours = MeshColours(counts.astype(np.float64), "views that see it", "%{intensity:.0f} views")
    figure = scene_json(_scene(summary, mesh, colours, poses))
    shares = covered_shares(counts, mesh.points_m, mesh.triangles, AT_LEAST)
    return ShownCoverage(shares, put(folder, "coverage.json", figure.encode()))


def shown_distances(folder: Path, summary: RunSummary, mesh: Simplified) -> ShownDistances:
    """Compare the CT with the scan, brought together by their spheres, and write both coloured by their distance.

    Raises:
        DataError: the run has no CT.
        ComputeError: the spheres of the two do not agree, or the surfaces are not near each other.
    """
    refs, scan_spheres = summary.artefacts("ct_mesh"), np.array(summary.scan_spheres_m())
    found = last_result(summary.protocol, summary.state, "ct_surface", SpheresFound)
    if not refs or found is None:
        raise DataError("the run has no CT", where=summary.run_id)
    match = match_constellations(scan_spheres, np.array(found.spheres_m))
    ct = Surface.kept(summary.store.artefact_path(refs[-1].sha256)).moved(match.T_a_b)
    vertices_m, faces = summary.scan_mesh()  # not the data set's mesh, in which both may be fused
    scan = Surface(np.asarray(vertices_m, np.float64), np.asarray(faces, np.int64))
    spacing_m = max(_SPACING_M, float(np.sqrt(max(ct.area_m2, scan.area_m2) / _SAMPLES)))
    settings = ChamferSettings(spacing_m=spacing_m, to_faces=False)
    score = chamfer(ct, scan, settings)
    scale = HeatScale(_FULL_M, settings.outlier_m)
    picture = heat_picture(ct, scan, score, scale, ("CT", "scan"))
    distance_m, _ = PointIndex(score.pred.samples.points_m).nearest(mesh.points_m)
    values = mm(np.minimum(distance_m, scale.full_m))
    title = f"distance to the CT (mm, at most {mm(scale.full_m):g})"
    figure = scene_json(_scene(summary, mesh, MeshColours(values, title, "%{intensity:.3f} mm"), {}))
    n = score.pred_to_gt.n + score.gt_to_pred.n
    _, encoded = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, 88))
    return ShownDistances(
        chamfer_mm=mm(score.chamfer_m),
        ct_to_scan_mm=mm(score.pred_to_gt.mean_m),
        scan_to_ct_mm=mm(score.gt_to_pred.mean_m),
        ct_to_scan_median_mm=mm(score.pred_to_gt.median_m),
        scan_to_ct_median_mm=mm(score.gt_to_pred.median_m),
        floor_mm=mm(score.floor_m),
        excluded=(score.pred_to_gt.excluded + score.gt_to_pred.excluded) / max(n, 1),
        outlier_mm=mm(settings.outlier_m),
        spacing_mm=mm(spacing_m),
        spheres=len(match.pairs),
        spheres_rms_mm=mm(match.rms_m),
        figure=put(folder, "distances.json", figure.encode()),
        picture=put(folder, "distances.jpg", encoded.tobytes()),
    )


def _scene(summary: RunSummary, mesh: Simplified, colours: MeshColours, poses: dict[str, Transform]) -> Scene:
    """The coloured mesh with its spheres, and cameras if there are poses."""
    centres = summary.scan_spheres_m()
    spheres = [SceneSphere(str(k), "registration", centre) for k, centre in enumerate(centres)]
    shown = SceneMesh(mesh.points_m, mesh.triangles, colours=colours)
    radius_m = metres(summary.protocol.spheres.radius_mm)
    return Scene(poses, dict.fromkeys(poses, ""), spheres, radius_m, shown)
