"""MkDocs hook: pages that live outside docs/ join the site, and links follow them (mkdocs.yml, ``hooks``).

README.md becomes the index page. A link from any page is resolved in the repository; if its target is on the site, the
link leads there, and else only its text stays (source files, folders of raw results).
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
OUTSIDE = {
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "examples.md": "examples/README.md",
    "results/atari.md": "results/atari/README.md",
    "results/minatar.md": "results/minatar/README.md",
    "results/export.md": "results/export/README.md",
    "results/profile.md": "results/profile/README.md",
    "results/recipe.md": "results/recipe/README.md",
}
"""Page of the site -> file of the repository."""

_ON_SITE = {path: page for page, path in OUTSIDE.items()}
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def site_page(path: str) -> str | None:
    """The site's page or file for a file of the repository, or None if the site does not show it."""
    if path in _ON_SITE:
        return _ON_SITE[path]
    inside = path.startswith("docs/") and path.endswith((".md", ".svg", ".png", ".gif")) and (ROOT / path).exists()
    return path.removeprefix("docs/") if inside else None


def follow_links(markdown: str, page: str) -> str:
    """The text of a page with its relative links led to the site's pages, or taken out."""
    source = OUTSIDE.get(page, f"docs/{page}")

    def follow(match: re.Match[str]) -> str:
        image, text, target = match.groups()
        if "://" in target or target.startswith("#"):
            return match.group(0)
        path, mark, anchor = target.partition("#")
        found = site_page(posixpath.normpath(posixpath.join(posixpath.dirname(source), path)))
        if found is None:
            return text
        return f"{image}[{text}]({posixpath.relpath(found, posixpath.dirname(page) or '.')}{mark}{anchor})"

    parts = _FENCE.split(markdown)
    return "".join(part if part.startswith("```") else _LINK.sub(follow, part) for part in parts)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside docs/."""
    for page, path in OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / path).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead a page's links."""
    return follow_links(markdown, page.file.src_uri)
