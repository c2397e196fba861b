"""Pictures: thumbnails, images with detected spheres, live view frames, recorded files; and plotly's own script."""

from __future__ import annotations

import base64
import gzip
import re
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi import Path as UrlPath
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field
from sqlalchemy import select

from service.core.errors import OrthocaptureError
from service.core.records.base import ArtefactRef, age_s
from service.followed_run import RunRecord
from service.monitor.snapshot import ask_for_frames, frame_path
from service.run_acts import NOTE_PHOTOGRAPH
from service.store.artefacts import to_artefact
from service.store.database.tables import artefacts
from service.web.images import (
    IMAGE_WIDTHS,
    PICTURES,
    Capture,
    cached,
    find_capture,
    further_of,
    nearest_width,
    reduced_jpeg,
    rig_cameras,
    safe_name,
)
from service.web.security import requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["media"])

RunId = Annotated[str, UrlPath(pattern=r"^[0-9A-Za-z_-]{1,64}$")]
Sha256 = Annotated[str, UrlPath(pattern=r"^[0-9a-f]{64}$")]
Viewpoint = Annotated[str, UrlPath(pattern=r"^[0-9A-Za-z_.+-]{1,64}$")]

_FOR_EVER = "private, max-age=31536000, immutable"  # its address holds the hash of its content
_ASK_AGAIN = "private, no-cache"
_STALE_FRAME_S = 5.0
_MEDIA_TYPE = re.compile(r"[a-z]+/[a-z0-9.+-]+")


@router.get("/vendor/plotly.js", name="plotly_script", response_class=FileResponse)
def plotly_script(request: Request, site: CurrentSite) -> Response:
    """Serve plotly's script from the installed package; the 3D view loads it in its sandboxed frame."""
    path = _plotly()
    stat = path.stat()
    tag = f'"{stat.st_size:x}-{stat.st_mtime_ns:x}"'
    headers = {"ETag": tag, "Cache-Control": "public, max-age=604800", "Vary": "Accept-Encoding"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):
        path = cached(site.data, f"plotly {tag}", ".js.gz", lambda: gzip.compress(path.read_bytes(), 6))
        headers["Content-Encoding"] = "gzip"
    return FileResponse(path, media_type="text/javascript", headers=headers)


@cache
def _plotly() -> Path:
    spec = find_spec("plotly")  # found, not imported: the package itself takes a while
    for folder in () if spec is None else spec.submodule_search_locations or ():
        path = Path(folder, "package_data", "plotly.min.js")
        if path.is_file():
            return path
    raise HTTPException(404, "plotly's script is not installed; install orthocapture again with its dependencies")


@router.get(
    "/runs/{run_id}/files/{sha256}",
    name="run_file",
    dependencies=[Depends(requires("read"))],
    response_class=FileResponse,
)
def run_file(
    request: Request,
    site: CurrentSite,
    run_id: RunId,
    sha256: Sha256,
    thumbnail: Annotated[int | None, Query(ge=64, le=640)] = None,
) -> Response:
    """Show a file of this run's evidence, hashed again before it is sent; or a small copy of a picture."""
    ref = recorded_file(site, run_id, sha256)
    tag = f'"{sha256}{"" if thumbnail is None else f"-{nearest_width(thumbnail)}"}"'
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers={"ETag": tag, "Cache-Control": _FOR_EVER})
    if thumbnail is not None:
        path = _reduced(site, ref, nearest_width(thumbnail))
        return _picture(path, tag, _FOR_EVER)
    path = site.store.artefact_path(sha256, verify=True)
    digest = base64.b64encode(bytes.fromhex(sha256)).decode()
    headers = {
        "ETag": tag,
        "Cache-Control": _FOR_EVER,
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": "sandbox; default-src 'none'",
        "Repr-Digest": f"sha-256=:{digest}:",  # RFC 9530
    }
    media_type = ref.media_type if _MEDIA_TYPE.fullmatch(ref.media_type) else "application/octet-stream"
    return FileResponse(path, media_type=media_type, headers=headers, filename=safe_name(ref.original_name, sha256))


class ImageQuery(BaseModel):
    """The query for an image of a viewpoint, and for how to show it.

    Attributes:
        step: the step that took it; "" for the last step that has it.
        attempt: attempt of the step; None for the valid image.
        seq: event of the image; None for the valid image.
        width: wanted width in pixels; the copy has the nearest width on offer.
        marked: true if outlines of the spheres are drawn over it.
        device: a further camera, whose image is shown; "" for the first one.
    """

    step: str = Field("", pattern=r"^[0-9A-Za-z_-]{0,64}$")
    attempt: int | None = Field(None, ge=1, le=10_000)
    seq: int | None = Field(None, ge=1, le=2**53)
    width: int = Field(1280, ge=64, le=4096)
    marked: bool = False
    device: str = Field("", max_length=64)


