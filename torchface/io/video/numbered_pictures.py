"""Numbered pictures in a folder, and the command that makes a film of them."""

import re
from collections import defaultdict
from pathlib import Path
from shlex import quote

_NAME = re.compile(r"(.*?)([0-9]+)(\.(?:png|jpe?g|tiff?|exr|dpx|bmp|webp))", re.IGNORECASE)
_FEWEST = 2


def film_of_pictures(folder: Path) -> str:
    """What to do with a folder of numbered pictures where a film is expected, as the end of an error's words; empty
    where it has none."""
    series: dict[tuple[str, str], list[str]] = defaultdict(list)
    for path in folder.iterdir():
        if found := _NAME.fullmatch(path.name):
            series[found[1], found[3]].append(found[2])
    (before, ending), numbers = max(series.items(), key=lambda one: len(one[1]), default=(("", ""), []))
    if len(numbers) < _FEWEST:
        return ""
    digits = min(map(len, numbers))  # zeros lead where numbers of fewer digits have as many places
    place = f"%0{digits}d" if digits > 1 else "%d"
    pattern = f"{folder}/{before}".replace("%", "%%") + place + ending
    first, count = min(map(int, numbers)), len(set(map(int, numbers)))
    if missing := max(map(int, numbers)) - first + 1 - count:
        return f"; between the first and the last of its {count} numbered pictures {missing} are missing, expected none"
    start = f" -start_number {first}" if first else ""
    return (
        f"; of its {len(numbers)} numbered pictures ffmpeg makes a film, at the rate at which they were taken: "
        f"ffmpeg -framerate 25{start} -i {quote(pattern)} film.mkv"
    )
