"""A real browser without a window, for tests of pages: Debian's chromium, driven over its DevTools protocol."""

import base64
import contextlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--mute-audio",
    "--disable-background-networking",
    "--disable-extensions",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--window-size=900,600",
    "--force-device-scale-factor=1",
)
WAIT = 60.0  # for what a page is to show; software WebGL beside other work is slow [s]


def chromium():
    """The browser's command; skips the test where there is none."""
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("there is no chromium here (on Debian: apt-get install chromium)")
    return found


def until(what, wait=WAIT):
    """The first true value of `what()`; fails where there is none within `wait` [s]."""
    last = time.monotonic() + wait
    while not (found := what()):
        assert time.monotonic() < last, f"not within {wait:g} s"
        time.sleep(0.1)
    return found


class Browser:
    """The browser; use it in a `with`."""

    def __enter__(self):
        from websockets.sync.client import connect

        self._folder = tempfile.mkdtemp()
        self._process: Any = subprocess.Popen(
            [chromium(), *_FLAGS, f"--user-data-dir={self._folder}", "about:blank"],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        )
        address = next(line for line in self._process.stderr if "DevTools listening on" in line).split()[-1]
        self._socket, self._numbers = connect(address, max_size=None, compression=None), itertools.count(1)
        return self

    def __exit__(self, *_):
        with contextlib.suppress(Exception):
            self._socket.close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._process.stderr.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def call(self, method, session=None, **params):
        """The result of the protocol's `method`."""
        number = next(self._numbers)
        self._socket.send(
            json.dumps(
                {"id": number, "method": method, "params": params, **({"sessionId": session} if session else {})}
            )
        )
        while True:
            answer = json.loads(self._socket.recv(WAIT))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, url):
        """A page that shows `url`."""
        target = self.call("Target.createTarget", url=url)["targetId"]
        return Tab(self, target, self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"])


class Tab:
    """A page of the browser."""

    def __init__(self, browser, target, session):
        self._browser, self._target, self._session = browser, target, session

    def call(self, method, **params):
        return self._browser.call(method, self._session, **params)

    def close(self):
        self._browser.call("Target.closeTarget", targetId=self._target)

    def run(self, script):
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    @property
    def text(self):
        """The text that the page shows."""
        return self.run("document.body?.innerText") or ""

    def reading(self, name):
        """The text beside `name` in the page's table of readings, or None."""
        rows = self.run("[...document.querySelectorAll('tr')].map(row => [...row.cells].map(cell => cell.innerText))")
        return dict(row for row in rows or [] if len(row) == 2).get(name)

    def key(self, code, down):
        """Presses or releases a key."""
        self.call("Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", code=code, key=code)

    def slide(self, label, key):
        """Sends the slider of that label a key: Home, End, ..."""
        script = """(label => {
            const leaves = [...document.querySelectorAll('label, div, span, p')];
            const name = leaves.find(one => one.childElementCount === 0 && one.textContent.trim() === label);
            for (let above = name; above; above = above.parentElement) {
                const thumb = above.querySelector?.('[role=slider]');
                if (thumb) { thumb.focus(); return true; }
            }
            return false;
        })"""
        until(lambda: self.run(f"{script}({json.dumps(label)})"))  # it may come with what was just clicked
        self.key(key, True)
        self.key(key, False)

    def click(self, label):
        """Clicks the button of that label."""
        script = "(label => [...document.querySelectorAll('button')].find(b => b.innerText.trim() === label)?.click())"
        self.run(f"{script}({json.dumps(label)})")

    def choose(self, now, option):
        """Chooses the `option` of the dropdown that shows `now`."""
        found = f"[...document.querySelectorAll('input')].find(one => one.value === {json.dumps(now)})"
        self.run(f"(one => {{ one.focus(); one.click(); }})({found})")
        options = "[...document.querySelectorAll('[role=option]')]"
        wanted = f"{options}.find(one => one.innerText.trim() === {json.dumps(option)} && one.offsetParent)"
        until(lambda: self.run(f"!!{wanted}"))
        self.run(f"{wanted}.click()")
        shown = f"[...document.querySelectorAll('input')].some(one => one.value === {json.dumps(option)})"
        until(lambda: self.run(shown))

    def click_at(self, x, y):
        """Clicks the place x, y, shares of the window's width and height."""
        x, y = x * self.run("innerWidth"), y * self.run("innerHeight")
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            button = "none" if kind == "mouseMoved" else "left"
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=1)
            time.sleep(0.2)  # it asks what is below the pointer between two pictures

    def screenshot(self, file=None):
        """The page's picture (height, width, 3) uint8; saved as the PNG `file`, where given."""
        import cv2
        import numpy as np

        content = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if file is not None:
            with open(file, "wb") as opened:
                opened.write(content)
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        return picture[..., ::-1]
