"""The words that people read, on screens, in terminals and in reports, for names in the records."""

from __future__ import annotations

from collections.abc import Mapping

_WORDS: Mapping[str, str] = {
    "board_view": "board images",
    "calibrate": "camera calibration",
    "coverage_points": "the specimen's surface",
    "ct_surface": "CT surface",
    "ct": "CT series",
    "detect_spheres": "spheres in images",
    "evaluate": "evaluation",
    "features": "features of the images",
    "hand_board": "board images taken by hand",
    "hand_view": "images taken by hand",
    "hybrid": "hybrid camera poses",
    "layout": "layout of the spheres",
    "live_summary": "summary of the images",
    "live_view": "images as they arrive",
    "locate_spheres": "spheres in the mesh",
    "match": "matches between images",
    "register": "registration",
    "structure_from_motion": "camera poses from images",
    "control_image": "images of the control spheres",
}


def term(name: str) -> str:
    """The words for a name in the records: ct_surface → CT surface. An unknown name gets spaces for underscores."""
    return _WORDS.get(name, name.replace("_", " "))
