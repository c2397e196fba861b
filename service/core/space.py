"""How much of a disk is whose: what is left below the least is for the evidence alone."""

from __future__ import annotations

LEAST_FREE_BYTES = 1 << 30
