"""The planned board images of a calibration as a drawing: corners expected over the image, places of the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from service.core.geometry import Array

_WIDTH, _HEIGHT = 760, 342
_CELL = 29
_LEFT, _TOP = 16, 74
_INK, _PAPER, _FAINT, _ACCENT = "#1d2733", "#ffffff", "#8895a3", "#1f6fb2"
_PLAN_LEFT, _PLAN_SIZE = 430, 240
_TICK = 12.0


def board_plan_svg(text: str, counts: Sequence[Sequence[int]], T_base_camera: Array, approach: Array) -> str:
    """An SVG document.

    Args:
        text: what the plan is predicted to give.
        counts: (8, 12) corners expected in each cell of the image.
        T_base_camera: (K, 4, 4) planned poses, those taken already included.
        approach: (3,) horizontal unit vector from the scene towards the robot, which is below in the drawing.
    """
    most = max(1, *(n for row in counts for n in row))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" rx="6" fill="{_PAPER}"/>',
        *(_text(_LEFT, 20 + 17 * k, line, 12, weight="bold") for k, line in enumerate(text.split("; ", 1))),
        _text(_LEFT, _TOP - 10, "Corners expected in each part of the image", 12),
        _text(_PLAN_LEFT, _TOP - 10, "Camera from above; the robot stands below", 12),
    ]
    for r, row in enumerate(counts):
        for c, n in enumerate(row):
            x, y = _LEFT + c * _CELL, _TOP + r * _CELL
            share = math.sqrt(n / most)
            fill = f'fill="{_ACCENT}" fill-opacity="{0.08 + 0.72 * share:.2f}"' if n else 'fill="none"'
            parts.append(f'<rect x="{x}" y="{y}" width="{_CELL}" height="{_CELL}" {fill} stroke="{_FAINT}"/>')
            ink = _PAPER if share > 0.75 else _INK
            parts.append(_text(x + _CELL / 2, y + _CELL / 2 + 4, str(n) if n else "–", 10, ink, anchor="middle"))
    parts += _cameras(T_base_camera, approach)
    return "\n".join([*parts, "</svg>"])


def _cameras(T_base_camera: Array, approach: Array) -> list[str]:
    if not len(T_base_camera):
        return []
    side = np.cross([0.0, 0.0, 1.0], approach)
    eyes, looks = T_base_camera[:, :3, 3], T_base_camera[:, :3, 2]
    places = np.column_stack([eyes @ side, eyes @ approach])
    low, high = places.min(axis=0), places.max(axis=0)
    scale = (_PLAN_SIZE - 2 * _TICK) / max(float((high - low).max()), 0.05)
    at = (places - (low + high) / 2) * scale + [_PLAN_LEFT + _PLAN_SIZE / 2, _TOP + _PLAN_SIZE / 2]
    ticks = np.column_stack([looks @ side, looks @ approach]) * _TICK
    out: list[str] = []
    for (x, y), (dx, dy) in zip(at, ticks, strict=True):
        line = f'x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}"'
        out.append(f'<line {line} stroke="{_ACCENT}"/><circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{_INK}"/>')
    bar = 0.1 * scale
    y = _TOP + _PLAN_SIZE + 14
    out.append(f'<line x1="{_PLAN_LEFT}" y1="{y}" x2="{_PLAN_LEFT + bar:.1f}" y2="{y}" stroke="{_INK}"/>')
    out.append(_text(_PLAN_LEFT + bar + 6, y + 4, "100 mm", 11))
    return out


def _text(
    x: float, y: float, words: str, size: int, ink: str = _INK, *, anchor: str = "start", weight: str = ""
) -> str:
    style = f' font-weight="{weight}"' if weight else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{ink}" text-anchor="{anchor}"{style}>'
        f"{escape(words)}</text>"
    )
