"""Live pages: the crowd behind one, the server, and the pages themselves in a real browser."""

import dataclasses
import http.client
import socket
import sys
import threading
import time

import mujoco
import numpy as np
import pytest
from browser import Browser, chromium, until

from macid import benchmark, cli, watch
from macid.crowd import CrowdConfig
from macid.layout import load_level
from macid.live.crowd import CrowdPage, CrowdSetting, LiveCrowd
from macid.live.page import between
from macid.live.server import Server, is_loopback
from macid.live.shapes import geom_rgba
from macid.scene import PERSON_RGBA, WALL_RGBA, crowd_spec


@pytest.fixture(scope="module")
def crowd():
    """The learned crowd of level 1; making one takes long, as it is compiled."""
    return LiveCrowd(CrowdSetting("macid", 1, stay=False), 0)


def test_a_crowd_that_nobody_touches_walks_as_it_is_evaluated(crowd):
    recorded = watch.record("macid", 1, CrowdConfig(duration=0.4, lcf=(0.67, 1.33)), 3)
    crowd.reset(3)
    path = [crowd.qpos()]
    for _ in range(4):
        path += list(crowd.tick()[1:])
    walked = np.array(path).reshape(len(path), -1, 3)
    assert len(walked) == len(recorded.position) == 21
    np.testing.assert_array_equal(walked[..., :2].astype(np.float32), recorded.position)
    np.testing.assert_array_equal(walked[..., 2].astype(np.float32), recorded.yaw)
    np.testing.assert_allclose(crowd.lcf, recorded.lcf, rtol=1e-6)
    assert crowd.time == pytest.approx(0.4) and crowd.collisions.tolist() == recorded.collisions[-1].tolist()


def test_the_knob_is_the_lcf_that_people_walk_by(crowd):
    def walk(*turns):
        crowd.reset(5)
        for turn in turns:
            turn()
        crowd.tick()
        return crowd.qpos().reshape(-1, 3)

    untouched, drawn = walk(), crowd.lcf.copy()
    hostile = walk(lambda: crowd.set_lcf(-2.0))
    assert (hostile != untouched).any(axis=1).mean() > 0.9 and (crowd.lcf == -2.0).all()
    np.testing.assert_array_equal(walk(lambda: crowd.set_lcf(-2.0), crowd.draw_lcf), untouched)
    np.testing.assert_array_equal(walk(lambda: crowd.set_lcf(drawn)), untouched)
    one = walk(lambda: crowd.set_lcf(-2.0, person=4))
    assert crowd.lcf[4] == -2.0 and (np.delete(crowd.lcf, 4) == np.delete(drawn, 4)).all()
    np.testing.assert_array_equal(one[4], hostile[4])  # too far from the others to meet their changes in 0.1 s


@pytest.mark.parametrize("stay", [True, False])
def test_who_arrives_walks_on_or_leaves(crowd, stay):
    crowd.reset(2)
    crowd.setting = dataclasses.replace(crowd.setting, stay=stay)
    number = len(crowd.lcf)
    while not crowd.reached and crowd.time < 30:
        before, path = crowd.goals(), crowd.tick()
    who = np.flatnonzero((crowd.goals() != before).any(axis=1)) if stay else np.flatnonzero(~crowd.here())
    assert crowd.reached == len(who) == 1 and crowd.here().sum() == (number if stay else number - 1)
    place = path.reshape(len(path), number, 3)[-1, who[0], :2]
    assert np.linalg.norm(place - before[who[0]]) < 0.7  # where it arrived, not where those are who have left
    if stay:
        crowd.tick()
        assert np.linalg.norm(crowd.qpos().reshape(-1, 3)[who[0], :2] - place) < 0.3
        assert np.linalg.norm(crowd.goals()[who[0]] - place) > 7


