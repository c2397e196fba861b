"""What is computed on surfaces stays within a hard limit of memory that it needs several times without blocks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "limit_mb"),
    [
        pytest.param("compared", 120, marks=pytest.mark.sweep(always=True)),
        pytest.param("fused", 80, marks=pytest.mark.sweep),
        pytest.param("covered", 58, marks=pytest.mark.sweep),
        pytest.param("nearest", 39, marks=pytest.mark.sweep),
        pytest.param("extracted", 600, marks=pytest.mark.sweep),
    ],
)
def test_surfaces_are_computed_within_a_hard_limit_of_memory(what: str, limit_mb: int) -> None:
    command = [sys.executable, "-m", "tests.support.processes.bounded_memory", what, str(limit_mb)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert 0 < float(done.stdout) <= limit_mb
