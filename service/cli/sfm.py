"""`orthocapture sfm`: camera poses from images alone, or also from robot poses and spheres, without a run."""

from __future__ import annotations

import json as json_module
import os
import shutil
import tempfile
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from drivers.meshes.mesh_file import MeshUnit, read_mesh_file
from service.cli.common import (
    JsonOption,
    StrictOption,
    console,
    error_console,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable_folder,
    tell_doubt,
    tell_left_out,
    write_whole,
)
from service.cli.scheduler import (
    PATIENCE_S,
    SchedulerCaOption,
    SchedulerCertOption,
    SchedulerKeyOption,
    SchedulerOption,
    SchedulerPatienceOption,
    reached_scheduler,
)
from service.compute.camera_model import CameraCovariance, read_camera_covariance
from service.compute.images.photographs import image_folder
from service.compute.markers.image_files import detect_all
from service.compute.poses.pose_files import (
    read_camera_json,
    read_poses_csv,
    read_spheres_json,
    write_camera_json,
    write_poses_csv,
)
from service.compute.poses.robot_files import read_hand_eye, read_stations
from service.compute.scene import PosedImages, ScanSpheres
from service.compute.sfm.estimate import SfmModel, SfmWorkspace, reconstruct, write_pose_covariance
from service.compute.sfm.hybrid import HybridPoses, hybrid_poses
from service.compute.sfm.options import Effort, Refine, options_for
from service.compute.surfaces.mesh_spheres import locate_spheres
from service.core.errors import DataError
from service.core.geometry import Array, Transform, align_points, apply
from service.core.units import deg, metres, mm
from service.machine.executors import computing_at

_FAR = 0.1  # fraction of the cameras' spread; robot poses that are off by more are in another frame


def sfm_command(
    images: Annotated[Path, typer.Option("--images", help="Folder of the images, all of one camera.")],
    camera: Annotated[Path, typer.Option("--camera", help="camera.json, as calibrate intrinsics writes it.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the COLMAP model to write.")],
    mapper: Annotated[
        Literal["incremental", "global"], typer.Option("--mapper", help="COLMAP's mapper, or GLOMAP's.")
    ] = "incremental",
    effort: Annotated[
        Effort, typer.Option("--effort", help="Number of features per image: takes seconds or minutes.")
    ] = "quality",
    robot_poses: Annotated[
        Path | None,
        typer.Option(
            "--robot-poses",
            help="CSV image,x,y,z,qx,qy,qz,qw (metres): T_base_camera, or T_base_flange with --hand-eye. Then only "
            "neighbouring images are matched, and --hybrid uses the poses.",
        ),
    ] = None,
    hand_eye: Annotated[
        Path | None, typer.Option("--hand-eye", help="hand_eye.json with T_flange_camera of the robot's poses.")
    ] = None,
    stations: Annotated[
        Path | None, typer.Option("--stations", help="CSV image,station, if the robot stood at several stations.")
    ] = None,
    refine_principal_point: Annotated[
        bool, typer.Option("--refine-principal-point", help="Refine the principal point in the final adjustment.")
    ] = False,
    refine_intrinsics: Annotated[
        bool, typer.Option("--refine-intrinsics", help="Refine all intrinsics, distortion included.")
    ] = False,
    hybrid: Annotated[
        bool,
        typer.Option(
            "--hybrid", help="Adjust images, robot poses and the spheres of a scan together: metric poses.csv."
        ),
    ] = False,
    mesh: Annotated[Path | None, typer.Option("--mesh", help="For --hybrid: the scan with the spheres.")] = None,
    spheres: Annotated[Path | None, typer.Option("--spheres", help="spheres.json, instead of a mesh.")] = None,
    radius_mm: Annotated[float | None, typer.Option("--radius-mm", help="Radius of the spheres.")] = None,
    mesh_unit: Annotated[MeshUnit, typer.Option("--mesh-unit", help="Unit of the mesh: mm, m or auto.")] = "auto",
    workspace: Annotated[
        Path | None, typer.Option("--workspace", help="Folder to keep features and matches for another mapper.")
    ] = None,
    strict: StrictOption = False,
    scheduler: SchedulerOption = "",
    scheduler_ca: SchedulerCaOption = None,
    scheduler_cert: SchedulerCertOption = None,
    scheduler_key: SchedulerKeyOption = None,
    scheduler_patience: SchedulerPatienceOption = PATIENCE_S,
    json: JsonOption = False,
) -> None:
    """Estimate camera poses with fixed, calibrated intrinsics; use the model with register --estimate-scale."""
    with reporting_errors(json):
        if refine_principal_point and refine_intrinsics:
            raise typer.BadParameter("--refine-intrinsics includes the principal point: give only one of the two")
        if hybrid and (mesh is None) == (spheres is None):
            raise typer.BadParameter("--hybrid needs either --mesh or --spheres")
        refine: Refine = "nothing"
        if refine_principal_point or refine_intrinsics:
            refine = "principal_point" if refine_principal_point else "intrinsics"
        for folder in filter(None, (out, workspace)):
            require_writable_folder(folder)
        model = read_camera_json(camera)
        found = image_folder(images, size=(model.width, model.height), strict=strict)
        tell_left_out(found.left_out)
        files = {file.name: file for file in found.files}
        prior = _robot_poses(robot_poses, hand_eye, files)
        station = None if stations is None else read_stations(stations, files)
        options = options_for(effort, model, refine=refine, threads=os.cpu_count() or 1)
        known = _spheres(mesh, spheres, radius_mm, mesh_unit) if hybrid else None
        cluster = reached_scheduler(
            scheduler, ca=scheduler_ca, cert=scheduler_cert, key=scheduler_key, patience_s=scheduler_patience
        )
        with _workspace(workspace) as folder, progress_bar(quiet=json) as progress, computing_at(cluster):
            work = SfmWorkspace(folder, model, options, progress)
            solved, off_m = _reconstruct(files, work, mapper, prior, station)
            well_known = read_camera_covariance(camera) if refine == "nothing" else None
            _write_model(out, solved, well_known)
            record = {**_record(solved, off_m), "left_out": found.left_out}
            if known is not None:
                metric = _hybrid(solved, files, prior, station, *known, well_known, progress)
                write_poses_csv(
                    out / "poses.csv", dict(zip(solved.T_world_camera, metric.T_world_camera, strict=True))
                )
                record["hybrid"] = _hybrid_record(metric)
                write_pose_covariance(
                    out / "poses_covariance.json", list(solved.T_world_camera), metric.pose_covariance, "m"
                )
        write_whole(out / "sfm.json", json_module.dumps(record, indent=1) + "\n")
        if json:
            print_json(record)
            return
        _tell(record)
        console.print(f"written: {out}")


