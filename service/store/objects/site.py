"""The file `site.yaml` of a data folder: the object store, where its keys come from, and the limits of the spool."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from service.core.errors import ConfigurationError
from service.store.data_folder import SITE_FILE
from service.store.durable_effects import Clock, SystemClock
from service.store.objects.s3 import S3Objects
from service.store.objects.signed_requests import Keys

_URL = re.compile(r"s3://(?P<bucket>[a-z0-9][a-z0-9.-]{1,61}[a-z0-9])(?:/(?P<prefix>[A-Za-z0-9._/-]*))?")
_REMEDY = "Correct it as docs/howto/site.md shows"
_VARIABLES = ("ORTHOCAPTURE_S3_ACCESS_KEY_ID", "ORTHOCAPTURE_S3_SECRET_ACCESS_KEY")
_MOST_BYTES = 10_000
Days = Annotated[float, Field(ge=0, le=36_500, allow_inf_nan=False)]
Gigabytes = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ObjectStoreSection(_Strict):
    """The object store that gets the second copy of every artefact."""

    url: str  # s3://BUCKET/PREFIX
    endpoint: str  # https://HOST[:PORT]
    region: str = Field(default="us-east-1", pattern=r"[a-z0-9-]{1,40}")
    keys: Literal["environment"] | Path = "environment"  # or a file of the owner's alone, relative to the data folder
    lock_days: int | None = Field(default=None, ge=1, le=36_500)

    @field_validator("url")
    @classmethod
    def _of_a_bucket(cls, url: str) -> str:
        if _URL.fullmatch(url) is None:
            raise ValueError("this is not s3://BUCKET or s3://BUCKET/PREFIX")
        return url

    @field_validator("endpoint")
    @classmethod
    def _of_a_server(cls, endpoint: str) -> str:
        if re.fullmatch(r"https?://[A-Za-z0-9.\-\[\]:]+/?", endpoint) is None:
            raise ValueError("this is not http://HOST:PORT or https://HOST; keys do not belong in it")
        return endpoint.rstrip("/")

    @property
    def bucket(self) -> str:
        """The name of the bucket."""
        return self._part("bucket")

    @property
    def prefix(self) -> str:
        """The prefix of all keys; "" for none."""
        return self._part("prefix").strip("/")

    @property
    def place(self) -> str:
        """The name of the place in records and messages, without keys."""
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/") + f" at {self.endpoint}"

    def _part(self, name: str) -> str:
        found = _URL.fullmatch(self.url)
        return "" if found is None else str(found.group(name) or "")


class SpoolSection(_Strict):
    """The time after which a file may leave the artefact folder, and the size of the cache of fetched files."""

    free_after_days: Days = 7.0  # since it was last written or stored again
    cache_gb: Gigabytes = 20.0


class Site(_Strict):
    """The content of a `site.yaml`."""

    object_store: ObjectStoreSection | None = None
    spool: SpoolSection = SpoolSection()

    @model_validator(mode="before")
    @classmethod
    def _a_mapping(cls, value: Any) -> Any:
        return {} if value is None else value


def load_site(data_dir: Path) -> Site | None:
    """Return the site's file of a data folder; None if it has none. Raises ConfigurationError."""
    path = data_dir / SITE_FILE
    try:
        text = path.read_bytes()[: _MOST_BYTES + 1].decode("utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"this cannot be read: {error}", where=str(path), remedy=_REMEDY) from error
    if len(text) > _MOST_BYTES:
        raise ConfigurationError("this is too long for a site's file", where=str(path), remedy=_REMEDY)
    try:
        return Site.model_validate(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise ConfigurationError(f"this is not YAML: {error}", where=str(path), remedy=_REMEDY) from error
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise ConfigurationError(
            first["msg"].removeprefix("Value error, "), where=f"{path}: {field}", remedy=_REMEDY
        ) from error


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


def _keys(data_dir: Path, section: ObjectStoreSection) -> Keys:
    if section.keys == "environment":
        values = [os.environ.get(name, "") for name in _VARIABLES]
        missing = [name for name, value in zip(_VARIABLES, values, strict=True) if not value]
        if missing:
            raise ConfigurationError(
                f"the keys of the object store are not in the environment: {', '.join(missing)}",
                where=str(data_dir / SITE_FILE),
                remedy="Set them, or name a file with `keys:`",
            )
        return Keys(*values)
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
    return Keys(*map(str, values))
