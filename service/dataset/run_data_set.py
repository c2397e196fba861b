"""Makes the posed data set of a finished run from its record, with the files of the registered scan."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np

from drivers.meshes.companions import companion_names
from drivers.meshes.foreign_text import alike
from service.computations.records import SpheresFound
from service.computations.register import Registration
from service.compute.camera_model import CameraModel
from service.compute.pixels.masks import WorldSphere, hull_mask
from service.compute.pixels.render import RayMesh
from service.compute.pixels.views import splits
from service.core.errors import DataError
from service.core.geometry import Array, apply, inverse
from service.core.picture_files import PNG_BEGINS
from service.core.records.data_set import FIRST_VERSION, DataSetStatement
from service.core.units import metres
from service.dataset.about_run import about_run, described_run
from service.dataset.further_views import FurtherView, further_views
from service.dataset.pixels import Photographs
from service.dataset.posts import posts_of
from service.dataset.records import DataSet, Mesh, PosedView, ScanFile
from service.dataset.registrations import result_of_step
from service.dataset.summary import RunSummary, control_centres, control_scan, registered_scan
from service.dataset.view_covariances import view_covariances

_POINTS = 2000  # of the mesh, by which the sparse views are chosen


def data_set_of(
    summary: RunSummary,
    not_in_yet: Sequence[str] = (),
    *,
    personal: bool = True,
    stated: DataSetStatement | None = None,
    version: str = FIRST_VERSION,
) -> DataSet:
    """Return images, poses and mesh of a run in the frame of its scan, which is the data set's `world`.

    The poses are those of the run's own registration, with the camera that it was made with. Images that were taken
    for the evaluation alone are left out. Control spheres are masked in all images: they were taken away before the
    scan. So are posts, if the scan shows the board on which they stand.

    Args:
        summary: the run.
        not_in_yet: texts on results that have not arrived yet.
        personal: False leaves GPS, owner and serial numbers out of the pictures, people and serial numbers out of
            the metadata, and the scanner's own files, which may state anything, out altogether.
        stated: title, licence, ethics, creators and citation; they replace those of the protocol.
        version: the data set's version.

    Raises:
        DataError: the run has no evaluated registration, no scan, or no registered image.
    """
    own, registered, files = _registered(summary)
    truth = summary.ground_truth()
    mesh = truth.mesh
    stated_errors = view_covariances(summary, own, registered, sorted(files))
    taken = {capture.viewpoint: capture.optics.exif_time for capture in summary.captures()}
    first = [
        _view(name, path, registered, stated_errors.covariance[name], taken[name])
        for name, (path, _) in sorted(files.items())
    ]
    further = further_views(summary, {view.name: view.T_world_camera for view in first})
    joint = None if stated_errors.joint is None else further.joint(stated_errors.joint, sorted(files))
    covariances = further.covariances(stated_errors.covariance)
    files |= {one.name: (one.path, one.sha256) for one in further.views}
    views = _in_order([*first, *(_further_view(one, covariances[one.name]) for one in further.views)])
    pixels, masks = _pixels(summary, files, views, mesh, personal=personal)
    hashes = {view.file: files[view.name][1] for view in views}
    about = about_run(summary, own, not_in_yet, stated=stated, version=version, personal=personal)
    return DataSet(
        identity=_identity(summary, own, registered, {**hashes, "mesh": truth.sha256}),
        simulated=summary.root.simulated,
        statement={
            **described_run(summary, own, not_in_yet, personal=personal),
            "mesh": truth.words,
            "mesh_sha256": truth.sha256,
            "masks": masks,
            "pose_covariance": stated_errors.words,
            "image_sha256": hashes,
            "further_cameras": further.statement,
        },
        views=views,
        pixels=pixels,
        mesh=mesh,
        splits=further.with_them(splits({view.name: _sees(view, mesh) for view in first})),
        about=dataclasses.replace(
            about, masks=masks, mesh=f"{truth.words}, in the frame of the scan", covariance=stated_errors.words
        ),
        pose_errors=joint,
        scan_files=scan_files(summary) if personal else (),
    )


def specimen_pixels(summary: RunSummary, view: PosedView) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return which pixels (H, W) lie between the spheres, which stand around the specimen."""
    return hull_mask(view.camera, view.T_world_camera, np.array(summary.scan_spheres_m()))


def _registered(summary: RunSummary) -> tuple[str, Registration, dict[str, tuple[Path, str]]]:
    """Return the run's own registration with its name, and its images.

    Raises:
        DataError: there is none, no scan, or no image.
    """
    own = summary.best()
    if own is None or not summary.scan_spheres_m():
        raise DataError("the run has no evaluated registration", where=summary.run_id, remedy="Finish the run first")
    registered = summary.registrations()[own]
    files = _photographs(summary, registered)
    if not files:
        raise DataError(
            "no image of the data set is registered", where=summary.run_id, remedy="Repeat the registration"
        )
    return own, registered, files


