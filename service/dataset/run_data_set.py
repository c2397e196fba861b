"""Makes the posed data set of a finished run from its record: views, scan, posts, and what is known of the run."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from drivers.meshes.companions import companion_names
from drivers.meshes.foreign_text import alike
from service.computations.records import SpheresFound
from service.computations.registration import ARM, Registration
from service.compute.camera_model import CameraModel
from service.compute.images.render import Cylinder, RayMesh, WorldSphere, hull_mask, posts_below
from service.compute.images.views import splits
from service.core.errors import ConfigurationError, DataError
from service.core.gates import BOUNDS_HOLD, accepted_gates, describe, standing
from service.core.geometry import Array, apply, inverse
from service.core.picture_files import PNG_BEGINS
from service.core.recorded_devices import bodies, recorded_report
from service.core.records.data_set import FIRST_VERSION, DataSetStatement
from service.core.records.import_list import imported_sentence
from service.core.records.run_events import DeviceOpened
from service.core.units import metres, mm
from service.dataset.further_cameras import FurtherView, further_views
from service.dataset.pixels import Photographs
from service.dataset.records import About, DataSet, Mesh, PosedView, ScanFile, UsedDevice
from service.dataset.registrations import late_results, result_of_step, shared_adjustment_note
from service.dataset.summary import RunSummary, control_centres, control_scan, recorded_fusion, registered_scan
from service.dataset.view_covariances import view_covariances
from service.rig import RigSection, parse_recorded_rig

_UNNAMED = "a person who is not named here"


def about_run(
    summary: RunSummary,
    own: str,
    not_in_yet: Sequence[str] = (),
    *,
    stated: DataSetStatement | None = None,
    version: str = FIRST_VERSION,
    personal: bool = True,
) -> About:
    """Return what a run's data set says about itself.

    Args:
        summary: the run.
        own: the name of its registration.
        not_in_yet: texts on results that have not arrived yet.
        stated: the statement that replaces the protocol's.
        version: the data set's version.
        personal: False leaves people and serial numbers out.
    """
    root, entered = summary.root, summary.root.about
    return About(
        stated=(stated or DataSetStatement()).or_else(summary.protocol.data_set),
        version=version,
        run=summary.run_id,
        protocol=f"{root.protocol_id} {root.protocol_version}, SHA-256 {root.protocol_sha256}",
        protocol_title=summary.protocol.title,
        source=summary.protocol.source,
        specimen="" if entered is None else entered.specimen,
        purpose="" if entered is None else entered.purpose,
        site="" if entered is None else entered.site,
        origin=origin_sentence(summary, personal=personal),
        published_utc=summary.events[-1].at_utc,
        head_sha256=summary.events[-1].sha256,
        software=root.software.get("orthocapture", "unknown"),
        people=tuple(sorted(filter(None, {*summary.state.people, root.operator}))) if personal else (),
        devices=_devices(summary, personal=personal),
        settings=_settings(summary),
        accuracy=next((row for row in summary.table() if row.poses == own), None),
        budget=summary.budgets().get(own),
        fusion=_fusion(summary, personal=personal),
        gates=tuple(gates_in_words(summary).items()),
        accepted=tuple(gate.text for gate in accepted_gates(summary.protocol, summary.state)),
        deviations=tuple(d.text for d in summary.state.deviations),
        later=tuple(late.text for late in late_results(summary.protocol, summary.state)),
        not_in_yet=tuple(not_in_yet),
    )


def gates_in_words(summary: RunSummary) -> dict[str, tuple[str, ...]]:
    """Return each judged step's gates as text, with their verdicts."""
    steps = {step.id: summary.state.steps[step.id] for step in summary.protocol.steps}
    return {
        name: tuple(
            f"{describe(v)}: {standing(v, accepted=state.accepted is not None).replace('_', ' ')}"
            for v in state.verdicts
        )
        for name, state in steps.items()
        if state.verdicts
    }


def origin_sentence(summary: RunSummary, *, personal: bool = True) -> str:
    """Return how the photographs came into the run."""
    if summary.root.origin != "imported":
        return "The photographs were captured in this run"
    by = summary.root.operator if personal else _UNNAMED
    return imported_sentence(summary.events[0].at_utc, by)


