"""`orthocapture register`: register any posed images with a scan, without a run."""

from __future__ import annotations

import json as json_module
import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drivers.meshes.mesh_file import MeshUnit
from service.cli.common import (
    JsonOption,
    StrictOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable,
    tell_left_out,
    write_whole,
)
from service.cli.ending import ExitStatus
from service.cli.scheduler import (
    PATIENCE_S,
    SchedulerCaOption,
    SchedulerCertOption,
    SchedulerKeyOption,
    SchedulerOption,
    SchedulerPatienceOption,
    reached_scheduler,
)
from service.cli.spheres import SeedsOption, spheres_of
from service.computations.registration import DetectorName
from service.computations.registration.compute import detector_of, search_outlines
from service.compute.camera_model import read_camera_covariance
from service.compute.images.photographs import image_folder
from service.compute.markers.detect import options_for
from service.compute.markers.grounded import VARIABLE, weights_in
from service.compute.markers.image_files import DetectFile, LocatedOutlines, search_nearby
from service.compute.markers.paper import read_boxes
from service.compute.markers.records import SphereOutline
from service.compute.pipeline import PipelineResult, register_images
from service.compute.poses.pose_files import posed_images, read_camera_json, read_spheres_json
from service.compute.registration.control_spheres import LEAST_SHARE, ExpectedNearby
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ConfigurationError
from service.core.gates import describe_judged, judge
from service.core.geometry import Array
from service.core.protocol import Gate
from service.core.records.run_events import GateVerdict
from service.core.units import metres, mm
from service.machine.executors import computing_at

_MOST_MM = 0.35  # the paper's mean radial error
_MOST_WORST_MM = 0.5  # radial error of one control sphere


