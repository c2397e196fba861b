"""The file `site.yaml` of a data folder: the database and the object store of a site, and the limits of the spool."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from service.core.errors import ConfigurationError
from service.store.data_folder import SITE_FILE

_URL = re.compile(r"s3://(?P<bucket>[a-z0-9][a-z0-9.-]{1,61}[a-z0-9])(?:/(?P<prefix>[A-Za-z0-9._/-]*))?")
_REMEDY = "Correct it as docs/howto/site.md shows"
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
    lock_days: int | None = Field(default=None, ge=1, le=36_500)  # with it, anchors of the evidence are locked there
    anchor_within_hours: float = Field(default=24.0, ge=0, le=8_760, allow_inf_nan=False)  # then a verification asks

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


class SiteFile(_Strict):
    """The content of a `site.yaml`."""

    database: str | None = None  # postgresql://ROLE@HOST/DATABASE; None: SQLite in the data folder
    object_store: ObjectStoreSection | None = None
    spool: SpoolSection = SpoolSection()

    @field_validator("database")
    @classmethod
    def _of_a_database(cls, database: str | None) -> str | None:
        if database is not None and not database.startswith("postgresql://"):
            raise ValueError("this is not postgresql://ROLE@HOST/DATABASE")
        return database

    @model_validator(mode="before")
    @classmethod
    def _a_mapping(cls, value: Any) -> Any:
        return {} if value is None else value


def load_site(data_dir: Path) -> SiteFile | None:
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
        return SiteFile.model_validate(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise ConfigurationError(f"this is not YAML: {error}", where=str(path), remedy=_REMEDY) from error
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise ConfigurationError(
            first["msg"].removeprefix("Value error, "), where=f"{path}: {field}", remedy=_REMEDY
        ) from error
