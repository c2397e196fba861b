"""Fixtures of runs on the in-memory rig."""

from tests.support.runs.bench_fixtures import begin, bench

__all__ = ["begin", "bench"]
