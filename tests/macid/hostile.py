"""Files as nobody should write them: valid ones with something changed, for hypothesis."""

import json

from hypothesis import strategies as st

SCALARS = [
    *("0", "-1", "1", "2.5", "1e-12", "1e300", "-1e308", "5e-324", "nan", "-inf", "9223372036854775808"),
    *("1" + 400 * "0", "true", '""', '"x"', '"a\\nb"', '"\\u0000"', '"../x"', f'"{"y" * 5000}"'),
    *("[]", "[1]", "[[]]", "[[1, 2]]", "{}"),
    *("1979-05-27", "0x10", "[" * 3000, "{a = 1}", "[[[[1]]]]", '["l", "l"]', '"orca"', "[1, 2, 3, 4, 5]", "'"),
]
JUNK = [
    *(b"\xff", b"\x00", b"\xed\xb3\xbf", b"\r", b"\n", b'"', b"[", b"]"),
    *(b"=", b"{", b"&a", b"*a", b": ", b"- ", b"#", b"."),
]


@st.composite
def mutated_bytes(draw, content):
    """`content` (bytes) with up to three pieces cut, doubled, swapped or put in."""
    content = bytearray(content)
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(content)))
        end = min(len(content), start + draw(st.integers(0, 40)))
        doubled = bytes(content[start:end]) * 2
        piece = draw(st.one_of(st.sampled_from(JUNK), st.binary(max_size=8), st.just(doubled), st.just(b"")))
        content[start:end] = piece
    return bytes(content)


@st.composite
def mutated_lines(draw, text, sign, values=SCALARS):
    """The document `text`, of lines `key SIGN value`, with some lines' values or keys changed, doubled or left out."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        index = draw(st.integers(0, len(lines) - 1))
        key, found, value = lines[index].partition(sign)
        how = draw(st.integers(0, 5))
        if how < 3 and found:
            lines[index] = f"{key}{sign}{draw(st.sampled_from(values))}"
        elif how == 3:
            lines.insert(draw(st.integers(0, len(lines))), lines[index])
        elif how == 4 and len(lines) > 1:
            del lines[index]
        elif found:
            numbers = value.split(",")
            place = draw(st.integers(0, len(numbers) - 1))
            numbers[place] = draw(st.sampled_from(values))
            lines[index] = f"{key}{sign}{','.join(numbers)}"
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def mutated(text, sign, values=SCALARS):
    """Bytes of the document `text`, mutated in one way or the other."""
    return st.one_of(mutated_lines(text, sign, values), mutated_bytes(text.encode()))


def yaml_scalars():
    """The same as YAML has them."""
    return [
        *SCALARS,
        *("1e-1", "~", '!!int ""', "1:1:1.5", "trinary", "scale", "raw", "yes", ".inf", "[0, 0, 0.3]", "&a [*a]"),
        *(json.dumps("\ud800"), "floor.pgm", "2001-99-99"),
    ]


def refused_in_one_line(load, *arguments):
    """Whether `load(*arguments)` refuses: it must end in success or in a ValueError of one printable line."""
    try:
        load(*arguments)
    except ValueError as error:
        message = str(error)
        assert message and "\n" not in message and "\r" not in message, message
        message.encode("ascii", "backslashreplace").decode("utf-8")
        assert len(message) < 2000
        return True
    return False
