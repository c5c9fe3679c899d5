"""C3D: round trips, a second opinion by the ``c3d`` package, every processor's numbers, axes, units, broken files."""

import io
import math
import re
import struct
import warnings
from pathlib import Path

import c3d
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from mutation import check_reader
from take_strategies import marker_takes, round_trip, same

from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io.markers.c3d import load_c3d, save_c3d
from torchface.take import Take, Track, empty_frames


def _take(frames: int = 7, markers: int = 4, fps: float = 60.0, seed: int = 0) -> Take:
    generator = torch.Generator().manual_seed(seed)
    values = 100 * torch.randn(frames, markers, 3, generator=generator)
    values[torch.rand(frames, markers, generator=generator) < 0.2] = torch.nan
    values[0] = 1.5
    return Take(fps, markers=Track(tuple(f"marker number {i}" for i in range(markers)), values))


def _opinion(data: bytes) -> tuple[c3d.Reader, np.ndarray, np.ndarray]:
    """What the package reads: itself, positions (T,M,3), and who was seen (T,M)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = c3d.Reader(io.BytesIO(data))
        points = np.stack([points for _, points, _ in reader.read_frames()])
    return reader, points[..., :3], points[..., 3] >= 0


@given(marker_takes())
@settings(max_examples=25)
def test_a_take_comes_back_to_the_bit(take: Take) -> None:
    assert round_trip(save_c3d, load_c3d, take).fps == take.fps


def test_the_c3d_package_reads_what_is_written(tmp_path: Path) -> None:
    take = _take(fps=60000 / 1001)
    save_c3d(take, tmp_path / "take.c3d")
    reader, positions, seen = _opinion((tmp_path / "take.c3d").read_bytes())
    expected = take.markers.values.numpy()
    assert np.array_equal(seen, ~np.isnan(expected[..., 0]))
    assert np.array_equal(positions[seen], expected[seen])
    assert [label.rstrip() for label in reader.point_labels] == list(take.markers.names)
    assert reader.point_rate == np.float32(60000 / 1001)
    assert reader.get_string("POINT:UNITS") == "mm"
    assert reader.first_frame == 1
    assert reader.last_frame == 7


@pytest.mark.parametrize("scale", [-1.0, 0.01])
def test_what_the_c3d_package_writes_is_read(scale: float, tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    points = np.zeros((9, 3, 5), np.float32)
    points[..., :3] = generator.normal(0, 100, (9, 3, 3))
    points[4, 1, 3] = -1
    writer = c3d.Writer(point_rate=100.0, analog_rate=200.0, point_scale=scale, point_units="cm  ")
    writer.set_point_labels(["nose", "chin", "a longer label"])
    writer.set_analog_labels(["force"])
    writer.add_frames([(frame, np.ones((1, 2))) for frame in points])
    with warnings.catch_warnings(), open(tmp_path / "take.c3d", "wb") as file:
        warnings.simplefilter("ignore")
        writer.write(file)
    _, positions, seen = _opinion((tmp_path / "take.c3d").read_bytes())
    take = load_c3d(tmp_path / "take.c3d")
    assert take.markers.names == ("nose", "chin", "a longer label")
    assert take.fps == 100
    values = take.markers.values.numpy()
    assert np.array_equal(np.isnan(values[..., 0]), ~seen)
    assert np.argwhere(~seen).tolist() == [[4, 1]]
    np.testing.assert_allclose(values[seen], 10 * positions[seen], rtol=1e-6)
    np.testing.assert_allclose(values[seen], 10 * points[seen][:, :3], atol=10 * max(scale, 0) + 1e-3)


def _dec(value: float) -> bytes:
    """A DEC F_floating number: value = 0.1mmm... * 2^(exponent - 128), the high half first."""
    if value == 0:
        return bytes(4)
    mantissa, exponent = math.frexp(abs(value))
    bits = (value < 0) << 31 | (exponent + 128) << 23 | (round(mantissa * 2**24) & 0x7FFFFF)
    return struct.pack("<HH", bits >> 16, bits & 0xFFFF)


def _build(
    points: np.ndarray,
    processor: int = 84,
    scale: float = -1.0,
    parameters: dict[tuple[int, str], tuple[int, tuple[int, ...], bytes]] | None = None,
    last_frame: int | None = None,
    analog: int = 0,
) -> bytes:
    """A C3D file from the format's description: points (T,M,4) as stored, group 1 is POINT and 2 TRIAL."""
    order = ">" if processor == 86 else "<"

    def number(value: float) -> bytes:
        return _dec(value) if processor == 85 else struct.pack(order + "f", value)

    frames, count = points.shape[:2]
    section = b""
    for group, name in ((1, b"POINT"), (2, b"TRIAL")):
        section += struct.pack("bb", len(name), -group) + name + struct.pack(order + "H", 3) + b"\0"
    values = {(1, "UNITS"): (-1, (2,), b"mm"), (1, "SCALE"): (4, (), number(scale)), (1, "RATE"): (4, (), number(50.0))}
    for (group, name), (kind, dimensions, data) in {**values, **(parameters or {})}.items():
        body = struct.pack("bB", kind, len(dimensions)) + bytes(dimensions) + data + b"\0"
        section += struct.pack("bb", len(name), group) + name.encode() + struct.pack(order + "H", 2 + len(body)) + body
    blocks = (len(section) + 6) // 512 + 1
    last = frames if last_frame is None else last_frame
    header = bytes([2, 80]) + struct.pack(order + "5H", count, analog, 1, last, 0) + number(scale)
    header += struct.pack(order + "HH", 2 + blocks, 1) + number(50.0)
    if scale > 0:
        words = points.astype(order + "i2")
    elif processor == 85:
        words = np.frombuffer(b"".join(_dec(float(value)) for value in points.ravel()), "<f4").reshape(points.shape)
    else:
        words = points.astype(order + "f4")
    rows = words.reshape(frames, -1)
    rows = np.concatenate([rows, np.zeros((frames, analog), rows.dtype)], 1).astype(rows.dtype)  # keeps the byte order
    head = header.ljust(512, b"\0") + (bytes([1, 80, blocks, processor]) + section).ljust(512 * blocks, b"\0")
    return head + rows.tobytes()


