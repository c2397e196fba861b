"""The scene in 3D as a plotly figure for the screen: cameras, spheres, decimated mesh, robot bases."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any, Literal

import fast_simplification
import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array, Transform, apply, inverse, transform
from service.core.units import metres, mm

_FRUSTUM_MM = 50.0
_ROUND, _FLAT = 10, 6  # meridians and parallels of a sphere


def frustum_lines(cameras: Sequence[Transform]) -> Array:
    """Return line segments (N, 3) in mm that draw each camera as a small pyramid, separated by NaN rows."""
    w, h, z = 0.36 * _FRUSTUM_MM, 0.24 * _FRUSTUM_MM, _FRUSTUM_MM
    o, a, b, c, d = [0, 0, 0], [-w, -h, z], [w, -h, z], [w, h, z], [-w, h, z]
    path = metres(np.array([o, a, b, c, d, a, o, b, o, c, o, d], dtype=np.float64))
    gap = np.full((1, 3), np.nan)
    return np.vstack([np.vstack([mm(apply(T, path)), gap]) for T in cameras]) if cameras else gap


def unit_ball() -> tuple[Array, NDArray[np.int64]]:
    """Return a unit sphere: points (V, 3), triangles (F, 3)."""
    polar = np.linspace(0, np.pi, _FLAT + 1)[1:-1]
    around = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
    rings = [[np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)] for p in polar for a in around]
    points = np.array([[0.0, 0.0, 1.0], *rings, [0.0, 0.0, -1.0]])
    last = len(points) - 1
    faces: list[list[int]] = []
    for k in range(_ROUND):
        nxt = (k + 1) % _ROUND
        faces += [[0, 1 + k, 1 + nxt], [last, last - _ROUND + nxt, last - _ROUND + k]]
        for ring in range(_FLAT - 2):
            a, b = 1 + ring * _ROUND + k, 1 + ring * _ROUND + nxt
            faces += [[a, a + _ROUND, b], [b, a + _ROUND, b + _ROUND]]
    return points, np.array(faces)


FACES_SHOWN = 60_000
STYLES = (("#2f86d6", "circle"), ("#d9772b", "diamond"), ("#9a58d1", "square"))  # camera marks, by station
FURTHER_STYLES = (("#0f9aa8", "x"), ("#b1891a", "cross"))  # of further cameras, one each
KINDS = {"registration": "#2f9e57", "sphere": "#2f9e57", "control": "#d05fa0"}
KIND_NAMES = {"registration": "registration spheres", "control": "control spheres", "sphere": "spheres"}
PROUD = 1.07  # times the radius, so that a drawn sphere covers the scanned one
BAR_MM = 100.0
_ROOM_MM = 60.0
EYE_MM, TOWARDS_MM = (280.0, -1150.0, 850.0), (0.0, 0.0, 210.0)  # the initial view
_NEAR_EYE_MM, _NEAR_TOWARDS_MM = (150.0, -620.0, 500.0), (0.0, 0.0, 0.0)  # without cameras around the surface


@dataclass(frozen=True, slots=True)
class SceneSphere:
    """A sphere with the label used on every page."""

    label: str
    kind: Literal["registration", "control", "sphere"]
    centre_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class MeshColours:
    """The values that a surface is coloured by.

    Attributes:
        values: (V,) the value of each vertex; with classes, their indices.
        title: the title of the values.
        hover: plotly's template of the text at a vertex; "" for none.
        classes: name and colour of each class; empty for values on a scale.
    """

    values: Array = field(repr=False)
    title: str
    hover: str
    classes: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class SceneMesh:
    """A surface decimated for display.

    Attributes:
        points_m: (V, 3).
        triangles: (F, 3).
        error_mm: (V,) predicted target registration error; None if unknown.
        colours: something else to colour it by.
    """

    points_m: Array = field(repr=False)
    triangles: NDArray[np.int64] = field(repr=False)
    error_mm: Array | None = field(default=None, repr=False)
    colours: MeshColours | None = None

    @property
    def coloured_by(self) -> MeshColours | None:
        """The values that the surface is coloured by; None if it has one colour."""
        if self.colours is not None or self.error_mm is None:
            return self.colours
        return MeshColours(self.error_mm, "predicted error (mm)", "%{intensity:.4f} mm")


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything in one frame, metres.

    Attributes:
        cameras: T_frame_camera by viewpoint.
        planned: T_frame_camera of the viewpoints still to be taken.
        stations: station of each viewpoint.
        bases: T_frame_base by station, where known.
        up: unit vector (3,).
        outlines: (K, 3) corners of closed polygons on the surface, by what they surround.
        further: T_frame_camera of each further camera of the rig, by its name and that of the view.
    """

    cameras: Mapping[str, Transform]
    stations: Mapping[str, str]
    spheres: Sequence[SceneSphere] = ()
    radius_m: float = 0.015
    mesh: SceneMesh | None = None
    planned: Mapping[str, Transform] = field(default_factory=dict[str, Transform])
    bases: Mapping[str, Transform] = field(default_factory=dict[str, Transform])
    up: tuple[float, float, float] | None = None
    outlines: Mapping[str, Array] = field(default_factory=dict[str, Array])
    further: Mapping[str, Mapping[str, Transform]] = field(default_factory=dict[str, Mapping[str, Transform]])


