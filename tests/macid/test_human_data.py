import numpy as np
import pytest

from macid.files import UsageError
from macid.human import data
from macid.human.command import data_files


def walkers(speed=1.2, people=3, samples=20, step=0.4):
    """Rows (id, t, x, y) of people who walk side by side at `speed` [m/s]."""
    return [(p, s * step, speed * s * step, float(p)) for p in range(people) for s in range(samples)]


def written(folder, name, lines):
    path = folder / name
    path.write_text("\n".join(" ".join(f"{each:g}" for each in line) for line in lines) + "\n")
    return path


def speed_of(walks):
    return np.linalg.norm(np.diff(walks.position, axis=0), axis=-1)[~np.isnan(walks.position[1:, :, 0])] / walks.period


def as_eth(rows, frames=6):
    return [(780 + frames * round(t / 0.4), p, x, 0, y, 0, 0, 0) for p, t, x, y in rows]


def as_ucy(rows, frames=10):
    return sorted((frames * round(t / 0.4), p, x, y) for p, t, x, y in rows)


def as_juelich(rows):
    return [(p + 1, round(16 * t), 100 * x, 100 * y, 170.0) for p, t, x, y in rows]


@pytest.mark.parametrize("form", [as_eth, as_ucy, as_juelich])
def test_all_forms_give_metres_and_seconds(form, tmp_path):
    rows = walkers(step=0.25 if form is as_juelich else 0.4)
    walks = data.load(written(tmp_path, "walks.txt", form(rows)))
    assert walks.position.shape[1] == 3
    assert speed_of(walks) == pytest.approx(1.2, abs=1e-3)


def test_a_csv_names_its_columns_in_any_order(tmp_path):
    path = tmp_path / "walks.csv"
    path.write_text("t,id,y,x\n" + "\n".join(f"{t},{p},{y},{x}" for p, t, x, y in walkers()))
    assert speed_of(data.load(path)) == pytest.approx(1.2)


def test_pedpys_comments_say_frames_and_units(tmp_path):
    path = written(tmp_path, "lab.txt", [(p, round(25 * t), x, y, 1.7) for p, t, x, y in walkers()])
    path.write_text("# framerate: 25\n# id frame x/m y/m z/m\n" + path.read_text())
    walks = data.load(path)
    assert walks.frames == 25 and speed_of(walks) == pytest.approx(1.2)


def test_pedpy_reads_the_same(tmp_path):
    pedpy = pytest.importorskip("pedpy")
    path = written(tmp_path, "lab.txt", [(p, round(10 * t), x, y) for p, t, x, y in walkers()])
    path.write_text("# framerate: 10\n# id frame x/m y/m\n" + path.read_text())
    theirs = pedpy.load_trajectory_from_txt(trajectory_file=path)
    single = pedpy.SpeedCalculation.BORDER_SINGLE_SIDED
    speeds = pedpy.compute_individual_speed(traj_data=theirs, frame_step=4, speed_calculation=single)
    assert speeds["speed"].to_numpy() == pytest.approx(speed_of(data.load(path)).mean())


def test_a_lab_file_says_its_corridor_by_its_name(tmp_path):
    walks = data.load(written(tmp_path, "uo-240-240-100_combined.txt", as_juelich(walkers(step=0.25))))
    assert walks.scene == "one way" and walks.source.place == data.Bottleneck(2.4, 1.0, -4.0, 4.0)
    assert "SHA-256 is not known" in walks.source.title
    walks = data.load(written(tmp_path, "bo-360-120-120.txt", as_juelich(walkers(step=0.25))))
    assert walks.scene == "two ways" and walks.source.place.width == 3.6


def test_annotators_clocks_are_put_on_one_grid(tmp_path):
    rows = [(780 + 6 * s + 3 * p, p, 0.48 * s, 0, p, 0, 0, 0) for p in range(2) for s in range(9)]
    walks = data.load(written(tmp_path, "eth.txt", rows))
    both = ~np.isnan(walks.position[..., 0]).any(axis=1)
    assert both.sum() == 8
    assert (walks.position[both, 0, 0] - walks.position[both, 1, 0]) == pytest.approx(0.24)


def test_who_comes_back_is_another(tmp_path):
    rows = [(p, t, x, y) for p, t, x, y in walkers(samples=40) if not 4.0 < t < 8.0]
    assert data.load(written(tmp_path, "ucy.txt", as_ucy(rows))).position.shape[1] == 6


def test_eth_with_ten_frames_a_step_is_refused_by_name(tmp_path):
    path = written(tmp_path, "biwi.txt", as_ucy(walkers(speed=1.5), frames=6))
    with pytest.raises(UsageError, match=r"2\.50 m/s.*BIWI ETH with 10 frames as 0\.4 s"):
        data.load(path)


@pytest.mark.parametrize(
    ("change", "line", "reason"),
    [
        (lambda lines: [*lines[:4], "0 1 2", *lines[5:]], 5, "3 columns"),
        (lambda lines: [*lines[:6], "70 0 1.0 word", *lines[7:]], 7, "'word' is no number"),
        (lambda lines: [*lines[:6], "70 0 nan 1.0", *lines[7:]], 7, "not finite"),
        (lambda lines: [*lines[:6], "70.5 0 1.0 1.0", *lines[7:]], 7, "no whole number"),
        (lambda lines: [*lines, lines[3]], 61, "second sample of one time"),
        (lambda lines: [*lines[:6], "20 0 90.0 1.0", *lines[7:]], 7, "walks"),
    ],
)
def test_a_bad_line_is_named(change, line, reason, tmp_path):
    path = written(tmp_path, "bad.txt", as_ucy(walkers()))
    path.write_text("\n".join(change(path.read_text().splitlines())))
    with pytest.raises(UsageError, match=f"bad.txt', line {line}: .*{reason}") as caught:
        data.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "no samples"),
        (b"id,t,x,y\n", "no samples"),
        (b"\xff\xfe\x00", "no text"),
        (b"1 2 3\n1 3 4\n", "3 columns"),
        (b"0 1 2 3\n10 2 3 4\n", "nobody has two samples"),
        (b"0 1 0 0\n10 1 0 0.01\n20 1 0 0.02\n", r"0\.02 m/s"),
        (b"0 1 0 0\n10 1 48 0\n20 1 96 0\n", "centimetres"),
    ],
)
def test_what_holds_no_walks_is_refused(content, reason, tmp_path):
    path = tmp_path / "bad.txt"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=reason):
        data.load(path)


def test_a_folder_is_told_file_by_file_until_a_bad_one(tmp_path):
    written(tmp_path, "a.txt", as_ucy(walkers()))
    written(tmp_path, "b.txt", as_juelich(walkers(step=0.25)))
    told = []
    assert [walks.name for walks in data_files(tmp_path, show=told.append)] == ["a", "b"]
    assert "3 people" in told[0] and "25 frames/s" in told[0] and "not a known file" in told[0]
    (tmp_path / "c.txt").write_text("nothing")
    with pytest.raises(UsageError, match="c.txt"):
        data_files(tmp_path, show=told.append)
    with pytest.raises(UsageError, match="no folder or file"):
        data.files(tmp_path / "missing")
