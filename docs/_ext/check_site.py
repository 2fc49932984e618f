"""Check the built site: links, anchors, public names, and that nothing is fetched.

Run as ``python docs/_ext/check_site.py docs/_build/html``; links to other sites are
written to ``outside_links.txt`` there and not opened.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: Attributes by which a browser fetches something while it shows a page.
FETCHES = {"script": "src", "link": "href", "img": "src", "iframe": "src"}
#: Kinds of <link> that name an address and fetch nothing.
NAMED = {"canonical", "index", "search", "next", "prev", "author", "alternate"}


class Page(HTMLParser):
    """What a page links to, fetches, and can be linked to at."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.anchors: set[str] = set()
        self.without_words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note links, anchors, what is fetched and images without words."""
        have = {name: value or "" for name, value in attrs}
        self.anchors |= {have[name] for name in ("id", "name") if name in have}
        if tag == "a" and "href" in have:
            self.links.append(have["href"])
        if tag in FETCHES and FETCHES[tag] in have:
            if tag == "link" and {*have.get("rel", "").split()} <= NAMED:
                return
            self.fetched.append(have[FETCHES[tag]])
        if tag == "img" and not have.get("alt"):
            self.without_words.append(have.get("src", ""))


def problems(site: Path) -> tuple[list[str], set[str]]:
    """Return what is wrong with a site, and the addresses outside it."""
    pages = {p: Page(p.read_text(encoding="utf-8")) for p in site.rglob("*.html")}
    found, outside = [], set()
    for path, page in pages.items():
        name = path.relative_to(site)
        found += [
            f"{name} fetches {address}"
            for address in page.fetched
            if urlsplit(address).netloc
        ]
        found += [f"{name}: no words for {source}" for source in page.without_words]
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme in ("http", "https"):
                outside.add(link)
            if parts.scheme or parts.netloc:
                continue
            target = path if not parts.path else path.parent / unquote(parts.path)
            target = target.resolve()
            if not target.exists():
                found.append(f"{name} links to {link}, which is not there")
            elif target in pages and unquote(parts.fragment) not in (
                "",
                *pages[target].anchors,
            ):
                found.append(f"{name} links to {link}, an anchor that is not there")
    return found, outside


def forgotten(site: Path) -> list[str]:
    """Return public names that have no entry on the site."""
    import importlib

    import sbi_active

    anchors = set()
    for path in (site / "reference" / "api").glob("*.html"):
        anchors |= Page(path.read_text(encoding="utf-8")).anchors
    missing = []
    for package in (*sbi_active._PACKAGES, "pyro", "tasks"):
        names = importlib.import_module(f"sbi_active.{package}").__all__
        missing += [
            f"sbi_active.{package}.{name} is not on the site"
            for name in names
            if f"sbi_active.{package}.{name}" not in anchors
        ]
    return missing


def main(site: Path) -> int:
    """Print what is wrong, and return the number of faults."""
    found, outside = problems(site.resolve())
    found += forgotten(site)
    text = "".join(f"{link}\n" for link in sorted(outside))
    (site / "outside_links.txt").write_text(text, encoding="utf-8")
    print("\n".join([*found, f"{len(found)} faults; {len(outside)} links outside"]))
    return min(len(found), 1)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
