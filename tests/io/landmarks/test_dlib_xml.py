"""dlib's XML of faces: what imglab writes is read; entities, wrong places and wrong numbers are refused."""

from pathlib import Path

import pytest
import torch
from mutation import check_reader

from torchface.errors import FileFormatError
from torchface.io.landmarks.dlib_xml import load_dlib_faces

HEAD = "<?xml version='1.0' encoding='ISO-8859-1'?>\n"
BOX = "<box top='1' left='2' width='30' height='40'>{}</box>"
FACE = f"<dataset><images><image file='a.jpg'>{BOX}</image></images></dataset>"
PART = "<part name='{}' x='{}' y='{}'/>"


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "faces.xml"
    path.write_text(text, encoding="latin-1")
    return path


def test_faces_boxes_and_parts_are_read(tmp_path: Path) -> None:
    text = HEAD + (
        "<?xml-stylesheet type='text/xsl' href='style.xsl'?><dataset><name>faces</name><images>"
        "<image file='a.jpg'><box top='1' left='2' width='30' height='40'><label>one</label>"
        "<part name='01' x='5' y='6.5'/><part name='3' x='-7' y='8'/></box>"
        "<box top='9' left='9' width='9' height='9' ignore='1'/></image>"
        "<image file='sub/b.jpg'><box top='0' left='0' width='3' height='4'/></image></images></dataset>"
    )
    first, second = load_dlib_faces(written(tmp_path, text))
    assert (first.image, second.image) == ("a.jpg", "sub/b.jpg")
    assert first.box.tolist() == [2, 1, 30, 40]
    assert first.points[1].tolist() == [5, 6.5]
    assert first.points[3].tolist() == [-7, 8]
    assert torch.isnan(first.points[[0, 2]]).all()
    assert second.points.shape == (0, 2)


def test_entities_are_refused_before_they_grow(tmp_path: Path) -> None:
    tenfold = [f"<!ENTITY b{i} '{f'&b{i - 1};' * 10 if i else 'ha'}'>" for i in range(12)]
    bomb = f"<!DOCTYPE d [{''.join(tenfold)}]><dataset><name>&b11;</name></dataset>"
    with pytest.raises(FileFormatError, match="XML entity"):
        load_dlib_faces(written(tmp_path, HEAD + bomb))
    outside = HEAD + "<!DOCTYPE d [<!ENTITY x SYSTEM 'file:///etc/hostname'>]>" + FACE.format("")
    with pytest.raises(FileFormatError, match="XML entity"):
        load_dlib_faces(written(tmp_path, outside))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<dataset><images>", "not readable XML"),
        ("no xml", "not readable XML"),
        ("<faces/>", "found no <dataset>"),
        (FACE.format("<image file='b.jpg'/>"), "found an <image> inside another"),
        ("<dataset><images><image file='a'><image file='b'/></image></images></dataset>", "inside another"),
        (FACE.format(PART.format("x", 1, 2)), "found a part named 'x', expected 0 to 999"),
        (FACE.format(PART.format(999999, 1, 2)), "found a part named '999999'"),
        (FACE.format(PART.format(1, "nan", 2)), "found x='nan' in a <part>"),
        (FACE.format(PART.format(1, 2, "1e300")), "found y='1e300' in a <part>"),
        (FACE.format(PART.format(1, 2, 3) * 2), "found part 1 twice"),
        (FACE.format("<part name='1' x='2'/>"), "found a <part> without y"),
        ("<dataset><part name='1' x='1' y='1'/></dataset>", "outside a <box>"),
        ("<dataset><box top='1' left='2' width='3' height='4'/></dataset>", "outside an <image>"),
        ("<dataset><images><image/></images></dataset>", "found a <image> without file"),
    ],
)
def test_what_is_no_such_file_is_named(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=message):
        load_dlib_faces(written(tmp_path, HEAD + text))


def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    parts = "".join(PART.format(f"{i:02d}", 100 + i, 200 - i) for i in range(68))
    check_reader(load_dlib_faces, [written(tmp_path, HEAD + FACE.format(parts))], ".xml")


@pytest.mark.real
def test_the_real_faces_are_all_there(data: Path) -> None:
    faces = load_dlib_faces(data / "images" / "dlib_faces" / "training_with_face_landmarks.xml")
    assert len(faces) == 18
    assert len({face.image for face in faces}) == 4
    for face in faces:
        assert face.points.shape == (68, 2)
        left, top, width, height = face.box.tolist()
        centre = face.points.mean(0)
        assert left < float(centre[0]) < left + width
        assert top < float(centre[1]) < top + height
