"""Video and sound files: look at one, read its pictures and its sound on one clock, write one."""

from personalize.container import MediaInfo, probe
from personalize.pictures import FrameReader, read_frames
from personalize.sound import AUDIO_RATE, on_video_clock, read_audio, write_wav
from personalize.video_writer import VideoWriter

__all__ = [
    "AUDIO_RATE",
    "FrameReader",
    "MediaInfo",
    "VideoWriter",
    "on_video_clock",
    "probe",
    "read_audio",
    "read_frames",
    "write_wav",
]