def _points(frames: int = 5, markers: int = 3, whole: bool = False) -> np.ndarray:
    points = np.random.default_rng(1).normal(0, 300, (frames, markers, 4)).astype(np.float32)
    points = np.rint(points) if whole else points
    points[..., 3] = 0
    points[2, 1, 3] = -1
    return points


@pytest.mark.parametrize("processor", [84, 85, 86])
@pytest.mark.parametrize("scale", [-1.0, 0.25])
@pytest.mark.parametrize("analog", [0, 3])
def test_every_processor_and_number_is_read_as_the_c3d_package_reads_it(
    processor: int, scale: float, analog: int, tmp_path: Path
) -> None:
    points = _points(whole=scale > 0)
    data = _build(points, processor, scale, analog=analog)
    (tmp_path / "take.c3d").write_bytes(data)
    take = load_c3d(tmp_path / "take.c3d")
    assert take.fps == 50
    expected = points[..., :3] * abs(scale)
    expected[2, 1] = np.nan
    np.testing.assert_array_equal(take.markers.values.numpy(), expected)
    if analog == 0:
        _, positions, seen = _opinion(data)
        np.testing.assert_array_equal(take.markers.values.numpy()[seen], positions[seen])


@pytest.mark.parametrize(
    ("text", "factor"), [("mm", 1.0), ("cm", 10.0), ("m ", 1000.0), ("in", 25.4), ("MM\0\0", 1.0), ("meters", 1000.0)]
)
def test_units_become_millimetres(text: str, factor: float, tmp_path: Path) -> None:
    points = _points()
    unit = {(1, "UNITS"): (-1, (len(text),), text.encode())}
    (tmp_path / "take.c3d").write_bytes(_build(points, parameters=unit))
    values = load_c3d(tmp_path / "take.c3d").markers.values.numpy()
    np.testing.assert_allclose(values[0], points[0, :, :3] * factor, rtol=1e-6)
    given = load_c3d(tmp_path / "take.c3d", unit="cm").markers.values.numpy()
    np.testing.assert_allclose(given[0], points[0, :, :3] * 10, rtol=1e-6)


