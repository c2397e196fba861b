"""The runs of this folder's tests."""

from __future__ import annotations

from tests.support.runs.bench_fixtures import begin, bench

__all__ = ["begin", "bench"]
