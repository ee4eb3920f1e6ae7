import json

import numpy as np
import pytest

from macid import assets
from macid.cli import main
from macid.files import UsageError
from macid.human import figures
from macid.human.measure import Options, interval, measure, summary, table, troupe


def answer(words):
    """The exit code of a command."""
    try:
        return main(words)
    except SystemExit as error:
        return error.code


@pytest.fixture
def recording(tmp_path):
    """A csv of people who cross a square and of one who stands."""
    rng, lines = np.random.default_rng(5), ["id,t,x,y"]
    for who in range(40):
        begin, angle, speed = rng.integers(0, 15), rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 1.6)
        middle = rng.uniform(-3, 3, 2)
        for step in range(20):
            x, y = middle + (step - 10) * 0.4 * speed * np.array([np.cos(angle), np.sin(angle)])
            lines.append(f"{who},{(begin + step) * 0.4:.1f},{x:.4f},{y:.4f}")
    lines += [f"40,{step * 0.4:.1f},8.0,8.0" for step in range(34)]
    path = tmp_path / "square.csv"
    path.write_text("\n".join(lines))
    return path


def test_people_go_through_the_same_code_and_lie_where_they_lay(recording, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["human", "measure", "--pedestrian", str(recording), "--out", str(out)]) == 0
    document = json.loads((out / "measured.json").read_text())
    rows = document["measures"]
    assert document["pedestrian"] == "square"
    assert rows["ADE"]["model"] == rows["FDE"]["model"] == rows["W"]["model"] == 0.0
    assert rows["straightness"]["model"] == pytest.approx(1.0)
    assert rows["exit1.2"]["model"] is None and rows["exit1.2"]["people"] == pytest.approx(1.96, abs=0.01)
    page = (out / "index.html").read_text()
    assert "square" in page and "data:video/webm" in page and page.count("data:image/png") == 4
    assert (out / "film.webm").stat().st_size > 1000
    told = capsys.readouterr().out
    assert "halves apart" in told and "Written to" in told


def test_a_measure_has_its_mean_its_interval_and_what_each_seed_gave():
    values = [{"speed": 1.2, "v2.4": np.nan}, {"speed": 1.4, "v2.4": np.nan}]
    rows = summary(values, {"measures": {}}, figures.shipped())
    assert rows["speed"]["model"] == pytest.approx(1.3) and rows["speed"]["seeds"] == [1.2, 1.4]
    assert (
        rows["speed"]["interval"][0] < 1.2
        and rows["speed"]["people"] == figures.shipped()["measures"]["speed"]["people"]
    )
    assert rows["v2.4"]["model"] is None and rows["v2.4"]["seeds"] == [None, None]
    assert rows["ADE"]["seeds"] == []  # not measured
    assert interval([1.0]) is None and interval([1.0, 1.0]) == (1.0, 1.0)
    assert "1.30" in table({"measures": rows})


def test_a_methods_seeds_are_its_policies_and_a_rules_are_chances():
    assert troupe("macid", 3) == ["macid-0", "macid-1", "macid-2"]
    assert troupe("macid-1", 2) == ["macid-1"] * 2 and troupe("orca", 2) == ["orca"] * 2
    with pytest.raises(UsageError, match="'macid' has 5 policies, not 9"):
        troupe("macid", 9)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--pedestrian", "nobody"], "nobody"),
        (["--pedestrian", "orca", "--radius", "3"], "--radius must be at most 0.5"),
        (["--pedestrian", "orca", "--preferred-speed", "fast"], "argument --preferred-speed: "),
        (["--pedestrian", "orca", "--preferred-speed", "9"], "--preferred-speed: "),
        (["--pedestrian", "orca", "--max-speed", "9"], "--max-speed must be at most 2"),
        (["--pedestrian", "orca", "--lcf", "1", "0"], "--lcf must be a range"),
        (["--pedestrian", "orca", "--lcf", "1", "1", "1"], "--lcf takes one LCF"),
        (["--pedestrian", "orca", "--only", "open"], "--only open needs --data"),
        (["--pedestrian", "orca", "--data", "missing"], "--data: there is no folder or file 'missing'"),
        (["--pedestrian", "missing.csv"], "There is no trajectory file 'missing.csv'"),
        (["--pedestrian", "macid", "--seeds", "77"], "--seeds: 'macid' has 5 policies"),
    ],
)
def test_what_cannot_be_measured_is_one_line_and_writes_nothing(words, reason, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert answer(["human", "measure", *words, "--out", "out"]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert reason in told[-1] and "error" in told[-1]
    assert not (tmp_path / "out").exists()


def test_a_bad_file_is_one_line(tmp_path, capsys):
    (tmp_path / "bad.txt").write_text("0 1 0 0\n10 1 x 0\n")
    assert main(["human", "data", str(tmp_path)]) == 2
    told = capsys.readouterr().err.strip()
    assert told.count("\n") == 0 and "bad.txt', line 2: 'x' is no number" in told


def test_the_shipped_figures_have_every_measure_and_its_source_and_no_walk():
    shipped = figures.shipped()
    assert set(shipped["measures"]) == {each.key for each in figures.MEASURES}
    for row in shipped["measures"].values():
        assert row["people"] is not None and len(row["halves"]) == 2
    assert shipped["command"].startswith("macid human data")
    assert all(each["source"] and each["licence"] for each in shipped["files"])
    assert assets.path("human", "people.json").stat().st_size < 20_000


def test_a_measure_of_one_part_needs_what_it_is_of():
    with pytest.raises(UsageError, match="--only open needs --data"):
        measure("orca", None, Options(only="open"))