@pytest.mark.parametrize(
    ("right", "up", "turned"),
    [("+X", "+Z", lambda p: (p[0], p[2], -p[1])), ("+Y", "+Z", lambda p: (p[1], p[2], p[0])), ("-X", "Y", None)],
)
def test_screen_axes_turn_the_points_to_y_up(right: str, up: str, turned: object, tmp_path: Path) -> None:
    points = _points()
    axes = {(1, "X_SCREEN"): (-1, (2,), right.encode()), (1, "Y_SCREEN"): (-1, (len(up),), up.encode())}
    (tmp_path / "take.c3d").write_bytes(_build(points, parameters=axes))
    values = load_c3d(tmp_path / "take.c3d").markers.values.numpy()
    x, y, z = points[0, 0, :3]
    expected = turned(points[0, 0, :3]) if callable(turned) else (-x, y, -z)
    np.testing.assert_allclose(values[0, 0], expected)
    mirrored = np.linalg.det(np.linalg.lstsq(points[0, :, :3], values[0], rcond=None)[0])
    assert mirrored == pytest.approx(1.0, rel=1e-3)  # a rotation, no mirror image


def test_labels_come_from_every_labels_parameter_and_are_made_distinct(tmp_path: Path) -> None:
    points = _points(markers=5)
    labels = {(1, "LABELS2"): (-1, (4, 2), b"nosechin"), (1, "LABELS"): (-1, (4, 2), b"nose    ")}
    (tmp_path / "take.c3d").write_bytes(_build(points, parameters=labels))
    take = load_c3d(tmp_path / "take.c3d")
    assert take.markers.names == ("nose", "unlabeled2", "nose_2", "chin", "unlabeled5")


def test_three_hundred_long_labels_beyond_ascii_come_back(tmp_path: Path) -> None:
    names = tuple(f"Größe der Nase, {i}." + "x" * (i % 50) for i in range(300))
    take = Take(60.0, markers=Track(names, torch.randn(3, 300, 3, generator=torch.Generator().manual_seed(0))))
    save_c3d(take, tmp_path / "take.c3d")
    back = load_c3d(tmp_path / "take.c3d")
    assert back.markers.names == names
    assert same(back.markers.values, take.markers.values)


def test_seventy_thousand_frames_come_back(tmp_path: Path) -> None:
    values = torch.arange(70_000 * 3, dtype=torch.float32).reshape(70_000, 1, 3)
    save_c3d(Take(120.0, markers=Track(("nose",), values)), tmp_path / "take.c3d")
    back = load_c3d(tmp_path / "take.c3d")
    assert same(back.markers.values, values)
    assert _opinion((tmp_path / "take.c3d").read_bytes())[0].last_frame == 70_000


def test_a_frame_range_kept_only_in_the_trial_group_is_found(tmp_path: Path) -> None:
    points = _points(frames=6)
    trial = {
        (2, "ACTUAL_START_FIELD"): (2, (2,), struct.pack("<I", 100_000)),
        (2, "ACTUAL_END_FIELD"): (2, (2,), struct.pack("<I", 100_005)),
    }
    (tmp_path / "take.c3d").write_bytes(_build(points, parameters=trial, last_frame=65535))
    take = load_c3d(tmp_path / "take.c3d")
    assert len(take) == 6
    assert take.numbers.tolist() == list(range(99_999, 100_005))  # C3D counts from 1
    save_c3d(take, tmp_path / "again.c3d")
    assert load_c3d(tmp_path / "again.c3d").numbers.tolist() == list(range(99_999, 100_005))


