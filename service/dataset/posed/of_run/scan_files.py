"""The files of the registered scan as its scanner exported them: mesh, materials, textures."""

from __future__ import annotations

from pathlib import PurePosixPath

from drivers.meshes.companions import companion_names
from drivers.meshes.foreign_text import alike
from service.dataset.posed.records import ScanFile
from service.dataset.registered_scan import registered_scan
from service.dataset.summary import RunSummary

_MOST_BYTES = 1 << 20  # of a mesh, which names its companions in its first lines, and of a material
_REFERRING = (".obj", ".mtl", ".ply")


def scan_files(summary: RunSummary) -> tuple[ScanFile, ...]:
    """The original files of the registered scan, under the names by which they refer to each other.

    Recorded files have lost their folders and may differ in case; a mesh finds its materials, and these find their
    textures, only under the names that are written in them.
    """
    step = registered_scan(summary.protocol, summary.state)
    kept = summary.state.steps[step].artefacts if step else ()
    refs = [ref for ref in kept if ref.kind == "scan_mesh_original"]
    named: dict[str, str] = {}  # by the last part of the name, in lower case and with accents composed
    for ref in refs:
        if ref.original_name.lower().endswith(_REFERRING):
            with summary.store.artefact_path(ref.sha256).open("rb") as file:
                content = file.read(_MOST_BYTES)
            for name in companion_names(content):
                named.setdefault(alike(PurePosixPath(name).name), name)
    return tuple(
        ScanFile(named.get(alike(ref.original_name), ref.original_name), summary.store.artefact_path(ref.sha256))
        for ref in refs
    )
