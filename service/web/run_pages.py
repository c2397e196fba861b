"""The guided screen of a run: one step at a time."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
