# SPDX-License-Identifier: Apache-2.0
"""List every name that users type or read; the tests compare the lists with the committed ones.

    python tools/public_surface.py            # print the lists of this checkout
    python tools/public_surface.py --write    # after adding a name on purpose: write the committed lists anew

The lists are made from the code itself: from argparse, pydantic, setup.py, the launch file, a short evaluation of the
sample, and a node that runs. The node's list needs ROS; without it, that list is left as it is.
"""

import argparse
import ast
import contextlib
import csv
import io
import json
import os
import re
import runpy
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import ndiff
from importlib.util import find_spec
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin
from unittest import mock

from pydantic import BaseModel

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "samples" / "pandaset_002_excerpt"
PACKAGE_LIST = ROOT / "tests" / "whole" / "public_surface.txt"
NODE_LIST = ROOT / "tests" / "with_ros" / "node" / "public_surface.txt"

_HEADER = "# Every public name, made by: python tools/public_surface.py --write\n"
_CONSTRAINTS = ("gt", "ge", "lt", "le", "multiple_of", "min_length", "max_length", "pattern", "allow_inf_nan")
_CAMERAS = ("front_left", "front_right", "front", "left", "right", "back")
_PATIENCE_SECONDS = 20.0

Sections = Mapping[str, Sequence[str]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the lists, or write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the committed lists")
    parser.add_argument("--only", choices=("package", "node"), help="one of the lists")
    options = parser.parse_args(arguments)
    for name, (path, sections) in {"package": (PACKAGE_LIST, package), "node": (NODE_LIST, node)}.items():
        if options.only not in (None, name):
            continue
        if name == "node" and find_spec("rclpy") is None:
            print(f"{path.relative_to(ROOT)}: needs ROS, left as it is", file=sys.stderr)
        elif options.write:
            path.write_text(text(sections()), encoding="utf-8")
        else:
            print(text(sections()), end="")
    return 0


def text(sections: Sections) -> str:
    """Return the list as it is committed."""
    parts = [f"\n[{title}]\n" + "".join(f"{line}\n" for line in lines) for title, lines in sections.items()]
    return _HEADER + "".join(parts)


def difference(committed: str, found: str) -> str:
    """Return the lines that differ, and what to do; nothing for equal lists."""
    lines = [line for line in ndiff(committed.splitlines(), found.splitlines()) if not line.startswith(" ")]
    advice = (
        "Users rely on these names. If the change is meant: python tools/public_surface.py --write, and CHANGELOG.rst"
    )
    return "\n".join([*lines, advice]) if lines else ""


def package() -> Sections:
    """Return what can be listed without ROS."""
    metrics, columns = evaluation_names()
    return {
        "setup.py": list(installed_names()),
        "command line": list(command_line()),
        "exit codes": list(exit_codes()),
        "launch arguments": list(launch_arguments()),
        "parameter file": list(parameter_file()),
        "rig file": list(fields(_rig_file_model())),
        "training configuration": list(training_fields()),
        "checkpoint": list(checkpoint_names()),
        "metrics.json": metrics,
        "per_frame.csv": columns,
    }


def installed_names() -> Iterator[str]:
    """Name the programs, extras and shared files that setup.py declares."""
    with mock.patch("setuptools.setup") as setup, _in_root():
        runpy.run_path(str(ROOT / "setup.py"))
    declared = setup.call_args.kwargs
    yield f"name {declared['name']}"
    yield f"python {declared['python_requires']}"
    yield from (f"program {script}" for script in declared["entry_points"]["console_scripts"])
    yield from (f"extra {name}" for name in declared["extras_require"])
    yield from sorted(f"file {folder}/{Path(file).name}" for folder, files in declared["data_files"] for file in files)


def command_line() -> Iterator[str]:
    """Give a line for every argument of every command: its spelling, choices, default and whether it is required."""
    from cvcdepth_ros.bag_replay import build_parser

    parser = build_parser("cvcdepth")
    yield from _arguments("cvcdepth", parser)
    for name, command in _subcommands(parser).items():
        yield from _arguments(f"cvcdepth {name}", command)


def exit_codes() -> Iterator[str]:
    """Say with which code the program ends after what, as it does it."""
    from cvcdepth_core import errors
    from cvcdepth_ros import bag_replay

    reasons = {
        "done": None,
        "CvcDepthError": errors.CvcDepthError(),
        "OSError": OSError(),
        "KeyboardInterrupt": KeyboardInterrupt(),
        "NotPromotedError": errors.NotPromotedError(),
    }
    command = mock.Mock(SUMMARY="summary", EXAMPLES=())
    for reason, error in reasons.items():
        command.execute.side_effect = error
        with mock.patch.object(bag_replay, "COMMANDS", {"command": command}), _silence():
            yield f"{bag_replay.main(['command'])} {reason}"
    try:
        with _silence():
            bag_replay.main(["--no-such-option"])
    except SystemExit as ended:
        yield f"{ended.code} wrong use"


def launch_arguments() -> Iterator[str]:
    """Name the arguments that the launch files declare, with their defaults."""
    for path in sorted((ROOT / "launch").glob("*.py")):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "DeclareLaunchArgument":
                default = next(word.value for word in call.keywords if word.arg == "default_value")
                shown = repr(default.value) if isinstance(default, ast.Constant) else "(computed)"
                yield f"{path.name} {ast.literal_eval(call.args[0])}:={shown}"


def parameter_file() -> Iterator[str]:
    """Name the parameters that config/surround_depth.yaml sets."""
    import yaml

    content = yaml.safe_load((ROOT / "config" / "surround_depth.yaml").read_text(encoding="utf-8"))
    for node_name, groups in content.items():
        for group, parameters in groups.items():
            yield from (f"{node_name} {group} {name}: {value!r}" for name, value in parameters.items())


def training_fields() -> Iterator[str]:
    """Name the fields of a training configuration, and what shipped files use beside them."""
    import yaml

    from cvcdepth_core.training.config import TrainingConfig

    files = (ROOT / "config" / "training").rglob("*.yaml")
    used = {key for file in files for key in yaml.safe_load(file.read_text(encoding="utf-8"))}
    yield from sorted(used - TrainingConfig.model_fields.keys())
    yield from fields(TrainingConfig)


def checkpoint_names() -> Iterator[str]:
    """Name what a checkpoint file holds: metadata, tensors' prefixes, and the fields of the spec."""
    import torch
    from safetensors import safe_open

    from cvcdepth_core.networks.checkpoint import save_checkpoint
    from cvcdepth_core.networks.registry import DepthModelSpec

    spec = DepthModelSpec(height=64, width=64, min_depth=1.0, max_depth=80.0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        save_checkpoint(path, spec, {"x": torch.zeros(1)}, {"x": torch.zeros(1)})
        with safe_open(path, framework="pt") as file:
            header = file.metadata()
            yield f"metadata cvcdepth_format_version = {header.pop('cvcdepth_format_version')}"
            yield from (f"metadata {key}" for key in sorted(header))
            yield from (f"tensors {key.removesuffix('x')}*" for key in sorted(file.keys()))
    yield from (f"cvcdepth_spec {line}" for line in fields(DepthModelSpec))


def evaluation_names() -> tuple[list[str], list[str]]:
    """Return the keys of metrics.json and the columns of per_frame.csv, from an evaluation of two sets."""
    from cvcdepth_ros.bag_replay import main as cvcdepth

    with tempfile.TemporaryDirectory() as folder, _silence():
        options = ["--predictor", "constant", "--height", "64", "--width", "96", "--duration", "0.3", "--no-report"]
        if cvcdepth(["evaluate", str(SAMPLE), "-o", folder, "--quiet", *options]):
            raise SystemExit("the sample could not be evaluated")
        metrics = json.loads((Path(folder) / "metrics.json").read_text(encoding="utf-8"))
        with (Path(folder) / "per_frame.csv").open(encoding="utf-8") as file:
            columns = next(csv.reader(file))
    return list(_keys(metrics)), columns


def node() -> Sections:
    """Return what the node declares, and advertises once it is active. Needs ROS."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    import rclpy

    from cvcdepth_ros.node.surround_node import SurroundDepthNode

    rclpy.init()
    try:
        with tempfile.TemporaryDirectory() as folder:
            running = SurroundDepthNode()
            cameras = rclpy.create_node("cameras")
            parameters = _declared_parameters(running)
            diagnostics = _diagnostics(cameras)
            _activate(running, cameras, Path(folder))
            _await_images(running, cameras)
            _spin_until(lambda: len(diagnostics) > 1, "diagnostics of the active node", running, cameras)
            found = {
                "parameters": _with_changeability(running, parameters),
                **_graph(running, cameras),
                "parameters for each topic": _overrides(running),
                "diagnostics before the first image": [line for lines in diagnostics.values() for line in lines],
            }
            running.trigger_deactivate()
            return found
    finally:
        rclpy.shutdown()


# ---- argparse


def _arguments(command: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        if not isinstance(action, argparse._HelpAction | argparse._SubParsersAction):
            yield f"{command} {_argument(action)}"
    for group in parser._mutually_exclusive_groups:
        names = " | ".join(action.option_strings[0] for action in group._group_actions)
        yield f"{command} one of {names}{' (required)' if group.required else ''}"


def _argument(action: argparse.Action) -> str:
    words = ["/".join(action.option_strings)] if action.option_strings else []
    if action.nargs != 0:
        words.append(_value(action))
    if isinstance(action, argparse._AppendAction):
        words.append("(repeatable)")
    if action.option_strings and action.required:
        words.append("(required)")
    if action.default not in (None, False, argparse.SUPPRESS, [], 0.0):
        words.append(f"= {action.default}")
    documented = re.search(r"\[([^][]*)\]$", action.help or "")
    return " ".join([*words, *([documented[0]] if documented else [])])


def _value(action: argparse.Action) -> str:
    if action.choices is not None:
        return "{" + ",".join(map(str, action.choices)) + "}"
    names = action.metavar or action.dest
    several = {"+": " ...", "*": " ... (or none)"}.get(str(action.nargs), "")
    return (names if isinstance(names, str) else " ".join(names)) + several


def _subcommands(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    found: Mapping[str, argparse.ArgumentParser] = commands.choices
    return found


# ---- pydantic


def fields(model: type[BaseModel], prefix: str = "", default: BaseModel | None = None) -> Iterator[str]:
    """Name the fields of a model and of those inside it: type, constraints, default."""
    for name, field in model.model_fields.items():
        value = field.get_default() if default is None else getattr(default, name)
        inner = _model_in(field.annotation)
        is_section = inner is not None and inner is field.annotation
        if not is_section or field.is_required():
            end = ", required" if field.is_required() else f" = {_plain(value)!r}"
            yield f"{prefix}{name}: {_type(field.annotation)}{_constraints(field.metadata)}{end}"
        if inner is not None:
            below = f"{prefix}{name}{'[]' if get_origin(field.annotation) is tuple else ''}."
            yield from fields(inner, below, value if is_section and isinstance(value, BaseModel) else None)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = (_model_in(inner) for inner in get_args(annotation) if get_origin(annotation) is not Literal)
    return next((model for model in found if model is not None), None)


def _type(annotation: Any) -> str:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " | ".join(map(repr, inner))
    if origin in (Union, UnionType):
        return " | ".join(map(_type, inner))
    if origin is tuple:
        several = inner[-1] is Ellipsis
        return f"list of {_type(inner[0])}" if several else f"[{', '.join(map(_type, inner))}]"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "fields"
    return {type(None): "null", Path: "path"}.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _constraints(metadata: Sequence[Any]) -> str:
    found = {
        kind: getattr(constraint, kind)
        for constraint in metadata
        for kind in _CONSTRAINTS
        if getattr(constraint, kind, None) is not None
    }
    return "".join(f", {kind} {value}" for kind, value in found.items())


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _rig_file_model() -> type[BaseModel]:
    from cvcdepth_core.rig.rig_file import RigLayout

    return RigLayout


# ---- JSON


def _keys(value: Any) -> Iterator[str]:
    """Name every key in a JSON value; {a,b} hold the same keys, <camera> stands for the name of any camera."""
    if isinstance(value, list):
        merged = {key: inner for element in value if isinstance(element, dict) for key, inner in element.items()}
        yield from (f"[].{below}" for below in _keys(merged))
    if isinstance(value, dict):
        alike: dict[tuple[str, ...], list[str]] = {}
        for key, inner in value.items():
            names = alike.setdefault(tuple(_keys(inner)), [])
            name = "<camera>" if key in _CAMERAS else key
            names.extend([name] if name not in names else [])
        for belows, names in alike.items():
            group = names[0] if len(names) == 1 else f"{{{','.join(names)}}}"
            dotted = (below if below.startswith("[") else f".{below}" for below in belows)
            yield from (group + below for below in dotted) if belows else (group,)


# ---- ROS

# Enough to be complete, so that neither /tf_static nor tf2_msgs is needed.
_RIG_FILE = """
cameras:
  - name: front
    image_topic: /front/image_raw
    camera_info_topic: /front/camera_info
    base_T_camera: {translation: [0.0, 0.0, 0.0], rotation: [0.5, -0.5, 0.5, -0.5]}
  - name: back
    image_topic: /back/image_raw
    camera_info_topic: /back/camera_info
    base_T_camera: {translation: [0.0, 0.0, 0.0], rotation: [0.5, -0.5, -0.5, 0.5]}
"""


def _declared_parameters(running: Any) -> dict[str, str]:
    """Return what an unconfigured node says of each parameter."""
    from rclpy.parameter import Parameter

    # start_type_description_service came with ROS 2 Jazzy, and is every node's.
    names = sorted(running._parameters.keys() - {"start_type_description_service"})
    found = {}
    for name, described in zip(names, running.describe_parameters(names), strict=True):
        kind = Parameter.Type(described.type).name.lower()
        ranges = [
            f", {limit.from_value:g} to {limit.to_value:g}{f' step {limit.step:g}' if limit.step else ''}"
            for limit in (*described.integer_range, *described.floating_point_range)
        ]
        read_only = ", read-only" if described.read_only else ""
        constraints = f", {described.additional_constraints}" if described.additional_constraints else ""
        value = running.get_parameter(name).value
        found[name] = f"{name}: {kind}{''.join(ranges)}{constraints}{read_only} = {value!r}"
    return found


def _activate(running: Any, cameras: Any, folder: Path) -> None:
    """Publish two cameras, one raw and one compressed, and have the node subscribe them."""
    from rclpy.parameter import Parameter
    from sensor_msgs.msg import CompressedImage, Image

    (folder / "rig.yaml").write_text(_RIG_FILE, encoding="utf-8")
    cameras.create_publisher(Image, "/front/image_raw", 1)
    cameras.create_publisher(CompressedImage, "/back/image_raw", 1)
    small = {"rig": str(folder / "rig.yaml"), "untrained": True, "height": 64, "width": 64, "backend": "torch_eager"}
    running.set_parameters([Parameter(name, value=value) for name, value in small.items()])
    running.trigger_configure()
    running.trigger_activate()
    if running.failure:
        raise SystemExit(running.failure)


def _await_images(running: Any, cameras: Any) -> None:
    """Spin until both image topics are subscribed."""
    topics = ("/front/image_raw", "/back/image_raw")
    subscribed = cameras.get_subscriptions_info_by_topic
    _spin_until(lambda: all(map(subscribed, topics)), f"subscriptions of {' and '.join(topics)}", running)


def _spin_until(condition: Callable[[], bool], what: str, *nodes: Any) -> None:
    import rclpy

    deadline = time.monotonic() + _PATIENCE_SECONDS
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"waited in vain for {what}")
        for one in nodes:
            rclpy.spin_once(one, timeout_sec=0.1)


def _diagnostics(cameras: Any) -> dict[str, list[str]]:
    """Return what will hold, by status, the names of status and values in the last diagnostics."""
    from diagnostic_msgs.msg import DiagnosticArray

    found: dict[str, list[str]] = {}

    def keep(message: Any) -> None:
        for status in message.status:
            name = re.sub("front|back", "<camera>", status.name)
            found[name] = [name, *(f"{name}: {value.key}" for value in status.values)]

    cameras.create_subscription(DiagnosticArray, "/diagnostics", keep, 10)
    return found


def _with_changeability(running: Any, parameters: Mapping[str, str]) -> list[str]:
    """Say of each parameter whether the active node takes a new value."""
    from rclpy.parameter import Parameter

    lines = []
    for name, line in parameters.items():
        same = Parameter(name, value=running.get_parameter(name).value)
        (answer,) = running.set_parameters([same])
        lines.append(f"{line}, {'changeable while active' if answer.successful else 'fixed while active'}")
    return lines


def _graph(running: Any, cameras: Any) -> Sections:
    """Return what others see of the active node."""
    name, namespace = running.get_name(), running.get_namespace()
    quality = {
        "published topics": cameras.get_publishers_info_by_topic,
        "subscribed topics": cameras.get_subscriptions_info_by_topic,
    }
    topics = {
        "published topics": cameras.get_publisher_names_and_types_by_node(name, namespace),
        "subscribed topics": cameras.get_subscriber_names_and_types_by_node(name, namespace),
    }
    services = cameras.get_service_names_and_types_by_node(name, namespace)
    lines = {
        title: {f"{_general(topic)}: {kinds[0]}, {_quality(quality[title](topic), name)}" for topic, kinds in found}
        for title, found in topics.items()
    }
    # get_type_description came with ROS 2 Jazzy, and is every node's.
    own = [f"{service}: {kinds[0]}" for service, kinds in services if not service.endswith("/get_type_description")]
    return {"node": [f"{namespace}{name}"], **{title: sorted(found) for title, found in lines.items()}, "services": own}


def _quality(endpoints: Sequence[Any], node_name: str) -> str:
    profile = next(endpoint.qos_profile for endpoint in endpoints if endpoint.node_name == node_name)
    return f"{profile.reliability.name.lower()}, {profile.durability.name.lower()}"


def _overrides(running: Any) -> list[str]:
    """Name the qos_overrides parameters of the active node."""
    return sorted({_general(name) for name in running._parameters if name.startswith("qos_overrides")})


def _general(name: str) -> str:
    """Put <camera> in the place of cameras' names."""
    return re.sub(r"/(front|back)/", "/<camera>/", name)


# ---- surroundings


@contextlib.contextmanager
def _in_root() -> Iterator[None]:
    """Be in the checkout's folder; contextlib.chdir is not there before Python 3.11."""
    former = Path.cwd()
    os.chdir(ROOT)
    try:
        yield
    finally:
        os.chdir(former)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
