"""Hooks of mkdocs.yml: the help of every command, and formulas as MathML, which browsers show without scripts."""

import html
import os
import re
import subprocess
import sys

from latex2mathml.converter import convert

HELP = "<!-- help of every command -->"
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
TAG = re.compile(r"\\tag\{([^}]*)\}")


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put the help of the commands where a page asks for it."""
    return markdown.replace(HELP, _help()) if HELP in markdown else markdown


def on_page_content(html: str, **_: object) -> str:
    """Convert the formulas of a page."""
    return FORMULA.sub(_formula, html)


def _help() -> str:
    overall = _printed("--help")
    names = re.findall(r"^│\s+• (\S+)", overall, re.MULTILINE)
    return "\n".join(f"## {name}\n\n```text\n{_printed(name, '--help')}```\n" for name in names)


def _printed(*words: str) -> str:
    command = [sys.executable, "-m", "modeler", *words]
    environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1"}
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout


def _formula(found: re.Match[str]) -> str:
    source, numbers = html.unescape(found[3]), TAG.findall(found[3])
    formula = convert(TAG.sub("", source).strip(), display="block" if found[2] == "[" else "inline")
    if found[1] == "span":
        return formula
    number = "".join(f'<span class="number" id="eq-{number}">({number})</span>' for number in numbers)
    return f'<div class="formula">{formula}{number}</div>'
