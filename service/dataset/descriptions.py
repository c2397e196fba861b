"""Describes every exported data set: DATACARD.md for people, croissant.json and views.csv for programs."""

from __future__ import annotations

import csv
import inspect
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from service.core.records.data_set import Party
from service.dataset.crate import media_type
from service.dataset.export_folder import ListedFile
from service.dataset.records import NOT_STATED, About, DataSet, PosedView

CARD_NAME = "DATACARD.md"
BESIDE = {
    "views.csv": "one line for each view: its files, split, camera, pose and the pose's covariance",
    "splits.json": "the views of the splits `dense` (all), `sparse` (few that see most), `train` and `test`",
    "dataset.json": "origin, gates, deviations, evaluation, and the hashes of the original photographs",
    "croissant.json": "this data set for machines: MLCommons Croissant",
    "ro-crate-metadata.json": "this data set for machines: RO-Crate 1.1",
    "SHA256SUMS": "the hash of every file; `sha256sum --check SHA256SUMS` verifies them",
}


def card(dataset: DataSet, words: str, description: str) -> str:
    """Return the data card as Markdown.

    Args:
        dataset: the data set as it is written.
        words: the format in a few words.
        description: the docstring of the format's writer, which explains its files.
    """
    about = dataset.about
    sections = {
        "": _head(dataset, words),
        "Licence, ethics and citation": _rights(about),
        "Frames and units": _frames(dataset),
        "Files": [_paragraphs(description), "", *_pairs(BESIDE.items(), code=True)],
        "How it was made": _made(about),
        "How accurate it is": _accuracy(about),
        **({"Ground truth": _pairs(about.fusion)} if about.fusion else {}),
        "Gates and deviations": _gates(about),
    }
    lines = [f"# {about.title}", ""]
    for title, body in sections.items():
        lines += [f"## {title}", ""] if title else []
        lines += [*body, ""]
    return "\n".join(lines)


def _head(dataset: DataSet, words: str) -> list[str]:
    about = dataset.about
    marked = [f"**{dataset.mark}.**", ""] if dataset.simulated else []
    cameras = {f"{view.camera.width} × {view.camera.height} px" for view in dataset.views}
    held = f"{len(dataset.views)} posed images of {' and '.join(sorted(cameras))}" if dataset.views else "no images"
    return [
        *marked,
        f"Version {about.version} of {held} and a surface mesh of {len(dataset.mesh.faces)} triangles, in one frame.",
        f"Format: {words}.",
    ]


def _rights(about: About) -> list[str]:
    return _pairs(
        [
            (
                "Licence",
                about.licence
                if about.licence_address in {"", about.licence}
                else f"{about.licence} ({about.licence_address})",
            ),
            ("Ethics", about.ethics),
            ("Made by", ", ".join(maker.words for maker in about.creators) or NOT_STATED),
            ("Cite as", about.citation),
            ("DOI", about.doi or NOT_STATED),
            ("Publisher", about.publisher.words if about.publisher is not None else NOT_STATED),
            ("Paid for by", ", ".join(funder.words for funder in about.funders) or NOT_STATED),
            ("Procedure", about.source or NOT_STATED),
        ]
    )


def _frames(dataset: DataSet) -> list[str]:
    about = dataset.about
    return [
        "There is one frame, `world`: that of the mesh. Lengths are metres, unless the format's files say otherwise. "
        "Poses are `T_world_camera`, x right, y down, z forward, unless the format demands otherwise; `views.csv` "
        "has them so in every format.",
        "",
        *_pairs(
            [
                ("Mesh", about.mesh or NOT_STATED),
                (
                    "Depth",
                    "z along the camera's axis, of the ray through the pixel's centre; 0 where nothing is seen",
                ),
                ("Masks", about.masks or NOT_STATED),
                ("Covariance of a pose", about.covariance or NOT_STATED),
            ]
        ),
    ]


def _made(about: About) -> list[str]:
    devices = [
        ", ".join(
            filter(
                None,
                (
                    f"{device.name}: {device.model or 'model not stated'}",
                    f"serial number {device.serial}" if device.serial else "",
                    f"firmware {device.firmware}" if device.firmware else "",
                ),
            )
        )
        for device in about.devices
    ]
    return [
        *_pairs(
            [
                ("Origin", about.origin or NOT_STATED),
                ("Specimen", about.specimen or NOT_STATED),
                ("Purpose", about.purpose or NOT_STATED),
                ("Site", about.site or NOT_STATED),
                ("Protocol", about.protocol or NOT_STATED),
                ("Run", about.run or NOT_STATED),
                ("Software", f"orthocapture {about.software}" if about.software else NOT_STATED),
                *((name.capitalize(), value) for name, value in about.settings),
            ]
        ),
        "",
        "Devices:",
        "",
        *_list(devices, "none are recorded"),
    ]


