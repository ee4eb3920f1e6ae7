"""Occupancy images, as ROS's map_server reads them: which of their cells are solid. Unknown cells are."""

import io
import os
import re
import warnings

import numpy as np

from macid.documents import read_bytes, shown_path
from macid.files import UsageError

MOST_CELLS = 1 << 26  # in an image: 8,192 x 8,192
MOST_BYTES = 1 << 28  # in its file
UNKNOWN = 205  # the grey, of 255, as which map_saver writes what is unknown; ROS 1 frees below an occupancy of 0.196
MODES = ("trinary", "scale", "raw")
_FORMATS = ("PNG", "BMP", "JPEG", "GIF", "TIFF", "WEBP")  # beside the portable ones, P1 to P6
_OPAQUE_MODES = {"1": 1, "L": 255, "I;16": 65535, "I;16L": 65535, "I;16B": 65535}  # Pillow's, and the value of white
_BITS = {"1": 1, "4": 1, "2": 1, "5": 1, "3": 3, "6": 3}  # channels of P1 to P6

# What this module, and Pillow for broken files, raise.
_BROKEN = (ValueError, OSError, SyntaxError, EOFError, LookupError, ArithmeticError, TypeError, AttributeError)


def solid_cells(path: str | os.PathLike[str], mode: str, negate: bool | int, free_thresh: float) -> np.ndarray:
    """Which cells of the image `path` are not known to be free: (rows, columns) bool, the image's lowest row first.

    As map_server has it, a cell's brightness is the mean of red, green and blue, from 0 to 1, and its occupancy is 1
    less the brightness, or the brightness itself with `negate`. A cell is free where the occupancy is below
    `free_thresh`; in the modes "trinary" and "scale" it has to be below the occupancy of the grey UNKNOWN, too, since
    nav2's 0.25 would free cells that map_saver wrote as unknown. In the mode "raw" the sample, of 255, is the occupancy
    in percent, whatever `negate` says, and above 100 unknown. What is transparent, if only in part, is unknown. Raises
    UsageError for a file that is no image, is cut or too large.
    """
    total, top, clear = _brightness(path)
    levels = np.arange(top + 1) / top
    if mode == "raw":
        percent = np.rint(255 * levels)
        exact = np.abs(255 * levels - percent) < 1e-6  # else no 8-bit sample, so nobody knows what it says
        free = exact & (percent <= 100) & (percent / 100 < free_thresh)
    else:
        unknown = min(round(UNKNOWN / 255 * top), top - 1)  # the level that comes closest
        whiteness = np.arange(top + 1)
        free = ((levels if negate else 1.0 - levels) < free_thresh) & (
            (top - whiteness if negate else whiteness) > unknown
        )
    solid = ~free[total]
    if clear is not None:
        solid |= clear
    return np.flipud(solid)


def _brightness(path):
    """The image `path`: the sum of each pixel's colours (rows, columns), white's sum, and which pixels are not fully
    opaque (rows, columns) bool, or None."""
    content = read_bytes(path, "map image", MOST_BYTES)
    try:
        return _portable(content) if re.match(rb"P[1-6]\s|P[1-6]#", content) else _picture(content)
    except UsageError:
        raise
    except _BROKEN as error:
        problem = " ".join(str(error).split()).encode("ascii", "backslashreplace").decode()[:200]
    raise UsageError(f"Can't read the map image {shown_path(path)}: {problem.rstrip('.')}.")


def _check_size(width, height):
    if not (width > 0 and height > 0 and width * height <= MOST_CELLS):
        raise ValueError(f"it has {width:,} x {height:,} cells; 1 to {MOST_CELLS:,} are read")


