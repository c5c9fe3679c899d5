"""The sound of a film, copied into another film packet by packet, not coded anew."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchface.io.video.video_packets import open_container, packets_of, pyav, read_packets

if TYPE_CHECKING:
    from av.audio.stream import AudioStream
    from av.container import InputContainer, OutputContainer
    from av.packet import Packet


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
    return [
        f"sound: {written.suffix} cannot hold {film.name}'s ({codec}), it is left out; to add it anew coded: "
        f"ffmpeg -i {written.name} -i {film.name} -map 0:v -map 1:a -c:v copy {written.stem}_sound{written.suffix}"
    ]


def add_sound(film: Path, target: "OutputContainer") -> Iterator[tuple[float, "Packet"]]:
    """Adds a stream for a film's sound, if it has some that the target can hold; gives its packets for it.

    Each comes with the time at which it is heard, seconds from the film's first frame; what is over before that frame
    is left out.
    """
    codec = sound_codec(film)
    if codec not in target.supported_codecs:
        return iter(())
    seconds = read_packets(film).seconds
    begin = float(seconds[0]) if len(seconds) and np.isfinite(seconds[0]) else 0.0
    with open_container(film) as (container, _):
        template = _sound_of(container)
        assert template is not None
        stream = target.add_stream_from_template(template)

    def packets() -> Iterator[tuple[float, "Packet"]]:
        with open_container(film) as (container, _):
            for packet in packets_of(container, _sound_of(container), []):
                if packet is None or packet.pts is None:
                    continue
                shift = round(begin / packet.time_base)
                packet.pts -= shift
                packet.dts = packet.pts
                if packet.pts + (packet.duration or 0) > 0:
                    packet.stream = stream
                    yield float(packet.pts * packet.time_base), packet

    return packets()


def _sound_of(container: "InputContainer") -> "AudioStream | None":
    found = container.streams.best("audio")
    return found if isinstance(found, pyav().AudioStream) and found.codec_context is not None else None
