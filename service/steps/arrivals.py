"""Files from other devices (scanner, CT): waits for them, stores the originals, and decodes them for the worker."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from drivers.errors import DeviceTimeoutError
from drivers.interfaces import CtSource, DeviceReport, ScannedMesh
from drivers.meshes.foreign_text import name_of
from drivers.meshes.polygons import in_doubt
from service.computations.records import JudgedLayout
from service.core.records.base import ArtefactRef
from service.core.records.run_events import FilesKept, Uncertainty
from service.steps.context import StepContext
from service.steps.notes import DEIDENTIFIED
from service.store.records import NewArtefact

T = TypeVar("T")
_LASTING_S = 3.0  # how long the text must have stayed the same before it is shown


def wait_for(
    context: StepContext,
    find: Callable[[], Sequence[T]],
    wait_s: float,
    what: str,
    report: Callable[[], DeviceReport],
) -> T:
    """Wait until `find` returns something, and return the newest.

    Meanwhile people see what is wrong with the files that are there, once it has lasted for some seconds: a file that
    is being written is no fault.

    Args:
        context: the step's surroundings: devices, evidence, clock.
        find: returns what is wanted, oldest first.
        wait_s: the longest wait.
        what: the name of what is awaited, for people.
        report: returns the device's report, with its problems.

    Raises:
        DeviceTimeoutError: nothing was found in `wait_s`.
    """
    look_s = context.monotonic_s()
    deadline_s = look_s + wait_s
    before: tuple[str, ...] = ()
    wrong = ""
    while not (found := find()):
        context.checkpoint()
        now_s = context.monotonic_s()
        if now_s >= look_s:
            problems = report().problems
            lasting = [text for text in problems if text in before]
            wrong = "".join(f"; {text}" for text in lasting[:1])
            wrong += f" (and {len(lasting) - 1} more)" if len(lasting) > 1 else ""
            before, look_s = problems, now_s + _LASTING_S
        context.progress(f"waiting for {what}{wrong}", 0, 1)
        if now_s > deadline_s:
            raise DeviceTimeoutError(
                f"{what} did not arrive within {wait_s:.0f} s{wrong}",
                where=f"step {context.step.id}",
                remedy="Check the export folder with `orthocapture doctor`, then confirm to wait again",
            )
        context.wait(0.5)
    return found[-1]


def keep(context: StepContext, path: Path, *, device: str, kind: str, media_type: str) -> ArtefactRef:
    """Copy one original file into the evidence, unchanged; the source is not touched.

    Raises DataError in a run that imports, if the file has changed since it was listed.
    """
    name = name_of(path)
    ref = context.evidence.put_file(path, kind=kind, media_type=media_type, original_name=name)
    note = f"kept {name}"
    listing = context.devices.imported()
    if listing is not None:
        note = f"imported {name}, written {listing.check(str(path), ref.sha256).modified_utc}"
    _record(context, ref, device, note)
    return ref


def keep_clean(
    context: StepContext, ct: CtSource, paths: Sequence[Path], *, device: str, kind: str
) -> tuple[ArtefactRef, ...]:
    """Copy files of a CT suite into the evidence, without what may name people, and note what was removed.

    The copies have new names, since the old ones may name people too. The note on each copy has the SHA-256 of its
    original. If the rig says that files stay as they are, they are copied unchanged.

    Raises DataError as `keep` does, and UnreadableFileError if a file cannot be copied so.
    """
    kept: list[ArtefactRef] = []
    removed: set[str] = set()
    copies = 0
    for number, path in enumerate(paths, start=1):
        context.checkpoint()
        with tempfile.TemporaryDirectory(prefix="orthocapture-") as folder:
            target = Path(folder) / f"{kind}_{number:05d}{_suffix(path)}"
            clean = ct.without_personal_data(path, target)
            if clean is None:
                kept.append(keep(context, path, device=device, kind=kind, media_type=_media_type(path)))
                continue
            listing = context.devices.imported()
            if listing is not None:
                listing.check(str(path), clean.original_sha256)
            ref = context.evidence.put_file(
                target, kind=kind, media_type=_media_type(path), original_name=target.name
            )
        removed.update(clean.removed)
        copies += 1
        note = f"kept {target.name} without personal data; the original file has the SHA-256 {clean.original_sha256}"
        _record(context, ref, device, note)
        kept.append(ref)
    if copies:
        context.note(DEIDENTIFIED, device=device, files=copies, removed=sorted(removed))
    return tuple(kept)


def _suffix(path: Path) -> str:
    return next((end for end in (".nii.gz", ".nii") if path.name.lower().endswith(end)), ".dcm")


def _media_type(path: Path) -> str:
    return "application/dicom" if _suffix(path) == ".dcm" else "application/octet-stream"


def keep_array(context: StepContext, array: Any, *, device: str, kind: str, name: str) -> ArtefactRef:
    """Store a decoded array (.npy) for the worker, in addition to the originals."""
    with tempfile.TemporaryDirectory(prefix="orthocapture-") as folder:
        path = Path(folder) / name  # written to disk first: a CT volume of 0.4 mm voxels has a gigabyte
        np.save(path, array, allow_pickle=False)
        ref = context.evidence.put_file(path, kind=kind, media_type="application/x-npy", original_name=name)
    _record(context, ref, device, f"decoded {name}")
    return ref


def keep_mesh(
    context: StepContext, scan: ScannedMesh, *, device: str, kind: str
) -> tuple[ArtefactRef, tuple[ArtefactRef, ...]]:
    """Store a scan's original files and its decoded mesh (.npz: vertices_m, faces).

    Returns:
        the mesh, and all files with the mesh last.
    """
    originals = tuple(
        keep(context, path, device=device, kind=f"{kind}_original", media_type="application/octet-stream")
        for path in scan.source.files
    )
    buffer = io.BytesIO()
    np.savez(buffer, vertices_m=scan.mesh.vertices_m, faces=scan.mesh.faces)
    name = name_of(scan.source.files[0])
    mesh = context.evidence.put_bytes(
        buffer.getvalue(), kind=kind, media_type="application/x-npz", original_name=f"{name}.npz"
    )
    doubt = in_doubt(int(scan.findings.get("polygons_in_doubt", 0)))
    if doubt:
        context.tell(f"{name}: {doubt}")
    said = f"; {doubt}" if doubt else ""
    _record(context, mesh, device, f"read {name}: unit {scan.unit} ({scan.unit_evidence}){said}")
    return mesh, (*originals, mesh)


def _record(context: StepContext, ref: ArtefactRef, device: str, note: str) -> None:
    row = NewArtefact(
        ref=ref,
        device=device,
        step=context.step.id,
        attempt=context.attempt,
        viewpoint=None,
        who=context.operator,
        monotonic_s=context.monotonic_s(),
    )
    payload = FilesKept(step=context.step.id, attempt=context.attempt, device=device, note=note, artefacts=(ref,))
    context.evidence.record(payload, artefacts=(row,))


def layout_uncertainties(layout: JudgedLayout | None) -> dict[str, Uncertainty]:
    """Return the uncertainty of each measure of a layout; empty where it was not judged (None)."""
    return {} if layout is None else dict(layout.bounds)
