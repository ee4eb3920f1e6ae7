"""The server of live pages: one port, a token where others can reach it, and pages that come and go.

viser draws the pages and carries their controls. It listens on a port of its own on the loopback address; what stands
here listens on the port that the user chose, lets in who may come in, and passes messages on. A page's world begins
once the page has told its keys' socket a name that only it knows, which takes the token: viser's own port gives no
world away.
"""

import contextlib
import hmac
import html
import http.cookies
import ipaddress
import json
import pathlib
import secrets
import sys
import threading
import time
import urllib.parse
import urllib.request
import warnings
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from macid import start
from macid.documents import shown
from macid.files import UsageError

PORT = 8080
MOST_PAGES = 8  # at once: each has a world, and they share the processor
LINGER = 10.0  # so long the server waits for another page once the last one has gone: for one that is loaded again [s]
LEAST_TOKEN = 8  # characters
_MOST_KEYS = 1000  # characters of a message of the keys' socket
_MOST_MESSAGE = 50 << 20  # of viser's [bytes]
_SHARING = b"ShareUrl"  # in a message by which a page would have viser open a way to it from outside


class LivePage(Protocol):
    """What a server runs for each open page."""

    def start(self) -> None:
        """Begins: the page has come."""
        ...

    def stop(self) -> None:
        """Ends, and gives everything back: the page has gone. Waits until this is done; a second call does nothing."""
        ...

    def press(self, keys: frozenset[str]) -> None:
        """The driving keys, by the names that browsers give them, that are held down now."""
        ...


