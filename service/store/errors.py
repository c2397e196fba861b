"""What the store refuses and why, as leaves of the one error tree."""

from __future__ import annotations

from service.core.errors import StoreError


class UnknownRunError(StoreError):
    """No run, or more than one, answers to this name."""


class LeaseHeldError(StoreError):
    """Another process drives this run."""


class LeaseLostError(StoreError):
    """The lease on a run or a job has gone to somebody else; nothing was written."""


class StoreVersionError(StoreError):
    """The database was written by another version of the software."""


class SigningKeyError(StoreError):
    """The private key that signs checkpoints is missing, unusable or badly kept; what is recorded stays as it is."""


class TimestampError(StoreError):
    """A time-stamp authority could not be reached, or its answer does not verify; the evidence stands without it."""
