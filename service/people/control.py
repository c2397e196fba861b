"""Which screen controls a run: one may act, the others only watch; every change is recorded in the run's chain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Any, Literal

from sqlalchemy import Connection, Row, bindparam, insert, select, update

from service.core.records.base import age_s
from service.core.records.entered import reason_of
from service.core.records.run_events import ControlTaken
from service.people.person import SESSION_S, AccountError, ControlError, NotAllowedError, Person
from service.store.database.tables import accounts, control, runs, sessions
from service.store.store import Store

UNANSWERED_S = 60.0  # after this time a locked screen that does not answer may lose control
_NOBODY_ASKS: Mapping[str, str | float] = {"asked_by_screen": "", "asked_by_account": "", "asked_utc_s": 0.0}
_DECIDE_AGAIN = "Read what the page shows now and decide again; nothing was done"
_RUN = select(runs.c.run_id).where(runs.c.run_id == bindparam("run"))  # put together once: every page asks them
_CONTROL = select(control).where(control.c.run_id == bindparam("run"))


@dataclass(frozen=True, slots=True)
class Holder:
    """The holder of control of a run, who asks for it, and who was refused it; "" for nobody.

    When a sign-in ends, so does its control.
    """

    screen: str = ""
    account: str = ""
    full_name: str = ""
    locked: bool = False
    asked_by_screen: str = ""
    asked_by_account: str = ""
    asked_by_name: str = ""
    asked_utc_s: float = 0.0
    refused_screen: str = ""  # the one that was refused last; until somebody asks again, or control changes
    refused_utc_s: float = 0.0


class Control:
    """Control of the runs in a data folder. Methods raise ControlError if a request is refused.

    `shown` is the screen of which a person's page spoke when they decided: the one in control ("" for none), or the
    one that asked. Where it is another one by now, the request is refused; None: there was no page.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    def holder(self, run_id: str) -> Holder:
        """Return who has control of the run now. Raises UnknownRunError."""
        with self._store.database.reading() as connection:
            return self._holder(connection, run_id)

    def require(self, run_id: str, person: Person) -> None:
        """Raise ControlError unless this person's screen has control of the run."""
        holder = self.holder(run_id)
        if holder.screen != person.screen:
            raise ControlError(
                f"{holder.full_name} has control of this run, on screen {holder.screen}"
                if holder.screen
                else "no screen has control of this run",
                where=run_id,
                remedy="Ask for control" if holder.screen else "Take control first",
            )

    def take(self, run_id: str, person: Person, *, shown: str | None = None) -> None:
        """Take control that is free, one's own elsewhere, or held by a locked screen that does not answer."""
        _require_operator(person)
        with self._store.database.writing() as connection:
            holder = self._holder(connection, run_id)
            if holder.screen == person.screen:
                return
            _require_shown(shown, holder, run_id)
            unanswered = (
                holder.locked
                and holder.asked_by_screen == person.screen
                and self._store.ages.at_least_s(holder.asked_utc_s) >= UNANSWERED_S
            )
            if not holder.screen:
                self._give(connection, run_id, person, holder, "free", "")
            elif holder.account == person.account:
                self._give(connection, run_id, person, holder, "handed_over", "the same person on another screen")
            elif unanswered:
                self._give(
                    connection, run_id, person, holder, "taken_over", "asked; the locked screen did not answer"
                )
            else:
                raise ControlError(
                    f"{holder.full_name} has control of this run, on screen {holder.screen}",
                    where=run_id,
                    remedy="Ask for control, or have a supervisor take over",
                )

    def take_over(self, run_id: str, person: Person, reason: str, *, shown: str | None = None) -> None:
        """Let a supervisor take control from whoever has it, with a reason. Raises NotAllowedError for others."""
        if person.role != "supervisor":
            raise NotAllowedError(
                "only a supervisor may take over control",
                where=run_id,
                remedy="Ask for control, or call a supervisor",
            )
        why = reason_of(reason, AccountError)
        with self._store.database.writing() as connection:
            holder = self._holder(connection, run_id)
            if holder.screen != person.screen:
                _require_shown(shown, holder, run_id)
                self._give(connection, run_id, person, holder, "taken_over" if holder.screen else "free", why)

    def ask(self, run_id: str, person: Person, *, shown: str | None = None) -> None:
        """Ask the screen in control to hand over. A later request replaces one that was not answered in time."""
        _require_operator(person)
        with self._store.database.writing() as connection:
            holder = self._holder(connection, run_id)
            if not holder.screen or holder.screen == person.screen:
                raise ControlError("there is nobody to ask", where=run_id, remedy="Take control; it is free")
            _require_shown(shown, holder, run_id)
            now = self._store.clock.utc_s()
            set_back = age_s(holder.asked_utc_s, now, if_set_back_s=inf) == inf
            answer_due = not set_back and self._store.ages.at_least_s(holder.asked_utc_s) < UNANSWERED_S
            if holder.asked_by_screen not in ("", person.screen) and answer_due:
                raise ControlError(
                    f"{holder.asked_by_name} has just asked", where=run_id, remedy="Wait for the answer"
                )
            # Asking again does not restart the waiting time, unless that is not known: the clock was set back.
            asked_s = holder.asked_utc_s if holder.asked_by_screen == person.screen and not set_back else now
            self._store.ages.begin(asked_s)
            self._write(
                connection,
                run_id,
                asked_by_screen=person.screen,
                asked_by_account=person.account,
                asked_utc_s=asked_s,
            )

    def answer(self, run_id: str, person: Person, *, grant: bool, shown: str | None = None) -> None:
        """Answer a request as the screen in control: with `grant` hand over, else refuse."""
        with self._store.database.writing() as connection:
            holder = self._holder(connection, run_id)
            if holder.screen != person.screen:
                raise ControlError("this screen does not have control", where=run_id, remedy="Read the page again")
            if not holder.asked_by_screen:
                raise ControlError("nobody asks for control any more", where=run_id, remedy="Nothing has to be done")
            if shown not in (None, holder.asked_by_screen):
                raise ControlError(
                    f"by now it is {holder.asked_by_name} who asks for control", where=run_id, remedy=_DECIDE_AGAIN
                )
            asker = self._valid(connection, holder.asked_by_screen)
            if grant and asker is not None:
                reason = f"asked for; granted by {person.account}"
                self._record(connection, run_id, asker.account, holder.asked_by_screen, holder, "handed_over", reason)
            else:
                self._write(connection, run_id, asked_utc_s=-self._store.clock.utc_s())
            if grant and asker is None:
                ended = ControlError("the screen that asked is signed out", where=run_id, remedy="You keep control")
            else:
                ended = None
        if ended is not None:
            raise ended

    def release(self, run_id: str, person: Person) -> None:
        """Give up control, so that anybody may take it."""
        with self._store.database.writing() as connection:
            holder = self._holder(connection, run_id)
            if holder.screen != person.screen:
                raise ControlError("this screen does not have control", where=run_id, remedy="Read the page again")
            self._record(connection, run_id, person.account, "", holder, "free", "given back")

    def _holder(self, connection: Connection, run_id: str) -> Holder:
        if connection.execute(_RUN, {"run": run_id}).first() is None:
            self._store.events(run_id)  # raises UnknownRunError in the store's words
        row = connection.execute(_CONTROL, {"run": run_id}).one_or_none()
        if row is None or not row.screen:
            return Holder()
        session = self._valid(connection, row.screen)
        if session is None:
            return Holder()
        holder = Holder(
            screen=row.screen, account=row.account, full_name=session.full_name, locked=bool(session.locked)
        )
        if row.asked_utc_s < 0:
            return replace(holder, refused_screen=row.asked_by_screen, refused_utc_s=-row.asked_utc_s)
        return replace(
            holder,
            asked_by_screen=row.asked_by_screen,
            asked_by_account=row.asked_by_account,
            asked_by_name=_full_name(connection, row.asked_by_account),
            asked_utc_s=row.asked_utc_s,
        )

    def _valid(self, connection: Connection, screen: str) -> Row[Any, Any, Any, Any] | None:
        """Return the sign-in on a screen, unless it has ended."""
        row = connection.execute(
            select(sessions.c.account, sessions.c.locked, sessions.c.created_utc_s, accounts.c.full_name)
            .join(accounts, sessions.c.account == accounts.c.account)
            .where(sessions.c.screen == screen, accounts.c.state == "active")
        ).one_or_none()
        return None if row is None or self._store.ages.at_most_s(row.created_utc_s) >= SESSION_S else row

    def _give(
        self,
        connection: Connection,
        run_id: str,
        person: Person,
        holder: Holder,
        how: Literal["free", "handed_over", "taken_over"],
        reason: str,
    ) -> None:
        self._record(connection, run_id, person.account, person.screen, holder, how, reason)

    def _record(
        self,
        connection: Connection,
        run_id: str,
        account: str,
        screen: str,
        before: Holder,
        how: Literal["free", "handed_over", "taken_over"],
        reason: str,
    ) -> None:
        taken = ControlTaken(screen=screen, previous=before.account, how=how, reason=reason)
        self._store.append(connection, run_id, [taken], actor=account)
        self._write(
            connection,
            run_id,
            screen=screen,
            account=account if screen else "",
            **_NOBODY_ASKS,
        )

    def _write(self, connection: Connection, run_id: str, **values: object) -> None:
        changed = connection.execute(update(control).where(control.c.run_id == run_id).values(**values))
        if not changed.rowcount:
            nobody = {"screen": "", "account": "", **_NOBODY_ASKS}
            connection.execute(insert(control).values(run_id=run_id, **{**nobody, **values}))


def _full_name(connection: Connection, account: str) -> str:
    """Return the name of the person with an account; "" for nobody."""
    return connection.execute(select(accounts.c.full_name).where(accounts.c.account == account)).scalar() or ""


def _require_shown(shown: str | None, holder: Holder, run_id: str) -> None:
    """Refuse what a person decided about another screen than the one that has control now."""
    if shown not in (None, holder.screen):
        who = f"{holder.full_name} has control, on screen {holder.screen}" if holder.screen else "nobody has control"
        raise ControlError(f"by now {who}", where=run_id, remedy=_DECIDE_AGAIN)


def _require_operator(person: Person) -> None:
    if not person.may("operate"):
        raise NotAllowedError(f"the role {person.role} may only watch", where="control", remedy="Ask a technician")
