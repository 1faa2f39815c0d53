"""Print how large each package is: ``python -m docs.size``, in a clone.

Size is tokens of Python without comments and docstrings, which formatting does not change.
"""

import ast
import io
import subprocess
import tokenize
from collections import Counter
from pathlib import Path

LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


def count_tokens(source: str) -> int:
    """Count the tokens of a module that are neither layout, comment nor docstring."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, documented)]
    num_docstrings = sum(ast.get_docstring(node, clean=False) is not None for node in nodes)
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return sum(token.type not in LAYOUT for token in tokens) - num_docstrings


def main() -> None:
    """Print a table of the packages, largest first."""
    tokens, lines = Counter[str](), Counter[str]()
    listed = subprocess.run(["git", "ls-files", "*.py"], capture_output=True, text=True, check=True)
    for path in map(Path, listed.stdout.split()):
        source = path.read_text(encoding="utf-8")
        for package in (path.parts[0] if len(path.parts) > 1 else "(root)", "all"):
            tokens[package] += count_tokens(source)
            lines[package] += source.count("\n")
    print("| package | tokens | lines | tokens a line |\n|---|---|---|---|")
    for package, count in tokens.most_common():
        print(f"| {package} | {count:,} | {lines[package]:,} | {count / lines[package]:.1f} |")


if __name__ == "__main__":
    main()
