"""USD files that are broken, hostile or of another kind end in an error that says what is wrong."""

import importlib.util
import os
import random
import shutil
import signal
import subprocess
import sys
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from mutation import mutated
from rig_samples import sheet_rig, sheet_take
from test_usd_reading import ANIMATION, QUAD, SHAPES, head, mesh_prim, usda

from torchface.errors import FileFormatError, MissingExtraError, TorchfaceError
from torchface.io import load_animation, load_mesh, load_rig, save_animation, save_rig
from torchface.io.usd import process_limits, stage_layers, stage_process, usd_reading

GOOD = head(mesh_prim(body=QUAD + SHAPES) + ANIMATION)
CASES = int(os.environ.get("TORCHFACE_FUZZ_CASES", "0")) // 20 or 1  # each takes a process of its own


def rig_and_weights(path: Path) -> None:
    load_rig(path)
    load_animation(path)


def changed(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new)


DAMAGES = {
    "no mesh": ('def Xform "nothing" {}', "found no mesh in its scene, expected at least one with faces"),
    "animated topology": (
        changed("int[] faceVertexCounts = [4]", "int[] faceVertexCounts.timeSamples = {1: [4], 2: [3]}"),
        "/head/face: faces .an animated topology. that change over 2 samples, expected a mesh that stands still",
    ),
    "animated points": (
        changed("point3f[] points = [", "point3f[] points.timeSamples = {1: [(0, 0, 0)], 2: [").replace(
            "(0, 1, 0)]", "(0, 1, 0)]}", 1
        ),
        "points that change over 2 samples",
    ),
    "value clips": (
        changed('def Mesh "face" (', 'def Mesh "face" (clips = {dictionary a = {asset manifestAssetPath = @a@}}\n'),
        "found value clips at /head/face",
    ),
    "a corner outside": (changed("[0, 1, 2, 3]", "[0, 1, 2, 4]"), "corners that name the points 0 to 4, expected .* 3"),
    "too few corners": (changed("Counts = [4]", "Counts = [5]"), "4 corners for faces of 5 to 5 corners,"),
    "a face of two": (changed("Counts = [4]", "Counts = [2, 2]"), "faces of 2 to 2 corners, expected .* at least 3"),
    "NaN": (changed("(1, 1, 0)", "(1, nan, 0)"), "/head/face: points: found NaN or infinity in 1 of 4 rows"),
    "offsets that overflow": (changed("[(0, 0, 1)]", "[(0, 0, 1e38)]"), "open: offsets: found NaN or infinity"),
    "offsets of another count": (changed("pointIndices = [2]", "pointIndices = [2, 3]"), "1 offsets for 2 points"),
    "all offsets of another count": (changed("(0, 0, 4)]", "(0, 0, 4), (0, 0, 5)]"), "found 5 offsets, .* of 4"),
    "a point outside": (changed("pointIndices = [2]", "pointIndices = [-1]"), "offsets of the points -1 to -1"),
    "an in-between beyond the shape": (
        changed("pointIndices = [2]", "pointIndices = [2]\nuniform vector3f[] inbetweens:b = [(0, 0, 1)] (weight = 2)"),
        "open: found an in-between at the weight 2, expected one between 0 and 1",
    ),
    "a combination without its driver": (
        changed('"SkelBindingAPI"]', '"SkelBindingAPI"]\ncustomData = {string torchface = \'{"version": 1, '
                '"correctives": [{"name": "wide", "drivers": ["open", "gone"]}]}\'}\n'),
        "a corrective 'wide' and no morph target 'gone'",
    ),
    "names of another count": (changed('["open", "wide"]', '["open"]'), "1 names of blend shapes, .* each of 2"),
    "a name twice": (changed('["open", "wide"]', '["a", "a"]'), "2 names of blend shapes, 1 of them different"),
    "a target that is none": (changed("[<open>, <wide>]", "[<open>, </head>]"), "target /head, expected a BlendShape"),
    "a transform of NaN": (
        changed("int[] faceVertexCounts", 'matrix4d xformOp:transform = ((nan,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1))\n'
                'uniform token[] xformOpOrder = ["xformOp:transform"]\nint[] faceVertexCounts'),
        "a transform that is NaN",
    ),
    "weights of NaN": (changed("1002: [0.5,", "1002: [nan,"), "animation: found NaN or infinity"),
    "weights of another count": (changed("1002: [0.5, 9, 0.25]", "1002: [0.5]"), "1 weights at time code 1002"),
    "coordinates of another count": (
        changed("int[] faceVertexCounts", 'texCoord2f[] primvars:st = [(0, 0)] (interpolation = "vertex")\n'
                "int[] faceVertexCounts"),
        r"1 texture coordinates \(st, vertex\), expected 4",
    ),
    "text that is no text": (
        changed('Shape "open"', 'Shape "op\udcffen"'),
        "found text that is no UTF-8, expected a whole USD file",
    ),
    "no such unit": (None, "found metersPerUnit = 0.0, expected"),
}  # fmt: skip


