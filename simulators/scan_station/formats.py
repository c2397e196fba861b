"""Encodes scans as a scanner's software writes them: binary PLY and STL, OBJ with material and texture.

Artec Studio's PLY is as in openscenegraph/OpenSceneGraph#908: without normals, with the places on textures as
elements of their own, and with textures that lie beside it and are not named in it. Its MTL has two comments, white
materials, and a second material without a map.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np

from simulators.geometry import Array, Ints

_ARTEC_PLY = "comment File exported by Artec Group 3D Scanning Solutions\ncomment www.artec-group.com\n"
_ARTEC_MTL = """\
#File exported by Artec 3D Scanning Solutions
#www.artec3d.com
newmtl material_0
Ka 1 1 1
Kd 1 1 1
Ks 1 1 1
Ns 1000
map_Kd {stem}_0.png
newmtl material_1
Ka 1 1 1
Kd 1 1 1
Ks 1 1 1
Ns 1000
"""


def encode(
    kind: str, name: str, vertices: Array, faces: Ints, normals: Array | None, *, artec: bool = False
) -> list[tuple[str, bytes]]:
    """Return the names and contents of an export's files, the mesh first.

    Args:
        kind: ply, obj or stl.
        name: the mesh file's name.
        vertices: (V, 3), in the file's unit.
        faces: (F, 3).
        normals: the vertices' normals (V, 3); None if the scanner exports none.
        artec: true for a file as Artec Studio writes it.
    """
    stem = name.rsplit(".", 1)[0]
    if kind == "ply" and artec:
        return [(name, _artec_ply(vertices, faces)), (f"{stem}_0.jpg", _texture(".jpg"))]
    if kind == "ply":
        return [(name, _ply(vertices, faces, normals))]
    if kind == "stl":
        return [(name, _stl(vertices, faces))]
    material = f"newmtl surface\nKd 0.8 0.8 0.8\nmap_Kd {stem}_0.png\n".encode()
    if artec:
        material = _ARTEC_MTL.format(stem=stem).encode()
    return [
        (name, _obj(stem, "material_0" if artec else "surface", vertices, faces, normals)),
        # Upper and lower case differ from what the OBJ and MTL files say, as on case-insensitive file systems.
        (f"{stem}.MTL", material),
        (f"{stem}_0.PNG", _texture(".png")),
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


def _artec_ply(vertices: Array, faces: Ints) -> bytes:
    head = ["ply", "format binary_little_endian 1.0", _ARTEC_PLY.rstrip(), f"element vertex {len(vertices)}"]
    head += [f"property float {axis}" for axis in ("x", "y", "z")]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    head += [f"element multi_texture_vertex {len(vertices)}", "property uchar tx"]
    head += [f"property float {name}" for name in ("u", "v")]
    head += [f"element multi_texture_face {len(faces)}", "property uchar tx", "property uint tn"]
    head += ["property list uchar int texture_vertex_indices", "end_header", ""]
    corners = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    corners["n"], corners["v"] = 3, faces
    places = np.zeros(len(vertices), dtype=[("tx", "u1"), ("uv", "<f4", 2)])
    places["uv"] = _places(vertices)
    wedges = np.zeros(len(faces), dtype=[("tx", "u1"), ("tn", "<u4"), ("n", "u1"), ("v", "<i4", 3)])
    wedges["n"], wedges["v"] = 3, faces
    rows = (vertices.astype("<f4"), corners, places, wedges)
    return "\n".join(head).encode() + b"".join(part.tobytes() for part in rows)


def _places(vertices: Array) -> Array:
    """Places (V, 2) on the texture, from 0 to 1."""
    low, span = vertices.min(axis=0), np.ptp(vertices, axis=0)
    return ((vertices - low) / span)[:, :2]


def _obj(stem: str, material: str, vertices: Array, faces: Ints, normals: Array | None) -> bytes:
    text = [f"# {len(vertices)} vertices\n# {len(faces)} faces\nmtllib {stem}.mtl\nusemtl {material}\n"]
    text.append(_rows("v %.5f %.5f %.5f\n", vertices))
    text.append(_rows("vt %.5f %.5f\n", _places(vertices)))
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


def _texture(kind: str) -> bytes:
    image = np.random.default_rng(1).integers(150, 220, (64, 64, 3)).astype(np.uint8)
    ok, data = cv2.imencode(kind, image)
    assert ok
    return data.tobytes()
