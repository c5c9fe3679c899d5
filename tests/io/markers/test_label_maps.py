"""Tables of marker labels."""

from pathlib import Path

import pytest

from torchface.errors import FileFormatError
from torchface.io.markers.label_maps import load_label_map


def test_a_map_with_and_without_a_heading(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    for heading in ("take,attachment\n", ""):
        path.write_text(f'{heading}LBrowIn,M001\n"a, b", M002 \n\nhelmet,\n')
        assert load_label_map(path) == {"LBrowIn": "M001", "a, b": "M002", "helmet": ""}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b,c\n", r"row 1: found 'a', 'b', 'c', expected two cells"),
        ("a,b\na,c\n", r"row 2: found 'a' again"),
        ("take,attachment\n", "found no row"),
        (",b\n", r"row 1: found '', 'b'"),
    ],
)
def test_what_is_no_map_is_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=rf"map\.csv: {said}"):
        load_label_map(path)