@pytest.mark.parametrize("last", [4464, 65535])
@pytest.mark.parametrize("kind", [2, 4])
def test_counts_of_16_bits_that_began_again_or_stopped_are_not_believed(last: int, kind: int, tmp_path: Path) -> None:
    """70,000 frames are 4,464 modulo 65,536; programs write that, or 65,535, and the whole number as a float or not."""
    points = np.ones((70_000, 1, 4), np.float32)
    count = struct.pack("<H", last) if kind == 2 else struct.pack("<f", 70_000)
    path = tmp_path / "take.c3d"
    made = _build(points, parameters={(1, "FRAMES"): (kind, (), count)}, last_frame=last)
    path.write_bytes(made + bytes(-len(made) % 512))
    assert len(load_c3d(path)) == 70_000
    if kind == 4:  # no count of 16 bits
        path.write_bytes(made + bytes(2**21))
        assert len(load_c3d(path)) == 70_000


@pytest.mark.parametrize("frames", [65_535, 65_536])
def test_counts_at_the_end_of_16_bits_are_exact_in_files_of_whole_blocks(frames: int, tmp_path: Path) -> None:
    made = _build(np.ones((frames, 1, 4), np.float32), last_frame=frames % 65_536)
    (tmp_path / "take.c3d").write_bytes(made + bytes(-len(made) % 512))
    assert len(load_c3d(tmp_path / "take.c3d")) == frames


def test_bytes_behind_the_last_count_of_16_bits_are_said(tmp_path: Path) -> None:
    made, path = _build(np.ones((65_535, 1, 4), np.float32), last_frame=65_535), tmp_path / "take.c3d"
    path.write_bytes(made + b"made by a program" * 4)
    with pytest.warns(UserWarning, match=r"take\.c3d: found 65539 frames stored and 65535 announced"):
        assert len(load_c3d(path)) == 65_539
    path.write_bytes(made)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(load_c3d(path)) == 65_535


def test_a_frame_without_a_marker_loads_and_is_named_on_request(tmp_path: Path) -> None:
    take = _take()
    take.markers.values[[2, 5]] = torch.nan
    path = tmp_path / "take.c3d"
    save_c3d(take, path)
    back = load_c3d(path)
    assert len(back) == 7
    assert empty_frames(back).tolist() == [2, 5]


