"""Stands in for programs of reconstruction: finds the corners of a known solid from the poses that it is given.

It is put in the place of COLMAP, OpenMVS, Instant-NGP, NeuS2 and SuGaR. $STAND_IN names a JSON file with the rays
(normalised coordinates) of the solid's corners in each view, and its faces. The poses come from the exported folder
alone, read as each program reads them; the mesh is left where, how and in the frame in which that program leaves it.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]


def meeting(poses: dict[str, Array]) -> Array:
    """(V, 3) where the rays of each corner meet, in the frame of the poses: (3, 4), camera to there."""
    known = json.loads(Path(os.environ["STAND_IN"]).read_text(encoding="utf-8"))["rays"]
    corners = len(next(iter(known.values())))
    normal, right = np.zeros((corners, 3, 3)), np.zeros((corners, 3))
    for name, pose in poses.items():
        for corner, (x, y) in enumerate(known[name]):
            ray = pose[:, :3] @ np.array([x, y, 1.0])
            across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
            normal[corner] += across
            right[corner] += across @ pose[:, 3]
    return np.linalg.solve(normal, right[..., None])[..., 0].astype(np.float64)


def write_obj(path: Path, vertices: Array) -> None:
    """Write vertices and the solid's faces as OBJ."""
    faces = json.loads(Path(os.environ["STAND_IN"]).read_text(encoding="utf-8"))["faces"]
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices]
    path.write_text("\n".join([*rows, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]) + "\n")


def write_ply(path: Path, vertices: Array) -> None:
    """Write vertices and the solid's faces as PLY."""
    faces = json.loads(Path(os.environ["STAND_IN"]).read_text(encoding="utf-8"))["faces"]
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property double {n}" for n in "xyz")]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [f"{x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices] + [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text("\n".join(head + rows) + "\n")


def radiance_poses(document: Any) -> dict[str, Array]:
    """Poses in the unit cube, as `nerf_matrix_to_ngp` makes them of frames; OpenCV's axes in the camera."""
    poses: dict[str, Array] = {}
    for frame in document["frames"]:
        pose = np.array(frame["transform_matrix"])[:3]
        if "from_na" not in document:
            pose[:, 1:3] *= -1
        pose[:, 3] = pose[:, 3] * document["scale"] + np.array(document["offset"])
        poses[Path(frame["file_path"]).stem] = pose if "from_na" in document else pose[[1, 2, 0]]
    return poses


def colmap_poses(folder: Path) -> dict[str, Array]:
    """Poses of a COLMAP model, camera to world."""
    model = pycolmap.Reconstruction(str(folder))
    return {Path(image.name).stem: image.cam_from_world().inverse().matrix() for image in model.images.values()}


def saved(document: Any, cube: Array) -> Array:
    """Points of the unit cube as both programs write them."""
    return (cube - np.array(document["offset"])) / document["scale"]


def option(name: str) -> str:
    """The value of an option of the command line."""
    return sys.argv[sys.argv.index(name) + 1]


def radiance() -> None:
    """Instant-NGP or NeuS2: `scripts/run.py`."""
    scene = Path(option("--scene"))
    neus2 = scene.is_file()
    document = json.loads((scene if neus2 else scene / "transforms.json").read_text(encoding="utf-8"))
    vertices = saved(document, meeting(radiance_poses(document)))
    if neus2:
        write_obj(Path("output") / option("--name") / "mesh" / f"{option('--n_steps')}.obj", vertices)
    else:
        write_ply(Path(option("--save_mesh")), vertices)


def splatting() -> None:
    """3D Gaussian splatting, then SuGaR: `train.py`."""
    data = Path(option("-s"))
    if "-m" in sys.argv:
        Path(option("-m")).mkdir()
        return
    assert Path(option("-c")).is_dir()
    write_obj(Path(option("-o")) / "refined" / "sugarfine_1.obj", meeting(colmap_poses(data / "sparse" / "0")))


def colmap() -> None:
    """COLMAP's dense steps, on the workspace that was made for them."""
    if sys.argv[1] == "patch_match_stereo":
        (Path(option("--workspace_path")) / "stereo" / "done").write_text("")
    elif sys.argv[1] == "stereo_fusion":
        workspace = Path(option("--workspace_path"))
        assert (workspace / "stereo" / "done").is_file()
        np.save(Path(option("--output_path")).with_suffix(".npy"), meeting(colmap_poses(workspace / "sparse")))
    else:
        write_ply(Path(option("--output_path")), np.load(Path(option("--input_path")).with_suffix(".npy")))


def openmvs(program: str) -> None:
    """OpenMVS's programs; what one writes is the next one's input."""
    work = Path(option("-w"))
    if program == "InterfaceCOLMAP":
        vertices = meeting(colmap_poses(Path(option("-i")) / "sparse"))
        assert any(Path(option("--image-folder")).iterdir())
        write_ply(work / option("-o"), vertices)
    else:
        (work / option("-o")).write_bytes((work / option("-m" if program == "RefineMesh" else "-i")).read_bytes())


def main() -> None:
    """Be the program by whose name this was called."""
    name = Path(sys.argv[0]).name
    if name == "colmap":
        colmap()
    elif name == "run.py":
        radiance()
    elif name == "train.py":
        splatting()
    else:
        openmvs(name)


if __name__ == "__main__":
    main()
