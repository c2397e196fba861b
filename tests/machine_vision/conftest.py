"""The drivers of this folder's tests are forked."""

from __future__ import annotations

from tests.support.processes.hosts import forked_hosts

__all__ = ["forked_hosts"]
