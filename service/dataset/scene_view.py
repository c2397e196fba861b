"""The scene in 3D for a report: cameras, spheres and the decimated mesh, as one self-contained plotly figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import fast_simplification
import numpy as np
import plotly.graph_objects as go

from service.core.geometry import Array, apply

_FACES_SHOWN = 40_000
_FRUSTUM_M = 0.05


def scene_figure(
    vertices_m: Array,
    faces: Any,
    spheres_m: Array,
    cameras: Mapping[str, Array],
    stations: Mapping[str, str],
    predicted_error_mm: Callable[[Array], Array] | None = None,
) -> str:
    """HTML (a div with its script) of the scene in the scan frame.

    Args:
        vertices_m: (V, 3).
        faces: (F, 3).
        spheres_m: (M, 3) registration spheres.
        cameras: T_scan_camera (4, 4) by viewpoint.
        stations: station of each viewpoint.
        predicted_error_mm: predicted target registration error (N,) of points (N, 3) of the scan; colours the mesh.
    """
    share = 1.0 - min(1.0, _FACES_SHOWN / max(len(faces), 1))
    points, triangles = vertices_m, faces.astype(np.int64)
    if share > 0:
        points, triangles = fast_simplification.simplify(points, triangles, target_reduction=share)[:2]
    figure = go.Figure()
    figure.add_mesh3d(
        x=points[:, 0], y=points[:, 1], z=points[:, 2], i=triangles[:, 0], j=triangles[:, 1], k=triangles[:, 2],
        lighting={"ambient": 0.5, "diffuse": 0.8}, name="scan", **_colouring(points, predicted_error_mm),
    )  # fmt: skip
    figure.add_scatter3d(
        x=spheres_m[:, 0], y=spheres_m[:, 1], z=spheres_m[:, 2], mode="markers+text", name="registration spheres",
        text=[str(i) for i in range(len(spheres_m))], marker={"size": 5, "color": "#1b7f3b"},
    )  # fmt: skip
    colours = ["#1f5fbf", "#bf5f1f", "#7f1fbf"]
    for colour, station in zip(colours, sorted(set(stations.values())), strict=False):
        names = [name for name in cameras if stations.get(name) == station]
        lines = _frusta([cameras[name] for name in names])
        figure.add_scatter3d(
            x=lines[:, 0], y=lines[:, 1], z=lines[:, 2], mode="lines", name=f"cameras of {station}",
            line={"color": colour, "width": 3}, hoverinfo="skip",
        )  # fmt: skip
        centres = np.array([cameras[name][:3, 3] for name in names])
        figure.add_scatter3d(
            x=centres[:, 0], y=centres[:, 1], z=centres[:, 2], mode="markers", text=names, hoverinfo="text",
            marker={"size": 3, "color": colour}, showlegend=False,
        )  # fmt: skip
    # The scan's frame is arbitrary: the cameras tell where up is.
    up = np.mean([T[:3, 3] for T in cameras.values()], axis=0) - spheres_m.mean(axis=0)
    up /= np.linalg.norm(up)
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    eye = 0.9 * up + 1.5 * side / np.linalg.norm(side)
    view = {axis: dict(zip("xyz", map(float, v), strict=True)) for axis, v in (("up", up), ("eye", eye))}
    figure.update_layout(
        scene_camera=view,
        scene={"aspectmode": "data", "xaxis_title": "x (m)", "yaxis_title": "y (m)", "zaxis_title": "z (m)"},
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        height=620,
        legend={"orientation": "h"},
    )
    return str(figure.to_html(full_html=False, include_plotlyjs=True))


def _colouring(points: Array, predicted_error_mm: Callable[[Array], Array] | None) -> dict[str, Any]:
    if predicted_error_mm is None:
        return {"color": "#c9a58f", "hoverinfo": "skip"}
    return {
        "intensity": predicted_error_mm(points),
        "colorscale": "Viridis",
        "colorbar": {"title": "predicted error (mm)", "len": 0.6},
        "hovertemplate": "%{intensity:.4f} mm<extra></extra>",
    }


def _frusta(cameras: Sequence[Array]) -> Array:
    """Line segments (N, 3), broken by NaN rows, of a small pyramid for each camera."""
    w, h, z = 0.36 * _FRUSTUM_M, 0.24 * _FRUSTUM_M, _FRUSTUM_M
    o, a, b, c, d = [0, 0, 0], [-w, -h, z], [w, -h, z], [w, h, z], [-w, h, z]
    path = np.array([o, a, b, c, d, a, o, b, o, c, o, d], dtype=np.float64)
    gap = np.full((1, 3), np.nan)
    return np.vstack([np.vstack([apply(T, path), gap]) for T in cameras]) if cameras else gap
