"""Encodes scans as a scanner's software writes them: binary PLY and STL, OBJ with material and texture."""

from __future__ import annotations

import struct

import cv2
import numpy as np

from simulators.geometry import Array, Ints


def encode(kind: str, name: str, vertices: Array, faces: Ints, normals: Array | None) -> list[tuple[str, bytes]]:
    """Return the names and contents of an export's files, the mesh first; vertices (V, 3) are in the file's unit."""
    if kind == "ply":
        return [(name, _ply(vertices, faces, normals))]
    if kind == "stl":
        return [(name, _stl(vertices, faces))]
    stem = name.rsplit(".", 1)[0]
    material = f"newmtl surface\nKd 0.8 0.8 0.8\nmap_Kd {stem}_0.png\n".encode()
    return [
        (name, _obj(stem, vertices, faces, normals)),
        # Upper and lower case differ from what the OBJ and MTL files say, as on case-insensitive file systems.
        (f"{stem}.MTL", material),
        (f"{stem}_0.PNG", _texture()),
    ]


def _ply(vertices: Array, faces: Ints, normals: Array | None) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in ("x", "y", "z")]
    if normals is not None:
        lines += [f"property float {axis}" for axis in ("nx", "ny", "nz")]
        vertices = np.concatenate([vertices, normals], axis=1)
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    rows["n"] = 3
    rows["v"] = faces
    return "\n".join(lines).encode() + vertices.astype("<f4").tobytes() + rows.tobytes()


def _stl(vertices: Array, faces: Ints) -> bytes:
    p = vertices[faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    rows = np.zeros(len(faces), dtype=[("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    rows["n"], rows["v"] = normal, p
    return b"scan".ljust(80, b"\0") + struct.pack("<I", len(faces)) + rows.tobytes()


def _obj(stem: str, vertices: Array, faces: Ints, normals: Array | None) -> bytes:
    low, span = vertices.min(axis=0), np.ptp(vertices, axis=0)
    uv = ((vertices - low) / span)[:, :2]
    text = [f"# {len(vertices)} vertices\n# {len(faces)} faces\nmtllib {stem}.mtl\nusemtl surface\n"]
    text.append(_rows("v %.5f %.5f %.5f\n", vertices))
    text.append(_rows("vt %.5f %.5f\n", uv))
    index = faces + 1
    if normals is not None:
        text.append(_rows("vn %.4f %.4f %.4f\n", normals))
        text.append(_rows("f %d/%d/%d %d/%d/%d %d/%d/%d\n", np.repeat(index, 3, axis=1)))
    else:
        text.append(_rows("f %d/%d %d/%d %d/%d\n", np.repeat(index, 2, axis=1)))
    return "".join(text).encode()


def _rows(form: str, rows: Array | Ints) -> str:
    """Format all rows, in blocks, because a single format string would be as long as the file."""
    return "".join(
        (form * len(block)) % tuple(block.ravel().tolist()) for block in np.array_split(rows, len(rows) // 50_000 + 1)
    )


def _texture() -> bytes:
    image = np.random.default_rng(1).integers(150, 220, (64, 64, 3)).astype(np.uint8)
    ok, data = cv2.imencode(".png", image)
    assert ok
    return data.tobytes()