def decimated(vertices_m: Array, faces: Any, most: int = FACES_SHOWN) -> tuple[Array, NDArray[np.int64]]:
    """Return points (V, 3) in metres and triangles (F, 3), reduced to about `most` triangles."""
    share = 1.0 - min(1.0, most / max(len(faces), 1))
    points, triangles = np.asarray(vertices_m, dtype=np.float64), np.asarray(faces).astype(np.int64)
    if share > 0:
        points, triangles = fast_simplification.simplify(points, triangles.astype(np.int32), target_reduction=share)[
            :2
        ]
    return np.asarray(points, dtype=np.float64), np.asarray(triangles, dtype=np.int64)


def viewing_frame(scene: Scene) -> Transform:
    """Return T_view_frame: origin at the spheres' centre, z up, −y towards the first station.

    The scan's frame is arbitrary, so the cameras define up unless the scene does.
    """
    centre = _centre(scene)
    eyes = np.array([T[:3, 3] for T in (*scene.cameras.values(), *scene.planned.values())]).reshape(-1, 3)
    up = np.array(scene.up if scene.up is not None else _mean(eyes) - centre, dtype=np.float64)
    up = _unit(up, np.array([0.0, 0.0, 1.0]))
    first = min([*scene.stations.values(), *scene.bases], default="")
    near = scene.bases[first][:3, 3] if first in scene.bases else _mean(_eyes_of(scene, first), default=eyes)
    front = near - centre
    front = _unit(front - up * float(front @ up), np.eye(3)[int(np.argmin(np.abs(up)))])
    front = _unit(front - up * float(front @ up), front)
    rotation = np.column_stack([np.cross(front, up) * -1.0, -front, up])  # axes of the view in the scene's frame
    return inverse(transform(rotation, centre))


def scene_json(scene: Scene) -> str:
    """Return the figure as plotly's JSON, in millimetres of the viewing frame; escaped for a script element.

    plotly places its camera relative to the box of the axes: the box is scaled to one unit per metre.
    """
    to_view = viewing_frame(scene)
    extent = _Extent()

    def in_view_mm(points_m: Array) -> Array:
        points = mm(apply(to_view, np.asarray(points_m, dtype=np.float64).reshape(-1, 3)))
        extent.add(points)
        return points

    data: list[dict[str, object]] = []
    if scene.mesh is not None:
        data.append(_mesh(in_view_mm(scene.mesh.points_m), scene.mesh))
    for kind in KIND_NAMES:
        mine = [s for s in scene.spheres if s.kind == kind]
        if mine:
            data += _spheres(in_view_mm(np.array([s.centre_m for s in mine])), mine, mm(scene.radius_m))
    data += [_outline(in_view_mm(corners), what) for what, corners in scene.outlines.items()]
    data.append(_scale_bar(in_view_mm(_centre(scene))))
    names = sorted({*scene.stations.values(), *scene.bases})
    for i, station in enumerate(names):
        colour, symbol = STYLES[i % len(STYLES)]
        data += _cameras(scene, station, to_view, colour, symbol)
        mine = [
            T for name, T in (*scene.cameras.items(), *scene.planned.items()) if scene.stations.get(name) == station
        ]
        in_view_mm(np.array([T[:3, 3] for T in mine]))
        if station in scene.bases:
            data.append(_base(in_view_mm(scene.bases[station][None, :3, 3]), station, colour))
    for (name, poses), (colour, symbol) in zip(scene.further.items(), cycle(FURTHER_STYLES), strict=False):
        in_view_mm(np.array([T[:3, 3] for T in poses.values()]))
        data += _frusta({view: to_view @ T for view, T in poses.items()}, name, colour, symbol)
    text = json.dumps(
        {"data": data, "layout": _layout(extent, near=not (names or scene.planned))},
        allow_nan=False,
        separators=(",", ":"),
    )
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