def _fusion(summary: RunSummary, *, personal: bool) -> tuple[tuple[str, str], ...]:
    """Return how CT and scan agree, and what of the mesh comes from where."""
    fusion = recorded_fusion(summary)
    if fusion is None:
        return ()
    m, loop = fusion.measures, fusion.measures.get("loop_closure_mm")
    drawn = [
        f"{'CT' if region.source == 'ct' else 'scan'} by "
        + (region.by if personal or region.by.startswith("protocol ") else _UNNAMED)
        for region in fusion.answer.regions
    ]
    return (
        (
            "Chamfer distance of CT and scan",
            f"{m['chamfer_ct_scan_mm']:.3f} mm (CT to scan {m['ct_to_scan_mm']:.3f} mm, scan to CT "
            f"{m['scan_to_ct_mm']:.3f} mm; medians {m['ct_to_scan_median_mm']:.3f} mm and "
            f"{m['scan_to_ct_median_mm']:.3f} mm), sampled every {mm(fusion.spacing_m):g} mm; equal surfaces would "
            f"give {m['chamfer_floor_mm']:.3f} mm",
        ),
        (
            "Distances of the spheres over the transport",
            f"changed by up to {m['sphere_distance_change_max_mm']:.3f} mm",
        ),
        ("Loop from scan to CT by spheres and back by cameras", "no images" if loop is None else f"{loop:.3f} mm"),
        (
            "Vertices",
            f"{100 * m['ct_share']:.1f} % of the CT, {100 * m['scan_share']:.1f} % of the scan, "
            f"{100 * m['blend_share']:.1f} % blended; median stated sigma {m['sigma_median_mm']:.3f} mm",
        ),
        ("Wound", f"proposed, then corrected: {'; '.join(drawn)}" if drawn else "as proposed"),
    )


def _devices(summary: RunSummary, *, personal: bool) -> tuple[UsedDevice, ...]:
    """Return every device as it first identified itself in the run."""
    known = bodies(summary.events)
    found: dict[str, UsedDevice] = {}
    for event in summary.events:
        if isinstance(event.payload, DeviceOpened):
            identity = recorded_report(event.payload.report).identity
            serial = known.shown(identity) if personal else ""
            device = UsedDevice(event.payload.device, identity.model, serial, identity.firmware)
            found.setdefault(event.payload.device, device)
    return tuple(found.values())


def _settings(summary: RunSummary) -> tuple[tuple[str, str], ...]:
    """Return the camera settings of the protocol, the lens as the photographs state it, and the spheres."""
    camera, spheres = summary.protocol.camera, summary.protocol.spheres
    optics = [view.optics for view in summary.captures()]
    lenses = dict.fromkeys(one.lens for one in optics if one.lens)
    lengths = dict.fromkeys(f"{one.focal_length_mm:g} mm" for one in optics if one.focal_length_mm)
    found = [("lens", ", ".join(lenses)), ("focal length", ", ".join(lengths))]
    if camera is not None:
        found += [
            ("aperture", f"f/{camera.aperture_f:g}"),
            ("exposure", f"{camera.exposure_s:.4g} s"),
            ("sensitivity", f"ISO {camera.iso}"),
            ("focus", camera.focus_mode),
            ("files", camera.image_quality),
        ]
    found.append(
        (
            "spheres",
            f"{spheres.registration} for registration and {spheres.control} for control, "
            f"radius {spheres.radius_mm:g} mm",
        )
    )
    return tuple((name, value) for name, value in found if value)


def described_run(
    summary: RunSummary, own: str, not_in_yet: Sequence[str], *, personal: bool = True
) -> dict[str, Any]:
    """Return what `dataset.json` says of the run as plain data; `own` is the name of its registration."""
    later = summary.better_later()
    return {
        "run": summary.run_id,
        "simulated": summary.root.simulated,
        "origin": summary.root.origin,
        "origin_in_words": origin_sentence(summary, personal=personal),
        "protocol": f"{summary.root.protocol_id} {summary.root.protocol_version}",
        "protocol_sha256": summary.root.protocol_sha256,
        "frame": "scan",
        "unit": "m",
        "pose_source": own,
        "evaluation": [row.plain() for row in summary.table()],
        "gates": gates_in_words(summary),
        "gates_explained": BOUNDS_HOLD,
        "accepted_gates": [gate.text for gate in accepted_gates(summary.protocol, summary.state)],
        "evaluation_note": shared_adjustment_note(summary.protocol, summary.state),
        "arrived_later": [late.text for late in late_results(summary.protocol, summary.state)],
        "arrived_later_and_better": None if later is None else later.poses,
        "not_in_yet": list(not_in_yet),
        "deviations": [d.text for d in summary.state.deviations],
        "head_of_chain_sha256": summary.events[-1].sha256,
    }


_CANDIDATES = 300  # faces whose normals are tried as the board's
_WITHIN, _LEVEL = 0.7, 0.996  # cosines: of the board from the cameras' direction, of level faces from the board
_LEAST_LEVEL = 0.05  # share of the surface that must be level