def _accuracy(about: About) -> list[str]:
    row, budget = about.accuracy, about.budget
    if row is None:
        return ["Not evaluated: nothing can be said about the accuracy of this data set."]
    predicted = NOT_STATED if row.predicted_error_mm is None else f"{row.predicted_error_mm:.3f} mm (1σ, 3D)"
    found = [
        f"The poses are those of `{row.poses}`. Measured on {row.evaluated_on}, the mean radial error is "
        f"{row.mean_radial_error_mm:.3f} mm; predicted error of the registration: {predicted}."
    ]
    if budget is not None and budget.total_mm is not None:
        found += [
            "",
            "| source of error | σ (mm, 3D) | how it was found |",
            "|---|---:|---|",
            *(
                f"| {c.name}{'' if c.counted else ' (not in the sum)'} | {c.sigma_mm:.4f} | {c.how} |"
                for c in budget.contributions
            ),
            f"| sum | {budget.total_mm:.4f} | root of the sum of squares |",
        ]
    return found


def _gates(about: About) -> list[str]:
    gates = [f"{step}: {gate}" for step, of_step in about.gates for gate in of_step]
    parts: Mapping[str, tuple[Sequence[str], str]] = {
        "Deviations from the protocol": (about.deviations, "none"),
        "Accepted outside their limits": (about.accepted, "none"),
        "Results that arrived after the evaluation": (about.later, "none"),
        "Not in when this was written": (about.not_in_yet, "nothing"),
        "Gates": (gates, "none were judged"),
    }
    lines: list[str] = []
    for title, (items, none) in parts.items():
        lines += [f"{title}:", "", *_list(items, none), ""]
    return lines[:-1]


def _pairs(pairs: Iterable[tuple[str, str]], *, code: bool = False) -> list[str]:
    return [f"- {f'`{name}`' if code else f'**{name}**'}: {value}" for name, value in pairs]


def _list(items: Sequence[str], none: str) -> list[str]:
    return [f"- {item}" for item in items] or [f"- {none}"]


def _paragraphs(docstring: str) -> str:
    """Return the docstring without its section of errors."""
    return inspect.cleandoc(docstring).split("\nRaises:")[0].strip()


_TERMS = (
    "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field", "fileObject", "fileProperty",
    "fileSet", "format", "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet",
    "references", "regex", "repeated", "replace", "samplingRate", "separator", "source", "subField", "transform",
)  # fmt: skip

CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _TERMS},
}


VIEWS_NAME = "views.csv"
CAMERA = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
COVARIANCE = tuple(f"c{row}{column}" for row in range(6) for column in range(row, 6))
_UPPER = np.triu_indices(6)
Parts = Mapping[str, Mapping[str, str]]  # role → view → file


def view_columns(parts: Parts) -> dict[str, str]:
    """Return the columns in order, each with what it holds."""
    return {
        "name": "name of the view",
        **{role: f"{role} of the view, a file of this folder" for role in parts},
        "split": "train or test",
        "sparse": "whether the view is one of the sparse split",
        "simulated": "whether the view was made by a simulated rig",
        "camera": "name of the further camera that took it; empty: the first camera",
        "width": "of the picture, px",
        "height": "of the picture, px",
        "fx": "focal length along x, px",
        "fy": "focal length along y, px",
        "cx": "principal point, px; the centre of the first pixel is 0",
        "cy": "principal point, px; the centre of the first pixel is 0",
        **dict.fromkeys(CAMERA[6:], "distortion, as OpenCV defines it"),
        **dict.fromkeys(POSE[:3], "position of the camera in the world, m"),
        **dict.fromkeys(POSE[3:], "rotation from the camera (x right, y down, z forward) to the world"),
        **dict.fromkeys(COVARIANCE, "covariance of the pose: position (m), rotation (rad), axes of the world"),
    }


def views_csv(dataset: DataSet, parts: Parts) -> bytes:
    """Return the table; `parts` names the files of each view, relative to the folder."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(view_columns(parts))
    test, sparse = set(dataset.splits.test), set(dataset.splits.sparse)
    for view in dataset.views:
        files = [files.get(view.name, "") for files in parts.values()]
        split = "test" if view.name in test else "train"
        about = [split, _flag(view.name in sparse), _flag(dataset.simulated), view.device]
        writer.writerow([view.name, *files, *about, *_numbers(view)])
    return text.getvalue().encode()


def _flag(value: bool) -> str:
    return "true" if value else "false"


def _numbers(view: PosedView) -> Sequence[str]:
    camera, T = view.camera, view.T_world_camera
    lens = [getattr(camera, name) for name in CAMERA]
    pose = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    shown = [str(int(value)) for value in lens[:2]]
    return [*shown, *(repr(float(value)) for value in (*lens[2:], *pose, *view.covariance[_UPPER]))]


CROISSANT_NAME = "croissant.json"
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
    """Return the metadata as plain data.

    Args:
        dataset: the data set as it is written.
        words: the format in a few words.
        files: the files of the folder, without this one.
        parts: the files of the views: role → view → file.
        described: a description of each file, by its name.
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
    """Return the files of one role, which lie in folders of their own."""
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
    """Return one record for each view, from views.csv."""
    columns = view_columns(parts)
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
                "source": {"fileObject": {"@id": VIEWS_NAME}, "extract": {"column": name}},
            }
            for name, meaning in columns.items()
        ],
    }


def _is_pictures(role: str, files: Iterable[str]) -> bool:
    return role not in _NOT_AS_PICTURES and all(media_type(file) in _PICTURES for file in files)


def _pictures(role: str) -> dict[str, Any]:
    """Return one record for each picture of a role: its file, as views.csv names it, and its pixels."""
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