def _robot_poses(path: Path | None, hand_eye: Path | None, files: Mapping[str, Path]) -> dict[str, Transform] | None:
    if path is None:
        return None
    given = read_poses_csv(path)
    T_flange_camera = np.eye(4) if hand_eye is None else read_hand_eye(hand_eye)
    found = {name: T @ T_flange_camera for name, T in given.items() if name in files}
    if not found:
        raise DataError("no image of the folder has a robot pose", where=str(path), remedy="Check the names")
    return found


def _spheres(
    mesh: Path | None, spheres: Path | None, radius_mm: float | None, mesh_unit: MeshUnit
) -> tuple[Array, float]:
    """Return sphere centres (M, 3) and radius, in metres."""
    if spheres is not None:
        known = read_spheres_json(spheres)
        return known.centres_m, known.radius_m if radius_mm is None else metres(radius_mm)
    if radius_mm is None:
        raise typer.BadParameter("--mesh needs --radius-mm")
    assert mesh is not None
    read = read_mesh_file(mesh, mesh_unit)
    tell_doubt(mesh, read.findings["polygons_in_doubt"])
    scan = read.mesh
    found = locate_spheres(scan.vertices_m, scan.faces, metres(radius_mm))
    return np.array([sphere.centre_m for sphere in found]), metres(radius_mm)


@contextmanager
def _workspace(folder: Path | None) -> Generator[Path]:
    if folder is not None:
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="orthocapture-sfm-") as temporary:
        yield Path(temporary)


def _reconstruct(
    files: Mapping[str, Path],
    workspace: SfmWorkspace,
    mapper: Literal["incremental", "global"],
    prior: Mapping[str, Transform] | None,
    stations: Mapping[str, str] | None,
) -> tuple[SfmModel, float | None]:
    """Return the model, and the rms distance in metres of the robot's poses from it (None without them).

    If the robot's poses are in another frame or images are missing, it matches all pairs and reconstructs again.
    """
    solved = reconstruct(files, workspace, mapper, T_world_camera_prior=prior, stations=stations)
    if prior is None:
        return solved, None
    off_m, spread_m = _disagreement(solved, prior, stations)
    if off_m <= _FAR * spread_m and not solved.missing:
        return solved, off_m
    if off_m > _FAR * spread_m:
        error_console.print(
            f"The robot's poses miss the model by {mm(off_m):.0f} mm: several stations without --stations, "
            "or poses of other images. All pairs of images are matched instead."
        )
    return reconstruct(files, workspace, mapper), off_m


