"""Job `calibrate`: board images → intrinsics, hand-eye, or both."""

from __future__ import annotations

import dataclasses
import os
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from service.compute.calibration.hand_eye import calibrate_hand_eye
from service.compute.calibration.intrinsics import calibrate_intrinsics, detect_board, half_turn, locate_board
from service.compute.images import read_image
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.worker.job import JobAnswer, JobContext


def calibrate(context: JobContext) -> JobAnswer:
    """Detect the board in every image, then solve what the step asks for."""
    arguments = context.arguments
    images = arguments["images"]
    columns, rows, square_m = int(arguments["columns"]), int(arguments["rows"]), float(arguments["square_m"])
    files = [context.input(image["sha256"]) for image in images]
    corners: list[Array] = []
    seen: list[int] = []
    missed: list[str] = []
    size = (0, 0)
    work = partial(_corners, columns=columns, rows=rows)
    with ProcessPoolExecutor(min(len(files), os.cpu_count() or 1), mp_context=get_context("spawn")) as pool:
        for i, (found, shape) in enumerate(pool.map(work, files)):
            context.progress("board images", i + 1, len(files))
            if found is None:
                missed.append(images[i]["viewpoint"])
                continue
            corners.append(found)
            seen.append(i)
            size = shape
    if not corners:
        raise ComputeError("the board is seen in no image", remedy="Check board size, light and focus")
    measures: dict[str, float] = {"views": float(len(corners)), "views_without_board": float(len(missed))}
    details: dict[str, Any] = {"views_without_board": missed}
    if "intrinsics" in arguments["solve"]:
        solved = calibrate_intrinsics(corners, square_m, columns, rows, size)
        camera = solved.camera
        measures |= {
            "rms_px": solved.rms_px,
            "coverage": solved.coverage,
            "tilt_deg": float(solved.tilt_deg.max()),
            "views": float(len(solved.views)),
        }
        details |= {"per_view_rms_px": solved.per_view_rms_px.tolist(), "sigma": dict(solved.sigma)}
        details["excluded"] = {images[seen[view.index]]["viewpoint"]: view.reason for view in solved.excluded}
    else:
        camera = context.camera()
    result: dict[str, Any] = {"camera": dataclasses.asdict(camera), "details": details}
    if "hand_eye" in arguments["solve"]:
        T_camera_board = np.array([locate_board(found, square_m, columns, rows, camera)[0] for found in corners])
        T_base_flange = np.array([images[i]["T_base_flange"] for i in seen])
        answer = calibrate_hand_eye(T_base_flange, T_camera_board, T_board_turned=half_turn(columns, rows, square_m))
        result["T_flange_camera"] = answer.T_flange_camera.tolist()
        result["T_base_board"] = answer.T_base_board.tolist()
        measures |= {
            "hand_eye_sigma_mm": answer.sigma_mm,
            "hand_eye_sigma_deg": answer.sigma_deg,
            "hand_eye_held_out_mm": float(np.median(answer.held_out_mm)),
            "hand_eye_held_out_deg": float(np.median(answer.held_out_deg)),
            "rotation_spread_deg": answer.rotation_spread_deg,
        }
        details["hand_eye_methods_spread_mm"] = answer.spread_mm
    ref = context.keep_json({**result, "measures": measures}, kind="calibration", name="calibration.json")
    return JobAnswer(measures, (ref,), result)


def _corners(path: Path, columns: int, rows: int) -> tuple[Array | None, tuple[int, int]]:
    cv2.setNumThreads(1)  # the pool already uses every core
    grey = cv2.cvtColor(read_image(path), cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
    height, width = grey.shape
    try:
        return detect_board(grey, columns, rows), (width, height)
    except ComputeError:
        return None, (width, height)
