"""DATACARD.md: what a data set is, how it was made, how good it is, and what may be done with it."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence

from service.dataset.records import NOT_STATED, About, DataSet

NAME = "DATACARD.md"
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