class _Extent:
    """The bounding box of everything drawn, mm."""

    def __init__(self) -> None:
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)

    def add(self, points: Array) -> None:
        if len(points):
            self._low, self._high = (
                np.minimum(self._low, points.min(axis=0)),
                np.maximum(self._high, points.max(axis=0)),
            )

    def ranges(self) -> list[list[float]]:
        """Return the low and high end of each axis, mm, with a margin for markers."""
        if not np.all(np.isfinite(self._low)):
            return [[-500.0, 500.0]] * 3
        return [[float(a) - _ROOM_MM, float(b) + _ROOM_MM] for a, b in zip(self._low, self._high, strict=True)]


# --- pieces -----------------------------------------------------------------------------------------------------


def _mesh(points: Array, mesh: SceneMesh) -> dict[str, object]:
    trace: dict[str, object] = {
        "type": "mesh3d",
        "name": "surface",
        **_xyz(points),
        **{axis: _packed(mesh.triangles[:, k]) for k, axis in enumerate("ijk")},
        "lighting": {"ambient": 0.55, "diffuse": 0.8, "specular": 0.05},
    }
    colours = mesh.coloured_by
    if colours is None:
        return trace | {"color": "#c9a58f", "hoverinfo": "skip"}
    bar = {"title": {"text": colours.title, "side": "right"}, "len": 0.6, "thickness": 14, "x": 1}
    if colours.classes:
        return trace | _by_class(mesh, colours, bar)
    return trace | {
        "intensity": _packed(colours.values.astype(np.float32)),
        "colorscale": "Viridis",
        "colorbar": bar,
        "hovertemplate": f"{colours.hover}<extra></extra>",
    }


def _by_class(mesh: SceneMesh, colours: MeshColours, bar: Mapping[str, object]) -> dict[str, object]:
    """Return one colour for each triangle, that of its first corner: between two classes there is nothing."""
    n = len(colours.classes)
    steps = [[(k + end) / n, colour] for k, (_, colour) in enumerate(colours.classes) for end in (0, 1)]
    names = {"tickvals": list(range(n)), "ticktext": [name for name, _ in colours.classes]}
    return {
        "intensity": _packed(colours.values[mesh.triangles[:, 0]].astype(np.float32)),
        "intensitymode": "cell",
        "cmin": -0.5,
        "cmax": n - 0.5,
        "colorscale": steps,
        "colorbar": {**bar, **names},
        "hoverinfo": "skip",
    }


def _spheres(centres: Array, spheres: Sequence[SceneSphere], radius: float) -> list[dict[str, object]]:
    ball, faces = unit_ball()
    points = (centres[:, None] + PROUD * radius * ball[None]).reshape(-1, 3)
    triangles = (np.arange(len(centres))[:, None, None] * len(ball) + faces[None]).reshape(-1, 3)
    kind = spheres[0].kind
    # Control spheres are marked by their labels (C0, C1, …) too, not by colour alone.
    return [
        {
            "type": "mesh3d",
            "name": KIND_NAMES[kind],
            "showlegend": True,
            **_xyz(points),
            **{axis: _packed(triangles[:, k]) for k, axis in enumerate("ijk")},
            "color": KINDS[kind],
            "hoverinfo": "skip",
            "lighting": {"ambient": 0.6, "diffuse": 0.7},
        },
        {
            "type": "scatter3d",
            "mode": "text",
            **_xyz(centres + np.array([0.0, 0.0, 1.6 * radius])),
            "text": [s.label for s in spheres],
            "textfont": {"size": 15},
            "hoverinfo": "skip",
            "showlegend": False,
        },
    ]


def _cameras(scene: Scene, station: str, to_view: Transform, colour: str, symbol: str) -> list[dict[str, object]]:
    out: list[dict[str, object]] = []
    for poses, what, opacity, filled in (
        (scene.cameras, "cameras", 1.0, symbol),
        (scene.planned, "planned", 0.45, f"{symbol}-open"),
    ):
        mine = {name: to_view @ T for name, T in poses.items() if scene.stations.get(name) == station}
        if not mine:
            continue
        title = f"{what} of {station}" if what == "cameras" else f"still to be taken at {station}"
        out += _frusta(mine, title if station else what, colour, filled, opacity)
    return out