def test_a_picture_between_two_decisions_is_between_their_places():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.add_geom(size=[0.1, 0, 0])
    spec.worldbody.add_body().add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
    spec.bodies[-1].add_geom(size=[0.1, 0, 0])
    model = spec.compile()
    turned = np.array([np.cos(0.4), 0, 0, np.sin(0.4)])  # by 0.8 rad
    path = np.array([[0, 0, 0, 1, 0, 0, 0, 1.0], [2, 0, 0, *turned, 3.0], [2, 4, 0, *turned, 3.0]])
    for step, share in ((0, 0.0), (1, 0.5), (2, 1.0)):
        np.testing.assert_array_equal(between(model, path, share), path[step])
    np.testing.assert_allclose(between(model, path, 0.25), [1, 0, 0, np.cos(0.2), 0, 0, np.sin(0.2), 2.0], atol=1e-12)


def test_shapes_have_the_colours_that_mujoco_draws():
    model = crowd_spec(load_level(1), 2).compile()
    rgba = geom_rgba(model)
    scene = mujoco.MjvScene(model, 1000)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, scene)
    drawn = {geom.objid: geom.rgba for geom in scene.geoms[: scene.ngeom] if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM}
    assert len(drawn) > 6
    for geom, colour in drawn.items():
        np.testing.assert_allclose(rgba[geom], colour, atol=1e-6)
    np.testing.assert_allclose(rgba[model.geom("box0").id], WALL_RGBA)
    np.testing.assert_allclose(rgba[model.geom("person0/cylinder").id], PERSON_RGBA)


# The server.


@pytest.fixture
def served():
    """A function that makes a Server on a free port, closed in the end."""
    made = []

    def serve(make_page=lambda client: None, **more):
        made.append(Server(make_page, "title & all", **{"port": 0, **more}))
        return made[-1]

    before = {thread.name for thread in threading.enumerate()}
    yield serve
    for server in made:
        server.close()
        server.close()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", server.port))
    until(lambda: not any("live" in t.name for t in threading.enumerate() if t.name not in before), 5)


