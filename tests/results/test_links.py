"""Every relative link of every page leads to a file, and to a heading of it."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = subprocess.run(
    ["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True
).stdout.split()


def anchors(page):
    """Return the anchors that GitHub gives a page's headings."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)  # "# ..." is code there
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in headings}


def broken_links(page):
    """Return the relative links of a page that lead nowhere."""
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(), flags=re.DOTALL)
    found = []
    for inline, reference in re.findall(r"\]\(([^)\s]+)\)|^\[[^]]+\]: (\S+)", text, flags=re.M):
        path, _, anchor = (inline + reference).partition("#")
        target = (page.parent / path).resolve() if path else page
        if re.match(r"https?:", path):
            continue
        if not target.exists() or (anchor and anchor not in anchors(target)):
            found.append(inline + reference)
    return found


@pytest.mark.parametrize("name", PAGES)
def test_relative_links_lead_somewhere(name):
    assert broken_links(ROOT / name) == []


def test_broken_links_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A b\n[1](#a-b) [2](#c) [3](page.md#a-b) [4](no.md) [5](https://x)\n[6]: d\n")
    assert broken_links(page) == ["#c", "no.md", "d"]
