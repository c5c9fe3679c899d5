"""Takes built by chance, of parts that disagree: strategies of :func:`built_files.check_built`."""

import math
import struct

from built_files import LINE_ENDS, Files, altered, counts, numbers, seldom
from hypothesis import strategies as st


@st.composite
def c3d_files(draw: st.DrawFn) -> Files:
    """Header, parameters of every type and points in integers or floats of three processors, with odd values."""
    processor = draw(st.sampled_from([84, 84, 85, 86]))
    order = ">" if processor == 86 else "<"
    points, analog, frames = draw(st.integers(0, 3)), draw(st.integers(0, 2)), draw(st.integers(0, 3))
    scale = draw(seldom(st.sampled_from([0.0, math.nan, math.inf, -math.inf, 1e38]), st.sampled_from([-1.0, 0.1])))
    real = seldom(st.sampled_from([math.nan, math.inf, -1.0, 0.0, 1e9, 1e38]), st.just(60.0))

    def short(value: int) -> bytes:
        return struct.pack(order + "H", value % 65536)

    def single(value: float) -> bytes:
        data = struct.pack(order + "f", value * (4 if processor == 85 and abs(value) < 1e37 else 1))
        return data[2:] + data[:2] if processor == 85 else data

    parameters = [
        ("POINT", "USED", 2, (), short(draw(counts(points)))),
        ("POINT", "SCALE", 4, (), single(scale)),
        ("POINT", "RATE", 4, (), single(draw(real))),
        ("POINT", "FRAMES", 2, (), short(draw(counts(frames)))),
        ("POINT", "DATA_START", draw(st.sampled_from([2, 2, 2, 4])), (), short(3)),
        ("POINT", "UNITS", -1, (2,), draw(st.sampled_from([b"mm", b"m ", b"\xff\xff"]))),
        ("POINT", "LABELS", -1, (2, points), b"ab" * points),
        ("POINT", "X_SCREEN", -1, (2,), draw(st.sampled_from([b"+X", b"-Z", b"+Y", b"  ", b"??"]))),
        ("POINT", "Y_SCREEN", -1, (2,), draw(st.sampled_from([b"+Y", b"+Z", b"+X"]))),
        ("TRIAL", "ACTUAL_START_FIELD", 2, (2,), short(1) + short(draw(counts(0)))),
        ("TRIAL", "ACTUAL_END_FIELD", 2, (2,), short(draw(counts(frames))) + short(0)),
    ]
    packed, groups = b"\1\x50\0\0"[:2] + b"\0" + bytes([processor]), {"POINT": 1, "TRIAL": 2}
    for name, number in groups.items():
        packed += struct.pack("bb", len(name), -number) + name.encode() + struct.pack(order + "H", 3) + b"\0"
    for group, name, kind, dimensions, data in draw(st.lists(st.sampled_from(parameters), unique=True, max_size=11)):
        dims = bytes(draw(counts(size)) % 256 for size in dimensions)
        kind = draw(seldom(st.sampled_from([-1, 1, 2, 4, 3]), st.just(kind), 30))
        body = struct.pack("b", kind) + bytes([len(dims)]) + dims + data + b"\0"
        offset = draw(seldom(st.integers(0, 300), st.just(2 + len(body)), 40))
        packed += struct.pack("bb", len(name), groups[group]) + name.encode() + struct.pack(order + "H", offset) + body
    packed = packed[:512].ljust(512, b"\0")
    header = b"\2\x50" + b"".join(map(short, (draw(counts(points)), draw(counts(analog)), 1, draw(counts(frames)), 0)))
    header += single(scale) + short(draw(counts(3))) + short(1) + single(draw(real))
    coordinate = seldom(st.sampled_from([math.nan, math.inf, -1.0, 3e38]), st.integers(0, 99).map(float))
    data = b""
    for _ in range(frames * (4 * points + analog)):
        value = draw(coordinate)
        data += single(value) if scale < 0 else short(int(value) if math.isfinite(value) else -1)
    return {"case.c3d": header.ljust(512, b"\0") + packed + data}


@st.composite
def trc_files(draw: st.DrawFn) -> Files:
    """The header's fields, labels and rows of numbers, with cells too many, too few, empty or odd."""
    markers, frames = draw(st.integers(0, 3)), draw(st.integers(0, 4))
    values = [
        draw(numbers(1, 99)),
        "60",
        str(draw(counts(frames))),
        str(draw(counts(markers))),
        draw(st.sampled_from(["mm", "m", "?"])),
    ]
    label = st.sampled_from(["a", "b", "", "a_2", "unlabeled1"])
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tcase.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        "\t".join(values),
        "Frame#\tTime\t" + "\t\t\t".join(draw(label) for _ in range(markers)),
        draw(st.sampled_from(["\t\tX1\tY1\tZ1", "", "\t"])),
    ]
    for row in range(frames):
        width = draw(seldom(st.integers(0, 12), st.just(3 * markers), 20))
        cells = [
            draw(seldom(numbers(), st.just(str(row + 1)))),
            str(row / 60),
            *(draw(numbers()) for _ in range(width)),
        ]
        lines.append("\t".join(cells))
    return {"case.trc": draw(st.sampled_from(LINE_ENDS)).join(map(str, draw(altered(lines, 1)))).encode()}


@st.composite
def csv_files(draw: st.DrawFn) -> Files:
    """Headers of every kind of table, with columns too many, missing or twice, and rows that may not fit them."""
    from torchface.shape_names import ARKIT

    label = st.sampled_from(["jaw", "blink", "nose", "HeadYaw", "timecode", "é", "a b"])
    names = draw(st.lists(label, min_size=1, max_size=4))
    kind = draw(st.sampled_from(["weights", "markers", "openface", "live"]))
    header = {
        "weights": ["frame", "time", *names],
        "markers": ["frame", "time", *(f"{name}_{axis}" for name in names for axis in "xyz")],
        "openface": ["frame", "timestamp", "confidence", "success", *(f"{a}_{n}" for n in names for a in "xy"), "gaze"],
        "live": ["Timecode", "BlendshapeCount", *ARKIT, *names],
    }[kind]
    header = [str(name) for name in draw(altered(header, 1))] if draw(st.integers(0, 3)) == 0 else header
    rows = [header]
    for row in range(draw(st.integers(0, 4))):
        width = draw(seldom(st.integers(0, 9), st.just(len(header)), 20))
        time_code = draw(st.sampled_from(["10:00:00:0{}.000", "23:59:59;0{}.5", "0:0:0:{}"])).format(row)
        first = [time_code, draw(numbers(0, 61))] if kind == "live" else [str(row), str(row / 60)]
        first = [draw(seldom(numbers(), st.just(cell), 20)) for cell in first]
        rows.append([*first, *(draw(numbers()) for _ in range(width - 2))][:width])
    cell = draw(st.sampled_from(["{}", "{}", '"{}"', " {}"]))
    text = draw(st.sampled_from(LINE_ENDS)).join(",".join(cell.format(value) for value in row) for row in rows)
    return {"case.csv": draw(st.sampled_from([b"", b"", b"\xef\xbb\xbf"])) + text.encode()}
