"""The registered data set as files: images, camera, poses and mesh in one frame, with their provenance."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from service.compute.camera_model import CameraModel
from service.compute.poses.files.camera_files import write_camera_json
from service.compute.poses.files.pose_files import write_poses_csv, write_transforms_json
from service.core.errors import DataError
from service.core.gates.dependence import accepted_gates
from service.core.gates.verdict import BOUNDS_HOLD, describe, standing
from service.core.geometry import Transform
from service.core.records.import_list import imported_sentence
from service.dataset.late_results import late_results
from service.dataset.registrations import shared_adjustment_note
from service.dataset.summary import RunSummary
from service.jobs.registration.register import Registration


def export_dataset(summary: RunSummary, folder: Path, not_in_yet: Sequence[str] = ()) -> None:
    """Write images/, camera.json, poses.csv, transforms.json, mesh.ply and dataset.json into a new folder.

    The common frame is the scan's (metres): the scan is the ground truth and is not resampled.

    Args:
        summary: the run.
        folder: created here.
        not_in_yet: results that have not arrived yet, in words.

    Raises:
        DataError: the run has no evaluated registration, or the folder exists.
    """
    best = summary.best()
    if best is None:
        raise DataError("the run has no evaluated registration", where=summary.run_id, remedy="Finish the run first")
    if folder.exists():
        raise DataError(
            "the folder exists already", where=str(folder), remedy="Name a new one; nothing is overwritten"
        )
    folder.mkdir(parents=True)
    registered = summary.registrations()[best]
    camera = CameraModel.from_record((registered.full_camera or registered.camera).plain())
    images = _copy_images(summary, registered, folder / "images")
    poses = {image.name: image.T_scan_camera for image in images}
    write_camera_json(folder / "camera.json", camera)
    write_poses_csv(folder / "poses.csv", poses)
    write_transforms_json(folder / "transforms.json", camera, {f"images/{name}": T for name, T in poses.items()})
    vertices_m, faces = summary.scan_mesh()
    trimesh.Trimesh(vertices_m, faces, process=False).export(folder / "mesh.ply")
    description = {
        **described_run(summary, best, not_in_yet),
        "poses": "poses.csv is T_scan_camera: x right, y down, z forward; transforms.json has OpenGL axes",
        "image_sha256": {image.name: image.sha256 for image in images},
    }
    (folder / "dataset.json").write_text(json.dumps(description, indent=1), encoding="utf-8")


@dataclass(frozen=True, slots=True)
class _Image:
    """A photograph of the data set."""

    name: str
    sha256: str
    T_scan_camera: Transform


def _copy_images(summary: RunSummary, registered: Registration, folder: Path) -> list[_Image]:
    """Copy the registered photographs into a new folder."""
    folder.mkdir()
    images: list[_Image] = []
    for capture in summary.captures():
        T = registered.T_scan_camera.get(capture.viewpoint)
        photograph = capture.artefacts[0]
        if T is not None and photograph.kind in ("image", "control_image"):
            image = _Image(f"{capture.viewpoint}.jpg", photograph.sha256, np.array(T))
            shutil.copyfile(summary.store.artefact_path(photograph.sha256), folder / image.name)
            images.append(image)
    return images


def described_run(summary: RunSummary, own: str, not_in_yet: Sequence[str]) -> dict[str, Any]:
    """What `dataset.json` says of the run, as plain data; `own` is the name of its registration."""
    later = summary.better_later()
    return {
        "run": summary.run_id,
        "simulated": summary.root.simulated,
        "origin": summary.root.origin,
        "origin_in_words": _origin(summary),
        "protocol": f"{summary.root.protocol_id} {summary.root.protocol_version}",
        "protocol_sha256": summary.root.protocol_sha256,
        "frame": "scan",
        "unit": "m",
        "pose_source": own,
        "evaluation": [row.plain() for row in summary.table()],
        "gates": _gates(summary),
        "gates_explained": BOUNDS_HOLD,
        "accepted_gates": [gate.text for gate in accepted_gates(summary.protocol, summary.state)],
        "evaluation_note": shared_adjustment_note(summary.protocol, summary.state),
        "arrived_later": [late.text for late in late_results(summary.protocol, summary.state)],
        "arrived_later_and_better": None if later is None else later.poses,
        "not_in_yet": list(not_in_yet),
        "deviations": [d.text for d in summary.state.deviations if not d.is_note],
        "head_of_chain_sha256": summary.events[-1].sha256,
    }


def _gates(summary: RunSummary) -> dict[str, list[str]]:
    """Each judged step's gates in words, with their verdicts."""
    steps = {step.id: summary.state.steps[step.id] for step in summary.protocol.steps}
    return {
        name: [
            f"{describe(v)}: {standing(v, accepted=state.accepted is not None).replace('_', ' ')}"
            for v in state.verdicts
        ]
        for name, state in steps.items()
        if state.verdicts
    }


def _origin(summary: RunSummary) -> str:
    if summary.root.origin == "imported":
        return imported_sentence(summary.events[0].at_utc, summary.root.operator)
    return "The photographs were captured in this run"
