"""Takes as they come from a recorder: prefixes, strangers, other labels, more frames than wanted."""

import struct
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import Attachment, BlendshapeRig, Take, Track, load_take, save_rig, save_take
from torchface.cli import main
from torchface.errors import FileFormatError
from torchface.synthetic.stages import StageFlaws, place_markers, record
from torchface.workflows.marker_input import load_label_map


@pytest.fixture(scope="module")
def stage(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig, an attachment, a take, and the same take under a recorder's labels beside strangers."""
    folder = tmp_path_factory.mktemp("stage")
    sites = place_markers(dome_rig, 30)
    weights = 0.5 + 0.5 * torch.sin(torch.arange(150)[:, None] * torch.tensor([0.05, 0.11, 0.17, 0.23]))
    take = record(dome_rig, sites, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0.05)).take
    save_rig(dome_rig, folder / "rig.glb")
    sites.save(folder / "attachment.json")
    save_take(take, folder / "take.c3d")
    far = torch.tensor([0.0, 300, 0]).expand(150, 2, 3)
    labels = ("*12", *(f"Actor:{label.lower()}" for label in take.markers.names), "Actor:Helmet1")
    values = torch.cat([far[:, :1], take.markers.values, far[:, 1:]], dim=1)
    save_take(Take(60.0, markers=Track(labels, values)), folder / "recorded.c3d")
    return folder


def run(*words: str | Path) -> None:
    main([str(word) for word in words])


def solved(stage: Path, take: str, *more: str | Path) -> Take:
    out = stage / f"{take}.csv"
    sites = ("--attachment", stage / "attachment.json")
    run("solve", stage / "rig.glb", stage / take, *sites, "--frame-by-frame", "--out", out, "--quiet", *more)
    return load_take(out)


def values(take: Take) -> torch.Tensor:
    return take.weights.values


