"""Signs the end of a run's chain: after each step that passed, and when the runner ends."""

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

    `authority`, if given, stamps the run's end; `signature_copy` is the path of the copy. `busy` and `tell` are the
    operator's methods.
    """

    store: Store
    run_id: str
    authority: Authority | None
    signature_copy: Path | None
    busy: Callable[[str], None]
    tell: Callable[[str], None]

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
        keep_elsewhere(self.store.database_path.parent, self.signature_copy, self.tell, self.store.files)

    def sign_if_missing(self) -> None:
        """Sign and stamp an ended run whose runner died before it could, or whose authority did not answer."""
        if self.authority is None or not self.store.timestamps(self.run_id):
            self.sign(ended=True)
