"""What the filters of the auditor's lists share: they are set by fields of text, and travel in links."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True, slots=True)
class Filter:
    """Base of filters, whose fields are texts; an empty field matches all."""

    @property
    def active(self) -> bool:
        """Whether anything is filtered."""
        return bool(self.query())

    def query(self) -> dict[str, str]:
        """The filter as query parameters of a link."""
        return {name: value for name, value in asdict(self).items() if value}