def test_a_recorders_labels_give_the_same_weights(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    right = solved(stage, "take.c3d")
    assert "warning" not in capsys.readouterr().err
    assert torch.equal(values(solved(stage, "recorded.c3d")), values(right))
    assert "warning: left out *12, Actor:Helmet1" in " ".join(capsys.readouterr().err.split())


def test_labels_csv_renames(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    take = load_take(stage / "take.c3d")
    own = tuple(f"face {i}" for i in range(30))
    save_take(replace(take, markers=Track(own, take.markers.values)), stage / "own.c3d")
    with pytest.raises(SystemExit):
        solved(stage, "own.c3d")
    told = " ".join(capsys.readouterr().err.split())
    assert "own.c3d: labels: found face 0, face 1" in told
    assert "--labels map.csv" in told
    rows = [f"{mine},{label}" for mine, label in zip(own, take.markers.names, strict=True)]
    (stage / "map.csv").write_text("take,attachment\n" + "\n".join(rows))
    renamed = solved(stage, "own.c3d", "--labels", stage / "map.csv")
    assert torch.equal(values(renamed), values(solved(stage, "take.c3d")))


def test_frames_cut_the_take(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = values(solved(stage, "take.c3d"))
    for text, rows in (("40:70", slice(40, 70)), (":25", slice(25)), ("130:999", slice(130, 150))):
        assert torch.equal(values(solved(stage, "take.c3d", "--frames", text)), whole[rows])
    # Both formats say when in the file a frame was.
    assert solved(stage, "take.c3d", "--frames", "70:75").timecode == solved(stage, "take.c3d").timecode[70:75]
    for text in ("40-70", "70:40", "200:"):
        with pytest.raises(SystemExit):
            solved(stage, "take.c3d", "--frames", text)
        assert "--frames: found" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        solved(stage, "take.c3d", "--frames", "40:70", "--neutral", "10")
    assert "--neutral: found frame 10" in capsys.readouterr().err


@pytest.mark.parametrize("ending", [".c3d", ".trc", ".csv"])
def test_a_trimmed_take_keeps_its_frames_numbers(ending: str, stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Formats count from 0 or 1: frame 70 of the recording is row 70 of the whole take's weights whichever it is."""
    whole = solved(stage, "take.c3d")
    save_take(load_take(stage / "take.c3d").frames(slice(70, 120)), stage / f"trimmed{ending}")
    if ending == ".c3d":
        assert struct.unpack_from("<H", (stage / "trimmed.c3d").read_bytes(), 6) == (71,)
    trimmed = solved(stage, f"trimmed{ending}")
    assert trimmed.timecode == whole.timecode[70:120]
    some = solved(stage, f"trimmed{ending}", "--frames", "80:90", "--neutral", "85")
    assert some.timecode == whole.timecode[80:90]
    with pytest.raises(SystemExit):
        solved(stage, f"trimmed{ending}", "--frames", "80:90", "--neutral", "5")
    assert "found frame 5, expected one of those that are used, 80 to 89" in " ".join(capsys.readouterr().err.split())
    for text in ("0:30", "120:"):
        with pytest.raises(SystemExit):
            solved(stage, f"trimmed{ending}", "--frames", text)
        assert "in a take of 50 frames, numbered 70 to 119" in " ".join(capsys.readouterr().err.split())


def test_a_span_in_which_the_take_lacks_all_frames_is_refused(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = load_take(stage / "take.c3d")
    save_take(whole.rows(torch.tensor([*range(40), *range(60, 150)])), stage / "dropped.csv")
    some = solved(stage, "dropped.csv", "--frames", "38:62")
    assert [text[6:11] for text in some.timecode] == ["00:38", "00:39", "01:00", "01:01"]
    for more in ((), ("--neutral", "45")):
        with pytest.raises(SystemExit):
            solved(stage, "dropped.csv", "--frames", "42:50", *more)
        said = " ".join(capsys.readouterr().err.split())
        assert "found '42:50' in a take of 130 frames, numbered 0 to 149" in said


def test_attach_takes_a_recorders_labels_too(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sites = Attachment.load(stage / "attachment.json")
    where = ("--initial", stage / "attachment.json", "--quiet", "--out", stage / "sites.json", "--frames", "10:")
    run("attach", stage / "rig.glb", stage / "recorded.c3d", *where)
    assert "warning: left out *12, Actor:Helmet1" in " ".join(capsys.readouterr().err.split())
    assert Attachment.load(stage / "sites.json").labels == sites.labels
    take = load_take(stage / "take.c3d")
    unseen = take.markers.values.clone()
    unseen[:, 3] = torch.nan
    save_take(replace(take, markers=Track(take.markers.names, unseen)), stage / "unseen.c3d")
    run("attach", stage / "rig.glb", stage / "unseen.c3d", *where)
    assert "warning: no site for M004: seen in no frame" in " ".join(capsys.readouterr().err.split())
    assert "M004" not in (Attachment.load(stage / "sites.json").labels or ())


def test_a_cut_take_keeps_what_belongs_to_its_frames() -> None:
    track = Track(("a",), torch.arange(6.0)[:, None, None])
    extras = {
        "columns": {"HeadYaw": torch.arange(6.0), "note": tuple("abcdef")},
        "blendshape_count": tuple(range(6)),
        "device": "phone",
    }
    seconds = torch.tensor([0, 0.3, 0.4, 0.5, 0.9, 1.0])
    cut = Take(60.0, weights=track, timecode=tuple("uvwxyz"), extras=extras, seconds=seconds).frames(slice(3, 5))
    assert cut.weights.values.flatten().tolist() == [3, 4]
    assert cut.timecode == ("x", "y")
    assert cut.extras["columns"]["HeadYaw"].tolist() == [3, 4]
    assert cut.extras["columns"]["note"] == ("d", "e")
    assert cut.extras["blendshape_count"] == (3, 4)
    assert cut.seconds.tolist() == seconds[3:5].double().tolist()
    assert cut.extras["frame_numbers"].tolist() == [3, 4]
    assert cut.extras["device"] == "phone"


def test_a_map_with_and_without_a_heading(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    for heading in ("take,attachment\n", ""):
        path.write_text(f'{heading}LBrowIn,M001\n"a, b", M002 \n\nhelmet,\n')
        assert load_label_map(path) == {"LBrowIn": "M001", "a, b": "M002", "helmet": ""}


def test_a_map_as_excel_writes_it(tmp_path: Path) -> None:
    path, text = tmp_path / "map.csv", 'LBrowIn;M001\n"a, b";M002\nhelmet;\n'
    for data in (text.encode(), text.encode("utf-16"), f"sep=;\ntake;attachment\n{text}".encode()):
        path.write_bytes(data)
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