def check_address(host: str, token: str | None) -> None:
    """Raises UsageError where other machines could reach the address `host` without a token, or the token is too
    short."""
    if token is not None and (len(token) < LEAST_TOKEN or not (token.isascii() and token.isprintable())):
        raise UsageError(f"--token must have at least {LEAST_TOKEN} characters, all ASCII, not {shown(token)}.")
    if token is None and not is_loopback(host):
        raise UsageError(f"--host {host} lets other machines in: give a --token that they need, or leave --host out.")


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the address `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def load_viser() -> Any:
    """The module viser. Raises UsageError, which says what to install."""
    try:
        import viser
        import websockets.sync.server  # noqa: F401  # its wheel comes with viser
    except ModuleNotFoundError as error:
        raise UsageError(f"A live page needs {error.name}: pip install 'bson-macid[live]'.") from None
    return viser


class Server:
    """Serves pages until it is closed; use it in a `with`.

    make_page(client): a LivePage for a new page, whose viser ClientHandle is `client`. title: the browser's. host,
    port: where to listen; port 0 is any free one. token: what a browser must bring; needed where `host` is not this
    machine's alone. Raises UsageError, where the port is in use, too.

    port, url: where it listens; url has the token.
    """

    def __init__(
        self,
        make_page: Callable[[Any], LivePage],
        title: str,
        host: str = "127.0.0.1",
        port: int = PORT,
        token: str | None = None,
    ):
        check_address(host, token)
        viser = load_viser()
        from websockets.sync.server import serve

        self._make_page, self._host, self._token = make_page, host, token
        self._lock = threading.Lock()
        self._pages: dict[str, LivePage] = {}  # {the name that its keys' socket gives: a page that is there}
        self._names: dict[int, str] = {}  # {viser's number of a page: its name}
        self._early: set[int] = set()  # numbers of pages that went before they were told to have come
        self._sockets: set[Any] = set()
        self._changed, self._left = threading.Condition(self._lock), None
        self._closed = False
        try:
            self._front = serve(
                self._connected,
                host,
                port,
                process_request=self._answer,
                select_subprotocol=lambda _, offered: next((one for one in offered if one.startswith("viser-v")), None),
                compression=None,
                max_size=_MOST_MESSAGE,
                logger=_quiet(),
            )
        except (OSError, OverflowError) as error:
            raise UsageError(_why_not(host, port, error)) from None
        # A page's last frame may be drawn after its browser has gone.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        try:
            with _silent():
                self._viser = viser.ViserServer("127.0.0.1", 0, verbose=False)
            self.port = self._front.socket.getsockname()[1]
            self._html = self._page_html(title)
        except BaseException:
            self._front.shutdown()
            raise
        self._viser.on_client_connect(self._came)
        self._viser.on_client_disconnect(self._went)
        self._thread = threading.Thread(target=self._front.serve_forever, daemon=True, name="live")
        self._thread.start()

    @property
    def url(self) -> str:
        """The address for the browser."""
        host = "127.0.0.1" if self._host in ("0.0.0.0", "::", "") else self._host
        shown_host = f"[{host}]" if ":" in host else host
        query = f"/?token={urllib.parse.quote(self._token)}" if self._token else ""
        return f"http://{shown_host}:{self.port}{query}"

    @property
    def pages(self) -> list[LivePage]:
        """The pages that are open now."""
        with self._lock:
            return list(self._pages.values())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def wait(self, stays: bool = False) -> None:
        """Returns when the last page has been gone for LINGER seconds; with `stays` never."""
        while True:
            with self._changed:
                self._changed.wait(0.5)
                gone = self._left is not None and time.monotonic() - self._left > LINGER
            if gone and not stays:
                return

    def close(self) -> None:
        """Ends all pages, frees the port, and waits until all is done; closing twice does no harm."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            sockets = list(self._sockets)
        self._front.shutdown()
        for page in self.pages:
            page.stop()
        for socket in sockets:
            with contextlib.suppress(OSError):
                socket.socket.shutdown(2)  # reading and writing: whoever waits for the other side wakes up
        with _silent():
            self._viser.stop()
        self._thread.join(5.0)

    def _page_html(self, title):
        with urllib.request.urlopen(f"http://127.0.0.1:{self._viser.get_port()}/") as answer:
            page = answer.read().decode()
        script = pathlib.Path(__file__).with_name("keys.js").read_text()
        page = page.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1)
        return page.replace("</title>", f"</title><script>{script}</script>", 1).encode()

    def _answer(self, connection, request):
        """The answer to a browser's request; None: it becomes a socket."""
        from websockets.http11 import Response

        place, headers = urllib.parse.urlsplit(request.path), request.headers
        cookie = f"live-{self.port}"

        def answer(status, text, *more, kind="text/plain; charset=utf-8"):
            body = text if isinstance(text, bytes) else f"{text}\n".encode()
            fields = [("Content-Type", kind), ("Content-Length", str(len(body))), ("Cache-Control", "no-store"), *more]
            return Response(int(status), http.HTTPStatus(status).phrase, type(headers)(fields), body)

        called = urllib.parse.urlsplit(f"//{headers.get('Host', '')}").hostname or ""
        if self._token is None:
            if not is_loopback(called):  # a page from elsewhere whose name was led to this machine
                return answer(403, "Open this page by the address that the command printed.")
        else:
            jar = http.cookies.SimpleCookie(headers.get("Cookie", ""))
            brought = jar[cookie].value if cookie in jar else ""
            given = urllib.parse.parse_qs(place.query).get("token", [""])[0]
            if not hmac.compare_digest(brought.encode(), self._token.encode()):
                if not hmac.compare_digest(given.encode(), self._token.encode()):
                    return answer(403, "This page needs its token: open the address that the command printed.")
                value = http.cookies.SimpleCookie({cookie: self._token})[cookie].OutputString()
                kept = ("Set-Cookie", f"{value}; HttpOnly; SameSite=Strict; Path=/")
                return answer(302, "", ("Location", "/"), kept)
        if headers.get("Upgrade", "").lower() == "websocket":
            origin = headers.get("Origin")  # a browser always names the page that asks
            if origin is not None and urllib.parse.urlsplit(origin).netloc != headers.get("Host"):
                return answer(403, "Another site's page may not use this one.")
            return None
        if place.path != "/":
            return answer(404, "There is no such page here.")
        return answer(200, self._html, kind="text/html; charset=utf-8")

    def _connected(self, browser):
        """A socket of a browser: its keys, or its messages to and from viser."""
        with self._lock:
            if self._closed:
                return
            self._sockets.add(browser)
        try:
            path = browser.request.path
            if path.startswith("/keys/"):
                self._listen(browser, path.removeprefix("/keys/"))
            else:
                self._relay(browser)
        finally:
            with self._lock:
                self._sockets.discard(browser)

    def _listen(self, browser, name):
        """Passes the keys that a page's browser tells to the page; its first socket begins the page."""
        from websockets.exceptions import ConnectionClosed

        with self._lock:
            page = self._pages.get(name)
        if page is None:
            return
        page.start()
        try:
            for message in browser:
                page.press(_keys(message))
        except ConnectionClosed:
            pass
        finally:
            page.press(frozenset())

    def _relay(self, browser):
        """Carries a page's messages to viser and viser's to the page, until one of them goes."""
        from websockets.sync.client import connect

        if browser.subprotocol is None:
            return
        address = f"ws://127.0.0.1:{self._viser.get_port()}"
        with connect(
            address, subprotocols=[browser.subprotocol], compression=None, max_size=None, proxy=None, logger=_quiet()
        ) as behind:
            back = threading.Thread(target=_pump, args=(behind, browser), daemon=True, name="live page")
            back.start()
            _pump(browser, behind, skip=_SHARING)
            back.join()

    def _came(self, client):
        """viser has a new page."""
        with self._changed:
            if self._closed or client.client_id in self._early:
                self._early.discard(client.client_id)
                return
            name = secrets.token_urlsafe(12) if len(self._pages) < MOST_PAGES else ""
            if name:
                self._names[client.client_id] = name
                self._pages[name] = self._make_page(client)
                self._left = None
        if name:
            client.gui.add_html(f'<span data-live-page="{name}"></span>', order=-1)
        else:
            client.gui.add_markdown(f"**{MOST_PAGES} pages are open.** Close one of them, then load this one again.")

    def _went(self, client):
        """A page has gone."""
        with self._changed:
            name = self._names.pop(client.client_id, None)
            if name is None:
                self._early.add(client.client_id)
            page = self._pages.pop(name, None) if name else None
        if page is not None:
            page.stop()
        with self._changed:
            if not self._pages:
                self._left = time.monotonic()
            self._changed.notify_all()


def _pump(source, target, skip=None):
    """Passes messages on until either side closes, then closes the other; without those that have `skip` in them."""
    from websockets.exceptions import ConnectionClosed

    with contextlib.suppress(ConnectionClosed, OSError):
        for message in source:
            if skip is None or skip not in message:
                target.send(message)
    with contextlib.suppress(ConnectionClosed, OSError):
        target.close()


def _keys(message):
    """The keys in a message of a browser; none where it is not understood."""
    try:
        keys = json.loads(message) if len(message) <= _MOST_KEYS else []
    except ValueError:
        return frozenset()
    return frozenset(key for key in keys if isinstance(key, str)) if isinstance(keys, list) else frozenset()


def _why_not(host, port, error):
    """Why nothing can listen there, and what to do."""
    import errno

    if getattr(error, "errno", None) == errno.EADDRINUSE:
        return f"Port {port} of {host} is in use. Choose another --port, or 0 for any free one."
    if getattr(error, "errno", None) == errno.EACCES:
        return f"Port {port} of {host} is for the administrator alone. Choose a --port from 1024 on."
    reason = getattr(error, "strerror", None) or str(error)
    return f"Can't listen on port {port} of {shown(host)} ({reason}). Choose another --host or --port."


def _quiet():
    """A logger that says nothing: browsers come and go as they like."""
    import logging

    logger = logging.getLogger("macid.live")
    logger.addHandler(logging.NullHandler())
    logger.propagate = False
    return logger


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Within, viser says nothing on stdout: its address is not the one to open."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def serve(
    make_page: Callable[[Any], LivePage],
    title: str,
    host: str = "127.0.0.1",
    port: int = PORT,
    token: str | None = None,
    stays: bool = False,
) -> None:
    """Serves pages, see Server, and prints the address; returns once the last page has gone, or raises
    KeyboardInterrupt. Everything is closed by then."""
    start.cleaning_up()
    with Server(make_page, title, host, port, token) as server:
        print(f"Open {server.url} in a browser. Ctrl-C ends it{'' if stays else ', and so does closing the page'}.")
        sys.stdout.flush()
        server.wait(stays)
