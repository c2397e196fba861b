"""Names of accounts and of their owners: what they may be, and that none looks like another."""

from __future__ import annotations

import unicodedata

from sqlalchemy import Connection

from service.core.errors import ConfigurationError
from service.core.text.person_names import looks_of, person_name
from service.people.errors import AccountError
from service.people.rows import full_names

ACCOUNT_CHARACTERS = (2, 32)
FULL_NAME_CHARACTERS = (2, 80)
_BETWEEN = frozenset("._-'")


def plain_name(typed: str) -> str:
    """The account name for a typed name: lower case, in Unicode's form NFKC, without outer blanks."""
    return unicodedata.normalize("NFKC", typed).strip().lower()


def require_account_name(typed: str) -> str:
    """The name of a new account. Raises AccountError if it cannot be one."""
    name = _checked(plain_name(typed), "account", ACCOUNT_CHARACTERS)
    parts = all(c in _BETWEEN or c.isdecimal() or unicodedata.category(c)[0] in "LM" for c in name)
    if not parts or not name[0].isalpha() or name[-1] in _BETWEEN:
        raise AccountError(
            "this cannot be the name of an account",
            where="account",
            remedy="Use 2 to 32 letters, digits, dots, dashes or underscores, a letter first and none of . _ - last",
        )
    return name


def require_full_name(typed: str) -> str:
    """The name of a new account's owner. Raises AccountError if it cannot be one."""
    return _checked(typed, "full_name", FULL_NAME_CHARACTERS)


def require_unlike_others(connection: Connection, account: str, full_name: str) -> None:
    """Raise AccountError if a new account could be taken for one that exists. Two people may have the same name."""
    for other, theirs in full_names(connection).items():
        if account == other:
            raise AccountError(
                f"there is an account {other} already", where="account", remedy="Choose another, or reset that one"
            )
        if looks_of(account) == looks_of(other):
            raise AccountError(f"{account} looks like the account {other}", where="account", remedy="Choose another")
        looks_alike = full_name != theirs and looks_of(full_name) in (looks_of(theirs), looks_of(other))
        if looks_alike:
            raise AccountError(
                f"the name looks like that of {other}, and is another one",
                where="full_name",
                remedy="Give first and last name, in the letters in which the person writes it",
            )


def _checked(typed: str, where: str, characters: tuple[int, int]) -> str:
    try:
        name = person_name(typed)
    except ConfigurationError as error:
        raise AccountError(error.what, where=where, remedy=error.remedy) from error
    least, most = characters
    if not least <= len(name) <= most:
        raise AccountError(
            f"the name has {len(name)} characters", where=where, remedy=f"Use {least} to {most} characters"
        )
    return name
