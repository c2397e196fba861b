"""What earlier steps left behind, as plain job arguments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from service.core.errors import ConfigurationError
from service.core.records.events import ArtefactRef, View, ViewHeld, ViewpointCaptured
from service.steps.context import StepContext


def result_of(context: StepContext, step_id: str) -> Mapping[str, Any]:
    """The Result of an earlier step, as plain data; ConfigurationError if it has none."""
    state = context.run.steps.get(step_id)
    if state is None or not state.result:
        raise ConfigurationError(
            f"step {context.step.id!r} needs the result of step {step_id!r}, which has none",
            where=f"step {context.step.id}",
            remedy=f"Pass step {step_id!r} first, or correct the protocol",
        )
    return state.result


def artefact_of(context: StepContext, step_id: str, kind: str) -> ArtefactRef:
    """The newest artefact of one kind that an earlier step produced."""
    state = context.run.steps.get(step_id)
    found = [ref for ref in (state.artefacts if state else ()) if ref.kind == kind]
    if not found:
        raise ConfigurationError(
            f"step {context.step.id!r} needs a {kind} of step {step_id!r}, which has none",
            where=f"step {context.step.id}",
            remedy=f"Pass step {step_id!r} first, or correct the protocol",
        )
    return found[-1]


def captured_images(context: StepContext, step_ids: Iterable[str]) -> list[dict[str, Any]]:
    """Every valid photograph of the given capture steps with its pose, in order of capture.

    Events recorded since this step began (its own images) are read through the evidence, not the stale state.
    """
    images: list[dict[str, Any]] = []
    for step_id in step_ids:
        held = held_views(context, step_id)
        for capture in context.evidence.captures(step_id):
            if not all(capture.verdicts.values()):
                continue
            photograph = capture.artefacts[0]
            if isinstance(capture, ViewHeld) and not held.get(photograph.sha256, {}).get("used"):
                continue
            images.append(
                {
                    "name": f"{capture.viewpoint}.jpg",
                    "step": step_id,
                    "viewpoint": capture.viewpoint,
                    "station": capture.station,
                    "sha256": photograph.sha256,
                    **robot_pose_of(capture),
                    **_held_pose(held.get(photograph.sha256, {})),
                }
            )
    if not images:
        raise ConfigurationError(
            f"no usable image from {', '.join(step_ids)}",
            where=f"step {context.step.id}",
            remedy="Take the images again",
        )
    return images


def robot_pose_of(view: View) -> dict[str, Any]:
    """The robot's pose at a photograph, as job arguments; empty where there was no robot."""
    if isinstance(view, ViewpointCaptured):
        return {"T_base_flange": [list(row) for row in view.T_base_flange], "joints_rad": list(view.joints_rad)}
    return {}


def held_views(context: StepContext, step_id: str) -> dict[str, Mapping[str, Any]]:
    """By photograph: what the worker found in the hand-held images of a step.

    Without a CT each image refines where all were: the newest poses count.
    """
    jobs = [j for j in context.evidence.jobs(step_id) if j.kind in ("hand_view", "hand_board")]
    done = [job for job in jobs if job.status == "finished"]
    refined: Mapping[str, Any] = done[-1].result.get("T_scene_cameras", {}) if done else {}
    found: dict[str, Mapping[str, Any]] = {}
    for job in done:
        newest = refined.get(job.result["viewpoint"])
        found[str(job.arguments["image"]["sha256"])] = (
            job.result if newest is None else {**job.result, "T_scene_camera": newest}
        )
    return found


def _held_pose(found: Mapping[str, Any]) -> dict[str, Any]:
    return {"T_scene_camera": found["T_scene_camera"]} if found.get("T_scene_camera") else {}


def hand_eye_of(context: StepContext, step_id: str, stations: Iterable[str]) -> dict[str, Any]:
    """What turns the robot's poses into camera poses, as job arguments (worker/robot_poses.py).

    The arm's correction is of one arm: it names the stations where that arm stood.
    """
    result = result_of(context, step_id)
    correction = (result.get("hand_eye") or {}).get("arm_correction")
    if correction is not None:
        robots = set(result["robots"])
        mine = sorted({station for station in stations if context.devices.layout(station).robot in robots})
        kept = ("model", "arm", "dh_deltas", "gear_cos_rad", "gear_sin_rad", "observed", "T_flange_camera")
        correction = {key: correction[key] for key in kept} | {"stations": mine}
    return {"T_flange_camera": result["T_flange_camera"], "arm_correction": correction}


def intrinsics_covariance_of(context: StepContext, step_id: str) -> list[list[float]] | None:
    """(8, 8) of fx, fy, cx, cy, k1, k2, p1, p2 of a calibration; None where its lens model has other parameters."""
    record = (result_of(context, step_id)["details"].get("intrinsics") or {}).get("covariance")
    if record is None:
        return None
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    known = list(record["parameters"])
    if not set(known) <= set(names):
        return None
    rows = record["matrix"]
    # What the model holds fixed is known exactly; the solver needs a number that is not zero.
    return [
        [rows[known.index(a)][known.index(b)] if a in known and b in known else 1e-18 * (a == b) for b in names]
        for a in names
    ]
