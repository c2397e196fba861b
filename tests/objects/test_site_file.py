"""The file site.yaml: what it may say, what is refused and how, and that it stands for its folder."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import ConfigurationError
from service.store.objects.opening import open_objects
from service.store.site import load_site
from tests.support.record.outsider import write_site_file
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store

STORE = "object_store: {url: 's3://bucket/site', endpoint: 'https://store.example'%s}\n"


def refused(folder: Path, text: str) -> str:
    (folder / "site.yaml").write_text(text)
    with pytest.raises(ConfigurationError) as error:
        load_site(folder)
    return str(error.value)


def test_without_a_file_there_is_no_site(tmp_path: Path) -> None:
    assert load_site(tmp_path) is None


def test_a_short_file_has_usual_values(tmp_path: Path) -> None:
    (tmp_path / "site.yaml").write_text(STORE % "")
    site = load_site(tmp_path)
    assert site is not None
    assert site.object_store is not None
    assert (site.object_store.bucket, site.object_store.prefix) == ("bucket", "site")
    assert site.spool.free_after_days > 0


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("object_store: [", "not YAML"),
        ("objects: {}", "objects"),
        (STORE % ", secret_access_key: abc", "secret_access_key"),
        (STORE % ", lock_days: 0", "lock_days"),
        ("object_store: {url: 'http://bucket', endpoint: 'https://store.example'}", "s3://"),
        ("object_store: {url: 's3://bucket', endpoint: 'https://user:key@store.example'}", "keys do not belong"),
        ("spool: {free_after_days: -1}", "free_after_days"),
        ("spool: {free_after_days: .nan}", "free_after_days"),
        ("x" * 20_000, "too long"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, named: str) -> None:
    assert named in refused(tmp_path, text)


def test_keys_that_others_may_read_and_keys_that_are_missing_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "site.yaml").write_text(STORE % ", keys: keys.yaml")
    site = load_site(tmp_path)
    assert site is not None
    assert site.object_store is not None
    keys = tmp_path / "keys.yaml"
    for text, mode, named in (
        ("access_key_id: a\nsecret_access_key: s", 0o640, "others than its owner"),
        ("access_key_id: a", 0o600, "incomplete"),
        ("{secret_access_key: hidden", 0o600, "not YAML"),
    ):
        keys.write_text(text)
        keys.chmod(mode)
        with pytest.raises(ConfigurationError, match=named) as error:
            open_objects(tmp_path, site.object_store)
        assert "hidden" not in str(error.value)
    keys.write_text("access_key_id: a\nsecret_access_key: s")
    assert "s3://bucket/site" in open_objects(tmp_path, site.object_store).place
    (tmp_path / "site.yaml").write_text(STORE % "")
    site = load_site(tmp_path)
    assert site is not None
    assert site.object_store is not None
    monkeypatch.delenv("ORTHOCAPTURE_S3_ACCESS_KEY_ID", raising=False)
    with pytest.raises(ConfigurationError, match="ORTHOCAPTURE_S3_ACCESS_KEY_ID"):
        open_objects(tmp_path, site.object_store)


def test_without_obstore_its_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore", None)
    monkeypatch.setenv("ORTHOCAPTURE_S3_ACCESS_KEY_ID", "a")
    monkeypatch.setenv("ORTHOCAPTURE_S3_SECRET_ACCESS_KEY", "s")
    (tmp_path / "site.yaml").write_text(STORE % "")
    site = load_site(tmp_path)
    assert site is not None
    assert site.object_store is not None
    with pytest.raises(ConfigurationError, match=r"orthocapture\[site\]"):
        open_objects(tmp_path, site.object_store)


def test_the_file_stands_for_its_folder_and_no_other_file_does(tmp_path: Path) -> None:
    with bench_store(tmp_path / "data") as store:
        run = begin_run(store, PROTOCOL, tmp_path).run_id
    write_site_file(tmp_path / "data", {"spool": {}})
    (tmp_path / "data" / "other.yaml").write_text("spool: {}")
    listed = CliRunner().invoke(app, ["runs", "--data", str(tmp_path / "data" / "site.yaml")])
    assert listed.exit_code == 0, listed.output
    assert run[:8] in listed.output
    other = CliRunner().invoke(app, ["runs", "--data", str(tmp_path / "data" / "other.yaml")])
    assert other.exit_code == 2
    assert "site.yaml" in other.output
