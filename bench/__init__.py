"""Measurements: each file is a script that anyone can run; one thread of linear algebra, as in the program itself."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded
