"""Signs the end of a run's chain: after each step that passed, and when the runner ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from service.core.errors import StoreError
from service.core.records.events import DeviceTrouble
from service.store.signatures.second_place import Away, SecondPlace, away_words
from service.store.signatures.signing import checkpoint
from service.store.signatures.timestamps import Authority, stamp_end
from service.store.store import Store

_DEVICE = "second place of signatures"


@dataclass
class Seal:
    """Signs the chain of one run, and keeps the second place of the signatures up to date.

    `authority`, if given, stamps the run's end. `busy` and `tell` are the operator's methods.
    """

    store: Store
    run_id: str
    authority: Authority | None
    second_place: SecondPlace
    busy: Callable[[str], None]
    tell: Callable[[str], None]
    _away: Away | None = None  # as the record says it

    def sign(self, *, ended: bool) -> None:
        """Sign the chain's end and, if the run has `ended`, have the signature stamped.

        The operator is told of a failure; nothing is raised: the next signature covers the same events.
        """
        self.busy("signing the record")
        try:
            stamp_end(self.store, self.run_id, self.authority if ended else None)
        except StoreError as error:
            resume = f"`orthocapture resume {self.run_id}` signs it"
            self.tell(f"the record could not be signed: {error}. Once that is put right, {resume}")
        away = self.second_place.update()
        if (away is None) != (self._away is None):
            self._tell_of_the_place(away)

    def _tell_of_the_place(self, away: Away | None) -> None:
        """Tell the operator, and record that the second place is away; a run goes on without it."""
        self._away = away
        if away is None:
            self.tell("the second place of the signatures is up to date again")
            return
        self.tell(away_words(away))
        trouble = DeviceTrouble(device=_DEVICE, error="Away", message=f"{away.place}: {away.why}")
        try:
            self.store.record(self.run_id, [trouble], actor="service")
            checkpoint(self.store, self.run_id)
        except StoreError as error:
            self.tell(f"that could not be recorded: {error}")

    def sign_if_missing(self) -> None:
        """Sign and stamp an ended run whose runner died before it could, or whose authority did not answer."""
        if self.authority is None or not self.store.timestamps(self.run_id):
            self.sign(ended=True)
