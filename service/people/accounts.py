"""Keeps accounts: first set-up, invitations, roles, badges, and changes by administrators and owners."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, Row, func, insert, select, update

from service.core.records.entered import reason_of
from service.core.records.events import AccountChanged
from service.people.credentials import (
    KnownTries,
    Passwords,
    SecretOrigin,
    ShortSecrets,
    new_token,
    on_screen_of,
    plain_badge,
    require_password,
    require_pin,
    token_sha256,
)
from service.people.person import (
    ROLES,
    SERVICE,
    Account,
    AccountError,
    Invitation,
    LinkError,
    Person,
    Role,
    end_sessions,
    get_account,
    record_change,
    require_account_name,
    require_full_name,
    require_unlike_others,
    to_account,
)
from service.store.database.tables import accounts, invitations
from service.store.store import Store

FIRST_LINK_S = 24 * 3600.0
INVITATION_S = 72 * 3600.0


class Accounts:
    """Changes that administrators make to accounts, and people to their own; each is recorded in its transaction."""

    def __init__(self, store: Store, passwords: Passwords, pins: ShortSecrets, known: KnownTries) -> None:
        self._store = store
        self._passwords = passwords
        self._pins = pins
        self._known = known

    def all(self) -> list[Account]:
        """Return every account, sorted by name."""
        with self._store.database.reading() as connection:
            return [to_account(row) for row in connection.execute(select(accounts).order_by(accounts.c.account))]

    def get(self, account: str) -> Account:
        """Return the account of this name. Raises AccountError if there is none."""
        with self._store.database.reading() as connection:
            return to_account(get_account(connection, account))

    def strangers_wait(self, account: Account) -> bool:
        """Return whether wrong passwords still close the account to strangers, until both clocks say it is over."""
        return self._store.ages.at_least_s(account.locked_until_utc_s) < 0

    def waits_until_utc_s(self, account: Account) -> float:
        """Return until when somebody has to wait after wrong passwords of the account; 0 if nobody has to."""
        known_s = self._known.longest_wait_s(account.account)
        strangers_s = account.locked_until_utc_s if self.strangers_wait(account) else 0.0
        return max(strangers_s, self._store.clock.utc_s() + known_s if known_s else 0.0)

    # --- one-time links ---

    def first_link(self) -> str | None:
        """Return a new one-time token for making the first administrator, or None if there is one already."""
        with self._store.database.writing() as connection:
            if self._administrators(connection):
                return None
            return self._new_link(connection, "", FIRST_LINK_S, actor=SERVICE)

    def invitation(self, token: str) -> Invitation:
        """Return the invitation of a link. Raises LinkError if the link is unknown, used or too old."""
        with self._store.database.reading() as connection:
            return self._invitation(connection, token)

    def set_up(self, token: str, account: str, full_name: str, password: str, pin: str) -> str:
        """Use the first link to make the administrator; returns its account. Raises LinkError, AccountError."""
        name = require_account_name(account)
        plain = require_full_name(full_name)
        require_password(password, name)
        require_pin(pin)
        secrets = {"password_hash": self._passwords.hash(password), "pin_hash": self._pins.hash(pin)}
        with self._store.database.writing() as connection:
            if self._invitation(connection, token).account or self._administrators(connection):
                raise _no_link()
            require_unlike_others(connection, name, plain)
            self._use(connection, token)
            self._create(connection, name, name, plain, "administrator", "active", secrets)
        return name

    def accept(self, token: str, password: str, pin: str) -> str:
        """Use an invitation to set password and PIN; returns the account. Raises LinkError, AccountError."""
        name = self.invitation(token).account
        require_password(password, name)
        require_pin(pin)
        secrets = {"password_hash": self._passwords.hash(password), "pin_hash": self._pins.hash(pin)}
        with self._store.database.writing() as connection:
            unused = name and self._invitation(connection, token).account == name
            if not unused or get_account(connection, name).state != "invited":
                raise _no_link()
            self._use(connection, token)
            connection.execute(
                update(accounts)
                .where(accounts.c.account == name)
                .values(state="active", failures=0, locked_until_utc_s=0.0, **secrets)
            )
            change = AccountChanged(account=name, field="state", old="invited", new="active")
            record_change(self._store, connection, name, change, secrets)
        return name

    def invite(self, by: Person, account: str, full_name: str, role: Role) -> str:
        """Make an account. Returns the token of its link, which is shown only once. Raises AccountError."""
        name = require_account_name(account)
        plain = require_full_name(full_name)
        _require_role(role)
        with self._store.database.writing() as connection:
            require_unlike_others(connection, name, plain)
            nothing = {"password_hash": "", "pin_hash": ""}
            self._create(connection, by.account, name, plain, role, "invited", nothing)
            return self._new_link(connection, name, INVITATION_S, actor=by.account)

    def reset(self, by: Person, account: str, reason: str) -> str:
        """Remove password, PIN and badge, end all sign-ins, and return a new link's token. Raises AccountError."""
        why = reason_of(reason, AccountError)
        with self._store.database.writing() as connection:
            row = get_account(connection, account)
            if row.state == "active":
                self._require_another_administrator(connection, row)
            nothing = {"password_hash": "", "pin_hash": "", "badge_hash": ""}
            values = {"state": "invited", "failures": 0, "locked_until_utc_s": 0.0, **nothing}
            connection.execute(update(accounts).where(accounts.c.account == account).values(**values))
            end_sessions(self._store, connection, account, actor=by.account)
            change = AccountChanged(account=account, field="state", old=row.state, new="invited", reason=why)
            record_change(self._store, connection, by.account, change, nothing)
            return self._new_link(connection, account, INVITATION_S, actor=by.account)

    # --- an administrator's changes ---

    def change_role(self, by: Person, account: str, role: Role, reason: str) -> None:
        """Give an account another role and end its sign-ins. Raises AccountError."""
        why = reason_of(reason, AccountError)
        _require_role(role)
        with self._store.database.writing() as connection:
            row = get_account(connection, account)
            if row.role == role:
                raise AccountError(f"{account} is {role} already", where="role", remedy="Nothing has to be done")
            if row.state == "active":
                self._require_another_administrator(connection, row)
            connection.execute(update(accounts).where(accounts.c.account == account).values(role=role))
            end_sessions(self._store, connection, account, actor=by.account)
            change = AccountChanged(account=account, field="role", old=row.role, new=role, reason=why)
            record_change(self._store, connection, by.account, change)

    def disable(self, by: Person, account: str, reason: str) -> None:
        """Disable an account and end its sign-ins and links. Raises AccountError, also for the last administrator."""
        why = reason_of(reason, AccountError)
        with self._store.database.writing() as connection:
            row = get_account(connection, account)
            if row.state == "disabled":
                raise AccountError(f"{account} is disabled already", where="account", remedy="Nothing has to be done")
            if row.state == "active":
                self._require_another_administrator(connection, row)
            connection.execute(update(accounts).where(accounts.c.account == account).values(state="disabled"))
            end_sessions(self._store, connection, account, actor=by.account)
            self._void_links(connection, account)
            change = AccountChanged(account=account, field="state", old=row.state, new="disabled", reason=why)
            record_change(self._store, connection, by.account, change)

    def enable(self, by: Person, account: str, reason: str) -> None:
        """Enable a disabled account again with its old password. Raises AccountError."""
        why = reason_of(reason, AccountError)
        with self._store.database.writing() as connection:
            row = get_account(connection, account)
            if row.state != "disabled" or not row.password_hash:
                raise AccountError(
                    f"{account} is not disabled"
                    if row.state != "disabled"
                    else f"{account} has never had a password",
                    where="account",
                    remedy="Reset the account for a new link if its owner cannot sign in",
                )
            connection.execute(update(accounts).where(accounts.c.account == account).values(state="active"))
            change = AccountChanged(account=account, field="state", old="disabled", new="active", reason=why)
            record_change(self._store, connection, by.account, change)

    def end_wait(self, by: str, account: str) -> None:
        """End all waits after wrong passwords of an account. Raises AccountError."""
        with self._store.database.writing() as connection:
            row = get_account(connection, account)
            values = {"failures": 0, "locked_until_utc_s": 0.0}
            connection.execute(update(accounts).where(accounts.c.account == account).values(**values))
            change = AccountChanged(
                account=account, field="lock_out", old=f"{row.failures} wrong passwords", new="ended"
            )
            record_change(self._store, connection, by, change)

    # --- one's own ---

    def change_password(self, person: Person, password: str) -> None:
        """Set a new password and end the person's other sign-ins. Raises AccountError if it is not acceptable.

        The caller has checked the old password.
        """
        require_password(password, person.account)
        self._change_secret(person, "password", self._passwords.hash(password))

    def change_pin(self, person: Person, pin: str) -> None:
        """Set a new PIN; the caller has checked the password. Raises AccountError if it is not acceptable."""
        require_pin(pin)
        self._change_secret(person, "pin", self._pins.hash(pin))

    def _change_secret(self, person: Person, which: str, stored: str) -> None:
        with self._store.database.writing() as connection:
            values = {f"{which}_hash": stored}
            connection.execute(update(accounts).where(accounts.c.account == person.account).values(**values))
            if which == "password":
                end_sessions(self._store, connection, person.account, actor=person.account, keep=person.screen)
            change = AccountChanged(account=person.account, field=which, old="set", new="changed")
            record_change(self._store, connection, person.account, change, values)

    # --- within a transaction ---

    def _create(
        self,
        connection: Connection,
        actor: str,
        name: str,
        full_name: str,
        role: Role,
        state: str,
        secrets: dict[str, str],
    ) -> None:
        change = AccountChanged(account=name, field="created", old="", new=f"{role}, {state}", full_name=full_name)
        made = record_change(self._store, connection, actor, change, secrets)
        connection.execute(
            insert(accounts).values(
                account=name,
                full_name=full_name,
                role=role,
                state=state,
                failures=0,
                locked_until_utc_s=0.0,
                created_utc=made.at_utc,
                **secrets,
            )
        )

    def _new_link(self, connection: Connection, account: str, valid_s: float, *, actor: str) -> str:
        self._void_links(connection, account)
        token = new_token()
        stored = {"token_sha256": token_sha256(token)}
        change = AccountChanged(account=account, field="link", old="", new=f"valid for {valid_s / 3600:.0f} h")
        made = record_change(self._store, connection, actor, change, stored)
        expires_utc_s = datetime.fromisoformat(made.at_utc).timestamp() + valid_s
        self._store.ages.begin(expires_utc_s)
        connection.execute(insert(invitations).values(account=account, expires_utc_s=expires_utc_s, used=0, **stored))
        return token

    def _void_links(self, connection: Connection, account: str) -> None:
        connection.execute(update(invitations).where(invitations.c.account == account).values(used=1))

    def _invitation(self, connection: Connection, token: str) -> Invitation:
        row = connection.execute(
            select(invitations).where(
                invitations.c.token_sha256 == token_sha256(token),
                invitations.c.used == 0,
            )
        ).one_or_none()
        if row is None or self._store.ages.at_most_s(row.expires_utc_s) >= 0:
            raise _no_link()
        if not row.account:
            return Invitation("", "", "administrator")
        owner = get_account(connection, row.account)
        return Invitation(owner.account, owner.full_name, owner.role)

    def _use(self, connection: Connection, token: str) -> None:
        connection.execute(
            update(invitations).where(invitations.c.token_sha256 == token_sha256(token)).values(used=1)
        )

    def _administrators(self, connection: Connection) -> int:
        return connection.execute(
            select(func.count()).where(accounts.c.role == "administrator", accounts.c.state == "active")
        ).scalar_one()

    def _require_another_administrator(self, connection: Connection, row: Row[Any]) -> None:
        if row.role == "administrator" and self._administrators(connection) < 2:
            raise AccountError(
                f"{row.account} is the last active administrator",
                where="account",
                remedy="Make another administrator first",
            )


