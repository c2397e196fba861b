"""Sphere identity in one image (four of ten visible, three false detections): counts of right, refused and wrong."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.machine import RESULTS
from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, cone_of_sphere
from service.compute.markers.records import OutlineEvidence, SphereOutline, outline_from_cone
from service.compute.registration.identity import identify_each
from service.compute.scene import ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import apply, inverse, look_at
from simulators.scene.world import RADIUS_M, Scene

Array = NDArray[np.float64]
RESULT = RESULTS / "identity.json"
CAMERA = CameraModel(1920, 1280, 2688.0, 2689.0, 966.0, 634.0, -0.05, 0.03, 2e-4, -3e-4)


@dataclass(frozen=True, slots=True)
class Trial:
    """One image: outlines in random order, and the sphere of each (-1: none)."""

    outlines: tuple[SphereOutline, ...]
    truth: tuple[int, ...]
    centres: Array


@lru_cache
def _laboratory(seed: int) -> Array:
    return Scene.generate(seed).registration_m


def random_layout(rng: np.random.Generator) -> Array:
    """Ten spheres (10, 3) anywhere on a board, at least 50 mm apart, with centres 30 to 110 mm high."""
    points: list[Array] = []
    while len(points) < 10:
        p = rng.uniform([-0.22, -0.14, 0.03], [0.22, 0.14, 0.11])
        if all(np.linalg.norm(p[:2] - q[:2]) > 0.05 for q in points):
            points.append(p)
    return np.array(points)


def make_trial(seed: int, visible: int, n_false: int, noise_px: float) -> Trial:
    """A trial with the simulated laboratory's layout (even seeds) or a random one (odd), from a random direction."""
    rng = np.random.default_rng([seed, 0x1DE])
    while True:
        centres = _laboratory(seed % 80) if seed % 2 == 0 else random_layout(rng)
        azimuth, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(3, 45))
        out = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        target = np.array([*rng.uniform(-0.05, 0.05, 2), 0.05])
        up = np.array([np.cos(azimuth + rng.uniform(2, 4)), np.sin(azimuth + rng.uniform(2, 4)), 0.1])
        T_world_camera = look_at(target + rng.uniform(0.5, 0.8) * out, target, up)
        c = apply(inverse(T_world_camera), centres)
        pixels = CAMERA.project(c)
        inside = np.nonzero(np.all((pixels > 40) & (pixels < [CAMERA.width - 40, CAMERA.height - 40]), axis=1))[0]
        if len(inside) >= visible:
            break
    chosen = rng.choice(inside, visible, replace=False)
    f = CAMERA.fx
    evidence = OutlineEvidence(
        1.0, 0.2, 0.2, 300, 0.1, 0.3, (180.0, 180.0, 180.0), 0.9, np.eye(3) * (max(noise_px, 0.02) / f) ** 2
    )
    outlines: list[SphereOutline] = []
    truth: list[int] = []
    for k in chosen:
        cone = cone_of_sphere(c[k], RADIUS_M)
        d = rng.normal(size=3) * noise_px / f
        axis = cone.axis + cone.frame()[:, :2] @ d[:2]
        noisy = Cone(axis / float(np.linalg.norm(axis)), cone.half_angle_rad + float(d[2]))
        outlines.append(outline_from_cone(noisy, CAMERA, 8, evidence))
        truth.append(int(k))
    for _ in range(n_false):
        ray = np.append(CAMERA.normalise(rng.uniform([0, 0], [CAMERA.width, CAMERA.height])[None])[0], 1.0)
        # With the size of a real sphere at these distances, so that the size does not reveal a false detection.
        place = ray * rng.uniform(0.45, 0.85)
        outlines.append(outline_from_cone(cone_of_sphere(place, RADIUS_M), CAMERA, 8, evidence))
        truth.append(-1)
    order = rng.permutation(len(outlines))
    return Trial(tuple(outlines[k] for k in order), tuple(truth[k] for k in order), centres)


def run(trials: int, visible: int, n_false: int, noise_px: float) -> dict[str, float | int]:
    """Counts of right, refused and wrong answers, and the time per answer."""
    counts = {"right": 0, "in part": 0, "refused": 0, "wrong": 0}
    seconds: list[float] = []
    for seed in range(trials):
        trial = make_trial(seed, visible, n_false, noise_px)
        begin = time.process_time()
        try:
            (answer,) = identify_each([trial.outlines], CAMERA, ScanSpheres(trial.centres, RADIUS_M))
            markers = answer.markers
        except ComputeError:
            markers = {}
        seconds.append(time.process_time() - begin)
        if any(trial.truth[d] != m for d, m in markers.items()):
            counts["wrong"] += 1
        elif not markers:
            counts["refused"] += 1
        else:
            counts["right" if len(markers) == visible else "in part"] += 1
    return {
        "trials": trials, "visible": visible, "false": n_false, "noise_px": noise_px, **counts,
        "seconds_median": round(float(np.median(seconds)), 4), "seconds_worst": round(float(np.max(seconds)), 4),
    }  # fmt: skip


def main() -> None:
    """Run the trials and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=RESULT)
    options = parser.parse_args()
    rows = [
        run(options.trials, 4, 3, 0.2),
        run(options.trials // 4, 4, 3, 0.5),
        run(options.trials // 4, 5, 3, 0.2),
        run(options.trials // 4, 8, 5, 0.2),
        run(options.trials // 4, 10, 8, 0.2),
        run(options.trials // 4, 3, 5, 0.2),  # no right answer is possible here
    ]
    options.out.parent.mkdir(exist_ok=True)
    options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    for row in rows:
        print(row)


if __name__ == "__main__":
    main()
