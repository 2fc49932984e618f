"""The elements and texts of a page."""

from html.parser import HTMLParser

VOID = {"br", "img", "meta"}


class Parsed(HTMLParser):
    """Tags with their attributes, and texts, of a page that must be balanced."""

    def __init__(self, page):
        super().__init__()
        self.elements, self.open, self.texts = [], [], []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
