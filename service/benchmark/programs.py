"""Our own programs of reconstruction, each a process that sees only an exported folder, its images and poses.

Run: python -m service.benchmark.programs stereo DATA MESH, dense stereo on a processor; triangulate DATA DENSE, which
makes the workspace that COLMAP's and OpenMVS's dense steps begin with; patch_match DENSE FUSED MESH, for which
pycolmap must be built with CUDA; or gaussians DATA MESH [STEPS], Gaussian splatting with gsplat and a mesh of its
depth maps, which needs torch and CUDA.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_grey, read_image
from service.compute.poses.pose_files import HALF_PIXEL
from service.compute.stereo.matching import DepthMap, StereoView
from service.compute.stereo.reconstruct import fused, reconstruct, surface_of
from service.compute.surfaces.surface import write_ply
from service.core.errors import ComputeError, DataError, OrthocaptureError
from service.core.geometry import Array, inverse, transform
from service.machine.executors import computing_as_environment_says
from service.machine.resources import keep_freed_memory

_USAGE = """usage: python -m service.benchmark.programs stereo DATA MESH | triangulate DATA DENSE
       | patch_match DENSE FUSED MESH | gaussians DATA MESH [STEPS]"""


def views_of(data: Path) -> tuple[StereoView, ...]:
    """Return the images of an export in the format `colmap-pinhole`.

    Raises:
        DataError: a camera is not a pinhole, or an image cannot be read.
    """
    model = pycolmap.Reconstruction(str(data / "sparse" / "0"))
    views: list[StereoView] = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        if camera.model.name != "PINHOLE":
            raise DataError("a camera has distortion", where=image.name, remedy="Export as colmap-pinhole")
        fx, fy, cx, cy = (float(x) for x in camera.params)
        pinhole = CameraModel(camera.width, camera.height, fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL)
        pose = image.cam_from_world().inverse().matrix()
        views.append(StereoView(read_grey(data / "images" / image.name), pinhole, transform(pose[:, :3], pose[:, 3])))
    return tuple(views)


def triangulate(data: Path, dense: Path) -> pycolmap.Reconstruction:
    """Extract, match and triangulate features of the exported images with pycolmap, poses and camera held.

    Args:
        data: an export in the format `colmap-pinhole`.
        dense: a new folder: `images/`, `sparse/` and `stereo/` as `colmap image_undistorter` makes them.
    """
    given = pycolmap.Reconstruction(str(data / "sparse" / "0"))
    first = next(iter(given.cameras.values()))
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = ", ".join(map(repr, first.params.tolist()))
    with tempfile.TemporaryDirectory(dir=dense.parent) as folder:
        database = Path(folder) / "database.db"
        mode = pycolmap.CameraMode.SINGLE if len(given.cameras) == 1 else pycolmap.CameraMode.PER_IMAGE
        # Images get their numbers in the order of their names, as in the export, before threads extract features.
        pycolmap.Database.open(database).close()
        pycolmap.import_images(database, data / "images", camera_mode=mode, options=reader)
        pycolmap.extract_features(database, data / "images", camera_mode=mode, reader_options=reader)
        pycolmap.match_exhaustive(database)
        model = pycolmap.triangulate_points(given, database, data / "images", Path(folder) / "model")
        pycolmap.undistort_images(dense, Path(folder) / "model", data / "images")
    return model


def patch_match(dense: Path, fused: Path, mesh: Path, meshing: pycolmap.PoissonMeshingOptions | None = None) -> None:
    """Run the steps of the program `colmap` with its own default options.

    Args:
        dense: COLMAP's workspace, as `triangulate` makes it.
        fused: PLY file for the fused points.
        mesh: PLY file for the mesh.
        meshing: options of the Poisson mesh; None for COLMAP's, which suit millions of points.

    Raises:
        ComputeError: the depth maps agree nowhere.
    """
    pycolmap.patch_match_stereo(dense)
    points = pycolmap.stereo_fusion(fused, dense, output_type="ply")
    if points.num_points3D() == 0:  # which the mesher would not survive
        raise ComputeError("the depth maps have no point in common", remedy="Use more images, at smaller angles")
    pycolmap.poisson_meshing(fused, mesh, meshing or pycolmap.PoissonMeshingOptions())


def stereo(data: Path, mesh: Path) -> None:
    """Reconstruct an export in the format `colmap-pinhole` by dense stereo on a processor."""
    keep_freed_memory()
    cv2.setNumThreads(0)
    with computing_as_environment_says():
        found = reconstruct(views_of(data), _tell)
    write_ply(mesh, found, 1.0, {}, ["metres, in the frame of the poses"])


def _tell(what: str, done: int, total: int) -> None:
    sys.stdout.write(f"{what} {done}/{total}\n" if total else f"{what}\n")
    sys.stdout.flush()


STEPS = 15_000
_REFINED = 0.5  # part of the steps in which Gaussians are split, added and removed
_LAST_RATE = 0.01  # of the means, as a part of the first
_TOLD = 1000  # steps between two lines of progress
OPAQUE = 0.5  # a pixel's depth counts where the Gaussians before it are as opaque
VOXEL_PX = 1.5
LEAST_MAPS = 3
# Learning rates of 3D Gaussian splatting (Kerbl et al., SIGGRAPH 2023); that of the means is for a scene of size 1.
_RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "colors": 2.5e-3}


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


def gaussians(data: Path, mesh: Path, steps: int = STEPS) -> None:
    """Fit Gaussians to an export in the format `colmap-pinhole`, and make a mesh of their depth maps."""
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
    write_ply(mesh, found, 1.0, {}, ["metres, in the frame of the poses"])


def main() -> None:
    """Run the program that the command line names."""
    try:
        match sys.argv[1:]:
            case ["stereo", data, mesh]:
                stereo(Path(data), Path(mesh))
            case ["triangulate", data, dense]:
                sys.stdout.write(triangulate(Path(data), Path(dense)).summary() + "\n")
            case ["patch_match", dense, fused_points, mesh]:
                patch_match(Path(dense), Path(fused_points), Path(mesh))
            case ["gaussians", data, mesh, *steps] if len(steps) <= 1 and all(word.isdigit() for word in steps):
                gaussians(Path(data), Path(mesh), *map(int, steps))
            case _:
                raise SystemExit(_USAGE)
    except OrthocaptureError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
