"""Map images: what is unknown is solid in every form that map_server reads."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from macid.geometry import point_box_distance, rotate
from macid.maps import load_map
from macid.occupancy import solid_cells

UNKNOWN, FREE, WALL = 205, 254, 0
ROW = [WALL, UNKNOWN, FREE, 255]  # of 255
SOLID = [True, True, False, False]
BOTH = pytest.mark.parametrize("free_thresh", [0.196, 0.25])


def read(folder, content, mode="trinary", negate=False, free_thresh=0.196):
    (folder / "floor.image").write_bytes(content)
    return solid_cells(folder / "floor.image", mode, negate, free_thresh)


def png(bits, colour, rows, *chunks):
    """A PNG of `rows` (bytes each), of `bits` a sample and the colour type `colour`, with `chunks` (kind, content)."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    header = struct.pack(">IIBBBBB", len(rows[0]) * 8 // bits // channels, len(rows), bits, colour, 0, 0, 0)
    packed = zlib.compress(b"".join(b"\0" + row for row in rows))
    parts = [(b"IHDR", header), *chunks, (b"IDAT", packed), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


@BOTH
@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("top", [3, 7, 10, 15, 31, 63, 100, 127, 200, 254, 255, 256, 1000, 1023, 4095, 65535])
def test_greymaps_of_every_depth(tmp_path, top, negate, free_thresh):
    levels = [round(level * top / 255) for level in ROW]
    levels = [top - level for level in levels] if negate else levels
    plain = f"P2\n# by hand\n4 1 # size\n{top}\n{' '.join(map(str, levels))}\n".encode()
    raw = f"P5\n# by hand\n4 1\n{top}\n".encode() + np.array(levels, ">u2" if top > 255 else "u1").tobytes()
    for content in (plain, raw):
        assert read(tmp_path, content, "trinary", negate, free_thresh)[0].tolist() == SOLID
        assert read(tmp_path, content, "scale", negate, free_thresh)[0].tolist() == SOLID


@BOTH
@pytest.mark.parametrize("ending", [".png", ".bmp", ".tiff", ".webp", ".jpg"])
def test_pictures_grey_and_coloured(tmp_path, ending, free_thresh):
    picture = np.repeat(np.repeat(np.uint8([ROW]), 16, axis=0), 16, axis=1)
    settings = [cv2.IMWRITE_JPEG_QUALITY, 100] if ending == ".jpg" else []
    for image in (picture, np.dstack([picture] * 3)):
        found = read(tmp_path, bytes(cv2.imencode(ending, image, settings)[1]), free_thresh=free_thresh)
        assert found[8, 8::16].tolist() == SOLID


@BOTH
@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_what_is_transparent_is_unknown(tmp_path, mode, free_thresh):
    white, pale = (0, 4) if mode == "raw" else (255, 250)
    grey = bytes([white, 0, pale, 255, white, 254, white, 255])  # and alpha
    assert read(tmp_path, png(8, 4, [grey]), mode, free_thresh=free_thresh)[0].tolist() == [True, False, True, False]
    colours = bytes([white] * 3 + [0] + [white] * 3 + [255])
    assert read(tmp_path, png(8, 6, [colours]), mode, free_thresh=free_thresh)[0].tolist() == [True, False]
    deep = struct.pack(">8H", *[white * 257] * 3, 0, *[white * 257] * 3, 65535)
    assert read(tmp_path, png(16, 6, [deep]), mode, free_thresh=free_thresh)[0].tolist() == [True, False]
    palette = (b"PLTE", bytes([white] * 3 + [white] * 3))
    clear = (b"tRNS", bytes([0, 255]))
    assert read(tmp_path, png(8, 3, [bytes([0, 1])], palette, clear), mode)[0].tolist() == [True, False]


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_a_transparent_grey_is_unknown_at_any_depth(tmp_path, bits):
    top = (1 << bits) - 1
    row = struct.pack(">H", top) if bits == 16 else bytes([top << (8 - bits)])
    content = [row]
    assert not read(tmp_path, png(bits, 0, content))[0, 0]
    assert read(tmp_path, png(bits, 0, content, (b"tRNS", struct.pack(">H", top))))[0, 0]
    colour = struct.pack(">3H", top, top, top) if bits == 16 else bytes([255] * 3)
    if bits >= 8:
        key = (b"tRNS", struct.pack(">3H", top, top, top))
        assert not read(tmp_path, png(bits, 2, [colour]))[0, 0]
        assert read(tmp_path, png(bits, 2, [colour], key))[0, 0]


def test_a_colour_counts_by_its_mean(tmp_path):
    yellow_and_white = b"P6 2 1 255\n" + bytes([255, 255, 0, 255, 255, 255])  # occupancies 1/3 and 0
    assert read(tmp_path, yellow_and_white)[0].tolist() == [True, False]


def test_bitmaps_are_black_where_set(tmp_path):
    for content in (b"P1\n# c\n3 1\n1 0 1\n", b"P1 3 1\n101", b"P4 3 1\n\xa0"):
        assert read(tmp_path, content)[0].tolist() == [True, False, True]


def test_raw_samples_are_percent_and_above_100_unknown(tmp_path):
    content = b"P5 256 1 255\n" + bytes(range(256))
    for negate in (False, True):
        for free_thresh in (0.196, 0.25):
            free = np.flatnonzero(~read(tmp_path, content, "raw", negate, free_thresh)[0])
            np.testing.assert_array_equal(free, np.arange(int(np.ceil(100 * free_thresh))))
    deep = np.array([0, 100, 255, 20 * 257, 0], ">u2")  # 100 of 65,535 is no percentage
    found = read(tmp_path, b"P5 5 1 65535\n" + deep.tobytes(), "raw", free_thresh=0.25)
    assert found[0].tolist() == [False, True, True, False, False]


@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("free_thresh", [0.05, 0.15, 0.196])
def test_below_the_unknown_grey_the_threshold_is_map_servers(tmp_path, negate, free_thresh):
    levels = np.arange(256)
    occupancy = levels / 255.0 if negate else 1.0 - levels / 255.0
    found = read(tmp_path, b"P5 256 1 255\n" + bytes(range(256)), "trinary", negate, free_thresh)
    np.testing.assert_array_equal(found[0], occupancy >= free_thresh)


def write(folder, picture, name="floor.yaml", **fields):
    cv2.imwrite(str(folder / "floor.pgm"), picture)
    lines = {"image": "floor.pgm", "resolution": 0.5, "origin": "[-3.0, 2.0, 0.0]", "negate": 0, **fields}
    (folder / name).write_text("".join(f"{key}: {value}\n" for key, value in lines.items()))
    return str(folder / name)


@pytest.mark.parametrize("yaw", [0.0, 0.3, np.pi / 2, -2.0, np.pi, 7.0])
@pytest.mark.parametrize("shape", [(12, 12), (8, 20), (20, 6)])
def test_a_turned_map_is_the_map_turned_and_solid_around(tmp_path, yaw, shape):
    rng = np.random.default_rng(0)
    solid = rng.random(shape) < 0.2
    layout = load_map(write(tmp_path, np.where(solid, 0, 254).astype(np.uint8), origin=f"[1.0, 2.0, {yaw}]"))
    rows, columns = shape
    x, y = (np.arange(columns) + 0.5) * 0.5 - columns / 4, (np.arange(rows) + 0.5) * 0.5 - rows / 4
    centres = rotate(np.stack(np.meshgrid(x, y), axis=-1), np.array(yaw))
    covered = (point_box_distance(centres, layout.obstacles) == 0).any(axis=-1)
    np.testing.assert_array_equal(covered, np.flipud(solid))
    places = rng.uniform(-layout.size / 2, layout.size / 2, (2000, 2))
    back = np.abs(rotate(places, np.array(-yaw)))
    outside = (back[:, 0] > columns / 4 + 1e-6) | (back[:, 1] > rows / 4 + 1e-6)
    assert ((point_box_distance(places, layout.obstacles) == 0).any(axis=-1) | ~outside).all()
    corners = np.abs(rotate(np.array([[columns / 4, rows / 4], [columns / 4, -rows / 4]]), np.array(yaw)))
    assert layout.size == pytest.approx(2 * corners.max())


def test_yaml_as_people_write_it(tmp_path):
    picture = np.full((8, 8), 254, np.uint8)
    picture[3, 3] = 205
    plain = load_map(write(tmp_path, picture))
    for name, fields in (
        ("a.yml", {}),
        ("b.yaml", {"resolution": "5e-1", "mode": "trinary", "free_thresh": 0.25}),
        ("c.yaml", {"negate": "false", "mode": "Scale", "cost_translation_table": "{a: 1}"}),
        ("d.yaml", {"image": tmp_path / "floor.pgm", "occupied_thresh": 0.65, "free_thresh": 0.25}),
    ):
        np.testing.assert_array_equal(load_map(write(tmp_path, picture, name, **fields)).obstacles, plain.obstacles)


def test_a_changed_image_is_read_again(tmp_path):
    picture = np.full((8, 8), 254, np.uint8)
    file = write(tmp_path, picture)
    assert len(load_map(file).obstacles) == 0
    cv2.imwrite(str(tmp_path / "floor.pgm"), np.zeros((9, 9), np.uint8))
    assert load_map(file).size == 4.5


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "none of PGM, PNG"),
        (b"P5 4 4 255\n" + bytes(15), "cut"),
        (b"P5 4 4 100\n" + bytes([200] * 16), "from 0 to its greatest value, 100"),
        (b"P2 2 1 255\n3 x", "unmatched data|not all of it"),
        (b"P5 40000 25000 255\n", "40,000 x 25,000 cells"),
        (b"P2 40000 25000 255\n", "40,000 x 25,000 cells"),
        (png(1, 0, [bytes(12500)] * 10)[:16] + struct.pack(">II", 100_000, 10_000) + bytes(50), "PNG|cells"),
        (bytes(cv2.imencode(".jpg", np.full((64, 64), 254, np.uint8))[1])[:-40], "truncated|cut"),
        (bytes(cv2.imencode(".png", np.full((64, 64), 254, np.uint8))[1])[:-40], "truncated|cut|broken"),
    ],
)
def test_an_image_that_cannot_be_read_is_told_with_its_files(tmp_path, content, told):
    (tmp_path / "floor.image").write_bytes(content)
    (tmp_path / "floor.yaml").write_text("image: floor.image\nresolution: 0.1\n")
    with pytest.raises(ValueError, match=f"floor.yaml.*floor.image.*({told})"):
        load_map(str(tmp_path / "floor.yaml"))


@pytest.mark.parametrize("name", [r'"\uDCFF.pgm"', r'"a\0b.pgm"', '"."', '"/dev/zero"', '""', "[1]", "y" * 5000])
def test_odd_names_of_images_are_told(tmp_path, name):
    (tmp_path / "floor.yaml").write_text(f"image: {name}\nresolution: 0.1\n")
    with pytest.raises(ValueError, match="floor.yaml") as caught:
        load_map(str(tmp_path / "floor.yaml"))
    assert "\n" not in str(caught.value)
