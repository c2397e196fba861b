"""Job `structure_from_motion`: camera poses from the images alone, one model over both stations."""

from __future__ import annotations

import numpy as np

from service.compute.poses.sfm import SfmOptions, reconstruct
from service.worker.job import JobAnswer, JobContext


def structure_from_motion(context: JobContext) -> JobAnswer:
    """Run each wanted mapper on shared features; the robot's poses only choose which pairs are matched."""
    arguments = context.arguments
    files = {image["viewpoint"]: context.input(image["sha256"]) for image in arguments["images"]}
    prior = {name: np.array(T) for name, T in (arguments.get("prior") or {}).items()}
    options = SfmOptions(**arguments["effort"])
    measures: dict[str, float] = {}
    artefacts = []
    for mapper in arguments["mappers"]:
        model = reconstruct(
            files,
            context.camera(),
            context.scratch,
            mapper,
            T_world_camera_prior=prior or None,
            options=options,
            progress=context.progress,
        )
        measures[f"{mapper}_images"] = float(model.n_registered)
        measures[f"{mapper}_missing"] = float(len(model.missing))
        measures[f"{mapper}_reprojection_px"] = model.mean_reprojection_error_px
        data = {
            "mapper": mapper,
            "T_world_camera": {name: T.tolist() for name, T in model.T_world_camera.items()},
            "mean_reprojection_error_px": model.mean_reprojection_error_px,
            "mean_track_length": model.mean_track_length,
            "missing": list(model.missing),
            "models": model.n_models,
            "points": len(model.points_world),
            "seconds": model.seconds,
        }
        artefacts.append(context.keep_json(data, kind="sfm_model", name=f"{mapper}.json"))
    return JobAnswer(measures, tuple(artefacts))