@router.get(
    "/runs/{run_id}/images/{viewpoint}",
    name="viewpoint_image",
    dependencies=[Depends(requires("read"))],
    response_class=FileResponse,
)
def viewpoint_image(
    request: Request,
    site: CurrentSite,
    run_id: RunId,
    viewpoint: Viewpoint,
    wanted: Annotated[ImageQuery, Query()],
) -> Response:
    """Show a copy of a viewpoint's image for the screen."""
    log = site.run(run_id)
    capture = find_capture(log, viewpoint, step=wanted.step, attempt=wanted.attempt, seq=wanted.seq)
    if capture is None:
        raise HTTPException(404, f"there is no image of viewpoint {viewpoint} in this run")
    size = nearest_width(wanted.width, IMAGE_WIDTHS)
    ref = _photograph(log, capture, wanted.device)
    source = mark_source(log, capture, wanted.device) if wanted.marked else ""
    tag = f'"{ref.sha256}-{size}{f"-{source}" if source else ""}"'
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers={"ETag": tag, "Cache-Control": _ASK_AGAIN})
    marks = _Marks(log, capture, wanted.device, source)
    return _picture(_reduced(site, ref, size, marks), tag, _ASK_AGAIN)


def _photograph(log: RunRecord, capture: Capture, device: str) -> ArtefactRef:
    """Return the photograph of a camera at a viewpoint. HTTP 404 if it did not expose there."""
    if not device:
        return capture.payload.artefacts[0]
    for one in further_of(log, capture):
        if one.exposure.device == device:
            return one.exposure.artefacts[0]
    raise HTTPException(404, f"{device} took no image at viewpoint {capture.payload.viewpoint}")


@router.get(
    "/runs/{run_id}/live-view",
    name="live_view",
    dependencies=[Depends(requires("read"))],
    responses={204: {"description": "no frame yet"}},
    response_class=FileResponse,
)
def live_view(site: CurrentSite, run_id: RunId, camera: Annotated[str, Query(max_length=64)] = "") -> Response:
    """Show a camera's newest frame. Each request keeps the frames coming; an old frame is not shown as live."""
    if camera and camera not in rig_cameras(site.run(run_id)):
        raise HTTPException(404, "the rig of this run has no further camera of this name")
    site.run(run_id)
    ask_for_frames(site.data, run_id, camera)
    path = frame_path(site.data, run_id, camera)
    headers = {"Cache-Control": "no-store"}
    try:
        frame_s = age_s(path.stat().st_mtime, site.store.clock.utc_s(), if_set_back_s=inf)
        content = path.read_bytes()  # now: it may be replaced while a response is sent piece by piece
    except OSError:
        return Response(status_code=204, headers=headers)
    if frame_s > _STALE_FRAME_S:
        return Response(status_code=204, headers=headers)
    return Response(content, media_type="image/jpeg", headers=headers | {"X-Frame-Age-S": f"{frame_s:.1f}"})


def recorded_file(site: Site, run_id: str, sha256: str) -> ArtefactRef:
    """Return this run's record of a file, or raise HTTP 404 if it has none, even if another run has one."""
    with site.store.database.reading() as connection:
        row = connection.execute(
            select(artefacts)
            .where(artefacts.c.sha256 == sha256, artefacts.c.run_id == run_id)
            .order_by(artefacts.c.seq, artefacts.c.position)
            .limit(1)
        ).first()
    if row is None:
        raise HTTPException(404, "this run has recorded no such file")
    return to_artefact(row).ref


def mark_source(log: RunRecord, capture: Capture, device: str = "") -> str:
    """Return a key of what would be drawn over an image; it changes with better outlines and is "" for nothing."""
    from service.web.outlines import outlines_of  # noqa: PLC0415 - the matching of spheres, not needed to start

    found = outlines_of(log, capture, device)
    return "" if found is None else found.source


@dataclass(frozen=True, slots=True)
class _Marks:
    """The marks that are drawn over an image; `source` changes with them, and is "" for none."""

    log: RunRecord
    capture: Capture
    device: str
    source: str


def _reduced(site: Site, ref: ArtefactRef, width: int, drawn: _Marks | None = None) -> Path:
    """Return the cached copy.

    HTTP 415 if the file is not a picture; the original is hashed again when a copy is made.
    """
    if ref.media_type not in PICTURES:
        raise HTTPException(415, f"{safe_name(ref.original_name, ref.sha256)} is not a picture")

    def make() -> bytes:
        from service.web.outlines import marks_of  # noqa: PLC0415 - as above

        marks = marks_of(drawn.log, drawn.capture, drawn.device) if drawn is not None and drawn.source else ()
        path = site.store.artefact_path(ref.sha256, verify=True)
        return reduced_jpeg(path, width, marks, upright=ref.kind == NOTE_PHOTOGRAPH)

    source = "" if drawn is None else drawn.source
    try:
        return cached(site.data, f"{ref.sha256} {width} {source}", ".jpg", make)
    except OSError as error:
        raise OrthocaptureError(
            f"a small copy of a picture cannot be kept: {error.strerror}",
            where=str(site.data / "cache"),
            remedy="Free some space on the disk; the recorded pictures are untouched",
        ) from error


def _picture(path: Path, tag: str, caching: str) -> Response:
    headers = {"ETag": tag, "Cache-Control": caching, "X-Content-Type-Options": "nosniff"}
    return FileResponse(path, media_type="image/jpeg", headers=headers)
