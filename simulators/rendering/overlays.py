"""Draws the marker spheres and the calibration board with exact pixel coverage instead of sampling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.geometry import Array, Array32
from simulators.rendering.surfaces import LAMP_COLOUR, ROOM_COLOUR
from simulators.scene.intrinsics import Intrinsics
from simulators.scene.world import BOARD_SQUARE_M, BOARD_SQUARES, board_sag_m

MARKER_ALBEDO = np.array([0.50, 0.74, 0.085])
MARGIN_M = 0.020
PAPER, INK = 0.80, 0.035
_SUBSAMPLES = 64
_SAG_ROUNDS = 2  # the first leaves a hundredth of the sag


@dataclass(frozen=True, slots=True)
class Frame:
    """Rows of an image being rendered: linear colour (H, W, 3), depth (H, W), rays (H, W, 3) in the camera frame."""

    colour: Array32
    depth: Array32
    rays: Array
    T_world_camera: Array
    intrinsics: Intrinsics
    top: int  # image row of this frame's first row


def half_plane_coverage(distance_px: Array, normal_u: Array, normal_v: Array) -> Array:
    """Return the fraction (0…1) of a unit-square pixel on the inner side of a straight edge.

    `distance_px` is the signed distance of the pixel centre from the edge, positive inside; (normal_u, normal_v) is
    the edge's unit normal. Exact: the integral of the trapezoid that is a square's section perpendicular to the
    normal.
    """
    a, b = np.abs(normal_u), np.abs(normal_v)
    big, small = np.maximum(a, b), np.minimum(a, b)
    outer, inner = (big + small) / 2, (big - small) / 2
    d = np.clip(distance_px, -outer, outer)
    corner = (outer - np.abs(d)) ** 2 / (2 * np.maximum(big * small, 1e-12))
    flat = 0.5 + d / np.maximum(big, 1e-12)
    return np.where(np.abs(d) <= inner, flat, np.where(d > 0, 1.0 - corner, corner))


def draw_sphere(frame: Frame, centre_camera: Array, centre_world: Array, radius_m: float, lamp_m: Array) -> None:
    """Draw a matte sphere unless something occludes it; its outline is exact to a few thousandths of a pixel."""
    box = _box(frame, centre_camera, radius_m)
    if box is None:
        return
    rows, columns = box
    d = frame.rays[rows, columns]
    along = d @ centre_camera
    across = np.linalg.norm(np.cross(d, centre_camera), axis=-1)
    # Angle inside the outline: nearly linear in pixels, so dividing by its gradient gives a distance.
    inside = np.arcsin(radius_m / np.linalg.norm(centre_camera)) - np.arctan2(across, along)
    g_row, g_column = np.gradient(inside)
    slope = np.maximum(np.hypot(g_row, g_column), 1e-15)
    cover = half_plane_coverage(inside / slope, g_column / slope, g_row / slope)
    # At the centre the angle has no gradient, but all pixels well inside are covered.
    cover = np.where(inside > 4.0 / frame.intrinsics.fx, 1.0, cover)
    dd = np.sum(d * d, axis=-1)
    cc = float(centre_camera @ centre_camera)
    root = np.sqrt(np.maximum(along**2 - dd * (cc - radius_m**2), 0.0))
    t = (along - root) / dd
    # At the outline the ray is tangent; beyond it use the point of the ray closest to the centre.
    hit = d * t[..., None] - centre_camera
    normal = (hit / np.linalg.norm(hit, axis=-1, keepdims=True)) @ frame.T_world_camera[:3, :3].T
    colour = _matte(normal, centre_world, radius_m, lamp_m)
    alpha = (cover * (t < frame.depth[rows, columns]))[..., None].astype(np.float32)
    frame.colour[rows, columns] += alpha * (colour - frame.colour[rows, columns])
    solid = (cover > 0.5) & (t < frame.depth[rows, columns])
    frame.depth[rows, columns] = np.where(solid, t, frame.depth[rows, columns])


def _box(frame: Frame, centre_camera: Array, radius_m: float) -> tuple[slice, slice] | None:
    if centre_camera[2] < 2 * radius_m:
        return None
    u, v = frame.intrinsics.project(centre_camera)
    reach = 1.35 * frame.intrinsics.fx * radius_m / (centre_camera[2] - radius_m) + 6
    height, width = frame.depth.shape
    r0, r1 = int(max(0, v - reach - frame.top)), int(min(height, v + reach - frame.top + 1))
    c0, c1 = int(max(0, u - reach)), int(min(width, u + reach + 1))
    if r1 - r0 < 2 or c1 - c0 < 2:
        return None
    return slice(r0, r1), slice(c0, c1)


def _matte(normal: Array, centre_world: Array, radius_m: float, lamp_m: Array) -> Array32:
    """Linear colour of a printed sphere at unit normals (…, 3) in the world frame."""
    place = centre_world + radius_m * normal
    to_lamp = lamp_m - place
    distance = np.linalg.norm(to_lamp, axis=-1, keepdims=True)
    cosine = np.sum(normal * to_lamp / distance, axis=-1)
    # The lamp is a disk: the terminator is softened over its angular radius of about 0.12.
    lamp = np.where(cosine > 0.12, cosine, np.maximum(cosine + 0.12, 0.0) ** 2 / 0.48)
    lamp = lamp * (np.linalg.norm(lamp_m) / distance[..., 0]) ** 2
    room = 0.80 + 0.45 * normal[..., 2]
    local = radius_m * normal
    layers = 0.5 + 0.5 * np.sin(local[..., 2] * (2 * np.pi / 0.0006))
    seams = np.sin(local[..., 0] * 1900.0 + 3.0 * np.sin(local[..., 1] * 900.0)) * np.sin(local[..., 1] * 2300.0)
    print_texture = 1.0 - 0.03 * layers + 0.025 * seams
    light = lamp[..., None] * LAMP_COLOUR + room[..., None] * ROOM_COLOUR
    return (MARKER_ALBEDO * light * print_texture[..., None]).astype(np.float32)


def draw_calibration_board(frame: Frame, T_world_board: Array, lamp_m: Array) -> None:
    """Draw the checkerboard, which lies above everything else; pixels on its edges are sampled 64 times."""
    T_camera_world = np.linalg.inv(frame.T_world_camera)
    T_camera_board = T_camera_world @ T_world_board
    R, origin = T_camera_board[:3, :3], T_camera_board[:3, 3]
    t = (origin @ R[:, 2]) / (frame.rays @ R[:, 2])
    place = frame.rays * t[..., None] - origin
    for _ in range(_SAG_ROUNDS):  # where the ray meets the bent surface, from where it meets the one before
        sag = board_sag_m(place @ R[:, 0], place @ R[:, 1])
        t = (origin @ R[:, 2] + sag) / (frame.rays @ R[:, 2])
        place = frame.rays * t[..., None] - origin
    # In units of squares, from the outer corner of the pattern.
    x, y = place @ R[:, 0] / BOARD_SQUARE_M + 1.0, place @ R[:, 1] / BOARD_SQUARE_M + 1.0
    margin = MARGIN_M / BOARD_SQUARE_M
    outer = _outside(x, y)
    cover, white = _sampled(x, y, outer, margin, t > 0)
    normal = -T_world_board[:3, 2]
    to_lamp = lamp_m - T_world_board[:3, 3]
    distance = float(np.linalg.norm(to_lamp))
    lamp = max(0.0, float(normal @ to_lamp)) / distance * (float(np.linalg.norm(lamp_m)) / distance) ** 2
    light = lamp * LAMP_COLOUR + ROOM_COLOUR
    colour = ((INK + (PAPER - INK) * white)[..., None] * light).astype(np.float32)
    frame.colour[:] += cover[..., None].astype(np.float32) * (colour - frame.colour)


def _sampled(x: Array, y: Array, outer: Array, margin: float, ahead: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Fraction (H, W) of each pixel that the board covers, and the fraction of that which is white.

    Args:
        x: (H, W) of the pixels' centres, in squares.
        y: likewise.
        outer: (H, W) distance outside the pattern, in squares.
        margin: width of the board outside the pattern, in squares.
        ahead: (H, W) whether the board's plane is in front of the camera.
    """
    dx, dy = np.gradient(x), np.gradient(y)
    step_x, step_y = np.abs(dx[0]) + np.abs(dx[1]), np.abs(dy[0]) + np.abs(dy[1])
    touched = ahead & (outer < margin + np.maximum(step_x, step_y))
    cover, white = (touched & (outer < margin)).astype(np.float64), _pattern(x, y)
    near = (np.abs(x - np.round(x)) < step_x) | (np.abs(y - np.round(y)) < step_y)
    near |= np.abs(outer - margin) < np.maximum(step_x, step_y)
    edge = np.flatnonzero(near & touched)
    # R2 sequence: no two samples share a row or column, so edges along the grid are not a special case.
    k = np.arange(_SUBSAMPLES)[:, None]
    sub = (0.5 + k * [0.7548776662466927, 0.5698402909980532]) % 1.0 - 0.5
    sub -= sub.mean(axis=0)
    xe, ye = x.ravel()[edge], y.ravel()[edge]
    gx, gy = [g.ravel()[edge] for g in dx], [g.ravel()[edge] for g in dy]
    inside_sum, white_sum = np.zeros(len(edge)), np.zeros(len(edge))
    for row, column in sub:
        xs, ys = xe + row * gx[0] + column * gx[1], ye + row * gy[0] + column * gy[1]
        inside = _outside(xs, ys) < margin
        inside_sum += inside
        white_sum += inside * _pattern(xs, ys)
    cover.ravel()[edge] = inside_sum / _SUBSAMPLES
    white.ravel()[edge] = white_sum / np.maximum(inside_sum, 1.0)
    return cover, white


def _outside(x: Array, y: Array) -> Array:
    """Distance outside the pattern along its axes, in squares; negative inside."""
    half = np.array(BOARD_SQUARES) / 2
    return np.maximum(np.abs(x - half[0]) - half[0], np.abs(y - half[1]) - half[1])


def _pattern(x: Array, y: Array) -> Array:
    """1 on white squares and the margin, 0 on black squares; x and y in units of squares."""
    columns, rows = BOARD_SQUARES
    on = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    return np.where(on, (np.floor(x) + np.floor(y)) % 2, 1.0)
