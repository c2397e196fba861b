"""The installed software, for the record of a session."""

from __future__ import annotations

import functools
import re
from importlib.metadata import Distribution, distributions

_FIELDS = re.compile(r"^(Name|Version):[ \t]*(.*?)[ \t]*$", re.MULTILINE)


def software_versions() -> dict[str, str]:
    """Return every installed distribution and its version, sorted by name; as this process found them first."""
    return dict(_installed())


@functools.cache
def _installed() -> tuple[tuple[str, str], ...]:
    found = dict(map(_named, distributions()))
    return tuple((name, version) for name, version in sorted(found.items()) if name)


def _named(distribution: Distribution) -> tuple[str, str]:
    """Return the name and version; the metadata's other fields, which are long, are not parsed."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    header = text.replace("\r\n", "\n").partition("\n\n")[0]
    fields = dict(reversed(_FIELDS.findall(header)))
    return fields.get("Name", ""), fields.get("Version", "")
