"""The file `site.yaml` of a data folder: a site keeps its record in the PostgreSQL database that it names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator, model_validator

from service.core.errors import ConfigurationError

SITE_FILE = "site.yaml"
_REMEDY = "Correct it as docs/howto/site.md shows"
_MOST_BYTES = 10_000


class Site(BaseModel):
    """The content of a `site.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    database: str | None = None  # postgresql://ROLE@HOST/DATABASE; None: SQLite in the data folder

    @model_validator(mode="before")
    @classmethod
    def _a_mapping(cls, value: Any) -> Any:
        return {} if value is None else value

    @field_validator("database")
    @classmethod
    def _of_a_server(cls, database: str | None) -> str | None:
        if database is not None and not database.startswith("postgresql://"):
            raise ValueError("this is not postgresql://ROLE@HOST/DATABASE")
        return database


def load_site(data_dir: Path) -> Site:
    """Return the site's file of a data folder, or the defaults if it has none. Raises ConfigurationError."""
    path = data_dir / SITE_FILE
    try:
        text = path.read_bytes()[: _MOST_BYTES + 1].decode("utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return Site()
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
