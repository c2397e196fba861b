"""`orthocapture export`: the data set of a run in a format that others read."""

from __future__ import annotations

import getpass
import re
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
)
from service.core.errors import ConfigurationError, IllegalTransitionError
from service.store.files.space_used import require_export_space
from service.store.store import Store

_SIZE = re.compile(r"([1-9]\d{0,5})x([1-9]\d{0,5})")


def export_command(
    run: Annotated[str, typer.Argument(help="Name of the run, its first characters, or `latest`.")],
    form: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="NAME",
            help="colmap, colmap-binary, colmap-pinhole, sugar, eth3d, nerfstudio, instant-ngp, neus2, dtu, bop, "
            "hdf5, gltf, or that of a plug-in.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="A new folder; it appears when it is whole.")],
    data: DataOption = DEFAULT_DATA,
    crop: Annotated[
        str, typer.Option(metavar="WIDTHxHEIGHT", help="Crops of this size without spheres, such as 1920x1080.")
    ] = "",
    crops: Annotated[int, typer.Option(min=1, max=16, help="At most so many crops of each image.")] = 1,
    anonymous: Annotated[
        bool, typer.Option("--anonymous", help="Leave GPS, owner and serial numbers out of the pictures.")
    ] = False,
    operator: Annotated[str, typer.Option(help="Your name, as it goes into the record.")] = "",
    json: JsonOption = False,
) -> None:
    """Write the data set of a completed run in a format that others read: images, poses, depth, masks, mesh.

    It is refused if the evidence does not verify, if the run is not complete, or if a release that the protocol
    requires is missing. An interrupted export goes on where it was when the same command is given again. The export
    is recorded in the run with the hash of its list of checksums, SHA256SUMS.
    """
    with (
        reporting_errors(json),
        Store.open(data, create=False) as store,
        progress_bar(quiet=json) as progress,
    ):
        # These load the numerics, which take seconds.
        from service.audit.bundle.export import record_export, require_exportable  # noqa: PLC0415
        from service.audit.record.missing_results import not_in_yet  # noqa: PLC0415
        from service.audit.record.run import read_run  # noqa: PLC0415
        from service.dataset.posed.exporter import exporter, write_data_set  # noqa: PLC0415
        from service.dataset.posed.of_run import data_set_of, specimen_pixels  # noqa: PLC0415
        from service.dataset.posed.pixels import cropped_data_set, undistorted_data_set  # noqa: PLC0415

        how, size = exporter(form), _size(crop)
        target = out.resolve()
        run_id = store.find_run(run)
        require_export_space(store, run_id, target)
        require_exportable(store, run_id, progress)
        recorded = read_run(data, run_id)
        if recorded.state.status != "completed":
            raise IllegalTransitionError(
                f"the run is {recorded.state.status}", where=run_id, remedy="Only a completed run is exported"
            )
        summary = recorded.summary()
        progress("writing", 0, 0)
        missing = not_in_yet(recorded.protocol, recorded.state, recorded.events)
        dataset = data_set_of(summary, missing, personal=not anonymous)
        if size is not None:
            whole = undistorted_data_set(dataset, personal=not anonymous) if how.pinhole else dataset
            dataset = cropped_data_set(
                whole, partial(specimen_pixels, summary), size, most=crops, personal=not anonymous
            )

        def leaving(sums: Path) -> None:
            head_sha256, actor = recorded.events[-1].sha256, operator or getpass.getuser()
            record_export(
                store, run_id, sums, file_name=target.name, what="dataset", head_sha256=head_sha256, actor=actor
            )

        write_data_set(dataset, how, target, personal=not anonymous, leaving=leaving)
    if json:
        print_json(
            {
                "run": run_id,
                "format": how.name,
                "folder": str(target),
                "images": len(dataset.views),
                "simulated": dataset.simulated,
            }
        )
    else:
        console.print(f"{len(dataset.views)} images of run {run_id} as {how.name}: {escape(str(target))}")
        if dataset.simulated:
            console.print("  The run is simulated, and its files say so.")


def _size(crop: str) -> tuple[int, int] | None:
    """Width and height; None for whole images."""
    if not crop:
        return None
    found = _SIZE.fullmatch(crop)
    if found is None:
        raise ConfigurationError(
            f"{crop!r} is not a size", where="--crop", remedy="Give width and height, such as 1920x1080"
        )
    return int(found[1]), int(found[2])
