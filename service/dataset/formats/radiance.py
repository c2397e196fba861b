"""Formats of programs for radiance fields: nerfstudio, Instant-NGP, NeuS2 and DTU, some in the unit box."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.compute.images.views import DEPTH_UNIT_MM, coded_depth
from service.compute.poses.pose_files import HALF_PIXEL, OPENGL, transforms_intrinsics
from service.core.errors import DataError
from service.core.geometry import Array, Transform, inverse
from service.core.units import metres
from service.dataset.export_folder import ExportFolder, Part
from service.dataset.exporter import Exporter, mask_png, png
from service.dataset.formats.colmap import write_images
from service.dataset.records import DataSet, Mesh, PosedView, only_camera


@dataclass(frozen=True, slots=True)
class UnitBox:
    """A cube around the scene: `unit = scale (world - centre_m)` is within -½ … ½ of each axis."""

    centre_m: Array  # (3,)
    scale: float  # 1/m

    def pose(self, T_world_camera: Transform) -> Transform:
        """Return the pose with its position relative to the centre, still in metres."""
        T = T_world_camera.copy()
        T[:3, 3] -= self.centre_m
        return T

    def record(self, dataset: DataSet, mesh_axes: tuple[int, int, int]) -> dict[str, object]:
        """Return JSON data to bring a saved mesh to the world: scale, centre, and which axes are the world's x, y, z.

        The programs undo the scale when they save a mesh, so only the centre has to be added.
        """
        return {
            "simulated": dataset.simulated,
            "centre_m": self.centre_m.tolist(),
            "scale_per_m": self.scale,
            "mesh_axes": list(mesh_axes),
            "meaning": "unit = scale_per_m * (world - centre_m); for a saved mesh, "
            "world = mesh[:, mesh_axes] + centre_m",
        }


def unit_box(mesh: Mesh, fill: float = 0.9) -> UnitBox:
    """Return the box about a mesh whose longest extent fills this share of the box's edge."""
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    return UnitBox((low + high) / 2, fill / float((high - low).max()))


PINHOLE_REMEDY = "Choose a format with undistorted images"


def write_nerfstudio(dataset: DataSet, folder: ExportFolder) -> None:
    """`transforms.json`, `images/`, `depth/` (16 bit, 0.1 mm, 0 where none is known) and `masks/` (0: leave out).

    Poses are camera to world with OpenGL's axes, in metres and the frame of the mesh. Keep them with
    `nerfstudio-data --orientation-method none --center-method none --auto-scale-poses False
    --depth-unit-scale-factor 1e-4`.

    Raises:
        DataError: a camera has the rational distortion k4, k5, k6.
    """
    frames = [
        {
            "file_path": f"images/{view.file}",
            "depth_file_path": f"depth/{view.name}.png",
            "mask_path": f"masks/{view.name}.png",
            **transforms_intrinsics(view.camera, remedy=PINHOLE_REMEDY),
            "transform_matrix": (view.T_world_camera @ OPENGL).tolist(),
            "covariance": view.covariance.tolist(),
        }
        for view in dataset.views
    ]
    files = {view.name: f"images/{view.file}" for view in dataset.views}
    document: dict[str, Any] = {
        "simulated": dataset.simulated,
        "camera_model": "OPENCV",
        "depth_unit_scale_factor": metres(DEPTH_UNIT_MM),
        "train_filenames": [files[name] for name in dataset.splits.train],
        "val_filenames": [files[name] for name in dataset.splits.test],
        "test_filenames": [files[name] for name in dataset.splits.test],
        "frames": frames,
    }
    folder.json("transforms.json", document)
    write_images(dataset, folder, "images")
    for view in dataset.views:
        folder.file(
            f"depth/{view.name}.png",
            lambda view=view: png(coded_depth(dataset.pixels.depth_m(view)), dataset.mark),
            Part("depth", view.name),
        )
        folder.file(
            f"masks/{view.name}.png",
            lambda view=view: mask_png(dataset.pixels.valid(view) & ~dataset.pixels.markers(view), dataset.mark),
            Part("mask", view.name),
        )


def write_instant_ngp(dataset: DataSet, folder: ExportFolder) -> None:
    """`transforms.json`, `images/` and `unit_box.json`, which says how a mesh comes back.

    The centring is in the poses and the three offsets are equal: Instant-NGP adds them before it cycles the axes.

    Raises:
        DataError: the views have several cameras, or one with k3 … k6.
    """
    camera = only_camera(dataset, "Instant-NGP")
    if camera.k3 or camera.k4 or camera.k5 or camera.k6:
        raise DataError("Instant-NGP knows only k1, k2, p1, p2", remedy="Export undistorted images")
    box = unit_box(dataset.mesh)
    folder.json(
        "transforms.json",
        {
            "simulated": dataset.simulated,
            **transforms_intrinsics(camera, remedy=PINHOLE_REMEDY),
            "aabb_scale": 1,
            "scale": box.scale,
            "offset": [0.5, 0.5, 0.5],
            "frames": [
                {
                    "file_path": f"images/{view.file}",
                    "transform_matrix": (box.pose(view.T_world_camera) @ OPENGL).tolist(),
                }
                for view in dataset.views
            ],
        },
    )
    # It cycles axes: (x, y, z) of its mesh is (Y, Z, X) of the poses that it was given (`nerf_matrix_to_ngp` in its
    # include/neural-graphics-primitives/nerf_loader.h).
    folder.json("unit_box.json", box.record(dataset, mesh_axes=(2, 0, 1)))
    write_images(dataset, folder, "images")


