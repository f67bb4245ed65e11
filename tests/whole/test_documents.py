# SPDX-License-Identifier: Apache-2.0
"""What documents, docstrings and comments name is there: files, modules, names, sections, hooks."""

import ast
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from repository import ROOT

PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PACKAGES = ("cvcdepth_core", "cvcdepth_ros")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
TEXTS = [
    *PAGES,
    *SOURCES,
    *(path for folder in ("tests", "tools", "benchmarks", "fuzz") for path in sorted((ROOT / folder).rglob("*.py"))),
    *(path for folder in ("config", "security") for path in sorted((ROOT / folder).rglob("*.*ml"))),
    *(ROOT / name for name in ("CHANGELOG.rst", "Makefile", "pyproject.toml", "setup.py", "setup.cfg", "MANIFEST.in")),
]
FOLDERS = "cvcdepth_core|cvcdepth_ros|tests|tools|config|docs|benchmarks|fuzz|launch|security|requirements|samples"
PATH = re.compile(rf"(?<![\w/.{{}}-])((?:{FOLDERS})/[\w./-]*\w)(?![\w<{{*(])")
ANY_NAME = re.compile(r"/[A-Z][A-Z_]+(?=[./]|$)")
MADE_WHILE_RUNNING = ("fuzz/found", "fuzz/findings", "docs/ablation_table.md")


def test_a_path_that_is_named_leads_to_a_file_or_folder():
    assert [f"{text.relative_to(ROOT)}: {path}" for text in TEXTS for path in missing_paths(text)] == []


def missing_paths(text: Path) -> list[str]:
    """Paths of this repository that the text names, which are not there; with capitals they stand for any name."""
    named = sorted({path.rstrip(".") for path in PATH.findall(text.read_text(encoding="utf-8"))})
    missing = (path for path in named if not (ROOT / path).exists())
    return [path for path in missing if not path.startswith(MADE_WHILE_RUNNING) and not ANY_NAME.search(path)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_link_leads_to_a_file_and_to_a_heading_in_it(page: Path):
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")) if "://" not in link]
    assert [link for link in links if not leads_somewhere(page, link)] == []


def leads_somewhere(page: Path, link: str) -> bool:
    file, _, heading = link.partition("#")
    target = page.parent / file if file else page
    if not heading:
        return target.exists()
    return target.exists() and heading in {anchor(line) for line in target.read_text(encoding="utf-8").splitlines()}


def anchor(line: str) -> str | None:
    """What GitHub calls a heading in links."""
    heading = re.fullmatch(r"#+ (.+)", line)
    return re.sub(r"[^\w -]", "", heading[1].lower()).replace(" ", "-") if heading else None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_dotted_name_of_our_packages_is_there(page: Path):
    named = set(re.findall(r"\bcvcdepth_(?:core|ros)(?:\.[a-zA-Z_]\w*)+", page.read_text(encoding="utf-8")))
    assert [name for name in sorted(named) if not is_there(name)] == []


def is_there(dotted: str) -> bool:
    """Whether it is a module, or a name that one defines."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:count])
        for source in (place.with_suffix(".py"), place / "__init__.py"):
            if source.exists():
                return all(part in source.read_text(encoding="utf-8") for part in parts[count:])
    return False


def test_every_module_that_the_architecture_page_names_is_there():
    named = set(re.findall(r"`((?:\w+/)?\w+\.py|\w+/)`", ARCHITECTURE))
    assert len(named) > 60
    places = [ROOT, *(ROOT / package for package in PACKAGES)]
    assert [name for name in sorted(named) if not any((place / name).exists() for place in places)] == []


def test_every_class_and_function_that_the_architecture_page_names_is_there():
    without_code = re.sub(r"```.*?```|<!-- rooms: made.*rooms: end -->", "", ARCHITECTURE, flags=re.DOTALL)
    camel, snake = r"[A-Z]\w*[a-z]\w*", r"[a-z]+(?:_[a-z]+)+"
    named = set(re.findall(rf"`({camel}|{snake})(?:\(\w*\))?`", without_code))
    defined = {name for source in SOURCES for name in names_in(source)}
    assert sorted(named - defined - {"CameraInfo", *PACKAGES, "target_T_source", "context_T_target"}) == []


def names_in(source: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name):
            yield node.id


def test_a_section_of_the_method_that_is_cited_is_on_the_page():
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    headings = set(re.findall(r"^## (\d+)\. ", page, re.MULTILINE))
    texts = "\n".join(path.read_text(encoding="utf-8") for path in TEXTS if path.suffix in (".py", ".yaml"))
    groups = re.findall(r"method sections? ([\d, and]+)", texts)
    cited = [number for group in groups for number in re.findall(r"\d+", group)]
    assert len(cited) >= 18
    assert set(cited) <= headings


def test_the_citation_file_names_this_version_and_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == ElementTree.parse(ROOT / "package.xml").findtext("version")
    assert citation["license"] == "Apache-2.0"
    paper = citation["preferred-citation"]
    assert paper["type"] == "conference-paper"
    assert [author["family-names"] for author in paper["authors"]] == ["Ding", "Jiang", "Li", "Chen", "Huang"]
    assert paper["url"] in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_hooks_before_a_commit_are_what_make_lint_runs():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (recipe,) = re.findall(r"^lint: .*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    hooks: list[dict[str, Any]] = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    programs = [" ".join(line.split()[:2]) for line in recipe.replace(" --check", "").splitlines()]
    assert [hook["entry"].removesuffix(" --force-exclude") for hook in hooks] == programs
