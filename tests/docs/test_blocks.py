"""Every Python block of the documentation runs. Those that ask a service ask a real one."""

from pathlib import Path

import pytest

from acceptance.accord_service import Accord
from docs.documented_code import SMALLER, URL, run_code
from support.markdown import DOCS, CodeBlock, code_blocks

pytestmark = pytest.mark.docs
BLOCKS = code_blocks("python")


def complete(block: CodeBlock) -> str:
    """The code of a block, after that of the block before it on its page if it imports nothing."""
    earlier = [each for each in BLOCKS if each.page == block.page and each.line < block.line]
    return block.code if "import " in block.code else complete(earlier[-1]) + block.code


@pytest.mark.parametrize("block", [block for block in BLOCKS if URL not in block.code], ids=str)
def test_a_block_runs(block: CodeBlock, folder: Path, hub: dict[str, str]) -> None:
    run_code(complete(block), folder, environment=hub)


@pytest.mark.parametrize("block", [block for block in BLOCKS if URL in block.code], ids=str)
def test_a_block_runs_with_a_service(block: CodeBlock, folder: Path, accord: Accord) -> None:
    run_code(block.code, folder, url=accord.url, token=accord.token(str(block), "researcher"))


def test_every_smaller_number_replaces_one_of_the_documentation() -> None:
    scripts = [path.read_text() for path in (DOCS / "examples").glob("*.py")]
    written = "\n".join([*scripts, *(block.code for block in BLOCKS)])
    assert [number for number in SMALLER if number not in written] == []
