"""What README and docs show: examples run from top to bottom, links lead somewhere, the site builds."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from helpers_paths import REPOSITORY
from markdown_it import MarkdownIt
from markdown_it.token import Token

DOCS = REPOSITORY / "docs"
README = REPOSITORY / "README.md"
PAGES = sorted(DOCS.rglob("*.md"))
WITH_LINKS = [
    README,
    *(REPOSITORY / name for name in ("CONTRIBUTING.md", "CHANGELOG.md")),
    REPOSITORY / "pipelines" / "README.md",
    REPOSITORY / "examples" / "external" / "README.md",
    *PAGES,
]
LANGUAGES = {"sh", "python", "toml", "text", "json"}
# a comment before a block: why it is not run, or with which codes it may end
NOT_RUN = re.compile(r"<!-- not run: \w.* -->")
EXIT_CODES = re.compile(r"<!-- exit code ([\d, or]+).* -->")
LARGEST_PICTURE = 150_000

pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="needs docs/ of the checkout beside the package")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: where it starts, its language and text, and the comment before it."""

    line: int
    language: str
    code: str
    note: str

    @property
    def runs(self) -> bool:
        return self.language in ("sh", "python") and NOT_RUN.fullmatch(self.note) is None

    @property
    def exit_codes(self) -> set[int]:
        found = EXIT_CODES.fullmatch(self.note)
        return {int(code) for code in re.findall(r"\d+", found[1])} if found else {0}


def tokens_of(page: Path) -> list[Token]:
    return MarkdownIt("commonmark").enable("table").parse(page.read_text(encoding="utf-8"))


def blocks_of(page: Path) -> list[Block]:
    found, note = [], ""
    for token in tokens_of(page):
        if token.type == "fence":
            found.append(Block((token.map or [0])[0] + 1, token.info.strip(), token.content, note))
        note = token.content.strip() if token.type == "html_block" else ""
    return found


def runnable(page: Path) -> list[Block]:
    blocks = blocks_of(page)
    # the two blocks that README opens with install the package: .ci/run runs them
    return [block for block in (blocks[2:] if page == README else blocks) if block.runs]


def pages_with_examples() -> Iterator[Any]:
    for page in (README, *PAGES):
        if runnable(page):
            marks = () if page == README else pytest.mark.slow
            yield pytest.param(page, id=page.relative_to(REPOSITORY).as_posix(), marks=marks)


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the pages take for granted: the demonstration's clouds and the ready pipelines.

    It is the home folder too, with an environment that `activate` puts on the PATH, as README installs it.
    """
    if os.name != "posix" or shutil.which("sh") is None:
        pytest.skip("there is no sh")
    shipped = resources.files("mtpcr_geo.cli") / "demo_clouds"
    (tmp_path / "mtpcr-demo").mkdir()
    for name in ("ground.laz", "aerial.laz"):
        for folder in (tmp_path, tmp_path / "mtpcr-demo"):
            (folder / name).write_bytes((shipped / name).read_bytes())
    shutil.copytree(REPOSITORY / "pipelines", tmp_path / "pipelines")
    programs = tmp_path / ".mtpcr-geo" / "bin"
    programs.mkdir(parents=True)
    command = programs / "mtpcr-geo"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m mtpcr_geo "$@"\n')
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    (programs / "activate").write_text(f'PATH="{programs}:$PATH"\n')
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return tmp_path


def run_sh(block: Block, folder: Path, env: dict[str, str], log: Path) -> Path:
    """Run a block as pasted into a terminal in `folder`; return the folder in which it ends."""
    # what the block exports and where it goes hold for the next ones, as in a terminal
    script = f'set -eu\n{block.code}\npwd > "{log}"\nprintf %s "$PATH" > "{log}.path"\n'
    done = subprocess.run(
        ["sh", "-c", script], cwd=folder, env=env, capture_output=True, text=True, timeout=300
    )
    assert done.returncode in block.exit_codes, f"line {block.line}: {done.stdout}\n{done.stderr}"
    if done.returncode:
        return folder
    env["PATH"] = Path(f"{log}.path").read_text()
    return Path(log.read_text().rstrip("\n"))


@pytest.mark.parametrize("page", list(pages_with_examples()))
def test_examples_run(page: Path, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env, folder = dict(os.environ), desk
    if page != README:
        env["PATH"] = f"{desk / '.mtpcr-geo' / 'bin'}{os.pathsep}{env['PATH']}"
    names: dict[str, Any] = {"__name__": "page"}
    for block in runnable(page):
        if block.language == "sh":
            folder = run_sh(block, folder, env, desk / ".log")
        else:
            monkeypatch.chdir(folder)
            # line numbers in a traceback are those of the page
            exec(compile("\n" * block.line + block.code, str(page), "exec"), names)


def test_every_block_is_of_a_known_kind_and_left_out_for_a_reason() -> None:
    for page in (README, *PAGES):
        for block in blocks_of(page):
            assert block.language in LANGUAGES, f"{page}:{block.line}"
            if "not run" in block.note:
                assert not block.runs, f"{page}:{block.line}: no reason given"


def slugs_of(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and mkdocs make them."""
    tokens = tokens_of(page)
    headings = [tokens[i + 1] for i, token in enumerate(tokens) if token.type == "heading_open"]
    texts = ["".join(part.content for part in heading.children or ()) for heading in headings]
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower()) for text in texts}


