"""Video files in and out."""

from torchface.io.video.video_file import VideoFile, open_video
from torchface.io.video.video_writing import to_bytes, write_video

__all__ = ["VideoFile", "open_video", "to_bytes", "write_video"]
