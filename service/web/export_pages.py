"""What leaves the system: release by a second person, bundle, report, data set."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
