# SPDX-License-Identifier: Apache-2.0
"""`networks`: list the depth networks that a training file or checkpoint can name."""

import argparse
from typing import TYPE_CHECKING

from cvcdepth_ros.commands.arguments import add_json
from cvcdepth_ros.console import print_result, table

if TYPE_CHECKING:
    from cvcdepth_core.networks.registry import NetworkDescription

SUMMARY = """List the depth networks that a training file's `depth.network` can name.

Parameters are in millions, with the encoder that is named and the published widths. A network that sees all cameras
together takes every camera of the rig at once. backend auto takes the first engine that is installed.
docs/networks.md tells what each does, what it costs, and when to choose it."""
EXAMPLES: tuple[str, ...] = ("networks --json",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Print the list."""
    from cvcdepth_core.networks.registry import describe_networks

    found = describe_networks()
    print_result({"networks": [one._asdict() for one in found]}, _text(found), arguments.json)


def _text(found: "list[NetworkDescription]") -> str:
    rows = [
        (
            one.name,
            one.encoder,
            f"{one.parameters / 1e6:.1f}",
            "each alone" if one.independent else "all together",
            ", ".join(one.engines),
        )
        for one in found
    ]
    said = "\n".join(f"{one.name}: {one.summary}" for one in found)
    return f"{table(('network', 'encoder', 'M', 'cameras', 'engines'), rows, (2,), apart=4)}\n\n{said}"
