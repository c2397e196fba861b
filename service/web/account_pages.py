"""Signing in and out, first set-up, invitations, the screen's lock, and the administrator's list of accounts."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter()
