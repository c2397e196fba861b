"""Gaussian splatting with gsplat, and a mesh of its depth maps, as a program of its own: needs torch and CUDA.

Run: python -m service.benchmark.programs.gaussians DATA MESH [STEPS]
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from service.benchmark.programs.colmap import views_of
from service.compute.images.photographs import read_image
from service.compute.poses.pose_files import HALF_PIXEL
from service.compute.stereo.matching import DepthMap, StereoView
from service.compute.stereo.reconstruct import fused, surface_of
from service.compute.surfaces.surface import write_ply
from service.core.errors import OrthocaptureError
from service.core.geometry import Array, inverse

STEPS = 15_000
_REFINED = 0.5  # part of the steps in which Gaussians are split, added and removed
_LAST_RATE = 0.01  # of the means, as a part of the first
_TOLD = 1000  # steps between two lines of progress
OPAQUE = 0.5  # a pixel's depth counts where the Gaussians before it are as opaque
VOXEL_PX = 1.5
LEAST_MAPS = 3
# Learning rates of 3D Gaussian splatting (Kerbl et al., SIGGRAPH 2023); that of the means is for a scene of size 1.
_RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "colors": 2.5e-3}
_USAGE = "usage: python -m service.benchmark.programs.gaussians DATA MESH [STEPS]"


def first_gaussians(torch: Any, points_m: Array) -> Any:
    """Return grey Gaussians at points (N, 3), as large as the distance between neighbours, nearly transparent."""
    count = len(points_m)
    size = float(np.cbrt(np.prod(np.ptp(points_m, axis=0)) / count))
    quats = np.random.default_rng(0).normal(size=(count, 4))
    values = {
        "means": points_m,
        "scales": np.full((count, 3), np.log(size)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "opacities": np.full(count, np.log(0.1 / 0.9)),
        "colors": np.zeros((count, 3)),
    }
    made = {name: torch.nn.Parameter(torch.tensor(value, dtype=torch.float32)) for name, value in values.items()}
    return torch.nn.ParameterDict(made).to("cuda")


class Splatting:
    """3D Gaussians, trained on posed images."""

    def __init__(self, views: Sequence[StereoView], points_m: Array) -> None:
        """Take the views, and points (N, 3) to begin with."""
        self._torch: Any = importlib.import_module("torch")
        self._gsplat: Any = importlib.import_module("gsplat")
        self._views = views
        self._extent_m = float(np.linalg.norm(np.ptp(points_m, axis=0))) / 2
        self._gaussians = first_gaussians(self._torch, points_m)

    def train(self, pictures: Sequence[NDArray[np.uint8]], steps: int) -> None:
        """Fit to pictures (H, W, 3), one for each view, and print the progress."""
        torch = self._torch
        rates = _RATES | {"means": _RATES["means"] * self._extent_m}
        optimizers = {
            name: torch.optim.Adam([{"params": self._gaussians[name], "lr": rate, "name": name}], eps=1e-15)
            for name, rate in rates.items()
        }
        decay = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], _LAST_RATE ** (1 / steps))
        strategy = self._gsplat.DefaultStrategy(refine_stop_iter=round(_REFINED * steps))
        strategy.check_sanity(self._gaussians, optimizers)
        state = strategy.initialize_state(scene_scale=self._extent_m)
        order = np.random.default_rng(0)
        for step in range(steps):
            k = int(order.integers(len(self._views)))
            wanted = torch.tensor(pictures[k], device="cuda").float() / 255
            rendered, _, about = self._rendered(self._views[k], "RGB")
            strategy.step_pre_backward(self._gaussians, optimizers, state, step, about)
            error = (rendered[0] - wanted).abs().mean()
            error.backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            decay.step()
            strategy.step_post_backward(self._gaussians, optimizers, state, step, about, packed=False)
            if (step + 1) % _TOLD == 0:
                count = len(self._gaussians["means"])
                sys.stdout.write(f"step {step + 1} of {steps}: {count} Gaussians, mean error {error.item():.4f}\n")
                sys.stdout.flush()

    def depth_map(self, view: StereoView) -> DepthMap:
        """Return the expected depth of a view, where it is opaque."""
        with self._torch.no_grad():
            rendered, opacity, _ = self._rendered(view, "ED")
        depth = rendered[0, ..., 0].cpu().numpy().astype(np.float32)
        depth[opacity[0, ..., 0].cpu().numpy() < OPAQUE] = np.nan
        return DepthMap(depth, view.camera, view.T_world_camera, 1.0)

    def _rendered(self, view: StereoView, mode: str) -> tuple[Any, Any, Any]:
        torch, gaussians = self._torch, self._gaussians
        K = view.camera.matrix
        K[:2, 2] += HALF_PIXEL
        return self._gsplat.rasterization(
            gaussians["means"],
            gaussians["quats"],
            torch.exp(gaussians["scales"]),
            torch.sigmoid(gaussians["opacities"]),
            torch.sigmoid(gaussians["colors"]),
            torch.tensor(inverse(view.T_world_camera), dtype=torch.float32, device="cuda")[None],
            torch.tensor(K, dtype=torch.float32, device="cuda")[None],
            view.camera.width,
            view.camera.height,
            packed=False,
            render_mode=mode,
        )


def main() -> None:
    """Reconstruct the folder that the command line names."""
    if not 3 <= len(sys.argv) <= 4 or not all(word.isdigit() for word in sys.argv[3:]):
        raise SystemExit(_USAGE)
    data, steps = Path(sys.argv[1]), int(sys.argv[3]) if sys.argv[3:] else STEPS
    try:
        views = views_of(data)
        model = pycolmap.Reconstruction(str(data / "sparse" / "0"))
        points = np.array([point.xyz for point in model.points3D.values()])
        names = sorted(image.name for image in model.images.values())
        splatting = Splatting(views, points)
        splatting.train([read_image(data / "images" / name)[..., ::-1].copy() for name in names], steps)
        maps = [splatting.depth_map(view) for view in views]
        depth = float(np.nanmedian(np.concatenate([one.depth_m.ravel()[::97] for one in maps])))
        field = fused(maps, VOXEL_PX * depth / views[0].camera.fx, min(LEAST_MAPS, len(maps)))
        found = surface_of(field, min(LEAST_MAPS, len(maps)))
    except OrthocaptureError as error:
        raise SystemExit(str(error)) from error
    write_ply(Path(sys.argv[2]), found, 1.0, {}, ["metres, in the frame of the poses"])


if __name__ == "__main__":
    main()
