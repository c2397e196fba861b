"""Benchmarks, in a folder for each subject: scripts that anyone can run.

Linear algebra uses one thread, as in the program.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # must be set before numpy is imported
