"""Settings for all tests: repeatable examples, and one thread of linear algebra per process, as in the program."""

from __future__ import annotations

import os

from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported, here and in child processes

# The same examples every time, so that a failure is due to the change. `--hypothesis-profile=default` tries new ones.
settings.register_profile("repeatable", derandomize=True, database=None)
settings.load_profile("repeatable")