def links_of(page: Path) -> Iterator[str]:
    for token in tokens_of(page):
        for part in token.children or ():
            target = part.attrGet("href") if part.type == "link_open" else part.attrGet("src")
            if target:
                yield str(target)


def exists_in_code(name: str) -> bool:
    """Return whether a dotted name is a module of the package or something in one."""
    module, _, rest = name.rpartition(".")
    if importlib.util.find_spec(module) is None:
        return False
    return hasattr(importlib.import_module(module), rest)


@pytest.mark.parametrize("page", WITH_LINKS, ids=lambda page: page.relative_to(REPOSITORY).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    for link in links_of(page):
        if re.match(r"https?://", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert target.is_relative_to(REPOSITORY), link
        if DOCS in page.parents:
            assert target.is_relative_to(DOCS), f"{link} is not part of the site"
        if anchor.startswith("mtpcr_geo."):
            assert exists_in_code(anchor), link
        elif anchor:
            assert anchor in slugs_of(target), link


def test_readme_is_short_and_begins_with_the_two_commands() -> None:
    lines = README.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 140
    assert [block.language for block in blocks_of(README)[:2]] == ["sh", "sh"]
    assert blocks_of(README)[1].line < 10
    assert all(len(block.code.splitlines()) == 1 for block in blocks_of(README)[:2])


def test_pictures_are_small_and_used() -> None:
    pictures = {path for path in (DOCS / "images").iterdir() if path.suffix in (".png", ".jpg")}
    shown = {(page.parent / link).resolve() for page in WITH_LINKS for link in links_of(page)}
    assert pictures <= shown
    for path in pictures:
        assert path.stat().st_size < LARGEST_PICTURE, path.name


class Fetched(HTMLParser):
    """Collects what a page makes a browser fetch from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        # links to click on, and the canonical address, are fetched by nobody
        address = values.get("src", "")
        if tag == "link" and values.get("rel") not in ("canonical", "next", "prev"):
            address = values.get("href", "")
        if re.match(r"(https?:)?//", address):
            self.found.append(address)


@pytest.mark.slow
def test_site_is_built_strictly_and_fetches_nothing(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="the extra docs is not installed")
    pytest.importorskip("mkdocstrings", reason="the extra docs is not installed")
    command = ["-m", "mkdocs", "build", "--strict", "--quiet", "-f", ".mkdocs.yml", "-d", str(tmp_path)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(REPOSITORY), os.environ.get("PYTHONPATH", "")))}
    done = subprocess.run(
        [sys.executable, *command], cwd=REPOSITORY, env=env, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert {page.with_suffix("").name for page in PAGES} <= {page.stem for page in pages}
    for page in pages:
        text = page.read_text(encoding="utf-8")
        fetched = Fetched()
        fetched.feed(text)
        assert not fetched.found, page
        # the theme fetches a script where a page has such a diagram
        assert 'class="mermaid"' not in text, page
        assert "<!-- generated" not in text, page
    for sheet in tmp_path.rglob("*.css"):
        assert not re.search(r"""(@import|url\()\s*['"]?(https?:)?//""", sheet.read_text(encoding="utf-8"))
