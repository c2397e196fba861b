"""The scene in 3D, and the same as a table."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