def _broken(change: str) -> bytes:
    points = _points()
    good = _build(points)
    if change == "no points":
        return _build(points[:, :0])
    if change == "unknown unit":
        return _build(points, parameters={(1, "UNITS"): (-1, (6,), b"cubits")})
    if change == "no unit":
        return _build(points, parameters={(1, "UNITS"): (-1, (0,), b"")})
    if change == "nothing seen":
        return _build(np.full_like(points, -1))
    if change == "no frames":
        return _build(points, last_frame=0)
    if change == "cut off":
        return good[:-20]
    if change == "too many frames":
        return _build(points, last_frame=60_000)
    if change == "rate":
        return _build(points, parameters={(1, "RATE"): (4, (), struct.pack("<f", 1e9))})
    if change == "points differ":
        return _build(points, parameters={(1, "USED"): (2, (), struct.pack("<H", 9000))})
    if change == "axes":
        return _build(points, parameters={(1, n): (-1, (2,), b"+X") for n in ("X_SCREEN", "Y_SCREEN")})
    if change == "axis":
        return _build(points, parameters={(1, n): (-1, (2,), b"+Q") for n in ("X_SCREEN", "Y_SCREEN")})
    if change == "long parameter":
        return _build(points, parameters={(1, "LABELS"): (-1, (255,) * 200, b"nose")})
    if change == "processor":
        return good[:515] + b"\x01" + good[516:]
    if change == "scale":
        return _build(points, parameters={(1, "SCALE"): (4, (), struct.pack("<f", math.nan))})
    if change.startswith("data start "):
        start = struct.pack("<f", float(change.split()[-1]))
        moved = _build(points, parameters={(1, "DATA_START"): (4, (), start)})
        return moved[:16] + bytes(2) + moved[18:]  # the header leaves it to the parameter
    return b"solid cube" + bytes(2000)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("no points", r"found no points .*expected at least one"),
        ("unknown unit", r"POINT:UNITS: found 'cubits', expected one of mm, cm, m, in"),
        ("no unit", r"POINT:UNITS: found '', expected one of mm, cm, m, in, um; or say it \(--unit, unit=\)"),
        ("nothing seen", r"found 3 points, none of them seen in any of 5 frames; expected at least one"),
        ("no frames", r"found no frames, expected at least one"),
        ("cut off", r"found 5 frames of 48 bytes announced and space for 4 .*expected all"),
        ("too many frames", r"found 60000 frames of 48 bytes announced and space for 5"),
        ("rate", r"POINT:RATE: found 1000000000.0 frames a second, expected 0.01 to 10000"),
        ("points differ", r"found POINT:USED 9000, expected 3 as in the header"),
        ("axes", r"found X_SCREEN '\+X' and Y_SCREEN '\+X', expected two different"),
        ("axis", r"POINT:X_SCREEN: found '\+Q', expected an axis"),
        ("long parameter", r"parameter 'LABELS': found it to run past the end"),
        ("processor", r"found processor type 1, expected 84"),
        ("scale", r"POINT:SCALE: found nan, expected a number"),
        *(
            (f"data start {number}", rf"found the data in block {re.escape(number)}, expected block 3 or later")
            for number in ("nan", "inf", "-inf", "-3", "1.5", "1e+30")
        ),
        ("other file", r"found no C3D header, expected"),
    ],
)
def test_a_broken_file_is_refused_by_name(change: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.c3d"
    path.write_bytes(_broken(change))
    with pytest.raises(FileFormatError, match=r"broken\.c3d: " + message):
        load_c3d(path)


def test_what_cannot_be_written_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    values = torch.zeros(2, 1, 3)
    path = tmp_path / "take.c3d"
    for name in ("", " nose", "nose ", "a\0b", "a\nb", "\ud800", "x" * 256):
        with pytest.raises(NameMismatchError, match=r"take\.c3d: found the .*label"):
            save_c3d(Take(60.0, markers=Track((name,), values)), path)
    with pytest.raises(ValueRangeError, match="infinite"):
        save_c3d(Take(60.0, markers=Track(("nose",), values + torch.inf)), path)
    with pytest.raises(ValueRangeError, match="without marker positions"):
        save_c3d(Take(60.0, markers=Track((), torch.zeros(2, 0, 3))), path)
    with pytest.raises(ValueRangeError, match="found 1e-05 frames a second"):
        save_c3d(Take(1e-5, markers=Track(("nose",), values)), path)
    assert list(tmp_path.iterdir()) == []


def test_a_unit_that_is_none_is_refused(tmp_path: Path) -> None:
    save_c3d(_take(), tmp_path / "take.c3d")
    with pytest.raises(ValueRangeError, match="unit: found 'furlong', expected one of mm, cm, m, in"):
        load_c3d(tmp_path / "take.c3d", unit="furlong")


def test_a_mutated_c3d_is_read_or_refused(tmp_path: Path) -> None:
    save_c3d(_take(frames=4), tmp_path / "floats.c3d")
    (tmp_path / "integers.c3d").write_bytes(
        _build(_points(whole=True), 86, 0.5, {(1, "LABELS"): (-1, (2, 3), b"a b c ")})
    )
    check_reader(load_c3d, [tmp_path / "floats.c3d", tmp_path / "integers.c3d"], ".c3d")