@dataclass(frozen=True, slots=True)
class Posts:
    """The posts of the spheres.

    Attributes:
        cylinders: one for each post, as thick as its sphere.
        words: a text on what is known of them, to follow the number of spheres.
    """

    cylinders: tuple[Cylinder, ...]
    words: str


@dataclass(frozen=True, slots=True)
class _Ground:
    """The plane on which the posts stand: unit normal (3,) upwards, and height along it, in the frame of the scan."""

    up: Array
    height_m: float


def posts_of(summary: RunSummary, spheres: Sequence[WorldSphere], views: Sequence[PosedView]) -> Posts:
    """Return the posts below spheres, along the normal of the board in the scan, or the z axis of an arm's base.

    They end on the board or, if the scan shows none, on the table that the rig file states, on which the board lies.
    """
    vertices_m, faces = summary.scan_mesh()
    scan = Mesh(np.asarray(vertices_m, dtype=np.float64), np.asarray(faces, dtype=np.int64))
    eyes = np.mean([view.T_world_camera[:3, 3] for view in views], axis=0)
    up = upwards(scan, eyes - np.mean(scan.vertices_m, axis=0))
    if up.any():
        return Posts(_down_to(_Ground(up, np.inf), scan, spheres), f", and the posts below {len(spheres)} of them")
    table = _table(summary)
    if table is None:
        return Posts(
            (),
            "; posts are not masked, because the scan shows no board on which they stand, and no arm and rig file "
            "say where the table is",
        )
    words = (
        f", and the posts below {len(spheres)} of them, down to the table of the rig file, because the scan shows no "
        "board"
    )
    return Posts(_down_to(table, scan, spheres), words)


def _down_to(ground: _Ground, scan: Mesh, spheres: Sequence[WorldSphere]) -> tuple[Cylinder, ...]:
    """Return a post below each sphere, down to the ground and at least to the lowest point of the scan."""
    lowest = min(ground.height_m, float((scan.vertices_m @ ground.up).min()))
    return tuple(
        post
        for sphere in spheres
        for post in posts_below(
            [sphere],
            ground.up,
            max(sphere.radius_m, float(sphere.centre_m @ ground.up) - lowest),
            sphere.radius_m,
        )
    )


def _table(summary: RunSummary) -> _Ground | None:
    """Return the table at a station, from the rig file and a registration of an arm's poses; None without either."""
    registrations = summary.registrations()
    registered = next((registrations[name] for name in reversed(ARM) if name in registrations), None)
    rig = None if registered is None else _rig(summary)
    if registered is None or rig is None:
        return None
    for station, T_world_base in registered.T_world_station.items():
        if station in rig.stations:
            T_scan_base = inverse(np.array(registered.T_world_scan)) @ np.array(T_world_base)
            top = np.array(rig.stations[station].scene_centre_m) - [0, 0, rig.collision.table_below_scene_m]
            up = T_scan_base[:3, 2]  # a rig file has upright arms only
            return _Ground(up, float(apply(T_scan_base, top) @ up))
    return None


def _rig(summary: RunSummary) -> RigSection | None:
    """Return the rig of a run; None if it was imported, or if an earlier version wrote what this one cannot read."""
    if summary.root.origin == "imported":
        return None
    recorded = summary.root.rig
    source = summary.store.artefact_path(recorded.sha256).read_bytes()
    try:
        return parse_recorded_rig(source, Path(recorded.original_name)).section
    except ConfigurationError:
        return None


def upwards(mesh: Mesh, about: Array) -> Array:
    """Return the board's unit normal (3,): the direction within 45° of `about` to which most surface is level.

    Zero where no direction has a twentieth of the surface: the mesh shows no board.
    """
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    vector = np.cross(b - a, c - a)
    area = np.linalg.norm(vector, axis=1)
    normal = vector / np.maximum(area, 1e-300)[:, None]
    up = about / np.linalg.norm(about)
    normal *= np.where(normal @ up < 0, -1.0, 1.0)[:, None]  # of a scan, faces may turn either way
    candidates = normal[:: max(1, len(normal) // _CANDIDATES)]
    candidates = candidates[candidates @ up > _WITHIN]
    if not len(candidates):
        return np.zeros(3)
    level = np.array([area[normal @ candidate > _LEVEL].sum() for candidate in candidates])
    best = int(level.argmax())
    if level[best] < _LEAST_LEVEL * area.sum():
        return np.zeros(3)
    mean = (area[:, None] * normal)[normal @ candidates[best] > _LEVEL].sum(axis=0)
    return mean / np.linalg.norm(mean)


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
