"""`orthocapture export`: the data set of a run in a format that others read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from service.audit.exports import WantedExport
from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    RunArgument,
    console,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable_folder,
)
from service.cli.options import OperatorOption, PasswordOption, acting_person
from service.cli.scheduler import (
    PATIENCE_S,
    SchedulerCaOption,
    SchedulerCertOption,
    SchedulerKeyOption,
    SchedulerOption,
    SchedulerPatienceOption,
    reached_scheduler,
)
from service.core.errors import ConfigurationError
from service.core.records.data_set import FIRST_VERSION, DataSetStatement
from service.core.words import counted
from service.machine.executors import computing_at
from service.store.store import Store


def export_command(
    run: RunArgument,
    form: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="NAME",
            help="colmap, colmap-binary, colmap-pinhole, sugar, eth3d, nerfstudio, instant-ngp, neus2, dtu, bop, "
            "hdf5, gltf, plain, matching, mcap, or that of a plug-in.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="A new folder; it appears when it is whole.")],
    data: DataOption = DEFAULT_DATA,
    crop: Annotated[
        str, typer.Option(metavar="WIDTHxHEIGHT", help="Crops of this size without spheres, such as 1920x1080.")
    ] = "",
    crops: Annotated[
        int,
        typer.Option(
            min=1, max=16, help="At most so many crops of each image; more than 1 without --crop: of 1920x1080."
        ),
    ] = 1,
    anonymous: Annotated[
        bool,
        typer.Option(
            "--anonymous",
            help="Leave GPS, owner and serial numbers out of the pictures, people out of the metadata, and the "
            "scanner's own files out of the folder.",
        ),
    ] = False,
    title: Annotated[
        str, typer.Option(help="Title of the data set; this and what follows replace the protocol's.")
    ] = "",
    licence: Annotated[
        str, typer.Option(help="SPDX identifier, such as CC-BY-4.0, or the address of the licence's text.")
    ] = "",
    ethics: Annotated[str, typer.Option(help="Approval or waiver: its number, and the body that gave it.")] = "",
    creator: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A person, with ORCID: 'Rivera, Ana 0000-0002-1825-0097', or a body, with ROR: 'ETH Zurich "
            "ror.org/05a28rw58'. Without one, `person: NAME` or `organisation: NAME` says which. May be given again.",
        ),
    ] = None,
    cite: Annotated[str, typer.Option(help="How to cite the data set.")] = "",
    doi: Annotated[str, typer.Option(metavar="DOI", help="Of the data set, such as 10.5281/zenodo.1234567.")] = "",
    publisher: Annotated[
        str, typer.Option(metavar="NAME", help="The body that publishes it, with its ROR if it has one.")
    ] = "",
    funder: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A body that paid for it, with its ROR if it has one; may be given again."),
    ] = None,
    data_version: Annotated[str, typer.Option(help="Version of the data set.")] = FIRST_VERSION,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    scheduler: SchedulerOption = "",
    scheduler_ca: SchedulerCaOption = None,
    scheduler_cert: SchedulerCertOption = None,
    scheduler_key: SchedulerKeyOption = None,
    scheduler_patience: SchedulerPatienceOption = PATIENCE_S,
    json: JsonOption = False,
) -> None:
    """Write the data set of a completed run in a format that others read: images, poses, depth, masks, mesh.

    It is refused if the evidence does not verify, if the run is not complete, or if a release that the protocol
    requires is missing. An interrupted export goes on where it was when the same command is given again. The export
    is recorded in the run with the hash of its list of checksums, SHA256SUMS. Beside the format's files, the folder
    has a data card, Croissant and RO-Crate metadata, and an index of the views.
    """
    with reporting_errors(json), Store.open(data, create=False) as store:
        from service.audit.data_set_export import export_data_set  # noqa: PLC0415 - loads the numerics

        target = out.resolve()
        require_writable_folder(target)
        run_id = store.find_run(run)
        stated = _stated(
            title=title,
            licence=licence,
            ethics=ethics,
            creators=tuple(creator or ()),
            cite=cite,
            doi=doi,
            publisher=publisher,
            funders=tuple(funder or ()),
        )
        wanted = WantedExport(form, crop, crops, anonymous, stated, data_version)
        who = acting_person(store, operator, "export", password_stdin=password_stdin)
        cluster = reached_scheduler(
            scheduler, ca=scheduler_ca, cert=scheduler_cert, key=scheduler_key, patience_s=scheduler_patience
        )
        with progress_bar(quiet=json) as progress, computing_at(cluster):
            dataset = export_data_set(store, run_id, wanted, target, who.name, progress)
    if json:
        print_json(
            {
                "run": run_id,
                "format": form,
                "folder": str(target),
                "images": len(dataset.views),
                "simulated": dataset.simulated,
            }
        )
    else:
        console.print(f"{counted(len(dataset.views), 'image')} of run {run_id} as {form}: {target!s}")
        if dataset.simulated:
            console.print("  The run is simulated, and its files say so.")


def _stated(**fields: Any) -> DataSetStatement:
    """Return the statement of the options.

    Raises ConfigurationError if one is too long, empty or a wrong identifier.
    """
    try:
        stated = DataSetStatement(**fields)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigurationError(
            f"{first['loc'][0]}: {first['msg']}", where="the options of the export", remedy="Correct it"
        ) from error
    for (name, *_), error in stated.problems().items():
        option = f"--{str(name).removesuffix('s')}"
        raise ConfigurationError(error.what, where=f"{option} {error.where}", remedy=error.remedy) from error
    return stated