def _pixels(
    summary: RunSummary, files: dict[str, tuple[Path, str]], views: Sequence[PosedView], mesh: Mesh, *, personal: bool
) -> tuple[Photographs, str]:
    """Return photographs, depth and masks of the views, and a text on what the masks hold."""
    standing, others = _spheres(summary)
    posts = posts_of(summary, standing, views)
    pixels = Photographs(
        {name: path for name, (path, _) in files.items()},
        RayMesh(mesh.vertices_m, mesh.faces),
        (*standing, *others),
        posts.cylinders,
        personal=personal,
        mark="SIMULATED" if summary.root.simulated else "",
    )
    return pixels, f"{len(standing) + len(others)} spheres{posts.words}"


def _photographs(summary: RunSummary, registered: Registration) -> dict[str, tuple[Path, str]]:
    """Return the file and hash of each registered image, by viewpoint."""
    found: dict[str, tuple[Path, str]] = {}
    for capture in summary.captures():
        photograph = capture.artefacts[0]
        if capture.viewpoint in registered.T_scan_camera and photograph.kind == "image":
            path = summary.store.artefact_path(photograph.sha256)
            found[capture.viewpoint] = (path, photograph.sha256)
    return found


def _further_view(one: FurtherView, covariance: Array) -> PosedView:
    suffix = _suffix(one.path)
    return PosedView(one.name, suffix, one.camera, one.T_scan_camera, covariance, one.taken, one.device)


def _in_order(views: Sequence[PosedView]) -> tuple[PosedView, ...]:
    """Return the views in order of their names. Raises DataError if two have the same name."""
    ordered = tuple(sorted(views, key=lambda view: view.name))
    for one, other in pairwise(ordered):
        if one.name == other.name:
            raise DataError("two images of the data set have the same name", where=one.name)
    return ordered


def _suffix(photograph: Path) -> str:
    with photograph.open("rb") as file:
        return ".png" if file.read(len(PNG_BEGINS)) == PNG_BEGINS else ".jpg"


def _view(name: str, path: Path, registered: Registration, covariance: Array, taken: str) -> PosedView:
    suffix = _suffix(path)
    camera = CameraModel.from_record((registered.full_camera or registered.camera).model_dump())
    T_scan_camera = np.array(registered.T_scan_camera[name])
    return PosedView(name, suffix, camera, T_scan_camera, covariance, taken)


def _spheres(summary: RunSummary) -> tuple[tuple[WorldSphere, ...], tuple[WorldSphere, ...]]:
    """Return the registration spheres, and the others that an image may show."""
    radius_m = metres(summary.protocol.spheres.radius_mm)
    standing, others = (
        tuple(WorldSphere(np.array(centre), radius_m) for centre in centres)
        for centres in (summary.scan_spheres_m(), control_spheres(summary))
    )
    return standing, others


def control_spheres(summary: RunSummary) -> tuple[tuple[float, float, float], ...]:
    """Return centres of the control spheres, which the images show and the scan does not."""
    before = control_scan(summary.protocol)
    if not before or not summary.state.steps[before].result:
        return ()
    return control_centres(summary.scan_spheres_m(), result_of_step(summary.state, before, SpheresFound).spheres_m)


def _sees(view: PosedView, mesh: Mesh) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return which of some vertices of the mesh are within the image."""
    points = mesh.vertices_m[:: max(1, len(mesh.vertices_m) // _POINTS)]
    camera = view.camera
    before = apply(inverse(view.T_world_camera), points)
    with np.errstate(all="ignore"):
        pixels = camera.project(before)
    inside = (pixels > -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)
    return inside[:, 0] & inside[:, 1] & (before[:, 2] > 0)


def _identity(summary: RunSummary, own: str, registered: Registration, hashes: dict[str, str]) -> str:
    inputs = json.dumps([own, registered.model_dump(mode="json"), hashes], sort_keys=True)
    return f"{summary.run_id} {hashlib.sha256(inputs.encode()).hexdigest()}"


_MOST_BYTES = 1 << 20  # of a mesh, which names its companions in its first lines, and of a material
_REFERRING = (".obj", ".mtl", ".ply")


def scan_files(summary: RunSummary) -> tuple[ScanFile, ...]:
    """Return the original files of the registered scan, under the names by which they refer to each other.

    Recorded files have lost their folders and may differ in case; a mesh finds its materials, and these find their
    textures, only under the names that are written in them.
    """
    step = registered_scan(summary.protocol, summary.state)
    kept = summary.state.steps[step].artefacts if step else ()
    refs = [ref for ref in kept if ref.kind == "scan_mesh_original"]
    named: dict[str, str] = {}  # full names by the last part of the name, in lower case and with accents composed
    for ref in refs:
        if ref.original_name.lower().endswith(_REFERRING):
            with summary.store.artefact_path(ref.sha256).open("rb") as file:
                content = file.read(_MOST_BYTES)
            for name in companion_names(content):
                named.setdefault(alike(PurePosixPath(name).name), name)
    return tuple(
        ScanFile(named.get(alike(ref.original_name), ref.original_name), summary.store.artefact_path(ref.sha256))
        for ref in refs
    )
