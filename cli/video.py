"""Write films: MP4 files, and GIF or WebP files that play by themselves in a page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from tempfile import TemporaryFile

import numpy as np

from ..files.writing import replacing
from .errors import UserError

VIDEO_ENDINGS = (".mp4",)
CLIP_ENDINGS = (".gif", ".webp")
_OPTION_OF = {**dict.fromkeys(VIDEO_ENDINGS, "--out"), **dict.fromkeys(CLIP_ENDINGS, "--gif")}
"""Option of ``play`` by the ending of its file."""
_PALETTE = "split[a][b];[a]palettegen=max_colors=96:stats_mode=full[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
_CODECS: dict[str, tuple[str, str, list[str]]] = {
    ".mp4": ("libx264", "yuv420p", ["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"]),
    ".gif": ("gif", "pal8", ["-filter_complex", _PALETTE, "-loop", "0"]),
    ".webp": ("libwebp_anim", "yuv420p", ["-q:v", "55", "-compression_level", "3", "-loop", "0"]),
}
"""Codec, format of the pixels and options of ffmpeg by the file's ending."""


def check_film_path(path: Path, option: str, endings: tuple[str, ...]) -> None:
    """Refuse the name of a film that cannot be written. Raises UserError: the folder does not exist, or the name has another ending."""
    if path.suffix.lower() not in endings:
        other = _OPTION_OF.get(path.suffix.lower())
        hint = f", or write {other} {path}" if other else ""
        raise UserError(f"{option} is '{path}'; give a name that ends in {' or '.join(endings)}{hint}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"folder '{path.parent}' of {option} does not exist; create it first")


@contextmanager
def film(path: Path, *, fps: float, size: tuple[int, int]) -> Iterator[Callable[[np.ndarray], None]]:
    """Write pictures to a file in the format that its ending names; the file gets its name when it is whole.

    Args:
        path: checked by ``check_film_path``.
        fps: pictures a second.
        size: width and height [pixels].

    Yields:
        A function that adds a picture (height, width, 3) uint8, and raises ``UserError`` where it cannot be written.
    """
    import imageio_ffmpeg

    codec, pixels, options = _CODECS[path.suffix.lower()]
    with replacing(path, UserError, ending=path.suffix) as partial, TemporaryFile() as complaints:
        pictures = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "{}x{}".format(*size), "-r", f"{fps:g}", "-i", "-"]
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *pictures, "-an", "-c:v", codec]
        # A session of its own: Ctrl-C in the terminal reaches this command, which ends the film.
        command += ["-pix_fmt", pixels, *options, str(partial)]
        encoder = Popen(command, stdin=PIPE, stdout=DEVNULL, stderr=complaints, start_new_session=True)
        assert encoder.stdin is not None
        sent = encoder.stdin

        def failure() -> UserError:
            code = encoder.wait()
            complaints.seek(0)
            said = " ".join(complaints.read().decode(errors="replace").split())
            return UserError(f"cannot write '{path}': {said[-200:] or f'ffmpeg ended with exit code {code}'}")

        def add(picture: np.ndarray) -> None:
            try:
                sent.write(np.ascontiguousarray(picture).data)
            except OSError as error:
                raise failure() from error

        try:
            yield add
            with suppress(OSError):  # ended by itself; the failure follows
                sent.close()
            if encoder.wait():
                raise failure()
        finally:
            encoder.kill()
            encoder.wait()
            with suppress(OSError):
                sent.close()
