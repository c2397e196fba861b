"""What holds for every test: one thread of linear algebra a process, as in the program (service/cli/main.py)."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded, here and in processes started from here
