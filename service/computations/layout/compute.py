"""Job `layout`: locates the spheres in photographs, searches for near-symmetries, and suggests moves."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from service.computations import layout as job
from service.computations.conversion import judged_layout
from service.computations.inputs import nominal_camera
from service.computations.job import JobAnswer, JobContext
from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image
from service.compute.layout.ambiguity import (
    REQUIRED_MARGIN_M,
    LayoutReport,
    check_layout,
    layout_bounds,
    layout_measures,
)
from service.compute.layout.moves import PhotographedMove, innermost, show_move, suggest_moves
from service.compute.layout.photographs import LensPrior, PhotoLayout, SpherePhotograph, layout_from_photographs
from service.compute.markers.detect import detect_spheres
from service.compute.markers.records import SphereOutline
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import mm

# The lens is not calibrated yet, and its distortion deforms the ellipses of the outlines. In an image of 9504 px this
# exceeds the noise of the edges, so that ten of thirteen good outlines were rejected: copies of smaller width are
# searched, and still smaller ones for a lens with more distortion.
_WIDTHS_PX = (1920, 1440, 960)
_GREEN, _YELLOW, _BLACK, _WHITE = (60, 220, 60), (0, 220, 255), (0, 0, 0), (255, 255, 255)  # BGR


def layout(context: JobContext[job.Arguments]) -> JobAnswer:
    """Locate the spheres of all photographs, check their layout, and number them in the last photograph."""
    arguments = context.arguments
    radius_m, expected = arguments.radius_m, arguments.expected
    photographs: list[NDArray[np.uint8]] = []
    for number, image in enumerate(arguments.images):
        context.progress("spheres in photographs", number, len(arguments.images))
        photographs.append(_not_wider(read_image(context.input(image.sha256)), _WIDTHS_PX[0]))
    focal_mm = [image.focal_mm for image in arguments.images]
    seen, pixels = _look(photographs, focal_mm, arguments.sensor_width_mm, expected)
    found = layout_from_photographs([SpherePhotograph.of(c, o) for c, o in seen], radius_m, LensPrior(), expected)
    report = check_layout(found.centres_m, found.covariance, radius_m=radius_m)
    shown = _moves(found, report, seen[-1][0], radius_m, arguments.control)
    measures = {
        "spheres_seen": float(len(found.centres_m)),
        "photographs_used": float(found.used),
        **layout_measures(report),
    }
    details = job.LayoutDetails(
        **judged_layout(report).set_fields(),
        chi2=found.chi2,
        photographs=tuple(_searched(ids, o) for ids, (_, o) in zip(found.spheres, seen, strict=True)),
        moves=tuple(_move_record(move, seen[-1][0]) for move in shown),
    )
    picture = _picture(pixels, seen[-1][0], seen[-1][1], found.spheres[-1], shown)
    overlay = context.keep_bytes(picture, kind="layout_overlay", media_type="image/jpeg", name="layout.jpg")
    answer = job.Answer(spheres_m=found.centres_m.tolist(), details=details)
    return JobAnswer(measures, (overlay,), answer)


def _look(
    photographs: Sequence[NDArray[np.uint8]], focal_mm: Sequence[float], sensor_width_mm: float, expected: int | None
) -> tuple[list[tuple[CameraModel, Sequence[SphereOutline]]], NDArray[np.uint8]]:
    """Find the outlines in each photograph. Returns them with nominal cameras, and the searched copy of the last one.

    All copies have the same width, because the photographs are adjusted together: the largest at which all spheres
    are found, or otherwise the one at which most are.
    """
    best: tuple[int, list[tuple[CameraModel, Sequence[SphereOutline]]], NDArray[np.uint8]] | None = None
    for width in _WIDTHS_PX:
        seen: list[tuple[CameraModel, Sequence[SphereOutline]]] = []
        copy = photographs[-1]
        for photograph, focal in zip(photographs, focal_mm, strict=True):
            copy = _not_wider(photograph, width)
            camera = nominal_camera(copy.shape[1], copy.shape[0], focal, sensor_width_mm)
            seen.append((camera, detect_spheres(copy, camera)))
        found = sum(len(outlines) for _, outlines in seen)
        if best is None or found > best[0]:
            best = found, seen, copy
        if expected is None or all(len(outlines) >= expected for _, outlines in seen):
            break
    assert best is not None  # there is at least one width
    return best[1:]


def _not_wider(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    if image.shape[1] <= width:
        return image
    size = (width, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _moves(
    found: PhotoLayout, report: LayoutReport, camera: CameraModel, radius_m: float, control: int
) -> list[PhotographedMove]:
    """Return the spheres to move, in the last photograph; none if the layout is good or no move would help."""
    T = found.T_photo_first[-1]
    if T is None or all(bounded.lower_m >= limit for bounded, limit in layout_bounds(report).values()):
        return []
    placed = found.centres_m
    up = _up(placed)
    try:
        moves = suggest_moves(placed, up=up, radius_m=radius_m, fixed=innermost(placed, control))
    except ComputeError:
        return []
    shown: list[PhotographedMove] = []
    for move in moves:
        shown.append(show_move(move, placed, up, T, camera, REQUIRED_MARGIN_M))
        placed = placed.copy()
        placed[move.sphere] += move.by_m
    return shown


def _up(centres: Array) -> Array:
    """Return the normal (3,) of the spheres' best plane, which points away from the table, towards the camera."""
    _, _, axes = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)
    return np.asarray(axes[2] if axes[2, 2] < 0 else -axes[2], dtype=np.float64)


def _searched(ids: NDArray[np.int64], outlines: Sequence[SphereOutline]) -> job.SearchedPhotograph:
    shown = zip(ids.tolist(), outlines, strict=False)
    return job.SearchedPhotograph(used=bool(len(ids)), spheres={str(i): o.centre_px for i, o in shown if i >= 0})


def _move_record(move: PhotographedMove, camera: CameraModel) -> job.SphereMove:
    """Return the move as recorded; places are fractions of the image's width and height."""
    size = np.array([camera.width, camera.height])
    places = {"from": (move.from_px / size).tolist(), "to": (move.to_px / size).tolist()}
    return job.SphereMove.model_validate({"words": move.words, **places, "higher_mm": mm(move.higher_m)})


def _picture(
    pixels: NDArray[np.uint8],
    camera: CameraModel,
    outlines: Sequence[SphereOutline],
    ids: NDArray[np.int64],
    moves: Sequence[PhotographedMove],
) -> bytes:
    """Return a JPEG of the photograph with numbered spheres, and arrows for the moves."""
    picture = pixels.copy()
    thick = max(1, round(camera.width / 900))
    curves = [outline.captured_px(camera) for outline in outlines]
    for curve in curves:
        cv2.polylines(picture, [_sixteenths(curve)], True, _GREEN, 2 * thick, cv2.LINE_AA, shift=4)
    for move in moves:
        moved = min(curves, key=lambda curve: float(np.linalg.norm(curve.mean(axis=0) - move.from_px)))
        _draw_move(picture, move, moved - moved.mean(axis=0), thick)
    for sphere, curve in zip(ids.tolist(), curves, strict=False):  # last: the advice refers to the numbers
        if sphere >= 0:
            _draw_number(picture, str(sphere), curve, thick)
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
    return encoded.tobytes()


def _draw_move(picture: NDArray[np.uint8], move: PhotographedMove, outline: Array, thick: int) -> None:
    """Draw the new place of a sphere, and an arrow from rim to rim, which leaves the number legible.

    Args:
        picture: the picture that is drawn into.
        move: the move.
        outline: (n, 2) pixels of the sphere's outline about its middle.
        thick: the width of a thin line, in pixels.
    """
    way = move.to_px - move.from_px
    length = float(np.linalg.norm(way))
    rim = float(np.linalg.norm(outline, axis=1).mean()) * way / length if length > 0 else np.zeros(2)
    (x0, y0), (x1, y1) = np.rint([move.from_px + rim, move.to_px + rim]).astype(int).tolist()
    for tone, width in ((_BLACK, 5 * thick), (_YELLOW, 2 * thick)):
        cv2.polylines(picture, [_sixteenths(outline + move.to_px)], True, tone, width, cv2.LINE_AA, shift=4)
    for tone, width in ((_BLACK, 7 * thick), (_YELLOW, 4 * thick)):
        cv2.arrowedLine(picture, (x0, y0), (x1, y1), tone, width, cv2.LINE_AA, tipLength=0.3)


def _draw_number(picture: NDArray[np.uint8], text: str, curve: Array, thick: int) -> None:
    """Draw a number on its sphere as large as possible, because pages show the photograph at a reduced size."""
    x, y = curve.mean(axis=0)
    radius = float(np.linalg.norm(curve - (x, y), axis=1).mean())
    (width_1, height_1), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 2 * thick)
    size = 1.3 * radius / max(height_1, width_1 / 1.1)
    place = (round(x - size * width_1 / 2), round(y + size * height_1 / 2))
    for tone, width in ((_BLACK, 6 * thick), (_WHITE, 2 * thick)):
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, tone, width, cv2.LINE_AA)


def _sixteenths(curve: Array) -> NDArray[np.int32]:
    """Return pixels as OpenCV expects them, with four fractional bits."""
    return np.rint(curve * 16).astype(np.int32)
