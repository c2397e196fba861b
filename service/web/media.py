"""Pictures: thumbnails, images with detected spheres, live view frames, recorded files."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
