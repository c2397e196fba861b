"""The calibration: coverage, residuals, uncertainty, poses to add, certificate."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
