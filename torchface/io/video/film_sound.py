"""The sound of a film, copied into another film packet by packet, not coded anew."""

from collections.abc import Iterator
from pathlib import Path
from shlex import quote
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

import numpy as np

from torchface.io.video.video_packets import open_container, packets_of, pyav, read_packets

if TYPE_CHECKING:
    from av.audio.stream import AudioStream
    from av.container import InputContainer, OutputContainer
    from av.packet import Packet

_ASTRAY = 0.03  # seconds between pictures and sound that nobody notices


def sound_codec(film: Path) -> str:
    """FFmpeg's name of the codec of a film's sound; empty where it has none."""
    with open_container(film) as (container, _):
        sound = _sound_of(container)
        return "" if sound is None else sound.codec_context.codec.canonical_name


def sound_line(film: Path, written: Path) -> list[str]:
    """A line for people where a written film lacks the sound of the film that it was made from."""
    codec = sound_codec(film)
    if not codec or sound_codec(written):
        return []
    with open_container(film) as (container, _):
        seconds = _first_frame(film) - (container.start_time or 0) / pyav().time_base
    sought = f"-ss {seconds:.3f} " if seconds > _ASTRAY else ""  # FFmpeg counts from where the first stream begins
    named, source = quote(str(written)), quote(str(film))
    made = quote(str(written.with_name(f"{written.stem}_sound{written.suffix}")))
    return [
        f"sound: {written.suffix} cannot hold {film.name}'s ({codec}) as it is, it is left out; to add it anew coded: "
        f"ffmpeg -i {named} {sought}-i {source} -map 0:v -map 1:a -c:v copy -af aresample=async=1:first_pts=0 {made}"
    ]


def add_sound(film: Path, target: "OutputContainer") -> Iterator[tuple[float, "Packet"]]:
    """Adds a stream for a film's sound, if it has some that the target can hold; gives its packets for it.

    Each comes with the time at which it is heard, seconds from the film's first frame; what is over before that frame
    is left out.
    """
    if sound_codec(film) not in target.supported_codecs:
        return iter(())
    begin = _first_frame(film)
    return _added(film, begin, target) if _can_hold(film, begin, target) else iter(())


def _can_hold(film: Path, begin: float, target: "OutputContainer") -> bool:
    """Whether a film's sound can be written into a file as the target, at its times: writes it into one without a name.

    A codec may be held in some forms alone, and AVI holds no times: its sound begins with its pictures.
    """
    av, name, last = pyav(), target.format.name, 0.0
    try:
        with TemporaryFile(dir=Path(target.name).parent) as file:
            with av.open(file, "w", format=name) as tried:
                for seconds, packet in _added(film, begin, tried):
                    last = seconds
                    tried.mux(packet)
            if name != "avi":
                return True
            file.seek(0)
            with av.open(file, "r", format=name) as written:
                times = [float(packet.pts * packet.time_base) for packet in written.demux(audio=0) if packet.size]
            return bool(times) and abs(times[-1] - last) < _ASTRAY
    except (av.FFmpegError, ValueError, OSError):
        return False


def _added(film: Path, begin: float, target: "OutputContainer") -> Iterator[tuple[float, "Packet"]]:
    avi = target.format.name == "avi"
    with open_container(film) as (container, _):
        template = _sound_of(container)
        assert template is not None
        stream = target.add_stream_from_template(template)
        if template.layout.name.endswith(" channels"):  # none is named, as in AVI: the usual one of so many
            stream.layout = f"{template.layout.nb_channels}c"

    def packets() -> Iterator[tuple[float, "Packet"]]:
        with open_container(film) as (container, _):
            for packet in packets_of(container, _sound_of(container), []):
                if packet is None or packet.pts is None:
                    continue
                shift = round(begin / packet.time_base)
                packet.pts -= shift
                packet.dts = packet.pts
                # AVI would show the pictures later, by what of the sound comes before the first one.
                if packet.pts >= 0 if avi else packet.pts + (packet.duration or 0) > 0:
                    packet.stream = stream
                    yield float(packet.pts * packet.time_base), packet

    return packets()


def _first_frame(film: Path) -> float:
    """When a film's first frame is shown, seconds; 0 where it does not say."""
    seconds = read_packets(film).seconds
    return float(seconds[0]) if len(seconds) and np.isfinite(seconds[0]) else 0.0


def _sound_of(container: "InputContainer") -> "AudioStream | None":
    found = container.streams.best("audio")
    return found if isinstance(found, pyav().AudioStream) and found.codec_context is not None else None
