"""Live capture: last image, verdicts, plan of the viewpoints, contact sheet, live view."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
