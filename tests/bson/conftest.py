import html.parser

import pytest


class _Tags(html.parser.HTMLParser):
    """Notes which tags are open; one that is closed out of turn is an error."""

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, self.getpos()


@pytest.fixture
def check_page():
    """A function that asserts that an HTML page is whole."""

    def check(page):
        """All tags are closed in turn, and it needs no other file."""
        tags = _Tags()
        tags.feed(page)
        assert tags.open == []
        assert 'src="http' not in page and "href=" not in page and "url(" not in page

    return check