def _disagreement(
    solved: SfmModel, prior: Mapping[str, Transform], stations: Mapping[str, str] | None
) -> tuple[float, float]:
    """Return the rms distance of the robot's from the reconstructed camera positions, and the cameras' spread, m."""
    squares: list[float] = []
    spread: list[float] = []
    groups = sorted({stations[name] for name in solved.T_world_camera}) if stations else [""]
    for group in groups:
        names = [
            name for name in solved.T_world_camera if name in prior and (not stations or stations[name] == group)
        ]
        if len(names) < 4:
            continue
        robot = np.array([prior[name][:3, 3] for name in names])
        found = np.array([solved.T_world_camera[name][:3, 3] for name in names])
        T, s = align_points(robot, found, with_scale=True)
        squares += np.sum((robot - apply(T, s * found)) ** 2, axis=1).tolist()
        spread += np.sum((robot - robot.mean(axis=0)) ** 2, axis=1).tolist()
    if not squares:
        return 0.0, 1.0
    return float(np.sqrt(np.mean(squares))), float(np.sqrt(np.mean(spread)))


def _write_model(out: Path, solved: SfmModel, known: CameraCovariance | None) -> None:
    out.mkdir(parents=True, exist_ok=True)
    for file in solved.folder.iterdir():
        shutil.copyfile(file, out / file.name)
    write_camera_json(out / "camera.json", solved.camera)
    write_pose_covariance(
        out / "pose_covariance.json", list(solved.T_world_camera), solved.pose_covariance(known), "model"
    )


def _hybrid(
    solved: SfmModel,
    files: Mapping[str, Path],
    prior: Mapping[str, Transform] | None,
    stations: Mapping[str, str] | None,
    centres_m: Array,
    radius_m: float,
    well_known: CameraCovariance | None,
    progress: Any,
) -> HybridPoses:
    names = list(solved.T_world_camera)
    outlines = detect_all(
        [files[name] for name in names],
        solved.camera,
        workers=min(len(names), os.cpu_count() or 1),
        progress=lambda done, total: progress("spheres in images", done, total),
    )
    order = list(dict.fromkeys(stations[name] for name in names)) if stations else []
    nothing = np.full((4, 4), np.nan)
    return hybrid_poses(
        PosedImages(
            np.array(list(solved.T_world_camera.values())),
            solved.camera,
            groups=[order.index(stations[name]) for name in names] if stations else None,
            metric=False,
            names=names,
        ),
        solved.tracks,
        outlines,
        ScanSpheres(centres_m, radius_m),
        T_base_camera=None if prior is None else np.array([prior.get(name, nothing) for name in names]),
        known_camera=well_known,
    )


def _record(solved: SfmModel, off_m: float | None) -> dict[str, Any]:
    return {
        "mapper": solved.mapper,
        "registered": list(solved.T_world_camera),
        "missing": list(solved.missing),
        "models": solved.n_models,
        "points": len(solved.points_world),
        "observations": len(solved.tracks.image),
        "mean_reprojection_error_px": solved.mean_reprojection_error_px,
        "mean_track_length": solved.mean_track_length,
        "camera": solved.camera.record(),
        "robot_poses_off_mm": None if off_m is None else mm(off_m),
        "seconds": solved.seconds,
    }


def _hybrid_record(metric: HybridPoses) -> dict[str, Any]:
    return {
        "T_world_scan": metric.T_world_scan.tolist(),
        "T_world_group": {str(g): T.tolist() for g, T in metric.T_world_group.items()},
        "covariance": metric.scan_covariance.tolist(),
        "predicted_error_mm": mm(metric.sigma_at_m(metric.centre_scan_m)),
        "sigma_track_px": metric.sigma_track_px,
        "sphere_factor": metric.sphere_factor,
        "sigma_robot_mm": None if metric.sigma_robot_m is None else mm(metric.sigma_robot_m),
        "sigma_robot_deg": None if metric.sigma_robot_rad is None else deg(metric.sigma_robot_rad),
        "chi2": metric.chi2,
    }


def _tell(record: Mapping[str, Any]) -> None:
    registered, missing = len(record["registered"]), record["missing"]
    console.print(
        f"{record['mapper']}: {registered} of {registered + len(missing)} images, {record['points']} points, "
        f"{record['mean_reprojection_error_px']:.2f} px"
    )
    if missing:
        console.print(f"not in the model: {', '.join(missing)}")
    if "hybrid" in record:
        metric = record["hybrid"]
        robot = "" if metric["sigma_robot_mm"] is None else f", robot {metric['sigma_robot_mm']:.2f} mm"
        console.print(
            f"hybrid: tracks {metric['sigma_track_px']:.2f} px{robot}; predicted error at the scene's centre "
            f"{metric['predicted_error_mm']:.3f} mm"
        )
