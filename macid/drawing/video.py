"""Pictures and films as files."""

import contextlib
import os
import pathlib
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from macid.files import named, new_file, write_bytes


def pace(speed: float) -> str:
    """The playback's speed in words."""
    return "real time" if abs(speed - 1) < 0.01 else f"played {speed:.3g} times as fast"


def write_png(path: str | os.PathLike[str], picture: np.ndarray) -> pathlib.Path:
    """Saves `picture` as the PNG `path`, all or nothing; returns the path."""
    import cv2

    write_bytes(path, cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
    return pathlib.Path(path)


def write_webm(
    path: str | os.PathLike[str],
    pictures: Generator[np.ndarray, None, None],
    number: int,
    fps: float,
    progress: Callable[[int, int], object] | None = None,
) -> pathlib.Path:
    """Writes the `number` pictures of the generator `pictures`, all of one size, as the VP8 video `path` (.webm), which
    browsers play; returns the path.

    progress(done, number) is called after each frame. The generator is closed in the end.
    Raises OSError where `path` can't be written or the film can't be read back. All or nothing: no half file is left.
    """
    import cv2

    path = pathlib.Path(path)
    if path.suffix.lower() != ".webm":
        raise ValueError(f"A film is a .webm file, not {named(path.name)}.")
    with contextlib.closing(pictures), new_file(path, ".webm") as (_, temporary), _ascii_path(temporary) as file:
        writer, done = cv2.VideoWriter(), 0
        with ThreadPoolExecutor(1) as encoder, _no_warnings():
            try:
                written = None
                for done, picture in enumerate(pictures, start=1):
                    frame = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
                    if written is None:
                        with _silent_stderr():  # FFmpeg remarks that WebM has no such tag: it needs none
                            writer.open(file, cv2.VideoWriter.fourcc(*"VP80"), float(fps), frame.shape[1::-1])
                        if not writer.isOpened():
                            raise OSError("OpenCV can't write VP8 video there")
                    else:
                        written.result()
                    written = encoder.submit(writer.write, frame)  # while the next picture is drawn
                    if progress is not None:
                        progress(done, number)
            finally:
                encoder.shutdown()
                with _silent_stderr():
                    writer.release()
        _check_film(file, done)
    return path


def _check_film(file, number):
    """Raises OSError where not all `number` pictures of a film can be read back, or it does not tell its length."""
    import cv2

    with _silent_stderr():
        video = cv2.VideoCapture(file, cv2.CAP_FFMPEG)
        told, found = video.get(cv2.CAP_PROP_FRAME_COUNT), 0
        while video.grab():
            found += 1
        video.release()
    if found < number:
        raise OSError(f"only {found} of its {number} pictures can be read back, as where a disk is full")
    if told < number:  # it is in what FFmpeg writes last
        raise OSError("its end is missing, as where a disk is full")


@contextlib.contextmanager
def _ascii_path(path):
    """`path` as OpenCV takes it, which fails at names that are not UTF-8: by its folder's handle where need be."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        handle = os.open(path.parent, os.O_RDONLY)
        try:
            yield f"/proc/self/fd/{handle}/{path.name}"
        finally:
            os.close(handle)
    else:
        yield str(path)


@contextlib.contextmanager
def _no_warnings():
    """Lets OpenCV not warn, at each picture that a full disk does not take: `_check_film` tells of it."""
    import cv2

    log = cv2.utils.logging
    level = log.setLogLevel(log.LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        log.setLogLevel(level)


@contextlib.contextmanager
def _silent_stderr():
    """Drops what C code prints on stderr."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
