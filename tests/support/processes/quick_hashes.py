"""Hashes of passwords and PINs that cost next to nothing; those of the service cost a tenth of a second each."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

from argon2 import PasswordHasher

QuickHasher = partial(PasswordHasher, time_cost=1, memory_cost=8, parallelism=1)


def hash_quickly() -> None:
    """Let this process hash quickly, if it has imported what hashes. Hashes of either kind are read by both."""
    credentials: Any = sys.modules.get("service.people.credentials")
    if credentials is not None:
        credentials.PasswordHasher = QuickHasher
