"""Lists of points as programs of many countries write them; each line is a point that was chosen here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.errors import UnreadableFileError
from drivers.meshes.point_cloud import parse_point_cloud, read_point_cloud
from service.cli.main import app
from service.core.geometry import Array

POINTS = np.array([[8.2028, -4.5805, 10.7645], [100.0, 0.5, -0.25], [-7.8193, 5.0, 8.8761], [1.0, 2.0, 250.0]])


def rows(separator: str, comma: str = ".", form: str = "{:.4f}") -> str:
    return "".join(separator.join(form.format(value).replace(".", comma) for value in row) + "\n" for row in POINTS)


def normals() -> Array:
    directions = np.random.default_rng(0).normal(size=POINTS.shape)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


WRITTEN: dict[str, bytes] = {
    "blanks": rows(" ").encode(),
    "tabs": rows("\t").encode(),
    "commas": rows(",").encode(),
    "commas and blanks": rows(", ").encode(),
    "semicolons": rows(";").encode(),
    "semicolons and blanks": rows(" ; ").encode(),
    "semicolons at the end too": rows(";").replace("\n", ";\n").encode(),
    "commas at the end too": rows(",").replace("\n", ",\n").encode(),
    "decimal commas and blanks": rows(" ", ",").encode(),
    "decimal commas and tabs": rows("\t", ",").encode(),
    "decimal commas and semicolons": rows(";", ",").encode(),
    "decimal commas in quotes": "".join(
        ",".join('"' + f"{value:.4f}".replace(".", ",") + '"' for value in row) + "\n" for row in POINTS
    ).encode(),
    "whole numbers among decimal commas": rows(" ", ",", "{:g}").encode(),
    "exponents": rows(";", ",", "{:.6E}").encode(),
    "a header": b"x;y;z\n" + rows(";", ",").encode(),
    "a header in Latin-1": "Länge Höhe Breite\n".encode("latin-1") + rows(" ", ",").encode(),
    "remarks": "# größte Länge: 1,5 m; x y z\n// ende\n".encode("latin-1") + rows(" ").encode(),
    "remarks behind": rows(" ").replace("\n", " # 1,2;3\n").encode(),
    "a count": b"4\n" + rows(" ").encode(),
    "a count and decimal commas": b"4\r\n" + rows(" ", ",").replace("\n", "\r\n").encode(),
    "CR": rows(" ").replace("\n", "\r").encode(),
    "no last newline": rows(" ").rstrip().encode(),
    "empty lines": rows(" ").replace("\n", "\n\n").encode(),
    "UTF-8 with a mark": b"\xef\xbb\xbf" + rows(";", ",").encode(),
    "UTF-16": rows("\t", ",").encode("utf-16"),
}


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".xyz", ".asc", ".pts"])
@pytest.mark.parametrize("name", WRITTEN)
def test_however_they_are_written_the_points_are_the_points(tmp_path: Path, name: str, suffix: str) -> None:
    path = tmp_path / f"points{suffix}"
    path.write_bytes(WRITTEN[name])
    points, without = parse_point_cloud(path)
    np.testing.assert_allclose(points, POINTS, rtol=1e-4)
    assert without is None


@pytest.mark.parametrize(("separator", "comma"), [(" ", "."), (";", ","), ("\t", ","), (",", ".")])
def test_normals_are_read_too(tmp_path: Path, separator: str, comma: str) -> None:
    path = tmp_path / "points.txt"
    table = np.concatenate([POINTS, normals()], axis=1)
    path.write_text("\n".join(separator.join(f"{v:.6f}".replace(".", comma) for v in row) for row in table))
    points, found = parse_point_cloud(path)
    np.testing.assert_allclose(points, POINTS, rtol=1e-6)
    assert found is not None
    np.testing.assert_allclose(found, normals(), atol=1e-5)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("1,5,2,5,3,5\n" * 4, "decimal commas: separate the numbers by ;"),  # or six whole numbers
        ("1.234,5;2,0;3,0\n" * 4, "decimal points and decimal commas"),  # thousands
        ("1,234.5;2.0;3.0\n" * 4, "decimal points and decimal commas"),
        ("1,5 2.5 3,5\n" * 4, "decimal points and decimal commas"),
        ("1;;2;3\n" * 4, "empty field"),
        ("1.5,,2.5,3.5\n" * 4, "empty field"),
        ("1 2\n" * 4, "2 columns"),
        ("1 2 3\n1 2\n3 4 5\n", "columns changed"),
        ("1 2 drei\n" * 4, "drei"),
        ("", "no points|no data|input contained"),
    ],
)
def test_what_may_be_read_in_two_ways_is_refused_by_name(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "points.txt"
    path.write_text(content)
    with pytest.raises(UnreadableFileError, match=words) as caught:
        read_point_cloud(path, "mm")
    assert caught.value.where == str(path)


def test_the_command_finds_a_sphere_in_a_list_with_decimal_commas(tmp_path: Path) -> None:
    """A ball of radius 9.5 mm seen from above, as a measuring machine of a German maker writes it."""
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = np.array([40.0, -20.0, 150.0]) + 9.5 * directions[directions[:, 2] > -0.2]
    path = tmp_path / "points.txt"
    path.write_text("\n".join("\t".join(f"{v:.4f}".replace(".", ",") for v in row) for row in points))
    words = [
        "spheres",
        "--mesh",
        str(path),
        "--mesh-unit",
        "mm",
        "--radius-mm",
        "9.5",
        "--out",
        str(tmp_path / "o.json"),
    ]
    answer = CliRunner().invoke(app, words)
    assert answer.exit_code == 0, answer.output
    (centre,) = json.loads((tmp_path / "o.json").read_text())["registration_mm"]
    np.testing.assert_allclose(centre, [40, -20, 150], atol=0.01)


def test_the_radius_confirms_the_unit_of_a_single_ball_or_the_size_is_said_to_be_none(tmp_path: Path) -> None:
    """29 units across: millimetres for a ball of 9.5 mm. The same in inches holds no such ball."""
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    path = tmp_path / "points.xyz"
    for radius, code in ((9.5, 0), (9.5 / 2.54, 1)):
        np.savetxt(path, np.concatenate([radius * directions, [[20.0, 20.0, 0.0]]]))
        words = ["spheres", "--mesh", str(path), "--radius-mm", "9.5", "--out", str(tmp_path / "o.json")]
        answer = CliRunner().invoke(app, words)
        assert answer.exit_code == code, answer.output
        assert ("unit cannot be determined" in answer.output) == bool(code)