def register_command(
    images: Annotated[Path, typer.Option("--images", help="Folder of the images.")],
    camera: Annotated[
        Path, typer.Option("--camera", help="camera.json: width, height, fx, fy, cx, cy, k1, k2, p1, p2.")
    ],
    poses: Annotated[
        Path,
        typer.Option("--poses", help="Poses CSV (T_world_camera, metres), transforms.json or COLMAP model folder."),
    ],
    out: Annotated[Path, typer.Option("--out", help="The result file to write.")],
    mesh: Annotated[Path | None, typer.Option("--mesh", help="The scan, with the spheres in it.")] = None,
    spheres: Annotated[Path | None, typer.Option("--spheres", help="spheres.json, instead of a mesh.")] = None,
    radius_mm: Annotated[float | None, typer.Option("--radius-mm", help="Radius of the spheres.")] = None,
    mesh_unit: Annotated[MeshUnit, typer.Option("--mesh-unit", help="Unit of the mesh: mm, m or auto.")] = "auto",
    control: Annotated[
        str, typer.Option("--control", help="Indices of spheres in the mesh used only for evaluation, such as 3,7,9.")
    ] = "",
    seeds: SeedsOption = None,
    estimate_scale: Annotated[bool, typer.Option("--estimate-scale", help="The poses are not metric.")] = False,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes that search images; default: one per core.")
    ] = None,
    full_search: Annotated[
        bool, typer.Option("--full-search", help="Search whole images, not only where the poses predict spheres.")
    ] = False,
    sphere_colour: Annotated[
        str | None,
        typer.Option(
            "--sphere-colour", help="white, grey, green, orange or #rrggbb; learnt in each image by default."
        ),
    ] = None,
    largest_sphere: Annotated[
        float | None,
        typer.Option(
            "--largest-sphere",
            help="Radius of the largest sphere searched for, as a fraction of the image's width; default: 0.13.",
            min=0.02,
            max=0.7,
        ),
    ] = None,
    detector: Annotated[
        DetectorName,
        typer.Option(
            "--detector",
            help="paper: the published method without its networks; grounded: with Grounding DINO and SAM 2; vote: "
            "grounded and classical. These search whole images.",
        ),
    ] = "classical",
    boxes: Annotated[
        Path | None,
        typer.Option(
            "--boxes",
            help="For --detector paper: JSON with boxes (left, top, right, bottom) of another detector by image.",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            "--weights",
            envvar=VARIABLE,
            help="For --detector grounded and vote: folder with grounding-dino/ and sam2/, the networks' weights.",
        ),
    ] = None,
    scheduler: SchedulerOption = "",
    scheduler_ca: SchedulerCaOption = None,
    scheduler_cert: SchedulerCertOption = None,
    scheduler_key: SchedulerKeyOption = None,
    scheduler_patience: SchedulerPatienceOption = PATIENCE_S,
    strict: StrictOption = False,
    json: JsonOption = False,
) -> None:
    """Register posed images with a scan by the spheres visible in both, and report the accuracy.

    The exit status is 0 if the figures are within their limits and nothing in the inputs contradicts the rest, else
    1; the result file says which.
    """
    with reporting_errors(json):
        require_writable(out)
        model, stated = read_camera_json(camera), read_camera_covariance(camera)
        folder = image_folder(images, size=(model.width, model.height), strict=strict)
        known, folder = posed_images(poses, folder, images, strict=strict)
        files = list(folder.files)
        tell_left_out(folder.left_out)
        options = options_for(sphere_colour, largest_sphere)
        registration_m, control_m, radius_m = _spheres(mesh, spheres, radius_mm, mesh_unit, control, seeds)
        names = [file.name for file in files]
        spheres_seen = len(registration_m) + len(control_m)
        detect, found_by = _file_detector(detector, boxes, names, weights, spheres_seen)
        T_world_camera = np.array([known[file.name] for file in files])
        processes = min(len(files), workers or os.cpu_count() or 1)
        posed = PosedImages(T_world_camera, model, metric=not estimate_scale, names=names)
        scanned = ScanSpheres(registration_m, radius_m, control_m=control_m)
        cluster = reached_scheduler(
            scheduler, ca=scheduler_ca, cert=scheduler_cert, key=scheduler_key, patience_s=scheduler_patience
        )
        with progress_bar(quiet=json) as progress, computing_at(cluster):
            # Control spheres take no part in choosing outlines: they are searched for once the poses are known.
            located = search_outlines(
                files,
                model,
                None if full_search else posed,
                ScanSpheres(registration_m, radius_m),
                detect=detect,
                options=options,
                workers=processes,
                progress=partial(progress, "spheres in images"),
            )

            def search(expected: ExpectedNearby) -> Sequence[Sequence[SphereOutline]]:
                tasks = [(files[i], around) for i, around in expected]
                told = partial(progress, "control spheres")
                return search_nearby(tasks, model, options, min(processes, len(tasks)), told)

            result = register_images(
                located.outlines,
                posed,
                scanned,
                assignments=located.assignments,
                search=search,
                lens_covariance=None if stated is None else stated.of_lens(),
            )
        verdicts = judge(_gates(result), result.measures())
        passed = all(verdict.passed for verdict in verdicts)
        record = result.as_json(model)
        record["verdict"] = "passed" if passed else "not passed"
        record["gates"] = [verdict.model_dump(mode="json") for verdict in verdicts]
        record["spheres_mm"] = {"registration": mm(registration_m).tolist(), "control": mm(control_m).tolist()}
        record["left_out"] = folder.left_out | {names[i]: why for i, why in result.left_out.items()}
        record["search"] = _search(located, names)
        record["detector"] = {"name": detector, "weights_sha256": found_by}
        write_whole(out, json_module.dumps(record, indent=1))
        if json:
            print_json(record)
        else:
            _tell(result, record, verdicts)
            console.print(f"written: {out}")
        if not passed:
            raise typer.Exit(ExitStatus.FAILED)


def _gates(result: PipelineResult) -> list[Gate]:
    """Return the limits of a registration: those of the shipped protocols' evaluation, and of contradictions."""
    gates = [
        Gate(measure="contradictions", max=0, unit="", why="inputs that contradict one another give no registration"),
        Gate(measure="predicted_error_mm", max=_MOST_MM, unit="mm", why="the paper's figure"),
    ]
    if result.controls is None:
        return gates
    return [
        *gates,
        Gate(measure="best_mean_radial_error_mm", max=_MOST_MM, unit="mm", why="the paper's figure"),
        Gate(measure="worst_control_sphere_mm", max=_MOST_WORST_MM, unit="mm", why="a mean hides one that was moved"),
        Gate(measure="control_outlines_share", min=LEAST_SHARE, unit="", why="what no image shows confirms nothing"),
    ]


