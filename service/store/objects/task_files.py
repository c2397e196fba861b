"""Lets a worker of a Dask cluster fetch the artefacts that tasks name from the site's object store.

`dask worker --preload service.store.objects.task_files`, with ORTHOCAPTURE_SITE in the environment: a folder of this
machine with the site's site.yaml and the keys that it names. What is fetched lies there, up to the site's `cache_gb`.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

from service.core.errors import ConfigurationError
from service.machine.remote_task import fetch_artefacts_with
from service.store.artefacts import ArtefactFiles
from service.store.data_folder import object_store_of
from service.store.durable_effects import DurableFiles, RandomIds
from service.store.objects.reading import SpoolReader

VARIABLE = "ORTHOCAPTURE_SITE"


def dask_setup(_worker: object) -> None:
    """Prepare a worker process; Dask calls this when one starts.

    Raises ConfigurationError if the environment names no folder with a site.yaml that has an object store.
    """
    named = os.environ.get(VARIABLE, "")
    folder = Path(named).absolute()
    if not named or object_store_of(folder) is None:
        raise ConfigurationError(
            f"{VARIABLE} names no folder whose site.yaml has an object store",
            where=named or VARIABLE,
            remedy="Copy the site's site.yaml and its keys into a folder of this machine, and name that",
        )
    reader = SpoolReader(folder, ArtefactFiles(folder / "artefacts", DurableFiles(), RandomIds()))
    fetch_artefacts_with(partial(reader.path, verify=True))
