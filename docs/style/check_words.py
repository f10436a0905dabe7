"""Check texts for the expressions in `docs/style/words.txt`.

    python docs/style/check_words.py [--all] [PATH ...]

Reads Markdown and reStructuredText (without code), docstrings, comments and messages in Python, comments in C, shell scripts
and ROS messages. Prints each expression with its position and a replacement. The exit code is 1 if a kind of text (documents
or code) contains more than `LIMIT` expressions per 1,000 words. Without PATH, it checks all files that git tracks.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

WORDS = Path(__file__).with_name("words.txt")
REPOSITORY = WORDS.parents[2]

LIMIT = 0.5
"""Allowed expressions per 1,000 words."""

Text = tuple[int, str]
"""First line number and text."""


@dataclass(frozen=True, slots=True)
class Expression:
    """An expression to avoid.

    Attributes:
        pattern: matches the expression.
        instead: standard terms.
    """

    pattern: re.Pattern[str]
    instead: str


def load(path: Path = WORDS) -> list[Expression]:
    """Read the list of expressions.

    Raises:
        ValueError: a line does not have two columns.
    """
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            columns = re.split(r" {2,}", line.strip(), maxsplit=1)
            if len(columns) != 2:
                raise ValueError(f"{path}:{number}: expected an expression, two spaces and a replacement")
            # Capital letters in the list match the start of a sentence.
            case = 0 if re.search("[A-Z]", columns[0]) else re.IGNORECASE
            found.append(Expression(re.compile(rf"\b(?:{columns[0]})\b", case), columns[1]))
    return found


def _blank(match: re.Match[str]) -> str:
    # Keep the line numbers.
    return "\n" * match[0].count("\n")


def of_markup(source: str) -> Iterator[Text]:
    """Yield the prose of Markdown or reStructuredText, without code blocks, inline code and link targets."""
    text = re.sub(r"^```.*?^```|^~~~.*?^~~~", _blank, source, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^( {4}|\t)\S.*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"``[^`]*``|`[^`]*`", lambda code: "X" + _blank(code), text)
    yield 1, re.sub(r"\]\([^)\n]*\)", "]", text)


def of_python(source: str) -> Iterator[Text]:
    """Yield docstrings, strings of more than two words and comments."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value.split()) > 2:
            yield node.lineno, re.sub(r"``[^`]*``|`[^`]*`", "X", node.value)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("# ")


def of_c(source: str) -> Iterator[Text]:
    """Yield the comments."""
    for comment in re.finditer(r"/\*(.*?)\*/|//([^\n]*)", source, re.DOTALL):
        yield source.count("\n", 0, comment.start()) + 1, comment[1] or comment[2] or ""


def of_script(source: str) -> Iterator[Text]:
    """Yield the comments after `#`."""
    for number, line in enumerate(source.splitlines(), 1):
        _, mark, comment = line.partition("#")
        if mark and not line.startswith("#!"):
            yield number, comment


DOCUMENTS: dict[str, Callable[[str], Iterator[Text]]] = {".md": of_markup, ".rst": of_markup}
CODE: dict[str, Callable[[str], Iterator[Text]]] = {
    ".py": of_python,
    ".c": of_c,
    ".h": of_c,
    ".hpp": of_c,
    ".cpp": of_c,
    ".ino": of_c,
    ".S": of_c,
    ".msg": of_script,
    ".yaml": of_script,
    ".sh": of_script,
}


def tracked(paths: Iterable[Path]) -> Iterator[Path]:
    """Yield files, and the files in folders that git tracks or would add."""
    for path in paths:
        if path.is_file():
            yield path
        else:
            command = ["git", "-C", str(path), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
            listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            yield from (path / name for name in sorted(set(listed.split("\0"))) if name)


def check(path: Path, texts: Iterable[Text], expressions: Iterable[Expression]) -> tuple[int, list[str]]:
    """Return the number of words of a file, and a line for each expression that was found."""
    words, lines = 0, []
    for first, text in texts:
        words += len(re.findall(r"[A-Za-z][A-Za-z'-]+", text))
        for expression in expressions:
            for match in expression.pattern.finditer(text):
                at = first + text.count("\n", 0, match.start())
                lines.append(f"{path}:{at}: {' '.join(match[0].split())!r}: say {expression.instead}")
    return words, lines


def main(arguments: list[str] | None = None) -> int:
    """Check the files, print the findings and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("paths", nargs="*", type=Path, help="files or folders (default: the repository)")
    parser.add_argument("--all", action="store_true", help="print findings below the limit, too")
    given = parser.parse_args(arguments)
    expressions = load()
    failed = False
    files = [path for path in tracked(given.paths or [REPOSITORY]) if path.is_file() and path != WORDS]
    for kind, readers in (("documents", DOCUMENTS), ("code", CODE)):
        words, lines = 0, []
        for path in files:
            if reader := readers.get(path.suffix):
                count, found = check(path, reader(path.read_text(encoding="utf-8")), expressions)
                words += count
                lines += found
        rate = 1000 * len(lines) / max(words, 1)
        if rate > LIMIT or given.all:
            print("\n".join(lines))
        print(f"{kind}: {len(lines)} in {words} words, {rate:.2f} per 1,000 (limit {LIMIT})")
        failed |= rate > LIMIT
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