def write_neus2(dataset: DataSet, folder: ExportFolder) -> None:
    """`transform.json`, `images/*.png` with alpha 0 where no surface or a marker is seen, and `unit_box.json`,
    which says how a mesh comes back.

    NeuS2 only tests whether `from_na` is there; camera to world, x right, y down, z forward.

    Raises:
        DataError: the views have several cameras.
    """
    camera = only_camera(dataset, "NeuS2")
    box = unit_box(dataset.mesh)
    K = np.eye(4)
    K[:3, :3] = camera.matrix
    K[:2, 2] += HALF_PIXEL
    folder.json(
        "transform.json",
        {
            "simulated": dataset.simulated,
            "from_na": True,
            "w": camera.width,
            "h": camera.height,
            "aabb_scale": 1.0,
            "scale": box.scale,
            "offset": [0.5, 0.5, 0.5],
            "frames": [
                {
                    "file_path": f"images/{view.name}.png",
                    "transform_matrix": box.pose(view.T_world_camera).tolist(),
                    "intrinsic_matrix": K.tolist(),
                }
                for view in dataset.views
            ],
        },
    )
    # With `from_na` it cycles no axes.
    folder.json("unit_box.json", box.record(dataset, mesh_axes=(0, 1, 2)))
    for view in dataset.views:
        folder.file(f"images/{view.name}.png", lambda view=view: _with_alpha(dataset, view), Part("image", view.name))


def _with_alpha(dataset: DataSet, view: PosedView) -> bytes:
    pixels = dataset.pixels
    shown = (pixels.depth_m(view) > 0) & pixels.valid(view) & ~pixels.markers(view)
    return png(np.dstack([pixels.colours(view), np.where(shown, np.uint8(255), np.uint8(0))]), dataset.mark)


def write_dtu(dataset: DataSet, folder: ExportFolder) -> None:
    """`cameras.npz`, `image/000000.png` and `mask/000000.png` (255: the mesh, and no marker), in order of the views.

    `world_mat_i` (4, 4) maps world points in metres to pixels, whose centres lie at integers, as these readers sample
    them. `scale_mat_i` maps the unit sphere to the world. `names` has the views' names.
    """
    folder.file("cameras.npz", lambda: _cameras(dataset))
    for k, view in enumerate(dataset.views):
        folder.file(
            f"image/{k:06d}.png",
            lambda view=view: png(dataset.pixels.colours(view), dataset.mark),
            Part("image", view.name),
        )
        folder.file(
            f"mask/{k:06d}.png",
            lambda view=view: mask_png(_shown(dataset, view), dataset.mark),
            Part("mask", view.name),
        )


def _shown(dataset: DataSet, view: PosedView) -> NDArray[np.bool_]:
    return (dataset.pixels.depth_m(view) > 0) & dataset.pixels.valid(view) & ~dataset.pixels.markers(view)


def _cameras(dataset: DataSet) -> bytes:
    box = unit_box(dataset.mesh)
    half_diagonal = float(np.linalg.norm(np.ptp(dataset.mesh.vertices_m, axis=0))) / 2
    scale = np.diag([half_diagonal, half_diagonal, half_diagonal, 1.0])
    scale[:3, 3] = box.centre_m
    arrays: dict[str, Array] = {}
    for k, view in enumerate(dataset.views):
        projection = np.eye(4)
        projection[:3] = view.camera.matrix @ inverse(view.T_world_camera)[:3]
        arrays[f"world_mat_{k}"], arrays[f"scale_mat_{k}"] = projection, scale
    buffer = io.BytesIO()
    names = np.array([view.name for view in dataset.views])
    np.savez(buffer, allow_pickle=False, simulated=np.array(dataset.simulated), names=names, **arrays)
    return buffer.getvalue()


KINDS = (
    Exporter("nerfstudio", "nerfstudio's transforms.json, with depth and masks", write_nerfstudio),
    Exporter(
        "instant-ngp", "Instant-NGP's transforms.json, the scene in the unit box", write_instant_ngp, one_camera=True
    ),
    Exporter(
        "neus2",
        "NeuS2: RGBA images with masks, the scene in the unit box",
        write_neus2,
        pinhole=True,
        one_camera=True,
    ),
    Exporter("dtu", "DTU as IDR and NeuS read it: cameras.npz, images and masks", write_dtu, pinhole=True),
)
