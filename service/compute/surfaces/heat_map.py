"""Shows distances as colours: at a mesh's vertices, and in pictures of surfaces and of a fusion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.surfaces.chamfer import ChamferScore, DistanceSamples, normals_at
from service.compute.surfaces.fuse import Fused, Source
from service.compute.surfaces.surface import IntArray, PointIndex, Surface, write_ply
from service.core.geometry import Array
from service.core.units import mm

Pixels = NDArray[np.uint8]

BEYOND = (128, 128, 128)  # grey: farther than the outlier limit
_PANEL_PX = 900  # longer side of each surface in the picture
_BAR_PX, _TEXT_PX = 24, 34
_MARGIN_PX = 20
_BEHIND = 1.6  # of the width around a point: depth over which a steep surface may fall there
_DENSE = 4  # points for a pixel: no gap is larger than a pixel
_SOME = 2000  # points whose neighbours are asked for
_WIDER, _LARGEST_GAP_PX = 2.5, 24  # than the distance of the nearest neighbours: points are not evenly spread
_FONT = (cv2.FONT_HERSHEY_SIMPLEX, 0.6)
_INK, _PAPER = (40, 40, 40), (255, 255, 255)


@dataclass(frozen=True, slots=True)
class HeatScale:
    """Distance at the end of the colours, and the one beyond which points are grey; metres."""

    full_m: float
    outlier_m: float

    @classmethod
    def of(cls, score: ChamferScore, outlier_m: float) -> HeatScale:
        """Return the scale whose end is the 95th percentile of both directions, rounded up to 1, 2 or 5."""
        wanted = max(score.pred_to_gt.p95_m, score.gt_to_pred.p95_m, 1e-6)
        power = 10.0 ** np.floor(np.log10(wanted))
        return cls(float(power * next(s for s in (1, 2, 5, 10) if s * power >= wanted * (1 - 1e-9))), outlier_m)

    def colours(self, distance_m: Array) -> Pixels:
        """Return (N, 3) red, green, blue for distances (N,)."""
        level = np.clip(255 * distance_m / self.full_m, 0, 255).astype(np.uint8)
        bgr = cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_VIRIDIS).reshape(-1, 3)
        out = np.ascontiguousarray(bgr[:, ::-1]).astype(np.uint8)
        out[distance_m > self.outlier_m] = BEYOND
        return out


@dataclass(frozen=True, slots=True)
class Panel:
    """Points of a surface to show: places (N, 3), red, green and blue (N, 3); a title.

    `normals` gives (K, 3) those of some of the points by their numbers, or None: most points are hidden by others.
    """

    points_m: Array = field(repr=False)
    colours: Pixels = field(repr=False)
    normals: Callable[[IntArray], Array | None] = field(repr=False)
    title: str

    @classmethod
    def of_distances(cls, surface: Surface, compared: DistanceSamples, scale: HeatScale, title: str) -> Panel:
        """Return the samples of a surface in the colours of their distances."""
        samples = compared.samples
        colours = scale.colours(compared.distance_m)
        return cls(samples.points_m, colours, lambda some: normals_at(surface, samples.origin[some]), title)

    def part(self, chosen: IntArray) -> Panel:
        """Return some of its points (K,)."""
        return Panel(self.points_m[chosen], self.colours[chosen], lambda some: self.normals(chosen[some]), self.title)


def heat_picture(
    pred: Surface,
    gt: Surface,
    score: ChamferScore,
    scale: HeatScale,
    names: tuple[str, str] = ("prediction", "truth"),
    more: Sequence[Panel] = (),
) -> Pixels:
    """Draw two surfaces coloured by their distances, seen along one direction.

    Args:
        pred, gt: the surfaces.
        score: their distances.
        scale: the scale of the colours.
        names: the names of both surfaces, for the titles.
        more: further views of the same scene, beside them.

    Returns:
        (H, W, 3), blue first as OpenCV has it.
    """
    one, other = names
    panels = (
        Panel.of_distances(pred, score.pred, scale, f"{one} to {other}: mean {mm(score.pred_to_gt.mean_m):.3f} mm"),
        Panel.of_distances(gt, score.gt, scale, f"{other} to {one}: mean {mm(score.gt_to_pred.mean_m):.3f} mm"),
        *more,
    )
    axes = _view(gt, score.gt.samples.points_m)
    seen = [panel.points_m @ axes.T for panel in panels]
    low = np.min([s.min(axis=0) for s in seen], axis=0)
    size = np.max([s.max(axis=0) for s in seen], axis=0) - low
    pixel_m = max(float(size[:2].max()) / _PANEL_PX, 1e-9)
    height, width = (int(np.ceil(size[k] / pixel_m)) + 1 for k in (1, 0))
    drawn = [
        _captioned(_splat(panel, s - low, pixel_m, (height, width), axes[2]), panel.title)
        for panel, s in zip(panels, seen, strict=True)
    ]
    rows = np.full((drawn[0].shape[0], _MARGIN_PX, 3), _PAPER, dtype=np.uint8)
    body = np.hstack([rows, *(part for one in drawn for part in (one, rows))])
    return np.vstack([body, _bar(body.shape[1], scale)])


def heat_row(panels: Sequence[Panel], gt: Surface, gt_points_m: Array, panel_px: int) -> Pixels:
    """Render surfaces beside one another, without the colour bar, as a BGR picture (H, W, 3).

    All are seen along the direction in which the truth is seen best, and cut at its rim.

    Args:
        panels: the surfaces; one without points leaves its place empty.
        gt: the truth.
        gt_points_m: (N, 3) samples of it.
        panel_px: longer side of each.
    """
    axes = _view(gt, gt_points_m)
    seen_gt = gt_points_m @ axes.T
    low, size = seen_gt.min(axis=0), np.ptp(seen_gt, axis=0)
    pixel_m = max(float(size[:2].max()) / panel_px, 1e-9)
    shape = (int(np.ceil(size[1] / pixel_m)) + 1, int(np.ceil(size[0] / pixel_m)) + 1)
    drawn: list[Pixels] = []
    for panel in panels:
        seen = panel.points_m @ axes.T - low
        at = seen[:, :2] / pixel_m
        inside = np.flatnonzero(((at >= 0) & (at < np.array([shape[1], shape[0]]))).all(axis=1))
        image = np.full((*shape, 3), _PAPER, dtype=np.uint8)
        if len(inside):
            image = _splat(panel.part(inside), seen[inside], pixel_m, shape, axes[2])
        gap = np.full((shape[0] + _TEXT_PX, _MARGIN_PX, 3), _PAPER, dtype=np.uint8)
        drawn += [gap, _captioned(image, panel.title)]
    return np.hstack(drawn)


def heat_bar(width: int, scale: HeatScale) -> Pixels:
    """Return (H, width, 3) the scale of colours, to be put under a picture."""
    return _bar(width, scale)


def _view(surface: Surface, points: Array) -> Array:
    """Return (3, 3) rows: right, down, away from the viewer, who looks onto the widest side of the surface."""
    few = points[:: max(1, len(points) // 20_000)]
    right, _, flat = np.linalg.svd(few - few.mean(axis=0), full_matrices=False)[2]
    toward = surface.area_vectors_m2.sum(axis=0) if surface.is_mesh else np.zeros(3)
    if np.linalg.norm(toward) < 0.05 * max(surface.area_m2, 1e-300):
        toward = np.array([0.0, 0.0, 1.0])
    away = -flat if flat @ toward > 0 else flat
    return np.stack([right, np.cross(away, right), away])


def _splat(panel: Panel, seen: Array, pixel_m: float, shape: tuple[int, int], away: Array) -> Pixels:
    """Draw the points of one surface as pixels, the nearest to the viewer on top, without paper between them."""
    at = (seen[:, :2] / pixel_m).astype(np.int64)
    order = np.argsort(-seen[:, 2])
    nearest_of = np.full(shape, -1, dtype=np.int64)
    nearest_of[at[order, 1], at[order, 0]] = order
    y, x = np.nonzero(nearest_of >= 0)
    nearest = nearest_of[y, x]
    depth = np.full(shape, np.inf, dtype=np.float32)
    depth[y, x] = seen[nearest, 2]
    gap = _gap_px(seen, pixel_m, len(nearest))
    # What lies behind shows between the points; it is far behind the nearest point around it.
    around = 2 * max(2, gap) + 1
    front = cv2.erode(depth, np.ones((around, around), np.uint8))
    behind_m = _BEHIND * around * pixel_m
    visible = seen[nearest, 2] <= front[y, x] + behind_m
    y, x, shown = y[visible], x[visible], nearest[visible]
    colours = panel.colours[shown].astype(np.float64)
    normals = panel.normals(shown)
    if normals is not None:
        colours *= (0.55 + 0.45 * np.abs(normals @ away))[:, None]
    image = np.full((*shape, 3), _PAPER, dtype=np.uint8)
    image[y, x] = colours[:, ::-1].astype(np.uint8)
    empty = np.ones(shape, dtype=np.uint8)
    empty[y, x] = 0
    found = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    away_px, label = np.asarray(found[0], dtype=np.float32), np.asarray(found[1], dtype=np.int64)
    of_label = np.zeros((int(label.max()) + 1, 3), dtype=np.uint8)
    of_label[label[empty == 0]] = image[empty == 0]
    filled = (empty == 1) & (away_px < gap + 0.5)
    image[filled] = of_label[label[filled]]
    return image


def _gap_px(seen: Array, pixel_m: float, occupied: int) -> int:
    """Return how far from a point of a surface (N, 3) the middle of a gap between neighbours is, in pixels."""
    if len(seen) < 2 or len(seen) > _DENSE * occupied:
        return 1
    some = np.arange(0, len(seen), max(1, len(seen) // _SOME))
    nearest = PointIndex(seen).neighbours(seen[some], 2)[:, 1]
    apart_m = float(np.median(np.linalg.norm(seen[some] - seen[nearest], axis=1)))
    return int(np.clip(np.ceil(_WIDER * apart_m / pixel_m), 1, _LARGEST_GAP_PX))


def _captioned(image: Pixels, title: str) -> Pixels:
    """Return the picture with its title above it."""
    head = np.full((_TEXT_PX, image.shape[1], 3), _PAPER, dtype=np.uint8)
    size = min(0.7, image.shape[1] / 11 / max(len(title), 1))
    cv2.putText(head, title, (4, _TEXT_PX - 10), cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)
    return np.vstack([head, image])


def _bar(width: int, scale: HeatScale) -> Pixels:
    """Return the scale of colours under the pictures."""
    out = np.full((2 * _MARGIN_PX + _BAR_PX + _TEXT_PX, width, 3), _PAPER, dtype=np.uint8)
    length = width - 2 * _MARGIN_PX
    colours = scale.colours(np.linspace(0, scale.full_m, length))[:, ::-1]
    out[_MARGIN_PX : _MARGIN_PX + _BAR_PX, _MARGIN_PX : _MARGIN_PX + length] = colours
    for share in (0.0, 0.5, 1.0):
        text = f"{mm(share * scale.full_m):g} mm"
        x = min(_MARGIN_PX + int(share * length), width - cv2.getTextSize(text, *_FONT, 1)[0][0] - 4)
        place = (x, _MARGIN_PX + _BAR_PX + 24)
        cv2.putText(out, text, place, *_FONT, _INK, 1, cv2.LINE_AA)
    return out


def write_heat_mesh(
    path: Path,
    surface: Surface,
    distance_m: Array,
    scale: HeatScale,
    metres_per_unit: float,
    comments: Sequence[str] = (),
) -> None:
    """Write a surface with, at each vertex, its distance in millimetres (`distance_mm`) and the colour of that.

    Args:
        path: the file to write.
        surface: metres.
        distance_m: (V,); what lies beyond the limit of the scale may be infinite, and is written as the limit.
        scale: the scale of the colours.
        metres_per_unit: unit of the file's coordinates, so that it lies over the file that was judged.
        comments: further lines for the header, in ASCII.
    """
    colours = scale.colours(distance_m)
    properties = {name: colours[:, k] for k, name in enumerate(("red", "green", "blue"))}
    told = f"colours end at {mm(scale.full_m):g} mm; grey is beyond {mm(scale.outlier_m):g} mm"
    distance_mm = mm(np.minimum(distance_m, scale.outlier_m))
    write_ply(path, surface, metres_per_unit, {**properties, "distance_mm": distance_mm}, [told, *comments])


_COLOURS = {Source.CT: (214, 94, 0), Source.SCAN: (0, 114, 178), Source.BLEND: (240, 228, 66)}  # red, green, blue
_WORDS = {Source.CT: "CT orange", Source.SCAN: "scan blue", Source.BLEND: "blend yellow"}


def fusion_picture(ct: Surface, scan: Surface, score: ChamferScore, scale: HeatScale, fused: Fused) -> bytes:
    """Draw a PNG with CT and scan by their distances, and the fused mesh by its sources, seen along one direction.

    Args:
        ct, scan: the surfaces as they were compared, in one frame.
        score: the result of the comparison.
        scale: the scale of its colours.
        fused: the fusion of both.
    """
    palette = np.array([_COLOURS[source] for source in Source], dtype=np.uint8)
    title = "source: " + ", ".join(f"{_WORDS[s]} {100 * fused.share(s):.0f} %" for s in Source)
    sources = Panel(fused.surface.vertices_m, palette[fused.source], fused.surface.vertex_normals.__getitem__, title)
    picture = heat_picture(ct, scan, score, scale, ("CT", "scan"), (sources,))
    return cv2.imencode(".png", picture)[1].tobytes()
