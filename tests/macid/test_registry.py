"""Every kind of name is resolved in one way: a built-in, somebody's own by module or file, a data file; errors name the
choices."""

import pathlib

import jax
import jax.numpy as jnp
import pytest

from macid.files import UsageError
from macid.pedestrians import make_controller
from macid.registry import Failed, Kind, code_file

OWN = """
import helper_beside
def double(x):
    return 2 * x
value = helper_beside.value
"""


def callable_only(found, name):
    if not callable(found):
        raise UsageError(f"Doubler '{name}' is not callable.")
    return found


DOUBLER = Kind(
    "doubler",
    {"twice": "operator:add", "mine": len},
    shipped=lambda: ["shipped-0"],
    read=lambda name: f"read {name}",
    files=(".npz", ".json"),
    own="function",
    attribute="double",
    check=callable_only,
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "own_doubler.py").write_text(OWN)
    (tmp_path / "helper_beside.py").write_text("value = 3")
    (tmp_path / "bad_doubler.py").write_text("\n\nraise RuntimeError('no luck')")
    (tmp_path / "quits.py").write_text("exit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_built_in_shipped_and_own_names_give_what_they_name(folder):
    import operator

    assert DOUBLER.names() == ["twice", "mine", "shipped-0"]
    assert DOUBLER.load("twice") is operator.add and DOUBLER.load("mine") is len
    assert DOUBLER.load("shipped-0") == "read shipped-0" and DOUBLER.load("a/b.json") == "read a/b.json"
    for name in ("own_doubler.py", "own_doubler.py:double", "own_doubler:double", str(folder / "own_doubler.py")):
        assert DOUBLER.load(name)(21) == 42


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("thrice", "Unknown doubler 'thrice'. Choose one of twice, mine, shipped-0, a 'module:function', a file "),
        (3, "Unknown doubler 3. Choose"),
        ("nobody.py", "Doubler 'nobody.py': there is no file 'nobody.py'. Choose one of"),
        ("nobody_there:x", "can't import 'nobody_there' .No module named 'nobody_there'.. Choose one of"),
        ("a b:c", "'a b' is no module's name"),
        ("own_doubler.py:tripple", "no 'tripple' there. There are: double."),
        ("own_doubler.py:value", "is not callable"),
        ("bad_doubler.py", "running 'bad_doubler.py' raised RuntimeError: no luck in .*bad_doubler.py, line 3"),
        ("bad_doubler:double", "importing 'bad_doubler' raised RuntimeError: no luck in .*bad_doubler.py, line 3"),
        ("quits.py", "running 'quits.py' called exit.3."),
    ],
)
def test_what_names_nothing_is_told_in_one_line(name, told, folder):
    with pytest.raises(UsageError, match=told) as caught:
        DOUBLER.load(name)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, Failed) == ("raised" in told or "called" in told)


def test_a_kind_of_data_files_alone_takes_no_code(folder):
    kind = Kind("map", shipped=lambda: ["hall"], read=pathlib.Path, files=(".toml", ".yaml"))
    assert kind.help == "Choose one of hall, or a .toml or .yaml file."
    assert kind.load("x.yaml") == pathlib.Path("x.yaml")
    for name in ("own_doubler.py", "own_doubler:double", "attic"):
        with pytest.raises(UsageError, match=f"Unknown map '{name}'. Choose one of hall, or a .toml or .yaml file."):
            kind.load(name)


def test_two_files_of_one_name_are_two(folder):
    (folder / "other").mkdir()
    (folder / "other" / "own_doubler.py").write_text("def double(x):\n    return 3 * x")
    first, second = DOUBLER.load("own_doubler.py"), DOUBLER.load("other/own_doubler.py")
    assert (first(1), second(1)) == (2, 3)
    assert [code_file(name).parent.name for name in ("own_doubler.py", "other/own_doubler.py")][1] == "other"
    assert code_file("own_doubler.py").read_text() == OWN


def test_a_pedestrian_model_that_jax_cannot_trace_or_that_gives_another_shape_is_told_in_one_line(tmp_path):
    (tmp_path / "own_people.py").write_text(
        "import numpy as np\nimport jax.numpy as jnp\n"
        "def by_numpy(state, boxes, goals, lcf):\n"
        "    return np.concatenate([np.asarray(goals), np.asarray(lcf)[..., None]], -1)\n"
        "def flat(state, boxes, goals, lcf):\n    return goals\n"
        "def right(state, boxes, goals, lcf):\n    return jnp.concatenate([goals, lcf[..., None]], -1)\n"
    )
    goals, lcf = jnp.ones((2, 4, 2)), jnp.zeros((2, 4))
    for name, told in (("by_numpy", "is written with jax.numpy"), ("flat", r"gives commands of shape \(2, 4, 2\)")):
        controller = make_controller(f"{tmp_path / 'own_people.py'}:{name}", 0.1)
        with pytest.raises(UsageError, match=told) as error:
            jax.jit(lambda goals, lcf, controller=controller: controller(None, None, goals, lcf))(goals, lcf)
        assert "\n" not in str(error.value)
    right = make_controller(f"{tmp_path / 'own_people.py'}:right", 0.1)
    assert jax.jit(lambda goals, lcf: right(None, None, goals, lcf))(goals, lcf).shape == (2, 4, 3)
