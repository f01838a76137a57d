"""Follows every link of the built pages: to a file and an anchor of them, or to a proper address.

    python docs/links.py docs/_build

Addresses elsewhere are not visited, as there need be no network; they must be well formed.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """The anchors of a page, and what it points to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Called for each tag."""
        given = {key: value or "" for key, value in attrs}
        self.anchors |= {given[key] for key in ("id", "name") if given.get(key)}
        self.links += [given[key] for key in ("href", "src") if key in given]


def broken(place: Path) -> list[str]:
    """Every link of the pages in a folder that leads nowhere, with its page."""
    pages = {path.resolve(): Page(path.read_text()) for path in place.rglob("*.html")}
    found = []
    for path, page in pages.items():
        for link in page.links:
            if reason := wrong(link, path, pages):
                found.append(f"{path.relative_to(place.resolve())}: {link!r} {reason}")
    return found


def wrong(link: str, path: Path, pages: dict[Path, Page]) -> str | None:
    """Why a link of a page leads nowhere; None where it leads somewhere."""
    parts = urlsplit(link)
    if parts.scheme in ("http", "https"):
        proper = "." in parts.netloc and " " not in link
        return None if proper else "is no proper address"
    if parts.scheme == "data":
        return None
    if parts.scheme or parts.netloc:
        return "has a scheme of its own"
    target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if not target.exists():
        return "has no file"
    anchor = unquote(parts.fragment)
    if anchor and target in pages and anchor not in pages[target].anchors:
        return "has no anchor"
    return None


def main(place: str) -> None:
    """Prints what is broken, and fails where anything is."""
    pages = list(Path(place).rglob("*.html"))
    if not pages:
        sys.exit(f"{place} has no pages")
    found = broken(Path(place))
    print("\n".join(found) or f"all links of {len(pages)} pages lead somewhere")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main(sys.argv[1])
