"""Code blocks of the documentation: those in Python compile, commands parse, and data can be read.

tests/docs runs those in Python.
"""

import ast
import json
import re
import shlex
import tomllib
from collections.abc import Callable, Iterator
from xml.etree import ElementTree

import pytest
import yaml
from _pytest.mark.structures import ParameterSet

from accord.cli.reference import commands
from support.markdown import DOCS, CodeBlock, code_blocks

READERS: dict[str, Callable[[str], object]] = {
    "json": json.loads,
    "py": ast.parse,  # needs other packages
    "python": lambda code: compile(code, "example", "exec"),
    "sh": lambda code: shlex.split(code, comments=True),
    "text": str,
    "toml": tomllib.loads,
    "xml": ElementTree.fromstring,
    "yaml": yaml.safe_load,
}
COMMANDS = commands()
#: a command, after variables, `sudo -u USER` and `docker compose exec SERVICE`
_COMMAND = re.compile(r"^(?:[A-Z_]+=\S+ +|sudo -u \S+ +|docker compose exec \S+ +)*(?:\S*/)?((?:accord|mapt) [a-z].*)")


@pytest.mark.parametrize("block", code_blocks(), ids=str)
def test_a_block_is_valid_in_the_language_that_it_names(block: CodeBlock) -> None:
    assert block.language in READERS, f"{block}: name one of {', '.join(READERS)}"
    READERS[block.language](block.code)


def command_lines() -> Iterator[ParameterSet]:
    for block in code_blocks("sh"):
        for line in block.code.replace("\\\n", " ").splitlines():
            if found := _COMMAND.match(line.partition("  #")[0].partition("&&")[0].partition("|")[0]):
                yield pytest.param(found[1].strip(), id=f"{block}-{found[1].split()[1]}")


@pytest.mark.parametrize("line", list(command_lines()))
def test_a_command_has_the_options_and_values_of_the_line(line: str) -> None:
    words = shlex.split(line)
    name = max((name for name in COMMANDS if words[: len(name.split())] == name.split()), key=len)
    with COMMANDS[name].make_context(name, words[len(name.split()) :]):
        pass


def statements_by_number(code: str) -> dict[int, int]:
    """Statements without imports after each comment `# NUMBER`."""
    numbers = {line: int(text[2:]) for line, text in enumerate(code.splitlines(), 1) if re.fullmatch(r"# \d+", text)}
    found = dict.fromkeys(numbers.values(), 0)
    for node in ast.walk(ast.parse(code)):
        before = [line for line in numbers if isinstance(node, ast.stmt) and line < node.lineno]
        if before:
            found[numbers[max(before)]] += 1
    return found


def test_the_comparison_counts_the_statements_of_its_blocks() -> None:
    blocks = {block.language: block.code for block in code_blocks("python", "py") if block.page == "docs/comparison.md"}
    rows = re.findall(r"^\| (\d+) \| .+? \| (\d+|—).*? \| (\d+|—)", (DOCS / "comparison.md").read_text(), re.MULTILINE)
    assert len(rows) == 12
    ours, theirs = ({int(row[0]): int(row[column]) for row in rows if row[column] != "—"} for column in (1, 2))
    assert statements_by_number(blocks["py"]) == theirs
    counted = statements_by_number(blocks["python"])
    assert counted == {number: ours[number] for number in counted}
