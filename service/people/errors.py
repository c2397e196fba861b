"""Errors of accounts, sign-ins and control, as leaves of the one error tree."""

from __future__ import annotations

from service.core.errors import OrthocaptureError


class PeopleError(OrthocaptureError):
    """A person's request was refused; nothing was changed."""


class NotSignedInError(PeopleError):
    """Nobody is signed in on this screen, or the sign-in has ended."""


class SignInRefusedError(PeopleError):
    """Name or password is wrong, or the account may not sign in now; which of these is deliberately not said."""


class AccountJustChangedError(SignInRefusedError):
    """The password was right, but the account was changed meanwhile; this does not count as a failed try."""


class TooManyTriesError(PeopleError):
    """Too many failed tries from one address; `wait_s` says how long to wait."""

    wait_s: float = 60.0


class NotAllowedError(PeopleError):
    """The person's role does not have the permission, or the request did not come from the person's own page."""


class ScreenLockedError(PeopleError):
    """The screen is locked: it shows pages but allows no actions."""


class PinRefusedError(PeopleError):
    """The PIN is wrong."""


class LinkError(PeopleError):
    """A one-time link is unknown, used, or too old."""


class AccountError(PeopleError):
    """An account cannot be made or changed like this."""


class ControlError(PeopleError):
    """Another screen has control of the run, or nobody has."""
