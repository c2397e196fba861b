"""The files of the registered scan as its scanner exported them: mesh, materials, textures."""

from __future__ import annotations

from pathlib import PurePosixPath

from drivers.meshes.companions import companion_names
from service.dataset.posed.records import ScanFile
from service.dataset.registered_scan import registered_scan
from service.dataset.summary import RunSummary

_REFERRING = (".obj", ".mtl")


def scan_files(summary: RunSummary) -> tuple[ScanFile, ...]:
    """The original files of the registered scan, under the names by which they refer to each other.

    Recorded files have lost their folders and may differ in case; a mesh finds its materials, and these find their
    textures, only under the names that are written in them.
    """
    step = registered_scan(summary.protocol, summary.state)
    kept = summary.state.steps[step].artefacts if step else ()
    refs = [ref for ref in kept if ref.kind == "scan_mesh_original"]
    named: dict[str, str] = {}  # by the last part of the name, in lower case
    for ref in refs:
        if ref.original_name.lower().endswith(_REFERRING):
            for name in companion_names(summary.store.artefact_path(ref.sha256).read_bytes()):
                named.setdefault(PurePosixPath(name).name.casefold(), name)
    return tuple(
        ScanFile(named.get(ref.original_name.casefold(), ref.original_name), summary.store.artefact_path(ref.sha256))
        for ref in refs
    )