def _tell(result: PipelineResult, record: dict[str, Any], verdicts: Sequence[GateVerdict]) -> None:
    console.print(
        f"{record['n_images']} images, {len(result.markers)} spheres, {result.registration.rms_px:.3f} px rms, "
        f"predicted error at their centre {record['predicted_error_mm']:.3f} mm"
    )
    controls = result.controls
    if controls is not None and result.evaluation is not None:
        console.print(
            f"control spheres: {result.evaluation.mean_radial_error_mm:.3f} mm mean radial error, "
            f"{result.evaluation.mean_reprojection_error_px:.2f} px mean reprojection error, worst sphere "
            f"{controls.worst_mm or 0.0:.3f} mm; {controls.measured} of {len(controls.spheres)} measured"
        )
    for one in result.findings:
        console.tell((f"{one.what}.", "bold"), f" {one.remedy}.")
    for text in () if controls is None else controls.findings:
        console.tell((f"{text[0].upper() + text[1:]}.", "bold"))
    outside = [verdict for verdict in verdicts if not verdict.passed]
    for verdict in outside:
        console.print(f"outside its limit: {describe_judged(verdict)}")
    console.tell(("not passed", "bold red") if outside else ("passed", "bold green"))


def _file_detector(
    detector: DetectorName, boxes: Path | None, names: list[str], folder: Path | None, least: int
) -> tuple[DetectFile | None, Mapping[str, str]]:
    """Return the detector for one file, None for the default, and the hashes of its weights, if it has any."""
    if boxes is not None and detector != "paper":
        raise typer.BadParameter("--boxes needs --detector paper")
    weights = weights_in(folder) if detector in ("grounded", "vote") else None
    found = detector_of(detector, weights, least, None if boxes is None else read_boxes(boxes, names))
    return found, {} if weights is None else weights.sha256()


def _search(located: LocatedOutlines, names: list[str]) -> dict[str, object]:
    """Return counts of images searched whole or at predicted places only, and of missing spheres, as plain data."""
    return {
        "images_searched": located.count("searched"),
        "images_predicted": located.count("predicted"),
        "anchors": [names[i] for i in located.anchors],
        "spheres_expected": sum(image.expected for image in located.images),
        "spheres_missing": [
            {"image": name, "sphere": sphere, "reason": reason}
            for name, image in zip(names, located.images, strict=True)
            for sphere, reason in sorted(image.missing.items())
        ],
    }


def _spheres(
    mesh: Path | None,
    spheres: Path | None,
    radius_mm: float | None,
    mesh_unit: MeshUnit,
    control: str,
    seeds: str | None,
) -> tuple[Array, Array, float]:
    """Return centres of registration (M, 3) and control spheres (C, 3), and their radius, in metres."""
    if (mesh is None) == (spheres is None):
        raise typer.BadParameter("give either --mesh or --spheres")
    if spheres is not None:
        known = read_spheres_json(spheres)
        return known.centres_m, known.control_m, known.radius_m if radius_mm is None else metres(radius_mm)
    if radius_mm is None:
        raise typer.BadParameter("--mesh needs --radius-mm")
    assert mesh is not None
    found = spheres_of(mesh, metres(radius_mm), mesh_unit, None, seeds)
    centres = np.array([sphere.centre_m for sphere in found])
    try:
        chosen = sorted({int(word) for word in control.split(",") if word.strip()})
    except ValueError as error:
        raise typer.BadParameter(f"--control takes indices such as 3,7,9, not {control!r}") from error
    if chosen and not 0 <= chosen[0] <= chosen[-1] < len(centres):
        raise ConfigurationError(
            f"--control names sphere {chosen[-1]}, the mesh has {len(centres)} (0 … {len(centres) - 1})",
            where=str(mesh),
            remedy="Run once without --control: result.json lists the spheres in order",
        )
    rest = [i for i in range(len(centres)) if i not in chosen]
    return centres[rest], centres[chosen], metres(radius_mm)
