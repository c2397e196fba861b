"""Opens the object store that a site's file names, with its keys."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

import yaml

from service.core.errors import ConfigurationError
from service.store.data_folder import SITE_FILE
from service.store.durable_effects import Clock, SystemClock
from service.store.objects.s3 import S3Objects
from service.store.objects.signed_requests import StoreKeys
from service.store.site import ObjectStoreSection

_VARIABLES = ("ORTHOCAPTURE_S3_ACCESS_KEY_ID", "ORTHOCAPTURE_S3_SECRET_ACCESS_KEY")


def open_objects(data_dir: Path, section: ObjectStoreSection, clock: Clock | None = None) -> S3Objects:
    """Return the object store that a site's file names. Nothing is sent. Raises ConfigurationError."""
    return S3Objects(
        endpoint=section.endpoint,
        bucket=section.bucket,
        prefix=section.prefix,
        region=section.region,
        keys=_keys(data_dir, section),
        clock=clock or SystemClock(),
    )


def _keys(data_dir: Path, section: ObjectStoreSection) -> StoreKeys:
    if section.keys == "environment":
        values = [os.environ.get(name, "") for name in _VARIABLES]
        missing = [name for name, value in zip(_VARIABLES, values, strict=True) if not value]
        if missing:
            raise ConfigurationError(
                f"the keys of the object store are not in the environment: {', '.join(missing)}",
                where=str(data_dir / SITE_FILE),
                remedy="Set them, or name a file with `keys:`",
            )
        return StoreKeys(*values)
    path = data_dir / section.keys
    remedy = "Write access_key_id and secret_access_key into it as YAML, and `chmod 600` it"
    try:
        mode = path.stat().st_mode
        if stat.S_IMODE(mode) & 0o077:
            raise ConfigurationError(
                "others than its owner may read the keys of the object store", where=str(path), remedy=remedy
            )
        found: Any = yaml.safe_load(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:  # a parser's message could quote a key
        said = error.strerror if isinstance(error, OSError) else "it is not YAML"
        raise ConfigurationError(
            f"the keys of the object store cannot be read: {said}", where=str(path), remedy=remedy
        ) from None
    names = ("access_key_id", "secret_access_key")
    values = [found.get(name) for name in names] if isinstance(found, dict) else []
    if len(values) != 2 or not all(isinstance(value, str) and value for value in values):
        raise ConfigurationError("the keys of the object store are incomplete", where=str(path), remedy=remedy)
    return StoreKeys(*map(str, values))
