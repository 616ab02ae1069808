"""Where frames go: an MP4 or a GIF through ffmpeg, or a folder of PNG files. None of them keeps frames in memory."""

from __future__ import annotations

import contextlib
import importlib.util
import subprocess
import tempfile
from pathlib import Path
from typing import Protocol

from PIL import Image

from switchmt_snn.errors import ConfigError, MissingExtraError, RunFolderError, TrainingFailed
from switchmt_snn.machine.temporary import temporary_beside
from switchmt_snn.runs.files import made, writing

CODERS = {
    ".mp4": (
        *("-c:v", "libx264", "-preset", "veryfast", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart"),
        *("-f", "mp4"),
    ),
    # A palette of its own for each frame, so that no frame waits for the last one's colours.
    ".gif": (
        *("-filter_complex", "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=none"),
        *("-f", "gif"),
    ),
}
"""ffmpeg's options by the file's ending; the format too, because the temporary name has another ending."""


class StopFilm(Exception):
    """Whoever watches has seen enough; what was filmed is kept."""


class Sink(Protocol):
    """Takes frames in order."""

    def add(self, image: Image.Image) -> None:
        """Take a frame."""

    def close(self) -> None:
        """Finish what was written; it then has its name."""

    def discard(self) -> None:
        """Leave nothing."""


class VideoFile:
    """An MP4 or a GIF that ffmpeg writes as frames come; it gets its name when it is whole."""

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        """Start ffmpeg.

        Raises:
            MissingExtraError: the package that brings ffmpeg is not installed.
        """
        self._path = path
        self._temporary = temporary_beside(path)
        self._closing = contextlib.ExitStack()
        self._complaints = self._closing.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        shape = f"{size[0]}x{size[1]}"
        source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", shape, "-r", f"{fps:g}", "-i", "-")
        command = [_ffmpeg(), "-loglevel", "error", "-y", *source, "-an", *CODERS[path.suffix], str(self._temporary)]
        # A session of its own: Ctrl-C ends the play, and the video is then finished here.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=self._complaints, stderr=self._complaints, start_new_session=True
        )

    def add(self, image: Image.Image) -> None:
        """Take a frame.

        Raises:
            TrainingFailed: ffmpeg ended.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(image.tobytes())
        except BrokenPipeError as error:
            raise self._failed() from error

    def close(self) -> None:
        """Finish the file.

        Raises:
            TrainingFailed: ffmpeg failed.
        """
        self._process.communicate()
        if self._process.returncode:
            raise self._failed()
        self._closing.close()
        with writing(self._path):
            self._temporary.replace(self._path)

    def discard(self) -> None:
        """End ffmpeg and remove what it wrote."""
        self._process.kill()
        self._process.communicate()
        self._closing.close()
        self._temporary.unlink(missing_ok=True)

    def _failed(self) -> TrainingFailed:
        self._process.wait()
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").strip().splitlines()
        self._temporary.unlink(missing_ok=True)
        reason = lines[-1] if lines else f"exit code {self._process.returncode}"
        return TrainingFailed(f"ffmpeg could not write {self._path} ({reason:.160}), expected room on the disk")


class FrameFolder:
    """``frame_000000.png`` and so on."""

    def __init__(self, folder: Path) -> None:
        """Make the folder.

        Raises:
            RunFolderError: it holds files, which frames would be mixed with.
        """
        if any(made(folder, "--out").iterdir()):
            raise RunFolderError(
                f"{folder} is not empty, expected a new or empty folder for frames; name another --out"
            )
        self._folder, self._count = folder, 0

    def add(self, image: Image.Image) -> None:
        """Write a frame."""
        path = self._folder / f"frame_{self._count:06}.png"
        self._count += 1
        with writing(path):
            image.save(path, compress_level=3)

    def close(self) -> None:
        """Every frame is on the disk."""

    def discard(self) -> None:
        """Remove the frames."""
        for index in range(self._count):
            (self._folder / f"frame_{index:06}.png").unlink(missing_ok=True)


def check_sink(path: Path) -> None:
    """Refuse an output that cannot be written, before anything is played.

    Raises:
        ConfigError: another ending than .mp4, .gif or none.
        MissingExtraError: ffmpeg is needed and not installed.
        RunFolderError: a folder that holds files, which frames would be mixed with.
    """
    if path.suffix in CODERS:
        _ffmpeg()
        if path.is_dir():
            raise ConfigError(f"--out is {path}, which is a folder, expected the name of a video file")
    elif path.suffix:
        raise ConfigError(
            f"--out is {path}, expected a name that ends in .mp4 or .gif, or without ending: a folder of PNG frames"
        )
    elif path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise RunFolderError(f"{path} is not an empty folder, expected one for frames, or a new name; change --out")


def open_sink(path: Path, size: tuple[int, int], fps: float) -> Sink:
    """A video file or a folder of frames, as the name says (``check_sink``)."""
    if path.suffix not in CODERS:
        return FrameFolder(path)
    made(path.parent, "--out")
    return VideoFile(path, size, fps)


def _ffmpeg() -> str:
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise MissingExtraError(
            "videos need imageio-ffmpeg, which is not installed; run: pip install 'switchmt-snn[video]', or name a "
            "folder with --out, for PNG frames"
        )
    import imageio_ffmpeg

    return str(imageio_ffmpeg.get_ffmpeg_exe())