@pytest.mark.usefixtures("same_process")
@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_broken_is_named(damage: str, tmp_path: Path) -> None:
    body, told = DAMAGES[damage]
    path = tmp_path / "broken.usda"
    usda(path, GOOD, "metersPerUnit = 0") if body is None else usda(path, body)
    with pytest.raises(FileFormatError, match=f"broken.usda: .*{told}"):
        rig_and_weights(path)


OUTSIDE = {
    "a reference above": 'def "head" (references = @../secret.usda@) {}',
    "a payload above": 'def "head" (payload = @../secret.usda@) {}',
    "an absolute path": 'def "head" (references = @SECRET@) {}',
    "a link": 'def "head" (references = @./link.usda@) {}',
    "another scheme": 'def "head" (references = @https://example.org/a.usda@) {}',
    "an expression": 'def "head" (references = @`"../secret.usda"`@) {}',
    "in a variant": 'def "head" (variants = {string v = "a"}\nprepend variantSets = "v")\n'
    '{\nvariantSet "v" = {\n"a" (references = @../secret.usda@) {\n}\n}\n}',
    "a texture above": mesh_prim(body=QUAD + "rel material:binding = </m>\n", api='"MaterialBindingAPI"')
    + 'def Material "m"\n{\ntoken outputs:surface.connect = </m/s.outputs:surface>\n'
    'def Shader "s"\n{\nuniform token info:id = "UsdPreviewSurface"\ntoken outputs:surface\n'
    "color3f inputs:diffuseColor.connect = </m/t.outputs:rgb>\n}\n"
    'def Shader "t"\n{\nuniform token info:id = "UsdUVTexture"\nasset inputs:file = @../secret.png@\n'
    "float3 outputs:rgb\n}\n}",
}


@pytest.mark.usefixtures("same_process")
@pytest.mark.parametrize("where", OUTSIDE)
def test_nothing_outside_the_files_folder_is_read(where: str, tmp_path: Path) -> None:
    secret = usda(tmp_path / "secret.usda", GOOD, 'defaultPrim = "head"')
    (tmp_path / "secret.png").write_bytes(b"secret")
    folder = tmp_path / "given"
    folder.mkdir()
    (folder / "link.usda").symlink_to(secret)
    path = usda(folder / "rig.usda", OUTSIDE[where].replace("SECRET", str(secret)))
    with pytest.raises(FileFormatError, match=r"found a reference to .*, expected"):
        load_mesh(path)


@pytest.mark.usefixtures("same_process")
def test_a_layer_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"reference to gone\.usda, which is not there"):
        load_rig(usda(tmp_path / "rig.usda", 'def "head" (references = @gone.usda@) {}'))
    with pytest.raises(FileFormatError, match="found Cycle detected"):
        load_rig(usda(tmp_path / "self.usda", 'def "a" (references = [</b>]) {}\ndef "b" (references = [</a>]) {}'))


@pytest.mark.usefixtures("same_process")
def test_packages_name_nothing_outside_and_are_not_packed(tmp_path: Path) -> None:
    usda(tmp_path / "secret.usda", GOOD, 'defaultPrim = "head"')
    for name in ("../secret.usda", str(tmp_path / "secret.usda")):
        path = packed(tmp_path / "out.usdz", f'#usda 1.0\ndef "head" (references = @{name}@) {{}}\n')
        with pytest.raises(FileFormatError, match=r"reference to .*, expected a file in the package"):
            load_mesh(path)
    body = "#usda 1.0\n" + GOOD
    assert load_rig(packed(tmp_path / "plain.usdz", body)).names == ("open", "wide")
    with pytest.raises(FileFormatError, match=r"tight\.usdz: found .*, expected"):
        load_rig(packed(tmp_path / "tight.usdz", body, zipfile.ZIP_DEFLATED))
    (tmp_path / "cut.usdz").write_bytes((tmp_path / "plain.usdz").read_bytes()[:300])
    with pytest.raises(FileFormatError, match=r"cut\.usdz: found .*, expected"):
        load_rig(tmp_path / "cut.usdz")


