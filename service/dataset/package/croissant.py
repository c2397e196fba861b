"""croissant.json: MLCommons Croissant 1.0 metadata, whose record sets hold the views, their pictures and masks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from service.core.records.data_set import Party
from service.dataset.package import views_table
from service.dataset.package.crate_entities import media_type
from service.dataset.package.croissant_context import CONTEXT
from service.dataset.package.listed import ListedFile
from service.dataset.package.views_table import CAMERA, COVARIANCE, POSE, Parts
from service.dataset.posed.records import DataSet

NAME = "croissant.json"
_PICTURES = ("image/jpeg", "image/png")
#: Croissant's readers turn images into 8 bits of red, green and blue, which a depth of 16 bits does not survive.
_NOT_AS_PICTURES = ("depth", "arrays")
_TYPES = {
    **dict.fromkeys(("sparse", "simulated"), "sc:Boolean"),
    **dict.fromkeys(CAMERA[:2], "sc:Integer"),
    **dict.fromkeys((*CAMERA[2:], *POSE, *COVARIANCE), "sc:Float"),
}


def croissant(
    dataset: DataSet, words: str, files: Sequence[ListedFile], parts: Parts, described: Mapping[str, str]
) -> dict[str, Any]:
    """The metadata as plain data.

    Args:
        dataset: as it is written.
        words: the format in a few words.
        files: of the folder, without this one.
        parts: the files of the views: role → view → file.
        described: what a file is, by its name.
    """
    about = dataset.about
    marked = "SIMULATED " if dataset.simulated else ""
    of_views = {file for named in parts.values() for file in named.values()}
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": f"{marked}{about.title}",
        "description": (
            f"{marked}Posed images and a surface mesh in one frame. Format: {words}. Ethics: {about.ethics}."
            + (f" {dataset.mark}." if dataset.simulated else "")
        ),
        "version": about.version,
        "datePublished": about.published_utc[:10] or "1970-01-01",
        "license": about.licence_address or about.licence,
        "citeAs": about.citation,
        "url": about.doi or f"urn:orthocapture:run:{about.run or 'unknown'}",
        "creator": [_party(maker) for maker in about.creators or (Party("not stated", "Organization"),)],
        **({} if about.publisher is None else {"publisher": _party(about.publisher)}),
        **({"funder": [_party(funder) for funder in about.funders]} if about.funders else {}),
        **({"identifier": about.doi} if about.doi else {}),
        "keywords": ["simulated"] if dataset.simulated else ["captured"],
        "distribution": [
            *(_file_object(file, described) for file in files if file.path not in of_views),
            *(_file_set(role, named.values()) for role, named in parts.items()),
        ],
        "recordSet": [
            _views(parts),
            *(_pictures(role) for role, named in parts.items() if _is_pictures(role, named.values())),
        ],
    }


def _party(one: Party) -> dict[str, str]:
    return {"@type": f"sc:{one.kind}", "name": one.name, **({"url": one.address} if one.address else {})}


def _file_object(file: ListedFile, described: Mapping[str, str]) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": file.path,
        "name": file.path,
        "description": described.get(file.path, ""),
        "contentUrl": file.path,
        "contentSize": f"{file.size_bytes} B",
        "encodingFormat": media_type(file.path),
        "sha256": file.sha256,
    }


def _file_set(role: str, files: Iterable[str]) -> dict[str, Any]:
    """The files of one role, which lie in folders of their own."""
    paths = [PurePosixPath(file) for file in files]
    return {
        "@type": "cr:FileSet",
        "@id": role,
        "name": role,
        "description": f"The {role} of each view; SHA256SUMS has their hashes",
        "encodingFormat": sorted({media_type(path.name) for path in paths}),
        "includes": sorted({f"{path.parent}/*{path.suffix}" for path in paths}),
    }


def _views(parts: Parts) -> dict[str, Any]:
    """One record for each view, from views.csv."""
    columns = views_table.columns(parts)
    return {
        "@type": "cr:RecordSet",
        "@id": "views",
        "name": "views",
        "description": "Each view with its files, its camera and its pose",
        "key": {"@id": "views/name"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"views/{name}",
                "name": name,
                "description": meaning,
                "dataType": _TYPES.get(name, "sc:Text"),
                "source": {"fileObject": {"@id": views_table.NAME}, "extract": {"column": name}},
            }
            for name, meaning in columns.items()
        ],
    }


def _is_pictures(role: str, files: Iterable[str]) -> bool:
    return role not in _NOT_AS_PICTURES and all(media_type(file) in _PICTURES for file in files)


def _pictures(role: str) -> dict[str, Any]:
    """One record for each picture of a role: its file, as views.csv names it, and its pixels."""
    name = f"{role}_pixels"
    fields = {
        "file": ("sc:Text", "fullpath", f"the file, as the field {role} of the views names it"),
        "pixels": ("sc:ImageObject", "content", "the pixels"),
    }
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": f"The {role} of each view as pixels",
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{field}",
                "name": field,
                "description": meaning,
                "dataType": kind,
                "source": {"fileSet": {"@id": role}, "extract": {"fileProperty": what}},
            }
            for field, (kind, what, meaning) in fields.items()
        ],
    }
