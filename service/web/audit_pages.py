"""The auditor's view: runs, first page of a run, timeline, artefacts, provenance."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
