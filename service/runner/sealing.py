"""Signs a run's chain as it stands: after each step that passed, and when the runner ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from service.core.errors import StoreError
from service.store.signatures.log_copy import keep_elsewhere
from service.store.signatures.timestamps import Authority, stamp_end
from service.store.store import Store


@dataclass(frozen=True)
class Seal:
    """Signs the chain of one run, and keeps the copy of the log of signatures up to date.

    `authority`, where there is one, is asked for a time stamp of the run's end; `signature_copy` is the second place
    of the log of signatures. `busy` and `tell` are the operator's.
    """

    store: Store
    run_id: str
    authority: Authority | None
    signature_copy: Path | None
    busy: Callable[[str], None]
    tell: Callable[[str], None]

    def sign(self, *, ended: bool) -> None:
        """Sign the chain; a run that has `ended` is stamped as well.

        A failure is told and raises nothing: the next signature covers what this one would have covered.
        """
        self.busy("signing the record")
        try:
            stamp_end(self.store, self.run_id, self.authority if ended else None)
        except StoreError as error:
            resume = f"`orthocapture resume {self.run_id}` signs it"
            self.tell(f"the record could not be signed: {error}. Once that is put right, {resume}")
        keep_elsewhere(self.store.database_path.parent, self.signature_copy, self.tell, self.store.files)

    def sign_if_missing(self) -> None:
        """Sign and stamp a run that ended before its runner could, or whose authority did not answer."""
        if self.authority is None or not self.store.timestamps(self.run_id):
            self.sign(ended=True)
