"""Errors of the store, as leaves of the one error tree."""

from __future__ import annotations

from service.core.errors import StoreError


class UnknownRunError(StoreError):
    """No run, or more than one, matches this name."""


class LeaseHeldError(StoreError):
    """Another process drives this run."""


class LeaseLostError(StoreError):
    """The lease on a run or a job now belongs to another process; nothing was written."""


class StoreVersionError(StoreError):
    """The database was written by another version of the software."""


class RecordDamagedError(StoreError):
    """Database and journal no longer agree: one of them was overwritten, cut, replaced or removed."""


class SigningKeyError(StoreError):
    """The private key that signs checkpoints is missing, unusable or readable by others; the record is unaffected."""


class TimestampError(StoreError):
    """A time-stamp authority cannot be reached or its answer does not verify; the evidence is valid without it."""
