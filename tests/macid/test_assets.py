import pytest

from macid import assets
from macid.layout import OTHER_LEVELS, VALIDATION_LEVELS


def test_the_root_holds_the_levels():
    assert assets.root().is_dir()
    levels = ["lv1", "lv2", "lv3", "lv4", *VALIDATION_LEVELS, *OTHER_LEVELS]
    assert assets.names("layouts", ".toml") == sorted(levels)
    assert assets.path("layouts", "lv2.toml").is_file()


def test_a_missing_asset_names_its_siblings():
    with pytest.raises(FileNotFoundError, match=r"No asset 'layouts/lv9.toml'.*lv1.toml, lv2.toml, lv3.toml, lv4.toml"):
        assets.path("layouts", "lv9.toml")
    with pytest.raises(FileNotFoundError, match="There are: none"):
        assets.path("layers", "lv1.toml")


def test_a_wheel_carries_its_own_and_an_incomplete_one_says_so(tmp_path, monkeypatch):
    package = tmp_path / "macid"
    package.mkdir()
    monkeypatch.setattr(assets, "__file__", str(package / "assets.py"))
    with pytest.raises(FileNotFoundError, match="incomplete; reinstall"):
        assets.root.__wrapped__()
    (package / "_assets").mkdir()
    assert assets.root.__wrapped__() == package / "_assets"
