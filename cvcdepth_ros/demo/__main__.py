# SPDX-License-Identifier: Apache-2.0
"""Play a recording to the live node over DDS, record what the node publishes, and show it.

Player, node and recorder are processes of their own, as on a vehicle. One folder gets it all: a picture of every set,
demo.html, demo.json, the recording of the node's outputs, the rig file, the node's parameters, and the logs.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from cvcdepth_core.errors import ConfigError, CvcDepthError, first_validation_message
from cvcdepth_core.rig.rig_file import RigLayout, load_rig_layout
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.console import positive, progress_bar
from cvcdepth_ros.demo.pace import manageable_rate
from cvcdepth_ros.demo.recorded_lidar import RecordedLidar
from cvcdepth_ros.demo.result import DemoResult
from cvcdepth_ros.demo.sheets import SheetWriter
from cvcdepth_ros.end_to_end.live_run import LiveOutcome, LiveRun
from cvcdepth_ros.end_to_end.paths import DemoPaths
from cvcdepth_ros.end_to_end.processes import children
from cvcdepth_ros.end_to_end.received import Output, ReceivedSets, node_outputs, sent_sets
from cvcdepth_ros.installation import package_version, require_ros
from cvcdepth_ros.settings import MatchingSettings, ModelSettings

SAMPLE = Path(__file__).parents[2] / "samples" / "pandaset_002_excerpt"
NODE = "/surround_depth"

_TOLERANCE_SECONDS = MatchingSettings().tolerance
_SAMPLE_CREDIT = "Recording: PandaSet by Hesai and Scale AI, CC BY 4.0"
_EXAMPLE = """example:
  python -m cvcdepth_ros.demo --output output/demo
  python -m cvcdepth_ros.demo --output output/drive --recording drive.mcap --checkpoint model.safetensors
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return 0 when every set was matched and every published one received, else 1."""
    options = _parse(arguments)
    try:
        result = run(options)
    except (CvcDepthError, OSError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("demo: interrupted", file=sys.stderr)
        return 130
    for problem in result.problems():
        print(f"demo: {problem}", file=sys.stderr)
    return 1 if result.problems() else 0


def run(options: argparse.Namespace) -> DemoResult:
    """Play the recording to the node, write what it publishes and print a summary; DemoError when a process fails."""
    model = _model(options)
    require_ros("the demo")
    paths = DemoPaths(options.output)
    paths.prepare()
    if model.notice:
        print(model.notice)
    with children(paths.logs) as family:
        live = LiveRun(family, paths, NODE)
        live.write_rig(options.recording)
        setup = Setup.from_rig_file(options.recording, model, paths)
        setup.write_parameters(paths)
        rate = options.rate or setup.manageable_rate()
        print(f"playing {setup.recording.name} at {rate:.3g} times real time")
        outcome = live.play(setup.recording, rate, options.duration, setup.outputs)
    result = _show(setup, paths, outcome)
    print(f"\n{result.text()}\n\npictures  {paths.sheets}\npage      {paths.page}\nresult    {paths.result}")
    if model.notice:
        print(model.notice)
    return result


@dataclass(frozen=True)
class Setup:
    """The recording that is played, and the node's configuration for it."""

    recording: Path
    layout: RigLayout
    model: ModelSettings
    parameters: dict[str, Any]
    """The node's parameters."""
    outputs: list[Output]

    @classmethod
    def from_rig_file(cls, recording: Path, model: ModelSettings, paths: DemoPaths) -> "Setup":
        """Return the setup for the rig file that `paths` names."""
        layout = load_rig_layout(paths.rig)
        parameters = {
            "use_sim_time": True,
            "rig": str(paths.rig.absolute()),
            "tolerance": _TOLERANCE_SECONDS,
            **model.model_dump(exclude_defaults=True),
        }
        outputs = node_outputs(NODE, layout.names, layout.anchor_camera)
        return cls(recording, layout, model, parameters, outputs)

    def write_parameters(self, paths: DemoPaths) -> None:
        """Write the node's parameter file."""
        content = {NODE.lstrip("/"): {"ros__parameters": self.parameters}}
        paths.parameters.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")

    def manageable_rate(self) -> float:
        """Return how fast the recording may be played here, which is measured."""
        with open_recording(self.recording) as recording:
            return manageable_rate(recording, self.layout, self.model)

    def notes(self, outcome: LiveOutcome) -> list[str]:
        """Return the lines below every picture."""
        is_sample = self.recording.resolve() == SAMPLE
        source = _SAMPLE_CREDIT if is_sample else f"Recording: {self.recording.name}"
        return [f"Network: {outcome.node.model or 'none ran'}. {source}"]


def _model(options: argparse.Namespace) -> ModelSettings:
    """Return the network of the options; ConfigError names one with an impossible value."""
    if options.checkpoint:
        return ModelSettings.model_validate({"checkpoint": str(options.checkpoint.absolute())})
    if not options.untrained:
        return ModelSettings.model_validate({})
    try:
        return ModelSettings.model_validate({"untrained": True, "height": options.height, "width": options.width})
    except ValidationError as error:
        raise ConfigError(f"--{first_validation_message(error)}") from error


def _show(setup: Setup, paths: DemoPaths, outcome: LiveOutcome) -> DemoResult:
    """Write pictures, result and page of what arrived; return the result."""
    with open_recording(setup.recording) as recording:
        sets = sent_sets(recording, setup.layout, _TOLERANCE_SECONDS, outcome.sent)
        received = ReceivedSets(paths.recording, setup.outputs, sets)
        lidar = RecordedLidar(recording, setup.layout)
        writer = SheetWriter(setup.layout.complete(), lidar, paths.sheets, setup.notes(outcome), setup.model.untrained)
        with progress_bar(outcome.node.published, "sets", label="drawing", decimals=0) as show:
            for number, _ in enumerate(writer.write(received, len(sets)), 1):
                show(number)
    result = DemoResult(
        version=package_version(),
        recording=str(setup.recording),
        rate=outcome.rate,
        parameters=setup.parameters,
        untrained=setup.model.untrained,
        sent=len(sets),
        received=len(writer.jpegs),
        never_sent=dict(received.foreign),
        incomplete={sequence + 1: topics for sequence, topics in received.missing.items()},
        node=outcome.node,
        images_sent=sum(outcome.sent.get(camera.image_topic, 0) for camera in setup.layout.cameras),
        messages_received=outcome.received,
        messages_lost=outcome.lost,
    )
    paths.result.write_text(result.model_dump_json(indent=2) + "\n", encoding="utf-8")
    if writer.jpegs:
        paths.page.write_text(writer.page("Surround depth, computed live", result), encoding="utf-8")
    return result


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="demo", description=__doc__, epilog=_EXAMPLE, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=Path("output/demo"), help="folder for the results [%(default)s]")
    parser.add_argument("--recording", type=Path, default=SAMPLE, help="what is played [the sample]")
    network = parser.add_mutually_exclusive_group()
    network.add_argument("--checkpoint", type=Path, help="trained network [the package's own small one]")
    network.add_argument("--untrained", action="store_true", help="random weights, whose depth means nothing")
    parser.add_argument(
        "--rate",
        type=positive,
        metavar="R",
        help="how many times real time [what this machine manages without dropping a set, measured]",
    )
    parser.add_argument(
        "--duration", type=positive, default=10.0, help="seconds of the recording, at most [%(default)s]"
    )
    parser.add_argument("--height", type=int, default=192, help="untrained network only: rows [%(default)s]")
    parser.add_argument("--width", type=int, default=320, help="untrained network only: columns [%(default)s]")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