def get(server, path="/", **headers):
    """(status, headers, text) of a request."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, dict(answer.getheaders()), text


UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}


def test_the_page_is_whole_and_hears_keys(served):
    status, _, text = get(served())
    assert status == 200 and "<title>title &amp; all</title>" in text and "/keys/" in text
    assert get(served(), "/other")[0] == 404


def test_nobody_comes_in_without_the_token(served, capfd):
    server = served(token="a secret word", host="0.0.0.0")
    assert server.url.endswith("/?token=a%20secret%20word")
    for path in ("/", "/?token=", "/?token=another+one", "/keys/x"):
        assert get(server, path)[0] == 403
        assert get(server, path, **UPGRADE)[0] == 403
    status, headers, _ = get(server, "/?token=a%20secret%20word")
    assert status == 302 and headers["Location"] == "/" and "HttpOnly" in headers["Set-Cookie"]
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert get(server, Cookie=cookie)[0] == 200
    host = f"127.0.0.1:{server.port}"
    assert get(server, Cookie=cookie, Origin="http://elsewhere.example", **UPGRADE)[0] == 403
    assert get(server, Cookie=cookie, Origin=f"http://{host}", **UPGRADE)[0] == 101
    assert capfd.readouterr().out == ""  # viser tells of its own port, which is not the one to open


def test_without_a_token_only_this_machine_is_let_in(served):
    server = served()
    assert get(server, Host=f"localhost:{server.port}")[0] == 200
    assert get(server, Host="elsewhere.example")[0] == 403  # a name that somebody led to this machine
    assert get(server, Origin="http://elsewhere.example", **UPGRADE)[0] == 403
    assert [is_loopback(host) for host in ("127.0.0.1", "localhost", "::1", "0.0.0.0", "10.0.0.1", "host")] == [
        True, True, True, False, False, False,
    ]  # fmt: skip


BAD = {
    "--host 0.0.0.0": "--host 0.0.0.0 lets other machines in: give a --token",
    "--token short": "--token must have at least 8 characters, all ASCII, not 'short'",
    "--port 70000": "--port must be at most 65535, not 70000",
    "--host nowhere.invalid --token longenough": "Can't listen on port 8080 of 'nowhere.invalid'",
    "--level 9": "Unknown level 9. Choose one of 1, 2",
    "--pedestrian nobody": "Unknown pedestrian model 'nobody'. Choose one of",
    "--lcf 2 1": "lcf must be a range (least, most) in [-2, 2], not (2.0, 1.0)",
    "--people 9000": "--people must be at most 500, not 9000",
    "--period 0.03": "period must be a multiple of the physics step 0.02 s, not 0.03",
}


@pytest.mark.parametrize("words", BAD)
def test_bad_input_is_one_line(words, capsys):
    assert cli.main(["live", *words.split()]) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1 and BAD[words] in told.err


def test_a_port_in_use_is_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert cli.main(["live", "--port", str(port)]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert (
        told.err == f"macid: error: Port {port} of 127.0.0.1 is in use. Choose another --port, or 0 for any free one.\n"
    )


def test_a_missing_extra_is_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main(["live"]) == 2
    assert capsys.readouterr().err == "macid: error: A live page needs viser: pip install 'bson-macid[live]'.\n"


def test_the_server_ends_when_its_last_page_has_been_gone_for_a_while(served, monkeypatch):
    monkeypatch.setattr("macid.live.server.LINGER", 0.3)
    server = served()
    server._left = time.monotonic()
    before = time.monotonic()
    server.wait()
    assert 0.2 < time.monotonic() - before < 5


# Pages in a browser.


def click(tab, page):
    """Clicks person 0, whom the camera follows; whether the page has heard of it."""
    tab.click_at(0.5, 0.54)
    last = time.monotonic() + 5.0
    while page.clicked != 0 and time.monotonic() < last:
        time.sleep(0.1)
    return page.clicked == 0


def test_pages_draw_and_do_not_disturb_each_other(served, tmp_path):
    chromium()
    pages = []  # of people who stand: walking ones are compiled first

    def make(client):
        pages.append(CrowdPage(client, CrowdSetting("standing", 1, people=8), len(pages)))
        return pages[-1]

    with Browser() as browser:
        server = served(make)
        one = browser.open(server.url)
        until(lambda: one.reading("Time") not in (None, "0.0 s"))
        picture = one.screenshot(tmp_path / "page.png")
        left = picture[:, : picture.shape[1] // 2].reshape(-1, 3)
        assert len(np.unique(left // 16, axis=0)) > 8  # floor, walls and people, not one colour
        two = browser.open(server.url)
        until(lambda: two.reading("Time") not in (None, "0.0 s"))
        first, second = pages
        before = second.world.lcf.copy()
        one.slide("LCF of all", "End")
        until(lambda: (first.world.lcf == 2.0).all() and one.reading("LCF: mean, least, most") == "2.00, 2.00, 2.00")
        np.testing.assert_array_equal(second.world.lcf, before)
        one.choose("map", "behind")
        until(lambda: click(one, first))
        one.slide("LCF of one", "Home")
        until(lambda: first.world.lcf.tolist() == [-2.0] + 7 * [2.0])
        two.click("Pause")
        until(lambda: not second.running)
        stopped, at = second.world.time, first.world.time
        until(lambda: first.world.time > at + 0.3)
        assert first.running and second.world.time == stopped
        two.close()
        until(lambda: second.ended and second.world is None)
        at = first.world.time
        until(lambda: first.world.time > at)
        assert server.pages == [first]
    until(lambda: first.ended and not server.pages)  # a browser that goes away takes its world along


def test_the_same_call_for_python_is_refused_alike():
    with pytest.raises(ValueError, match="lets other machines in"):
        benchmark.live(host="::")
