"""News for the pages as server-sent events: that something changed, never what."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
