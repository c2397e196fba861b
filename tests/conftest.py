"""What holds for every test: repeatable, and one thread of linear algebra a process as in the program."""

from __future__ import annotations

import os

from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded, here and in processes started from here

# The same examples every time: a failure belongs to the change. `--hypothesis-profile=default` looks for new ones.
settings.register_profile("repeatable", derandomize=True, database=None)
settings.load_profile("repeatable")
