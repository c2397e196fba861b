"""What people do to a run: start, tick, confirm, sign, redo, skip, pause, resume, abort; and who has control."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