def _portable(content):
    """A portable bitmap, greymap or pixmap, plain or raw, of any maxval: what `_brightness` returns."""
    kind = chr(content[1])
    numbers, place = [], 2
    while len(numbers) < (2 if kind in "14" else 3):
        found = re.compile(rb"(?:\s|#[^\r\n]*[\r\n])*(\d{1,9})(?=\s|#)").match(content, place)
        if not found:
            raise ValueError(f"the header of a P{kind} file is wanted: width, height and the greatest value")
        numbers.append(int(found[1]))
        place = found.end()
    comment = re.compile(rb"#[^\r\n]*").match(content, place)
    place = (comment.end() if comment else place) + 1  # one white space ends the header
    width, height, top = [*numbers, 1][:3]
    _check_size(width, height)
    if not 1 <= top <= 65535:
        raise ValueError(f"its greatest value must be from 1 to 65535, not {top}")
    channels = _BITS[kind]
    count = width * height * channels
    if kind in "123":
        text = re.sub(rb"#[^\r\n]*", b"", content[place - 1 :])
        if kind == "1":
            samples = np.frombuffer(text, np.uint8)
            samples = samples[(samples == ord("0")) | (samples == ord("1"))] - ord("0")
        else:
            with warnings.catch_warnings():  # NumPy warns of words that are no numbers; the count shows them
                warnings.simplefilter("ignore")
                samples = np.fromstring(text, np.int64, sep=" ")
    elif kind == "4":
        row = (width + 7) // 8
        packed = np.frombuffer(content, np.uint8, offset=place)[: row * height]
        if len(packed) < row * height:
            raise ValueError("it is cut")
        samples = np.unpackbits(packed.reshape(height, row), axis=1)[:, :width].ravel()
    else:
        samples = np.frombuffer(content[place : place + count * (1 + (top > 255))], ">u2" if top > 255 else np.uint8)
    if len(samples) < count:
        raise ValueError(f"it is cut, or not all of it are numbers: {len(samples):,} samples for {count:,}")
    samples = samples[:count].reshape(height, width, channels)
    if kind in "14":
        samples = 1 - samples  # a set bit is black
    if samples.min() < 0 or samples.max() > top:
        raise ValueError(f"its samples must be from 0 to its greatest value, {top}")
    return samples.sum(axis=-1, dtype=np.int32), top * channels, None


def _picture(content):
    """An image in one of _FORMATS: what `_brightness` returns."""
    from PIL import Image, UnidentifiedImageError

    with warnings.catch_warnings():  # Pillow warns of sizes, which are checked here, and of odd metadata
        warnings.simplefilter("ignore")
        try:
            picture = Image.open(io.BytesIO(content), formats=_FORMATS)
        except UnidentifiedImageError:
            raise ValueError(f"it is none of PGM, {', '.join(_FORMATS)}, or it is broken") from None
        except Image.DecompressionBombError:
            raise ValueError(f"it has too many cells; 1 to {MOST_CELLS:,} are read") from None
        _check_size(*picture.size)
        picture.load()
    key, mode = picture.info.get("transparency"), picture.mode
    if mode in _OPAQUE_MODES:
        samples, top = np.asarray(picture).astype(np.int32), _OPAQUE_MODES[mode]
        if key is None:
            return samples, top, None
        bits = content[24] if picture.format == "PNG" else 8  # of the file, in which the transparent grey is said
        key = min(_whole(key), 1) if bits == 1 else _whole(key) * top // ((1 << bits) - 1)
        return samples, top, samples == key
    if mode == "RGB":
        samples = np.asarray(picture)
        if key is not None:
            bits = content[24] if picture.format == "PNG" else 8
            key = (samples == np.array([_whole(each) >> (bits - 8) for each in key])).all(axis=-1)
        return samples.sum(axis=-1, dtype=np.int32), 3 * 255, key
    if mode not in ("P", "PA", "LA", "La", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr"):
        raise ValueError(f"pixels of the sort '{mode}' are not supported: write it as PGM or PNG of 8 or 16 bits")
    samples = np.asarray(picture.convert("RGBA"))
    return samples[..., :3].sum(axis=-1, dtype=np.int32), 3 * 255, samples[..., 3] < 255


def _whole(value):
    if not isinstance(value, int):
        raise ValueError("its transparent colour is no number")
    return value
