# SPDX-License-Identifier: Apache-2.0
"""Work with recordings of surround cameras: describe their rig, compute and score depth, train, play them live."""

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from cvcdepth_core.errors import CvcDepthError, NotPromotedError
from cvcdepth_ros.commands import (
    bench,
    check,
    evaluate,
    export,
    finetune,
    import_weights,
    inspect,
    networks,
    play,
    pretrain,
    rig,
    run,
    simulate,
)
from cvcdepth_ros.console import styled
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.process_setup import openmp_environment

PROGRAM = "cvcdepth"
"""The program's name in examples, messages and results. ROS users know it as `bag_replay` too."""


class Command(Protocol):
    """The interface of each module of `cvcdepth_ros.commands`."""

    SUMMARY: str
    """One line for the list of commands; what may follow is for the command's own help."""
    EXAMPLES: tuple[str, ...]
    """Command lines, without the program's name."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options, importing nothing heavy."""

    def execute(self, arguments: argparse.Namespace) -> None:
        """Do the work; CvcDepthError says why it failed. `arguments.usage_error(text)` ends it as wrong use."""


COMMANDS: Mapping[str, Command] = {
    "inspect": inspect,
    "check": check,
    "rig": rig,
    "run": run,
    "evaluate": evaluate,
    "finetune": finetune,
    "import": import_weights,
    "play": play,
    "bench": bench,
    "export": export,
    "simulate": simulate,
    "pretrain": pretrain,
    "networks": networks,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code: 0, 1 when the job failed, 3 when a training was not promoted.

    Wrong use ends by SystemExit(2).
    """
    os.environ.update(openmp_environment())  # before a command loads torch
    program = "bag_replay" if Path(sys.argv[0]).name == "bag_replay" else PROGRAM
    given = sys.argv[1:] if arguments is None else arguments
    try:
        if not given:  # as `ros2` does
            build_parser(program).print_help()
            return 0
        parsed = build_parser(program).parse_args(given)
        parsed.execute(parsed)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read our output (`| head`) is gone; without this the interpreter complains once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except NotPromotedError as error:
        return _fail(program, str(error), code=3)
    except (CvcDepthError, OSError) as error:
        return _fail(program, str(error))
    except KeyboardInterrupt:
        return _fail(program, "interrupted")
    return 0


def build_parser(program: str) -> argparse.ArgumentParser:
    """Return the parser of all commands; `program` is the name that its usage shows."""
    parser = argparse.ArgumentParser(**_texts(program, str(__doc__), [f"{name} --help" for name in COMMANDS]))
    parser.add_argument("--version", action="version", version=f"%(prog)s {package_version()}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        headline = command.SUMMARY.splitlines()[0]
        subparser = commands.add_parser(
            name, help=headline, **_texts(f"{program} {name}", command.SUMMARY, command.EXAMPLES)
        )
        command.add_arguments(subparser)
        subparser.set_defaults(execute=command.execute, usage_error=subparser.error)
    return parser


def _texts(program: str, description: str, examples: Sequence[str]) -> dict[str, Any]:
    lines = "".join(f"\n  {PROGRAM} {example}" for example in examples)
    return {
        "prog": program,
        "description": description,
        "epilog": f"examples:{lines}",
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


def _fail(program: str, reason: str, code: int = 1) -> int:
    print(f"{styled(f'{program}:', 'red', sys.stderr)} {' '.join(reason.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
