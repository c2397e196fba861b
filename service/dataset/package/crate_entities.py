"""Entities of RO-Crate 1.1 metadata that bundles of evidence and exported data sets share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

METADATA = "ro-crate-metadata.json"
CONTEXT = ["https://w3id.org/ro/crate/1.1/context", {"sha256": "https://w3id.org/ro/terms/workflow-run#sha256"}]
Entity = dict[str, Any]
_FORMATS = {
    "jsonl": "application/x-ndjson",
    "json": "application/json",
    "yaml": "application/yaml",
    "txt": "text/plain",
    "md": "text/markdown",
    "csv": "text/csv",
    "py": "text/x-python",
    "html": "text/html",
    "jpg": "image/jpeg",
    "png": "image/png",
    "h5": "application/x-hdf5",
    "glb": "model/gltf-binary",
}


def media_type(path: str) -> str:
    """The media type of a file, by the end of its name."""
    return _FORMATS.get(path.rpartition(".")[2], "application/octet-stream")


def descriptor() -> Entity:
    """The entity of the metadata file itself."""
    return {
        "@id": METADATA,
        "@type": "CreativeWork",
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
        "about": {"@id": "./"},
    }


def file_entity(path: str, sha256: str, size_bytes: int, description: str = "") -> Entity:
    """A file of the crate."""
    return {
        "@id": path,
        "@type": "File",
        "name": path,
        "description": description,
        "encodingFormat": media_type(path),
        "contentSize": str(size_bytes),
        "sha256": sha256,
    }


def software(version: str) -> Entity:
    """This program."""
    return {"@id": "#software", "@type": "SoftwareApplication", "name": "orthocapture", "softwareVersion": version}


def person(account: str, full_names: Mapping[str, str]) -> Entity:
    """By full name; the account, as the records have it, is the other name."""
    found = {"@id": anchor("person", account), "@type": "Person", "name": full_names.get(account) or account}
    return found if found["name"] == account else found | {"alternateName": account}


def device(name: str, model: str, firmware: str, serial: str) -> Entity:
    """A device as it first answered."""
    return {
        "@id": anchor("device", name),
        "@type": "IndividualProduct",
        "name": name,
        "description": f"{model} {firmware}".strip(),
        "serialNumber": serial,
    }


def anchor(kind: str, name: str) -> str:
    """An identifier within the crate that is a valid URI reference."""
    return f"#{kind}-" + "".join(c if c.isascii() and c.isalnum() else f"_{ord(c):x}_" for c in name)