def _frusta(
    poses: Mapping[str, Transform], title: str, colour: str, symbol: str, opacity: float = 1.0
) -> list[dict[str, object]]:
    """Return cameras as small pyramids in the viewing frame, with a mark at each projection centre."""
    line = {"color": colour, "width": 3}
    frusta = {"mode": "lines", "name": title, "line": line, "hoverinfo": "skip", "opacity": opacity}
    eyes = mm(np.array([T[:3, 3] for T in poses.values()]))
    marker = {"size": 5, "color": colour, "symbol": symbol}
    points = {"mode": "markers", "text": list(poses), "hoverinfo": "text", "marker": marker, "showlegend": False}
    return [
        {"type": "scatter3d", **frusta, **_xyz(frustum_lines(list(poses.values())))},
        {"type": "scatter3d", **points, **_xyz(eyes)},
    ]


def _base(at: Array, station: str, colour: str) -> dict[str, object]:
    return {
        "type": "scatter3d",
        "mode": "markers+text",
        "name": f"robot base, {station}",
        **_xyz(at),
        "text": [f"robot, {station}"],
        "textposition": "bottom center",
        "marker": {"size": 9, "color": colour, "symbol": "square"},
        "hoverinfo": "text",
    }


def _outline(corners: Array, what: str) -> dict[str, object]:
    line = {"mode": "lines", "line": {"color": "#c2352b", "width": 7}, "hoverinfo": "skip"}
    return {"type": "scatter3d", "name": what, **line, **_xyz(np.vstack([corners, corners[:1]]))}


def _scale_bar(centre: Array) -> dict[str, object]:
    x, y, z = (float(v) for v in centre[0])
    ends = [[x - 0.5 * BAR_MM, y - 300, z - 60], [x + 0.5 * BAR_MM, y - 300, z - 60]]
    return {
        "type": "scatter3d",
        "mode": "lines+text",
        **_xyz(np.array(ends)),
        "text": ["", f"  {BAR_MM:.0f} mm"],
        "textposition": "middle right",
        "line": {"color": "#8a97a0", "width": 5},
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _layout(extent: _Extent, *, near: bool) -> dict[str, object]:
    eye, towards = (_NEAR_EYE_MM, _NEAR_TOWARDS_MM) if near else (EYE_MM, TOWARDS_MM)
    ranges = dict(zip("xyz", extent.ranges(), strict=True))
    axes = {f"{a}axis": {"visible": False, "showspikes": False, "range": ends} for a, ends in ranges.items()}
    return {
        "scene": {
            "aspectmode": "manual",
            "aspectratio": {a: metres(high - low) for a, (low, high) in ranges.items()},
            "dragmode": "turntable",
            "camera": {"eye": _in_box(ranges, eye), "center": _in_box(ranges, towards)},
            **axes,
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 70},
        "legend": {"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"},
    }


def _in_box(ranges: Mapping[str, Sequence[float]], point_mm: Sequence[float]) -> dict[str, float]:
    """Return a point of the viewing frame in the coordinates of plotly's camera."""
    return {a: metres(p - sum(ends) / 2) for (a, ends), p in zip(ranges.items(), point_mm, strict=True)}


def _xyz(points: Array) -> dict[str, object]:
    return {axis: _packed(points[:, k].astype(np.float32)) for k, axis in enumerate("xyz")}


def _packed(values: NDArray[Any]) -> dict[str, str]:
    """Return a typed array in base64, in plotly's format."""
    kind = "f4" if values.dtype.kind == "f" else "u4"
    little = values.astype(np.dtype(f"<{kind}"))
    return {"dtype": kind, "bdata": base64.b64encode(little.tobytes()).decode()}


def _centre(scene: Scene) -> Array:
    if scene.spheres:
        return np.array([s.centre_m for s in scene.spheres], dtype=np.float64).mean(axis=0)
    if scene.mesh is not None:
        return scene.mesh.points_m.mean(axis=0)
    poses = [*scene.cameras.values(), *scene.planned.values()]
    # Only cameras: the point they look at, roughly.
    return _mean(np.array([T[:3, 3] + 0.6 * T[:3, 2] for T in poses]).reshape(-1, 3))


def _eyes_of(scene: Scene, station: str) -> Array:
    poses = {**scene.planned, **scene.cameras}
    return np.array([T[:3, 3] for name, T in poses.items() if scene.stations.get(name) == station]).reshape(-1, 3)


def _mean(points: Array, default: Array | None = None) -> Array:
    if len(points):
        return points.mean(axis=0)
    return np.zeros(3) if default is None else _mean(default)


def _unit(vector: Array, otherwise: Array) -> Array:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-9 else otherwise / float(np.linalg.norm(otherwise))