def _require_role(role: str) -> None:
    if role not in ROLES:
        raise AccountError(f"there is no role {role!r}", where="role", remedy=f"One of {', '.join(ROLES)}")


def _no_link() -> LinkError:
    return LinkError(
        "this link is not valid: it was used, is too old, or was replaced by a newer one",
        where="link",
        remedy="Ask an administrator for a new one; the first link is printed by `orthocapture serve` as it starts",
    )


class Badges:
    """Enrolling and revoking badges, by supervisors and administrators."""

    def __init__(
        self, store: Store, codes: ShortSecrets, check_password: Callable[[str, str, SecretOrigin], None]
    ) -> None:
        self._store = store
        self._codes = codes
        self._check_password = check_password

    def enrol(self, by: Person, account: str, password: str, badge: str) -> None:
        """Give an account a badge, which replaces its old one.

        The owner agrees by giving the account's password; otherwise whoever enrols badges could sign as anybody.

        Raises:
            AccountError: the code is not a badge's, or the badge belongs to somebody else.
            SignInRefusedError: the password is wrong.
        """
        plain = plain_badge(badge)
        self._check_password(account, password, on_screen_of(by))
        if any(self._codes.matches(stored, plain) for stored in self._others(account)):
            raise AccountError(
                "this badge belongs to somebody else", where="badge", remedy="Revoke it there first, or use another"
            )
        self._set(by, account, self._codes.hash(plain), "enrolled")

    def revoke(self, by: Person, account: str, reason: str) -> None:
        """Revoke an account's badge, so that it can no longer sign. Raises AccountError."""
        self._set(by, account, "", "revoked", reason_of(reason, AccountError))

    def _others(self, account: str) -> list[str]:
        with self._store.database.reading() as connection:
            rows = connection.execute(
                select(accounts.c.badge_hash).where(accounts.c.account != account, accounts.c.badge_hash != "")
            )
            return [row.badge_hash for row in rows]

    def _set(self, by: Person, account: str, stored: str, new: str, reason: str = "") -> None:
        values = {"badge_hash": stored}
        with self._store.database.writing() as connection:
            row = get_account(connection, account)
            if not stored and not row.badge_hash:
                raise AccountError(f"{account} has no badge", where="badge", remedy="Nothing has to be done")
            connection.execute(update(accounts).where(accounts.c.account == account).values(**values))
            old = "enrolled" if row.badge_hash else ""
            change = AccountChanged(account=account, field="badge", old=old, new=new, reason=reason)
            record_change(self._store, connection, by.account, change, values)
