"""Writes RO-Crate 1.1 metadata of an exported data set, of entities that bundles of evidence have too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from service.core.records.data_set import Party, licence_name
from service.dataset.export_folder import ListedFile
from service.dataset.records import About, DataSet

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
    """Return the media type of a file, by the end of its name."""
    return _FORMATS.get(path.rpartition(".")[2], "application/octet-stream")


def descriptor() -> Entity:
    """Return the entity of the metadata file itself."""
    return {
        "@id": METADATA,
        "@type": "CreativeWork",
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
        "about": {"@id": "./"},
    }


def file_entity(path: str, sha256: str, size_bytes: int, description: str = "") -> Entity:
    """Return a file of the crate."""
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
    """Return the entity of this program."""
    return {"@id": "#software", "@type": "SoftwareApplication", "name": "orthocapture", "softwareVersion": version}


def person(account: str, full_names: Mapping[str, str]) -> Entity:
    """Return a person's entity: the full name, and as the other name the account, as the records have it."""
    found = {"@id": anchor("person", account), "@type": "Person", "name": full_names.get(account) or account}
    return found if found["name"] == account else found | {"alternateName": account}


def device(name: str, model: str, firmware: str, serial: str) -> Entity:
    """Return a device as it first answered."""
    return {
        "@id": anchor("device", name),
        "@type": "IndividualProduct",
        "name": name,
        "description": f"{model} {firmware}".strip(),
        "serialNumber": serial,
    }


def anchor(kind: str, name: str) -> str:
    """Return an identifier within the crate that is a valid URI reference."""
    return f"#{kind}-" + "".join(c if c.isascii() and c.isalnum() else f"_{ord(c):x}_" for c in name)


def crate(dataset: DataSet, words: str, files: Sequence[ListedFile], described: Mapping[str, str]) -> dict[str, Any]:
    """Return the metadata as plain data.

    Args:
        dataset: the data set as it is written.
        words: the format in a few words.
        files: the files of the folder, without this one.
        described: a description of each file, by its name.
    """
    about = dataset.about
    people = [person(name, {}) for name in about.people]
    devices = [device(one.name, one.model, one.firmware, one.serial) for one in about.devices]
    makers = _parties("creator", about.creators)
    publishers = _parties("publisher", () if about.publisher is None else (about.publisher,))
    funders = _parties("funder", about.funders)
    parts = [file_entity(file.path, file.sha256, file.size_bytes, described.get(file.path, "")) for file in files]
    root = _root(dataset, words) | {
        "creator": _ids(makers),
        "contributor": _ids(people),
        **({"publisher": _ids(publishers)[0]} if publishers else {}),
        **({"funder": _ids(funders)} if funders else {}),
        "hasPart": _ids(parts),
        "mentions": _ids(devices),
    }
    run = _run(about, devices)
    return {
        "@context": CONTEXT,
        "@graph": [
            descriptor(),
            root,
            _licence(about),
            {"@id": "#ethics", "@type": "CreativeWork", "name": "Ethics", "description": about.ethics},
            software(about.software or "unknown"),
            run,
            # One body may make, publish and pay for a data set.
            *{entity["@id"]: entity for entity in (*makers, *publishers, *funders)}.values(),
            *people,
            *devices,
            *parts,
        ],
    }


def _root(dataset: DataSet, words: str) -> Entity:
    about = dataset.about
    marked = "SIMULATED " if dataset.simulated else ""
    return {
        "@id": "./",
        "@type": "Dataset",
        "name": f"{marked}{about.title}",
        "description": (
            f"{marked}Posed images and a surface mesh in one frame. Format: {words}."
            + (f" {dataset.mark}." if dataset.simulated else "")
            + (f" {about.origin}." if about.origin else "")
            + "".join(f" Deviation: {text}." for text in about.deviations)
            + "".join(f" Accepted outside its limits: {text}." for text in about.accepted)
            + "".join(f" Not in when this was made: {text}." for text in about.not_in_yet)
        ),
        "datePublished": about.published_utc,
        "version": about.version,
        "identifier": [about.doi, about.run] if about.doi else about.run,
        "license": {"@id": _licence(about)["@id"]},
        "subjectOf": {"@id": "#ethics"},
        "creditText": about.citation,
        "keywords": ["simulated"] if dataset.simulated else [],
    }


def _run(about: About, devices: Sequence[Entity]) -> Entity:
    """Return the run that made the data set, and the head of its chain of evidence."""
    return {
        "@id": "#run",
        "@type": "CreateAction",
        "name": f"Run {about.run}".strip(),
        "description": f"Protocol {about.protocol}. SHA-256 of the last event: {about.head_sha256}",
        "instrument": [{"@id": "#software"}, *_ids(devices)],
        "endTime": about.published_utc,
        "result": {"@id": "./"},
    }


def _licence(about: About) -> Entity:
    """Return the licence's entity: its address, as RO-Crate wants it, or its text if it has none."""
    address = about.licence_address
    if not address:
        return {"@id": "#licence", "@type": "CreativeWork", "name": "Licence", "description": about.licence}
    return {"@id": address, "@type": "CreativeWork", "name": licence_name(address), "url": address}


def _parties(kind: str, found: Sequence[Party]) -> list[Entity]:
    """Return people by their ORCID and bodies by their ROR, where they have one."""
    return [
        {"@id": one.address or anchor(kind, one.name), "@type": one.kind, "name": one.name, **_names(one)}
        for one in found
    ]


def _names(one: Party) -> Entity:
    family, comma, given = one.name.partition(", ")
    return {"familyName": family, "givenName": given} if one.kind == "Person" and comma and "," not in given else {}


def _ids(entities: Sequence[Entity]) -> list[dict[str, str]]:
    return [{"@id": entity["@id"]} for entity in entities]
