"""glTF 2.0 (binary) for looking: the mesh and the cameras in one file, metres, frame of the mesh."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

from service.compute.poses.pose_files import OPENGL
from service.dataset.export_folder import ExportFolder
from service.dataset.exporter import Exporter
from service.dataset.records import DataSet, PosedView

_FLOAT, _UNSIGNED = 5126, 5125  # component types
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`scene.glb`: the mesh in single precision, and a camera with its name for each view."""
    folder.file("scene.glb", lambda: glb(dataset))


def glb(dataset: DataSet) -> bytes:
    """Return the file, as Khronos' specification of glTF 2.0 describes it."""
    points = dataset.mesh.vertices_m.astype("<f4")
    blob = points.tobytes() + dataset.mesh.faces.astype("<u4").tobytes()
    split = points.nbytes
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "orthocapture", "extras": {"simulated": dataset.simulated}},
        "scene": 0,
        "scenes": [{"nodes": list(range(1 + len(dataset.views)))}],
        "nodes": [{"name": "mesh", "mesh": 0}, *(_node(k, view) for k, view in enumerate(dataset.views))],
        "cameras": [_camera(view) for view in dataset.views],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "type": "VEC3",
                "count": len(points),
                "min": points.min(axis=0).tolist(),
                "max": points.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": _UNSIGNED, "type": "SCALAR", "count": dataset.mesh.faces.size},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": split, "target": _VERTICES},
            {"buffer": 0, "byteOffset": split, "byteLength": len(blob) - split, "target": _INDICES},
        ],
        "buffers": [{"byteLength": len(blob)}],
    }
    if not dataset.views:
        del document["cameras"]  # an empty array is not allowed
    text = json.dumps(document, allow_nan=False).encode()
    chunks = _chunk(b"JSON", text, b" ") + _chunk(b"BIN\0", blob, b"\0")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _chunk(kind: bytes, data: bytes, filler: bytes) -> bytes:
    data += filler * (-len(data) % 4)
    return struct.pack("<I4s", len(data), kind) + data


def _node(number: int, view: PosedView) -> dict[str, Any]:
    """Return the pose with OpenGL's axes; matrices are stored column by column."""
    return {"name": view.name, "camera": number, "matrix": (view.T_world_camera @ OPENGL).T.ravel().tolist()}


def _camera(view: PosedView) -> dict[str, Any]:
    """Return a symmetric pinhole: glTF has neither a principal point nor distortion."""
    camera = view.camera
    lens = {
        "yfov": 2 * math.atan(camera.height / (2 * camera.fy)),
        "aspectRatio": camera.width * camera.fy / (camera.height * camera.fx),
        "znear": 0.01,
    }
    return {"name": view.name, "type": "perspective", "perspective": lens}


KIND = Exporter("gltf", "glTF for looking: the mesh and the cameras in one file", write)
