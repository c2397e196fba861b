"""The first page: runs under way and recorded, and protocols to start."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
