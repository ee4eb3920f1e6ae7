from typing import Annotated, Literal

import msgspec
import pytest
from msgspec import Meta

from macid.documents import convert, parse, read_bytes, shown, shown_path
from macid.files import UsageError


class Mount(msgspec.Struct, forbid_unknown_fields=True):
    position: Annotated[list[float], Meta(min_length=3, max_length=3)]


class Thing(msgspec.Struct, forbid_unknown_fields=True):
    size: Annotated[float, Meta(gt=0, le=5)]
    count: Annotated[int, Meta(ge=0)] = 0
    kind: Literal["a", "b"] = "a"
    rows: list[tuple[float, float]] = []
    mounts: dict[str, Mount] = {}
    either: float | list[float] | None = None
    said: Annotated[list[int], Meta(description="a list of odd numbers")] = []


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"size": -1}, "'size': it must be a number above 0 and of at most 5, not -1"),
        ({"size": 6}, "'size': it must be a number above 0 and of at most 5, not 6"),
        ({"size": "big"}, "'size': it must be a number above 0 and of at most 5, not 'big'"),
        ({"count": 1.5}, "'count': it must be a whole number of at least 0, not 1.5"),
        ({"kind": "c"}, "'kind': it must be one of a, b, not 'c'"),
        ({"rows": [[1, 2], [1]]}, "'rows[1]': it must be a list of 2, not [1]"),
        ({"rows": [[1, "x"]]}, "'rows[0][1]': it must be a number, not 'x'"),
        (
            {"mounts": {"a": {"position": [1, 2, 3]}, "b": {"position": [1]}}},
            "'mounts.b.position': it must be a list of 3, not [1]",
        ),
        ({"mounts": {"b": {"at": [1]}}}, "'mounts.b': unknown key 'at'. Choose among position"),
        ({"mounts": {"b": {}}}, "'mounts.b': missing 'position'"),
        ({"either": "x"}, "'either': it must be a number or a list, not 'x'"),
        ({"said": 3}, "'said': it must be a list of odd numbers, not 3"),
        ({"said": [3, "x"]}, "'said[1]': it must be a whole number, not 'x' (a list of odd numbers)"),
        ({"thing": 1}, ": unknown key 'thing'. Choose among size, count, kind"),
        ({"size": float("nan")}, "'size': a number from"),
        ({"count": 10**400}, "'count': a whole number of 64 bits"),
    ],
)
def test_an_error_names_the_key_the_value_and_what_is_allowed(changes, told):
    with pytest.raises(UsageError) as caught:
        convert({"size": 1.0, **changes}, Thing, "thing 'x'")
    assert told in str(caught.value) and str(caught.value).startswith("thing 'x'")


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.toml", ".".join(["a"] * 200_000) + " = 1", "more than 64 parts"),
        ("a.toml", '"a=,".' * 100_000 + "b = 1", "more than 64 parts"),
        ("a.toml", "x = {" + "a . " * 100 + "b = 1}", "more than 64 parts"),
        ("a.toml", "x = " + "[" * 3000, "nested too deeply"),
        ("a.yaml", "x: " + "[" * 3000, "nested too deeply"),
        ("a.json", "[" * 100_000, "nested too deeply"),
        ("a.yaml", "a: &a [1]\nb: *a", "aliases"),
        ("a.yaml", "a: 1\na: 2", "'a' stands twice"),
        ("a.json", '{"a": 1, "a": 2}', "'a' stands twice"),
        ("a.toml", "a = 1\na = 2", "is not TOML"),
        ("a.yaml", 'a: !!int ""', "is not YAML"),
        ("a.yaml", "a: " + "1:" * 300 + "1.5", "is not YAML"),
    ],
)
def test_what_would_hang_or_raise_something_else_is_told_in_one_line(name, text, told):
    with pytest.raises(UsageError, match=told) as caught:
        parse(name, "thing", text.encode())
    assert "\n" not in str(caught.value)


def test_numbers_with_points_are_no_keys():
    numbers = ", ".join(f"{number}.5" for number in range(2000))
    assert len(parse("a.toml", "thing", f"x = [{numbers}]\n".encode())["x"]) == 2000
    assert parse("a.yaml", "thing", b"x: 1e-1") == {"x": 0.1}


def test_a_long_path_keeps_its_end_and_a_long_value_its_beginning():
    assert shown_path("/a/" + 300 * "b" + "/end.toml").endswith("b/end.toml'") and len(shown_path(300 * "b")) <= 120
    assert shown_path("\udcff.pgm") == r"'\udcff.pgm'"
    assert shown(1000 * "x").startswith("'xxx") and len(shown(1000 * "x")) <= 60
    deep = []
    for _ in range(5000):
        deep = [deep]
    assert len(shown(deep)) <= 60


def test_what_is_no_file_is_told(tmp_path):
    (tmp_path / "large").write_bytes(bytes(11))
    for name, told in (
        ("large", "11 bytes; at most 10"),
        ("none", "no thing file"),
        ("", "no regular file"),
        ("\0", "thing"),
    ):
        with pytest.raises(UsageError, match=told):
            read_bytes(tmp_path / name, "thing", 10)
