# SPDX-License-Identifier: GPL-3.0-or-later
"""The pages of docs/ that the extension takes along, as plain HTML: for the menu entry Online Manual, without network.

Knows the little Markdown that these pages use: headings, paragraphs, lists, tables, blocks of code, bold, italics, code
and links. Headings get the names that the site of `make docs` gives them.
"""

from __future__ import annotations

import html
import re
from pathlib import Path

PAGES = ("artists", "first-rig", "troubleshooting", "anchored", "limits")

_STYLE = """body { max-width: 60em; margin: 2em auto; padding: 0 1em; font: 16px/1.5 sans-serif; color: #222; }
table { border-collapse: collapse; } td, th { border: 1px solid #ccc; padding: .3em .6em; text-align: left; }
code, pre { background: #eee; padding: 0 .2em; } pre { padding: .6em; overflow: auto; }"""


def write_pages(docs: Path, out: Path) -> list[Path]:
    """Each page of `PAGES` as out/<page>/index.html, as the site has them; gives the files."""
    written = []
    for name in PAGES:
        path = out / name / "index.html"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page((docs / f"{name}.md").read_text(encoding="utf-8")), encoding="utf-8")
        written.append(path)
    return written


def page(text: str) -> str:
    """A page of Markdown as HTML."""
    title = re.search(r"^# (.+)$", text, re.M)
    head = f"<title>GSkin: {html.escape(title[1] if title else '')}</title>\n<style>{_STYLE}</style>"
    start = '<!DOCTYPE html>\n<html lang="en">\n<meta charset="utf-8">'
    return f"{start}\n{head}\n<body>\n{body(text)}\n</body>\n</html>\n"


def body(text: str) -> str:
    """The blocks of a page: what blank lines or the kind of line part."""
    out: list[str] = []
    lines = text.splitlines()
    while lines:
        line = lines[0]
        if not line.strip():
            lines.pop(0)
        elif line.startswith("```"):
            block = _while(lines[1:], lambda each: not each.startswith("```"))
            out.append(f"<pre>{html.escape(chr(10).join(block))}</pre>")
            del lines[: len(block) + 2]
        elif line.startswith("#"):
            level, words = len(line) - len(line.lstrip("#")), line.lstrip("# ")
            out.append(f'<h{level} id="{slug(words)}">{inline(words)}</h{level}>')
            lines.pop(0)
        elif line.startswith("|"):
            rows = _while(lines, lambda each: each.startswith("|"))
            out.append(_table(rows))
            del lines[: len(rows)]
        elif re.match(r"(\*|-|\d+\.) ", line):
            items = _while(lines, lambda each: bool(each.strip()))
            kind = "ol" if line[0].isdigit() else "ul"
            joined = re.split(r"^(?:\*|-|\d+\.) ", "\n".join(items), flags=re.M)[1:]
            out.append(f"<{kind}>{''.join(f'<li>{inline(item)}</li>' for item in joined)}</{kind}>")
            del lines[: len(items)]
        else:
            words = _while(lines, lambda each: bool(each.strip()) and not each.startswith(("#", "|", "```")))
            out.append(f"<p>{inline(chr(10).join(words))}</p>")
            del lines[: len(words)]
    return "\n".join(out)


def inline(text: str) -> str:
    """A line's marks; what is between backticks stays as it is. Pictures become their words."""
    spans = re.findall(r"`([^`]+)`", text)
    marked = _marks(re.sub(r"`[^`]+`", "\0", text))  # links may have code in them
    for span in spans:
        marked = marked.replace("\0", f"<code>{html.escape(span)}</code>", 1)
    return marked


def slug(words: str) -> str:
    """The name of a heading in an address, as MkDocs makes it."""
    plain = re.sub(r"[^\w\s-]", "", words).strip().lower()
    return re.sub(r"[-\s]+", "-", plain)


def _marks(text: str) -> str:
    text = html.escape(text, quote=False)
    text = re.sub(r"!\[([^\]]*)\]\([^)]*\)", r"<em>\1</em>", text)
    text = re.sub(r"\[([^\]]*)\]\(([^)\s]*)\)", lambda found: _link(found[1], found[2]), text)
    text = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text)
    return re.sub(r"\*(?!\s)(.+?)\*", r"<i>\1</i>", text)


def _link(words: str, target: str) -> str:
    """A link to a page that is here, or into the web; else the words alone."""
    path, _, place = target.partition("#")
    if not path:
        return f'<a href="#{place}">{words}</a>'
    if path.startswith("https://"):
        return f'<a href="{html.escape(target)}">{words}</a>'
    name = path.removesuffix(".md")
    if name in PAGES and path.endswith(".md"):
        return f'<a href="../{name}/index.html{"#" + place if place else ""}">{words}</a>'
    return words


def _table(rows: list[str]) -> str:
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", row.strip().strip("|"))] for row in rows]
    head = "".join(f"<th>{inline(cell)}</th>" for cell in cells[0])
    below = "\n".join("<tr>" + "".join(f"<td>{inline(cell)}</td>" for cell in row) + "</tr>" for row in cells[2:])
    return f"<table><tr>{head}</tr>\n{below}</table>"


def _while(lines: list[str], fits) -> list[str]:
    found = []
    for line in lines:
        if not fits(line):
            break
        found.append(line)
    return found
