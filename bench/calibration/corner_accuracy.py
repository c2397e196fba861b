"""Corners of rendered boards against ground truth: error and time, from small images up to 61 megapixels."""

from __future__ import annotations

import argparse
import datetime
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bench.machine import RESULTS, commit, machine
from service.compute.calibration.board import Board, find_board
from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_grey
from service.core.geometry import apply, transform
from tests.support.boards.board_images import Photography, checkerboard, photograph

BOARD = Board(16, 23, 0.015)
LENS = CameraModel(1536, 1024, 2148.9, 2149.0, 770.9, 514.0, -0.0458, 0.0256, 4.4e-4, -4.9e-4)


def main(words: Sequence[str] | None = None) -> int:
    """Render, detect and compare; print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--widths", type=int, nargs="+", default=[1536, 4752, 9504])
    parser.add_argument("--images", type=int, default=3)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(words)
    cv2.setNumThreads(1)
    rows = [measure(width, k) for width in options.widths for k in range(options.images)]
    text = "\n".join(
        [
            "| width | image | corners | rms (px) | of a coordinate | worst | bias x, y | decode (s) | detect (s) |",
            "|---|---|---|---|---|---|---|---|---|",
            *(
                f"| {r['width']} | {r['image']} | {r['corners']} | {r['rms_px']:.4f} | {r['rms_1d_px']:.4f} | "
                f"{r['worst_px']:.3f} | {r['bias_px'][0]:+.4f}, {r['bias_px'][1]:+.4f} | "
                f"{r['decode_s']:.2f} | {r['detect_s']:.2f} |"
                for r in rows
            ),
        ]
    )
    sys.stdout.write(text + "\n")
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    options.results.mkdir(parents=True, exist_ok=True)
    about: dict[str, Any] = {"date": date, "commit": commit(), "machine": machine(), "rows": rows}
    stem = options.results / f"corner_accuracy-{date}"
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    heading = f"# Corners of a 16 × 23 board, {date}"
    notes = "Processor seconds of one thread; JPEG 95, gamma 2.2, noise of 2 levels, blurred by a lens."
    stem.with_suffix(".md").write_text(f"{heading}\n\n{notes}\n\n{text}\n")
    return 0


def measure(width: int, k: int) -> dict[str, Any]:
    """Corner errors and times of one image."""
    camera = LENS.scaled(width, round(width * LENS.height / LENS.width))
    rng = np.random.default_rng(k)
    points = BOARD.points()
    R = Rotation.from_euler("zxz", [40 + 70 * k, 14 + 6 * k, 55 - 70 * k], degrees=True).as_matrix()
    T = transform(R, np.array([0.004, -0.006, 0.86]) - R @ points.mean(axis=0))
    truth = camera.project(apply(T, points))
    shade = checkerboard(BOARD.columns, BOARD.rows, BOARD.square_m)
    # The blur scales with resolution above 4752 px (0.7 px there); smaller images are pixel-sharp.
    how = Photography(blur_px=0.7 if width < 4752 else 0.7 * width / 4752)
    image = photograph(shade, camera, T, rng, corners=truth if width > 4000 else None, samples=3, how=how)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "board.jpg"
        cv2.imwrite(str(file), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        begun = time.process_time()
        grey = read_grey(file)
        decoded = time.process_time()
        view = find_board(grey, BOARD)
        done = time.process_time()
    error = view.corners - truth[view.indices]
    distance = np.linalg.norm(error, axis=1)
    return {
        "width": width,
        "image": k,
        "corners": len(view.indices),
        "rms_px": float(np.sqrt(np.mean(distance**2))),
        "rms_1d_px": float(np.sqrt(np.mean(error**2))),
        "worst_px": float(distance.max()),
        "bias_px": error.mean(axis=0).tolist(),
        "decode_s": decoded - begun,
        "detect_s": done - decoded,
    }


if __name__ == "__main__":
    sys.exit(main())
