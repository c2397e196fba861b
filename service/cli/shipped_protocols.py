"""The protocols that come with orthocapture, in a checkout or an installed wheel, and how one is named."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from service.core.errors import ProtocolError

_FOLDER = "protocols"
PROTOCOL_HELP = "The protocol file, or the name of a shipped one, such as exvivo_spine."


def shipped_protocols() -> Path:
    """The folder of the protocols that come with orthocapture."""
    return Path(str(files(_FOLDER)))


def protocol_file(named: Path) -> Path:
    """The protocol file of this path, or the shipped one of this name if there is no such file.

    `exvivo_spine`, `exvivo_spine.yaml` and `protocols/exvivo_spine.yaml` name the same one, wherever the command is
    given. Raises ProtocolError, which lists the names, if there is neither.
    """
    if named.is_file() or named.parent.as_posix() not in (".", _FOLDER):
        return named
    shipped = {path.name: path for path in sorted(shipped_protocols().glob("*.yaml"))}
    found = shipped.get(named.name) or shipped.get(f"{named.name}.yaml")
    if found is None:
        raise ProtocolError(
            "there is no such file, and no protocol of this name comes with orthocapture",
            where=str(named),
            remedy=f"Check the path, or name one of {', '.join(path.stem for path in shipped.values())}",
        )
    return found