def packed(path: Path, layer: str, how: int = zipfile.ZIP_STORED) -> Path:
    """A package of one layer, which begins at a multiple of 64 bytes, as USD wants it."""
    entry = zipfile.ZipInfo("a.usda")
    entry.compress_type = how
    entry.extra = b"\x86\x19" + (24).to_bytes(2, "little") + bytes(24)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(entry, layer)
    return path


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole animated file."""
    path = tmp_path_factory.mktemp("usd") / "take.usdc"
    save_animation(sheet_rig(), sheet_take(), path)
    return path


def test_another_process_reads_and_refuses(good: Path, tmp_path: Path) -> None:
    assert load_rig(good).names == sheet_rig().names
    cut = tmp_path / "cut.usdc"
    cut.write_bytes(good.read_bytes()[: good.stat().st_size // 2])
    with pytest.raises(FileFormatError, match=r"cut\.usdc: found .*truncated.*, expected a whole USD file"):
        load_rig(cut)


def test_nothing_and_no_file_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "empty.usdc").write_bytes(b"")
    with pytest.raises(FileFormatError, match="found an empty file, expected content"):
        load_rig(tmp_path / "empty.usdc")
    with pytest.raises(FileFormatError, match="found no such file"):
        load_rig(tmp_path / "gone.usda")
    (tmp_path / "folder.usda").mkdir()
    with pytest.raises(FileFormatError, match="found a folder or a device"):
        load_mesh(tmp_path / "folder.usda")


def test_shapes_of_gigabytes_are_refused_before_they_are_made(tmp_path: Path) -> None:
    """Two thousand shapes that move nothing, over a large mesh."""
    from pxr import Sdf, Vt

    rig = sheet_rig()
    save_rig(rig, tmp_path / "large.usda")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "large.usda"))
    mesh = layer.GetPrimAtPath("/rig/face")
    mesh.attributes["points"].default = Vt.Vec3fArray(100_000, (0, 0, 0))
    mesh.RemoveProperty(mesh.attributes["primvars:displayColor"])
    mesh.attributes["skel:blendShapes"].default = Vt.TokenArray([f"s{i}" for i in range(2000)])
    for i in range(2000):
        Sdf.PrimSpec(mesh, f"s{i}", Sdf.SpecifierDef, "BlendShape")
    paths = [Sdf.Path(f"/rig/face/s{i}") for i in range(2000)]
    mesh.relationships["skel:blendShapeTargets"].targetPathList.explicitItems = paths
    assert layer.Export(str(tmp_path / "large.usdc"))
    with pytest.raises(FileFormatError, match="shapes that unpack to 2400000000 bytes, expected at most"):
        load_rig(tmp_path / "large.usdc")


def test_a_process_that_crashes_or_fills_the_memory_is_an_error(
    good: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script = tmp_path / "crash.py"
    script.write_text("import os\nos.kill(os.getpid(), 11)\n")
    monkeypatch.setattr(usd_reading, "_PROCESS", script)
    with pytest.raises(FileFormatError, match="OpenUSD ended with SIGSEGV; expected a whole file"):
        load_rig(good)
    script.write_text("print('Killed')\nraise SystemExit(3)\n")
    with pytest.raises(FileFormatError, match=r"ended with status 3 \(Killed\)"):
        load_rig(good)


@pytest.mark.parametrize("ending", [".usdc", ".usda"])
def test_mutated_files_are_read_or_refused(ending: str, good: Path, tmp_path: Path) -> None:
    seed = good.read_bytes() if ending == ".usdc" else usda(tmp_path / "text.usda", GOOD).read_bytes()
    case, generator = good.with_name(f"case{ending}"), random.Random(0)
    for _ in range(CASES):
        case.write_bytes(mutated(seed, generator))
        with suppress(TorchfaceError):
            load_rig(case)


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for attempt in (lambda: load_rig(tmp_path / "a.usdc"), lambda: save_rig(sheet_rig(), tmp_path / "a.usdc")):
        with pytest.raises(MissingExtraError, match=r"usd-core is not installed.*-m pip install usd-core"):
            attempt()


@pytest.mark.parametrize("ending", [".usda", ".usdz"])
def test_a_full_disk_leaves_what_was_there(ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / f"rig{ending}"
    path.write_bytes(b"before")

    def full(source: Path, target: Path) -> Any:
        Path(target).write_bytes(Path(source).read_bytes()[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(FileFormatError, match="cannot be written: the disk is full"):
        save_rig(sheet_rig(), path)
    assert path.read_bytes() == b"before"
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_many_prims_are_refused_before_they_are_composed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pxr import Usd

    monkeypatch.setattr(stage_layers, "MAX_PRIMS", 50)
    monkeypatch.setattr(Usd.Stage, "Open", None)
    usda(tmp_path / "many.usda", "".join(f'def Xform "p{i}" {{\ndef Xform "q" {{\n}}\n}}\n' for i in range(30)))
    with pytest.raises(stage_process.Refused, match="more than 50 prims"):
        stage_process.extract(tmp_path / "many.usda", lambda size: None)


CHILD = (  # beside the file, which needs no more of the library
    f"import sys; sys.path.insert(0, {str(Path(process_limits.__file__).parent)!r}); "
    "from process_limits import end_in_time; end_in_time({}); print('ready', flush=True); "
)
WAITS = "import os; os.read(os.pipe()[0], 1)"


@pytest.mark.skipif(sys.platform != "linux", reason="the system reports a parent's end on Linux alone")
def test_the_process_ends_with_the_one_that_started_it() -> None:
    starts = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {CHILD.format(100) + WAITS!r}])"
    parent = subprocess.Popen([sys.executable, "-c", starts], stdout=subprocess.PIPE)
    assert parent.stdout.readline() == b"ready\n"
    parent.kill()
    assert parent.stdout.read() == b""  # ends when no process holds the other end
    parent.wait()


@pytest.mark.skipif(sys.platform == "win32", reason="no such signal")
def test_the_process_ends_in_time_whatever_it_waits_for() -> None:
    done = subprocess.run([sys.executable, "-c", CHILD.format(1) + WAITS], stdout=subprocess.PIPE, timeout=60)
    assert done.returncode == -signal.SIGALRM
