"""The documentation: links, commands, code blocks, generated files, language check, and the built site.

`make docs` checks anchors and the rest of the markup.
"""

import importlib.util
import json
import re
import shlex
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import generated
import pytest
import typer
import yaml
from conftest import REPOSITORY
from test_launch import generate as generate
from test_launch import launch, settings

from benchmarks import cli as benchmarks
from uwb_mitigation.commands import cli
from uwb_mitigation.nodes.support.parameter_tables import ALL_TABLES, TABLES
from uwb_mitigation.recordings.formats import open_recording

PAGES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "models/*.md", "firmware/*.md", "benchmarks/**/*.md")
    for path in REPOSITORY.glob(pattern)
    if not path.is_relative_to(generated.REFERENCE)
)


@cache
def reference_pages() -> frozenset[Path]:
    """Return the pages that `make docs` generates."""
    return frozenset(generated.reference())


def folder_of(page: Path) -> Path:
    """Return the folder that links of a page refer to. A template is filled in into the folder of the reference."""
    return generated.REFERENCE if page.parent == generated.TEMPLATES else page.parent


def links(page: Path) -> list[str]:
    """Return the targets of the links of a page, without code."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    prose = [line for line in text.splitlines() if not line.startswith("    ")]
    return re.findall(r"\]\(([^)\s#]+)", "\n".join(prose))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_between_pages_are_valid(page: Path):
    local = [target for target in links(page) if not re.match(r"[a-z]+:", target)]
    targets = {target: (folder_of(page) / target).resolve() for target in local}
    assert [
        link for link, path in targets.items() if path not in reference_pages() and not path.exists()
    ] == []


def test_every_page_of_the_documentation_can_be_reached():
    read: set[Path] = set()
    waiting = [REPOSITORY / "README.md"]
    while waiting:
        page = waiting.pop()
        if page.parent == generated.REFERENCE and (template := generated.TEMPLATES / page.name).is_file():
            page = template
        if page in read or page.suffix != ".md" or not page.is_file():
            continue
        read.add(page)
        waiting += [(folder_of(page) / target).resolve() for target in links(page) if "://" not in target]
    assert {page for page in PAGES if page.is_relative_to(REPOSITORY / "docs")} <= read


# Commands and code blocks.


NODES = {
    "driver": ("driver",),
    "mitigator": ("mitigator",),
    "locator": ("locator",),
    "pipeline": ("driver", "mitigator", "locator"),
    "monitor": (),
    "px4": ("px4",),
    "viewer": ("viewer",),
}
BLOCK = re.compile(r"^(?:```(?:console|sh|bash)?\n(.*?)^```|((?:    .*\n|\n)+))", re.MULTILINE | re.DOTALL)
# Lines of drawings may start with the name of a node.
COMMAND = re.compile(
    r"\s*(?:\.venv/bin/)?(?:(?:uwb-mitigation|make|ros2|python -m benchmarks) |(?:driver|mitigator|pipeline) --ros)"
)


ALIKE = {f".venv/bin/{node}": ["ros2", "run", "uwb_mitigation", node] for node in NODES}


@cache
def typed(page: Path) -> list[list[str]]:
    """Return the command lines in the code blocks of a page as words, without comments and line continuations."""
    blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
    lines = "\n".join(fenced or indented for fenced, indented in blocks).replace("\\\n", " ").splitlines()
    commands = [shlex.split(line, comments=True) for line in lines if COMMAND.match(line)]
    return [[*ALIKE.get(words[0], [words[0].removeprefix(".venv/bin/")]), *words[1:]] for words in commands]


def lines_of(*start: str) -> list:
    return [
        pytest.param(words[len(start) :], id=f"{page.stem}: {' '.join(words)}")
        for page in PAGES
        for words in typed(page)
        if words[: len(start)] == list(start)
    ]


COMMANDS: dict[str, Any] = {
    "uwb-mitigation": typer.main.get_command(cli.app),
    "python -m benchmarks": typer.main.get_command(benchmarks.app),
}


@pytest.mark.parametrize(
    ("start", "words"),
    [pytest.param(start, *one.values, id=one.id) for start in COMMANDS for one in lines_of(*start.split())],
)
def test_commands_on_pages_exist_with_their_options(start: str, words: list[str]):
    command = COMMANDS[start]
    while hasattr(command, "commands"):
        assert words[0] in command.commands
        command, words = command.commands[words[0]], words[1:]
    assert [parameter.name for parameter in command.params if not parameter.help] == []
    names = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    assert {word.partition("=")[0] for word in words if word.startswith("-")} <= names | {"--help"}


@pytest.mark.parametrize("words", lines_of("make"))
def test_make_targets_on_pages_exist(words: list[str]):
    targets = re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.M)
    assert [word for word in words if "=" not in word and word not in targets] == []


def test_scripts_and_modules_in_python_commands_exist():
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    scripts = set(re.findall(r"\bpython3? ([\w/]+/\w+\.py)", text))
    assert len(scripts) > 5
    assert [script for script in sorted(scripts) if not (REPOSITORY / script).is_file()] == []
    modules = set(re.findall(r"\bpython3? -m ([\w.]+)", text))
    assert [module for module in sorted(modules) if importlib.util.find_spec(module) is None] == []


def check_parameters(node: str, values: dict[str, object]) -> None:
    rows = {row.name: row for name in NODES[node] for row in ALL_TABLES[name]}
    for name, value in values.items():
        if name not in ("use_sim_time", "qos_overrides"):
            rows[name].check(value)


@pytest.mark.parametrize("words", lines_of("ros2", "run", "uwb_mitigation"))
def test_nodes_on_pages_have_the_given_parameters(words: list[str]):
    node, *options = words
    assert node in NODES
    pairs = [option for flag, option in pairwise(options) if flag == "-p"]
    check_parameters(
        node, {name: yaml.safe_load(value) for name, value in (pair.split(":=") for pair in pairs)}
    )
    remapped = [option.split(":=")[0] for flag, option in pairwise(options) if flag == "-r"]
    assert set(remapped) <= {"__node", "uwb/range_raw", "uwb/range_corrected", "uwb/pose"}
    values = [*pairs, *(option for flag, option in pairwise(options) if flag in ("-r", "--params-file"))]
    assert set(options) <= {"--ros-args", "-p", "-r", "--params-file", *values}


@pytest.mark.parametrize("words", lines_of("ros2", "param", "set"))
def test_parameters_set_on_pages_are_live(words: list[str]):
    node, name, value = words
    (row,) = [row for row in TABLES[node.removeprefix("/")] if row.name == name]
    assert row.live
    row.check(yaml.safe_load(value))


@pytest.mark.parametrize("words", lines_of("ros2", "launch", "uwb_mitigation"))
def test_launch_commands_start_nodes(words: list[str], generate, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("robot.yaml", "left.yaml", "right.yaml"):
        Path(name).write_text("/**: {ros__parameters: {source: serial, port: /dev/ttyACM0}}")
    Path("drive.mcap").touch()
    file, values = words[0], dict(word.split(":=", 1) for word in words[1:])
    if file == "nav2.launch.py":
        # It hands the arguments that are not for Nav2 on.
        nav2 = {entity.values[0] for entity in generate(file) if entity.kind == "argument"}
        assert {"map", "params_file"} <= nav2 & set(values)
        file, values = (
            "uwb.launch.py",
            {"locate": "true"} | {n: v for n, v in values.items() if n not in nav2},
        )
    for node in launch(generate, file, **values):
        rows = {row.name: row for row in ALL_TABLES.get(node.executable, ())}
        for name in settings(node).keys() & rows.keys():
            rows[name].check(settings(node)[name])


def test_parameter_files_on_pages_contain_known_parameters():
    files = [
        yaml.safe_load(block)
        for page in PAGES
        for block in re.findall(r"^```yaml\n(.*?)^```", page.read_text(), re.M | re.S)
    ]
    assert any("/**" in file for file in files)
    for file in files:
        if "/**" in file:  # otherwise another file, such as anchors
            check_parameters("pipeline", file["/**"]["ros__parameters"])


# Pages and the code that they describe.


def test_source_on_the_page_is_read_corrected_and_written_to_a_bag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    page = (REPOSITORY / "docs" / "guides" / "recordings.md").read_text()
    module, use, _ = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    (example,) = re.findall(r"^```json\n(.*?)^```", page, re.M | re.S)
    row = json.loads(example)
    row["cir"] = [[abs(900 - 6 * abs(tap - 8)) // (1 + abs(tap - 8)), 40] for tap in range(170)]
    lost = {**row, "range": None}
    (tmp_path / "json_lines.py").write_text(module)
    (tmp_path / "anchor.jsonl").write_text("".join(json.dumps(r) + "\n" for r in (row, lost, row)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    exec(compile(use, "docs/guides/recordings.md", "exec"), {})
    assert capsys.readouterr().out.count("4.310 m -> ") == 2
    with open_recording(tmp_path / "anchor.mcap") as recording:
        records = list(recording)
    assert [(r.measurement.tag_id, r.measurement.sequence, r.truth.range_m) for r in records] == [
        (7, 0, pytest.approx(4.02)),
        (7, 2, pytest.approx(4.02)),
    ]
    assert len(records[0].measurement.cir) == 170


def test_committed_generated_files_are_up_to_date():
    stale = [
        path.name
        for path, text in generated.committed_files().items()
        if path.read_text(encoding="utf-8") != text
    ]
    assert not stale, "run: python docs/generated.py"
